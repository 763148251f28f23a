"""`nlt data stats`: the cost of a sample by field, and the estimated cost of the paper's dataset on this machine."""

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nlt.config import read_configs
from nlt.data.engines import Died, Process, available_cpus
from nlt.data.files import open_path
from nlt.data.generate import SAMPLES_PER_JOB, TIMED_SPP, timed_spp
from nlt.data.render import SampleRenderer
from nlt.data.sample import BUFFERS, DIRECT, FIELDS, SPLITS
from nlt.data.spec import DatasetSpec
from nlt.data.store import read_spec, references, write_shard
from nlt.errors import UserError
from nlt.paths import CONFIGS

# Rendering stages of a sample, and the fields that each stage produces.
STAGES = {
    "state, view": ("camera_matrix", "world_to_view", "translation", "present"),
    "noisy": ("noisy",),
    "noisy_input": ("noisy_input",),
    "target": ("target",),
    "G-buffer": (*BUFFERS, *DIRECT),
    "photons": ("photon_origin", "photon_direction", "photon_flux", "photon_hit", "photon_valid"),
    "reference": ("reference_a", "reference_b"),
    "storing": (),
}
_WARM_UP, _SAMPLES = 2, 4


def stats(place: str, workers: int | None = None) -> str:
    """Return a report of bytes and seconds by field, at the dataset's and at the paper's size, with total costs.

    Raise UserError if there is no dataset or the renderer crashes. Seconds are averaged over all scenes. The dataset's
    references count with the samples per pixel chosen from pilot views, the paper's with the maximum allowed.
    """
    spec = read_spec(open_path(place))
    spp = [reference["spp"] for reference in references(open_path(place), spec)]
    full = read_configs([str(CONFIGS / "scale" / "paper.yaml")])["data"]["dataset"]
    paper = DatasetSpec(spec.scenes, spec.experiment, **full)
    workers = workers or available_cpus()
    with tqdm(desc="measuring", total=2 * len(spec.scenes), unit="scene") as bar:
        ours = _measure(spec, spp, workers, bar)
        theirs = _measure(paper, [paper.reference_spp] * len(spp), workers, bar)
    lines = [f"{'field':18}{'bytes':>10}{'at paper size':>15}{'ms':>10}{'at paper size':>15}"]
    for stage, fields in STAGES.items():
        timed = f"{1e3 * ours[stage]:>10.1f}{1e3 * theirs[stage]:>15.1f}"
        if len(fields) != 1:
            lines.append(f"{stage:18}{'':>25}{timed}")
        for name in fields:
            field = FIELDS[name]
            sizes = "".join(f"{field.nbytes(s.sizes('test')):>{width},}" for s, width in ((spec, 10), (paper, 15)))
            lines.append(f"{name if len(fields) == 1 else '  ' + name:18}{sizes}{timed if len(fields) == 1 else ''}")
    lines += [
        f"Seconds are measured in {workers} concurrent processes, each with {_SAMPLES} samples per scene after "
        f"{_WARM_UP} for warm-up; references are timed at up to {TIMED_SPP} spp and extrapolated linearly. "
        f"Totals are extrapolated from these samples.",
        _cost("this dataset", spec, ours, workers),
        _cost("the paper's", paper, theirs, workers),
    ]
    return "\n".join(lines)


def _cost(name: str, spec: DatasetSpec, seconds: dict[str, float], workers: int) -> str:
    """Return a line with the total time and size of all scenes."""
    per_evaluated = sum(seconds[stage] for stage in STAGES)
    per_train = per_evaluated - seconds["reference"]
    scenes, evaluated = len(spec.scenes), spec.val + spec.test
    processes = -(-(spec.train + evaluated) // SAMPLES_PER_JOB)
    hours = (spec.train * per_train + evaluated * per_evaluated + processes * seconds["start"]) / workers / 3600
    size = sum(spec.count(split) * spec.nbytes(split) for split in SPLITS)
    return (
        f"{name}: {scenes} scenes x ({spec.train:,} + {evaluated:,}) samples of {spec.resolution}x{spec.resolution}: "
        f"{scenes * hours:.2f} h with {workers} workers ({1e3 * per_train:.0f} ms per training sample, "
        f"{1e3 * per_evaluated:.0f} ms per evaluated sample, {seconds['start']:.1f} s to start a process), "
        f"{scenes * size / 1e9:.2f} GB"
    )


def _measure(spec: DatasetSpec, spp: list[int], workers: int, bar: tqdm) -> dict[str, float]:
    """Return the mean seconds per sample by stage and, as `start`, the seconds that a process needs to start.

    `spp` lists the samples per pixel of each reference half by scene.
    """
    results = []
    for scene in range(len(spec.scenes)):
        trial = replace(spec, train=_WARM_UP + _SAMPLES, val=0, test=0, reference_spp=spp[scene])
        try:
            runs = [
                Process(_time_samples, trial, scene, max(1, available_cpus() // workers), time.time())
                for _ in range(workers)
            ]
            results += [run.result() for run in runs]
        except Died as error:
            raise UserError(f"the renderer crashed in a trial run ({error})") from None
        bar.update()
    return {stage: float(np.mean([result[stage] for result in results])) for stage in results[0]}


def _time_samples(spec: DatasetSpec, scene: int, threads: int, launched: float) -> dict[str, float]:
    render = SampleRenderer(spec, scene, threads)
    sample = render.sample("train", 0)
    with tempfile.TemporaryDirectory() as folder:
        frames = [laps(render, k, lambda: write_shard(Path(folder) / "shard", [sample])) for k in range(spec.train)]
    seconds = {stage: float(np.mean([frame[stage] for frame in frames[_WARM_UP:]])) for stage in STAGES}
    start = time.time() - launched - sum(seconds.values()) * len(frames)
    seconds["reference"] *= 2 * spec.reference_spp / timed_spp(spec)
    return seconds | {"start": start}


def laps(render: SampleRenderer, k: int, store: Callable[[], None]) -> dict[str, float]:
    """Return the seconds by stage of a training sample, of one reference half at `timed_spp`, and of `store`."""
    spec, trace = render.spec, render.renderer
    seconds: dict[str, float] = {}

    def lap(stage: str, work: Callable[[], Any]) -> Any:
        begin = time.perf_counter()
        result = work()
        seconds[stage] = time.perf_counter() - begin
        return result

    camera = lap("state, view", lambda: render.place("train", k))
    lap("noisy", lambda: trace.radiance(camera, spec.noisy_spp, k))
    lap("noisy_input", lambda: trace.radiance(camera, spec.input_spp, k))
    lap("target", lambda: trace.radiance(camera, spec.target_spp, k))
    lap("G-buffer", lambda: trace.gbuffer(camera, direct=True))
    lap("photons", lambda: trace.photons(spec.num_photons, k))
    lap("reference", lambda: trace.radiance(camera, timed_spp(spec), k))
    lap("storing", store)
    return seconds
