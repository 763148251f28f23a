"""Rendering a dataset: short-lived processes fill shards, here or on a cluster; what is there already is kept."""

from __future__ import annotations

import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from tqdm import tqdm

from nlt.data.engines import Died, Engine, Local, Process, find_engine
from nlt.data.files import AnyPath, open_path, remove_leftovers
from nlt.data.render import SampleRenderer
from nlt.data.sample import SPLITS
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import MANIFEST, missing_files, points_name, write_manifest, write_shard
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant

# Mitsuba's memory grows with every scene and state: a process renders so many samples and ends.
SAMPLES_PER_JOB = 1024


@dataclass(frozen=True)
class Job:
    """What one process renders: shards of a scene, and the scene's points if `points`."""

    scene: int
    shards: tuple[Shard, ...]
    points: bool


def generate(
    spec: DatasetSpec,
    root: str | AnyPath,
    workers: int | None = None,
    scheduler: str = "local",
    slurm: Mapping[str, str] | None = None,
) -> AnyPath:
    """Render what is missing of a dataset and return its directory.

    Killed at any time and run again, it redoes at most the unfinished shards, with the same bytes. Two at a time
    on the same directory do each other no harm.

    Args:
        root: of datasets: a directory or an fsspec URL, for several machines one that all of them see.
        workers, scheduler, slurm: as `nlt.data.engines.find_engine`.

    Raises:
        UserError: a scene is wrong, a worker failed twice, or the disk has no room.
    """
    directory = spec.directory(root)
    missing = missing_files(directory, spec)
    if not missing and (directory / MANIFEST).exists():
        return directory
    if isinstance(directory, Path):
        directory = directory.absolute()  # workers elsewhere have other working directories
    engine = find_engine(scheduler, workers, slurm or {})
    remove_leftovers(directory)
    variant = choose_variant()
    write_manifest(directory, spec, f"{variant.name}: {variant.reason}")
    print(f"rendering with {variant.name}: {variant.reason}", flush=True)
    _announce(spec, directory, _shards(spec, missing), engine)
    _run(spec, directory, engine, partial(_render, spec, str(directory), variant.name))
    return directory


def _shards(spec: DatasetSpec, missing: Iterable[str]) -> list[Shard]:
    names = set(missing)
    return [shard for shard in spec.shards() if shard.name in names]


def _announce(spec: DatasetSpec, directory: AnyPath, shards: list[Shard], engine: Engine) -> None:
    """Say what it will take before it starts; refuse what the disk cannot hold."""
    samples = {split: sum(s.stop - s.start for s in shards if s.split == split) for split in SPLITS}
    size = sum(count * spec.nbytes(split) for split, count in samples.items())
    cost = f"{size / 1e9:.2f} GB"
    if isinstance(directory, Path):
        free = shutil.disk_usage(directory).free
        if size > free:
            room = f"the dataset needs {size / 1e9:.1f} GB, {free / 1e9:.1f} GB are free"
            raise UserError(f"{directory}: no space left on disk: {room}")
        cost += f" of {free / 1e9:.0f} GB free"
    if isinstance(engine, Local):  # other machines may be faster or slower than this one
        try:
            train, evaluated = Process(_measure, spec).result()
        except Died as error:
            raise UserError(f"the renderer died while it was tried out ({error})") from None
        seconds = (samples["train"] * train + (samples["val"] + samples["test"]) * evaluated) / engine.workers
        cost += f", about {seconds / 60:.1f} min"
    print(f"{directory}: {sum(samples.values())} samples to render, {engine.workers} side by side, {cost}", flush=True)


def plan(spec: DatasetSpec, missing: list[str], workers: int) -> list[Job]:
    """The files that are missing, dealt out to jobs."""
    jobs, shards = [], _shards(spec, missing)
    for scene in range(len(spec.scenes)):
        mine = [shard for shard in shards if shard.scene == scene]
        most = max(1, min(SAMPLES_PER_JOB // spec.shard_size, -(-len(shards) // workers)))
        points = points_name(scene) in missing
        # Shards of evaluated splits cost more: deal them out.
        count = -(-len(mine) // most)
        parts = [mine[k::count] for k in range(count)] or [[]]
        jobs += [Job(scene, tuple(part), points and k == 0) for k, part in enumerate(parts) if part or points]
    return jobs


def _run(spec: DatasetSpec, directory: AnyPath, engine: Engine, work: Callable) -> None:
    """Run what is missing."""
    left = lambda: sum(shard.stop - shard.start for shard in _shards(spec, missing_files(directory, spec)))
    total, died = left(), dict[Job, str]()
    jobs = plan(spec, missing_files(directory, spec), engine.workers)
    with (
        tqdm(total=total, unit="sample", desc="rendering", file=sys.stderr, mininterval=1.0) as bar,
        closing(engine.run(work, jobs, died)) as ticks,
    ):
        for ticked in ticks:
            bar.update((total - left() if ticked is None else ticked) - bar.n)
        bar.update(total - left() - bar.n)
    for job, reason in died.items():
        raise UserError(f"rendering {spec.scenes[job.scene]}: a worker died twice ({reason})")
    if missing := missing_files(directory, spec):
        raise UserError(f"{directory}: still without {missing[0]}: do all machines see this directory?")


def _render(spec: DatasetSpec, place: str, variant: str, job: Job, threads: int, tick: Callable[[int], None]) -> None:
    """A job, in a process of its own."""
    os.environ["NLT_VARIANT"] = variant  # the same on every machine
    fill(SampleRenderer(spec, job.scene, threads), open_path(place), job, tick)


def fill(render: SampleRenderer, directory: AnyPath, job: Job, tick: Callable[[int], None]) -> None:
    """Render a job of `render`'s scene and write it; `tick(n)` is called after every n samples."""
    if job.points:
        write_shard(directory / points_name(job.scene), [render.points()])
    for shard in job.shards:
        path = directory / shard.name
        if path.exists():  # another run has been faster
            tick(shard.stop - shard.start)
        else:
            render_shard(render, path, shard, tick)


def render_shard(render: SampleRenderer, path: AnyPath, shard: Shard, tick: Callable[[int], None]) -> None:
    """Render and write the samples of a shard."""
    samples = []
    for index in range(shard.start, shard.stop):
        samples.append(render.sample(shard.split, index))
        tick(1)
    write_shard(path, samples)


def _measure(spec: DatasetSpec) -> tuple[float, float]:
    """Seconds for a training and for an evaluated sample, one worker, warm."""
    render = SampleRenderer(spec, 0, 1)
    seconds = []
    for split in ("train", "test"):
        for _ in range(2):
            start = time.perf_counter()
            render.sample(split, 0, rest=True)
            last = time.perf_counter() - start
        seconds.append(last)
    return seconds[0], seconds[1]
