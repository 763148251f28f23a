"""Rendering a dataset: short-lived processes fill shards, here or on a cluster; what is there already is kept."""

from __future__ import annotations

import copy
import json
import math
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from nlt.data.engines import Died, Engine, Local, Process, find_engine
from nlt.data.files import AnyPath, open_path, remove_leftovers, write_bytes
from nlt.data.render import SampleRenderer
from nlt.data.sample import SPLITS
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import (
    MANIFEST,
    missing_files,
    pilot_name,
    points_name,
    references,
    write_manifest,
    write_shard,
)
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant

# Mitsuba's memory grows with every scene and state: a process renders so many samples and ends.
SAMPLES_PER_JOB = 1024
# Pilot views choose the samples per pixel of a scene's references: their number, and the samples per pixel of a half.
PILOT_VIEWS, PILOT_SPP = 4, 32


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
    _choose_reference_spp(spec, directory, missing)
    _announce(spec, directory, _shards(spec, missing), engine)
    _run(spec, directory, engine, partial(_render, spec, str(directory), variant.name))
    return directory


def _shards(spec: DatasetSpec, missing: Iterable[str]) -> list[Shard]:
    names = set(missing)
    return [shard for shard in spec.shards() if shard.name in names]


def _choose_reference_spp(spec: DatasetSpec, directory: AnyPath, missing: Iterable[str]) -> None:
    """Choose the samples per pixel of each scene's references and write them down.

    This is done here, once and before any shard: samples of one scene, whose workers may run on different machines,
    must all have the same number, and it must stay the same when a killed generation is resumed.
    """
    for scene, description in enumerate(spec.descriptions):
        if pilot_name(scene) not in missing:
            continue
        try:
            mse = Process(_pilot, spec, scene).result()
        except Died as error:
            raise UserError(f"{description.file}: the renderer died on a pilot view ({error})") from None
        pilot = min(PILOT_SPP, spec.reference_spp)
        spp = needed_spp(spec, mse)
        found = {"spp": spp, "predicted_mse": mse * pilot / spp, "pilot_spp": pilot, "pilot_mse": mse}
        write_bytes(directory / pilot_name(scene), json.dumps(found, indent=1).encode())
        most = ", the most that is allowed" if found["predicted_mse"] > spec.reference_mse else ""
        print(f"{description.name}: references of 2 x {spp} spp{most}; predicted MSE {found['predicted_mse']:.1e}")


def needed_spp(spec: DatasetSpec, mse: float) -> int:
    """The samples per pixel at which halves whose MSE is `mse` on the pilot views reach `reference_mse`.

    The MSE is taken to fall with the inverse of the samples per pixel. They are rounded up to a power of two.
    """
    pilot = min(PILOT_SPP, spec.reference_spp)
    needed = max(pilot, pilot * mse / spec.reference_mse)
    return min(spec.reference_spp, 2 ** math.ceil(math.log2(needed)))


def _pilot(spec: DatasetSpec, scene: int) -> float:
    """The MSE between two halves of a reference, as displayed: the mean over the pilot views of a scene."""
    import torch  # not at the top, because processes that render samples do not need it

    from nlt.metrics.display import display

    render = SampleRenderer(spec, scene)
    spp = min(PILOT_SPP, spec.reference_spp)
    evaluated = [(split, index) for split in ("test", "val") for index in range(spec.count(split))]
    errors = []
    for k, (split, index) in enumerate(evaluated[:PILOT_VIEWS]):
        camera = render.place(split, index)
        # No split has this number, so no sample has these seeds: the choice must not depend on the references' noise.
        seeds = np.random.SeedSequence([spec.seed, len(SPLITS), scene, k]).generate_state(2)
        halves = torch.from_numpy(np.stack([render.radiance(camera, spp, int(seed)) for seed in seeds])).double()
        a, b = display(halves, render.description.exposure)
        errors.append(float((a - b).square().mean()))
    return float(np.mean(errors))


def _with_reference_spp(spec: DatasetSpec, spp: int) -> DatasetSpec:
    """The spec with a fixed number of samples per pixel for its references, as `SampleRenderer` reads it."""
    fixed = copy.copy(spec)  # unlike dataclasses.replace, this keeps the descriptions that the user's files gave
    fixed.reference_spp, fixed.reference_mse = spp, 0.0
    return fixed


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
            mean = round(np.mean([reference["spp"] for reference in references(directory, spec)]))
            train, evaluated = Process(_measure, _with_reference_spp(spec, mean)).result()
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
    directory = open_path(place)
    chosen = _with_reference_spp(spec, references(directory, spec)[job.scene]["spp"])
    fill(SampleRenderer(chosen, job.scene, threads), directory, job, tick)


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
