"""Dataset generation: short-lived processes, local or on a cluster, render the shards that do not exist yet."""

import json
import math
import os
import shutil
import sys
import timeit
from collections.abc import Callable, Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from tqdm import tqdm

from nlt.data.engines import Died, Engine, Local, Process, find_engine
from nlt.data.files import AnyPath, open_path, remove_leftovers, write_bytes
from nlt.data.render import SampleRenderer
from nlt.data.sample import SPLITS
from nlt.data.spec import DatasetSpec, Shard
from nlt.data.store import MANIFEST, missing_files, pilot_name, points_name, references, write_manifest, write_shard
from nlt.errors import UserError
from nlt.rendering.variant import choose_variant

# Mitsuba's memory grows with every scene and state, so a process ends after this many samples.
SAMPLES_PER_JOB = 1024
# Number of pilot views per scene, and samples per pixel of each half of a pilot reference.
PILOT_VIEWS, PILOT_SPP = 4, 32
TIMED_SPP = 8  # most samples per pixel of a reference that is only timed
_BAR = "{l_bar}{bar}| [{elapsed}<{remaining}]"  # no counts, because samples differ in cost


@dataclass(frozen=True)
class Job:
    """The work of one process: shards of a scene and, if `needs_points`, the scene's points."""

    scene: int
    shards: tuple[Shard, ...]
    needs_points: bool


def generate(
    spec: DatasetSpec,
    root: str | AnyPath,
    workers: int | None = None,
    scheduler: str = "local",
    slurm: Mapping[str, str] | None = None,
) -> AnyPath:
    """Render the missing files of a dataset and return its directory.

    After being killed at any time, another run renders only the unfinished shards, with the same bytes. Two concurrent
    runs may use the same directory. Every machine that renders must be able to access `root`, a directory or fsspec
    URL. The other arguments are those of `find_engine`.

    Raises:
        UserError: a scene is invalid, a worker died twice, or the disk is too small.
    """
    directory = spec.directory(root)
    missing = missing_files(directory, spec)
    if not missing and (directory / MANIFEST).exists():
        return directory
    if isinstance(directory, Path):
        directory = directory.absolute()  # workers on other machines have other working directories
    engine = find_engine(scheduler, workers, slurm or {})
    size = _check_space(spec, directory, missing)
    remove_leftovers(directory)
    variant = choose_variant()
    write_manifest(directory, spec, f"{variant.name}: {variant.reason}")
    print(f"rendering with {variant.name}: {variant.reason}", flush=True)
    _choose_reference_spp(spec, directory, missing)
    evaluated = _announce(spec, directory, _shards(spec, missing), engine, size)
    cost = {split: 1 if split == "train" else evaluated for split in SPLITS}
    _run(spec, directory, engine, partial(_render, spec, str(directory), variant.name, cost), cost)
    return directory


def _shards(spec: DatasetSpec, missing: Iterable[str]) -> list[Shard]:
    names = set(missing)
    return [shard for shard in spec.shards() if shard.name in names]


def _choose_reference_spp(spec: DatasetSpec, directory: AnyPath, missing: Iterable[str]) -> None:
    """Choose the samples per pixel of each scene's references and store them.

    This happens once, before any shard is rendered, because all samples of a scene must have the same number, even if
    workers run on different machines or a killed generation is resumed.
    """
    for scene, description in enumerate(spec.descriptions):
        if pilot_name(scene) not in missing:
            continue
        try:
            mse, decay = Process(_pilot, spec, scene).result()
        except Died as error:
            raise UserError(f"{description.file}: the renderer crashed on a pilot view ({error})") from None
        pilot = min(PILOT_SPP, spec.reference_spp)
        spp = needed_spp(spec, mse, decay)
        predicted = mse * (pilot / spp) ** decay
        choice = {"spp": spp, "predicted_mse": predicted, "pilot_spp": pilot, "pilot_mse": mse, "decay": decay}
        write_bytes(directory / pilot_name(scene), json.dumps(choice, indent=1).encode())
        limit = ", the maximum allowed" if choice["predicted_mse"] > spec.reference_mse else ""
        print(f"{description.name}: references of 2 x {spp} spp{limit}; predicted MSE {choice['predicted_mse']:.1e}")


def needed_spp(spec: DatasetSpec, mse: float, decay: float) -> int:
    """Return the samples per pixel that reach `reference_mse`, given the `mse` between halves on the pilot views.

    The MSE is assumed to fall with the power `decay` of the samples per pixel, which are rounded up to a power of two
    and limited to `reference_spp`.
    """
    pilot = min(PILOT_SPP, spec.reference_spp)
    needed = max(pilot, pilot * (mse / spec.reference_mse) ** (1 / decay))
    return min(spec.reference_spp, 2 ** math.ceil(math.log2(needed)))


def _pilot(spec: DatasetSpec, scene: int) -> tuple[float, float]:
    """Return the MSE between two reference halves as displayed, averaged over a scene's pilot views, and its decay.

    The decay is the power of the samples per pixel with which the MSE falls. It is less than 1, because the display
    transform clips and compresses the noise of few samples, and tends to 1. So it is taken as the mean of 1 and the
    power between a quarter of the pilot's samples and all of them.
    """
    import torch  # here, because processes that render samples do not need it

    from nlt.display import display

    render = SampleRenderer(spec, scene)
    many = min(PILOT_SPP, spec.reference_spp)
    few = max(1, many // 4)
    evaluated = [(split, index) for split in ("test", "val") for index in range(spec.count(split))]
    errors: dict[int, list[float]] = {few: [], many: []}
    for k, (split, index) in enumerate(evaluated[:PILOT_VIEWS]):
        camera = render.place(split, index)
        # No split has this index, so no sample shares these seeds: the choice must not depend on the references' noise.
        seeds = np.random.SeedSequence([spec.seed, len(SPLITS), scene, k]).generate_state(2)
        for spp, of_views in errors.items():
            halves = torch.from_numpy(np.stack([render.radiance(camera, spp, int(seed)) for seed in seeds])).double()
            a, b = display(halves, render.description.exposure)
            of_views.append(float((a - b).square().mean()))
    noisier, mse = float(np.mean(errors[few])), float(np.mean(errors[many]))
    if few == many or not mse:
        return mse, 1.0
    return mse, (1 + min(1.0, max(0.0, math.log(noisier / mse) / math.log(many / few)))) / 2


def _check_space(spec: DatasetSpec, directory: AnyPath, missing: list[str]) -> str:
    """Return the size of the missing files in words; raise UserError if the disk is too small."""
    size = sum(shard.size * spec.nbytes(shard.split) for shard in _shards(spec, missing))
    size += sum(spec.points_nbytes for scene in range(len(spec.scenes)) if points_name(scene) in missing)
    if not isinstance(directory, Path):
        return f"{size / 1e9:.2f} GB"
    free = shutil.disk_usage(next(folder for folder in directory.parents if folder.is_dir())).free
    if size > free:
        room = f"the dataset needs {size / 1e9:.1f} GB, but only {free / 1e9:.1f} GB are free"
        raise UserError(f"{directory}: no space left on disk: {room}")
    return f"{size / 1e9:.2f} GB of {free / 1e9:.0f} GB free"


def _announce(spec: DatasetSpec, directory: AnyPath, shards: list[Shard], engine: Engine, size: str) -> int:
    """Print the number of samples, their size and the expected time.

    Return how many training samples take as long as one evaluated sample, or 1 if no time was measured.
    """
    samples = {split: sum(s.size for s in shards if s.split == split) for split in SPLITS}
    ratio = 1
    if isinstance(engine, Local):  # other machines may be faster or slower
        try:
            mean = round(np.mean([reference["spp"] for reference in references(directory, spec)]))
            train, evaluated = Process(_measure, replace(spec, train=1, val=0, test=1), mean).result()
        except Died as error:
            raise UserError(f"the renderer crashed in a trial run ({error})") from None
        seconds = (samples["train"] * train + (samples["val"] + samples["test"]) * evaluated) / engine.workers
        size += f", about {seconds / 60:.1f} min"
        ratio = max(1, round(evaluated / train))
    print(f"{directory}: {sum(samples.values())} samples to render, {engine.workers} at a time, {size}", flush=True)
    return ratio


def plan(spec: DatasetSpec, missing: list[str], workers: int) -> list[Job]:
    """Divide the missing files into jobs: as many for each worker, so that none is idle at the end."""
    jobs, shards = [], _shards(spec, missing)
    most = max(1, min(SAMPLES_PER_JOB // spec.shard_size, -(-len(shards) // workers)))  # shards of a job
    multiple = workers // math.gcd(workers, len(spec.scenes))  # of jobs of a scene
    for scene in range(len(spec.scenes)):
        in_scene = [shard for shard in shards if shard.scene == scene]
        needs_points = points_name(scene) in missing
        # Shards of evaluated splits cost more, so they are spread over the jobs.
        count = -(-len(in_scene) // most)
        count = max(min(-(-count // multiple) * multiple, len(in_scene)), int(needs_points))
        jobs += [Job(scene, tuple(in_scene[k::count]), needs_points and k == 0) for k in range(count)]
    return jobs


def _run(spec: DatasetSpec, directory: AnyPath, engine: Engine, work: Callable, cost: Mapping[str, int]) -> None:
    """Run `work` on all jobs; the progress bar counts `cost` for each sample of a split, so that its ETA is right."""
    remaining = lambda: sum(shard.size * cost[shard.split] for shard in _shards(spec, missing_files(directory, spec)))
    total, failures = remaining(), dict[Job, str]()
    jobs = plan(spec, missing_files(directory, spec), engine.workers)
    with (
        tqdm(total=total, bar_format=_BAR, desc="rendering", file=sys.stderr, mininterval=1.0, smoothing=0) as bar,
        closing(engine.run(work, jobs, failures)) as ticks,
    ):
        for ticked in ticks:
            bar.update((total - remaining() if ticked is None else ticked) - bar.n)
        bar.update(total - remaining() - bar.n)
    for job, reason in failures.items():
        raise UserError(f"rendering {spec.scenes[job.scene]}: a worker died twice ({reason})")
    if missing := missing_files(directory, spec):
        raise UserError(f"{directory}: {missing[0]} is still missing; check that all machines see this directory")


def _render(
    spec: DatasetSpec,
    place: str,
    variant: str,
    cost: Mapping[str, int],
    job: Job,
    threads: int,
    tick: Callable[[int], None],
) -> None:
    """Run a job in its own process; `tick` counts the `cost` of every sample."""
    os.environ["NLT_VARIANT"] = variant  # every machine must use the same one
    directory = open_path(place)
    spec.reference_spp = references(directory, spec)[job.scene]["spp"]  # this process has its own spec
    fill(SampleRenderer(spec, job.scene, threads), directory, job, lambda split, n: tick(n * cost[split]))


def fill(render: SampleRenderer, directory: AnyPath, job: Job, tick: Callable[[str, int], None]) -> None:
    """Render and write the files of a job; `tick(split, n)` is called after every n samples of a split."""
    if job.needs_points:
        write_shard(directory / points_name(job.scene), [render.points()])
    for shard in job.shards:
        path = directory / shard.name
        if path.exists():  # another run has rendered it
            tick(shard.split, shard.size)
        else:
            render_shard(render, path, shard, tick)


def render_shard(render: SampleRenderer, path: AnyPath, shard: Shard, tick: Callable[[str, int], None]) -> None:
    """Render and write the samples of a shard."""
    samples = []
    for index in range(shard.start, shard.stop):
        samples.append(render.sample(shard.split, index))
        tick(shard.split, 1)
    write_shard(path, samples)


def timed_spp(spec: DatasetSpec) -> int:
    """Return the samples per pixel at which a reference is timed; its seconds are extrapolated linearly."""
    return min(spec.reference_spp, TIMED_SPP)


def _measure(spec: DatasetSpec, reference_spp: float) -> tuple[float, float]:
    """Return the seconds of a training sample and of a test sample, with one thread after a warm-up.

    References are timed with few samples per pixel, because many would take minutes, and extrapolated.
    """
    spec.reference_spp = timed_spp(spec)  # this process has its own spec
    render = SampleRenderer(spec, 0, threads=1)
    seconds = lambda *sample: timeit.repeat(partial(render.sample, *sample), number=1, repeat=2)[-1]
    reference = seconds("test", 0, ("reference_a", "reference_b")) * (reference_spp / spec.reference_spp - 1)
    return seconds("train", 0), seconds("test", 0) + reference
