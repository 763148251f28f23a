"""`nlt data stats`: what a sample costs by field, and what the paper's full dataset would cost here."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nlt.data.engines import Died, Process, available_cpus
from nlt.data.files import open_path
from nlt.data.generate import SAMPLES_PER_JOB
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec, read_configs
from nlt.data.store import read_spec, references, write_shard
from nlt.errors import UserError
from nlt.paths import CONFIGS

# What is rendered at once, and the fields that come of it.
STAGES = {
    "state, view": ("camera_matrix", "world_to_view", "translation", "present"),
    "noisy": ("noisy",),
    "noisy_input": ("noisy_input",),
    "G-buffer": ("depth", "normal", "albedo", "emission"),
    "photons": ("photon_origin", "photon_direction", "photon_flux", "photon_hit", "photon_valid"),
    "reference": ("reference_a", "reference_b"),
    "storing": (),
}
_WARM_UP, _SAMPLES = 2, 4
_MOST_SPP = 8  # of a reference that is timed


def stats(place: str, workers: int | None = None) -> str:
    """A report: bytes by field of a dataset, seconds by field at its size and at the paper's, the paper's cost.

    Bytes follow from the manifest. Seconds are measured now, in `workers` processes side by side, warm, the mean over
    all scenes; a reference of more than 8 spp is measured at 8 and extrapolated in proportion. The dataset's references
    count with the samples per pixel that its pilot views chose, those at the paper's size with the most allowed.

    Raises:
        UserError: there is no dataset, or the renderer dies.
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
            sizes = "".join(f"{s.fields('test')[name].nbytes(s.sizes):>{w},}" for s, w in ((spec, 10), (paper, 15)))
            lines.append(f"{name if len(fields) == 1 else '  ' + name:18}{sizes}{timed if len(fields) == 1 else ''}")
    lines += [
        f"Seconds: {workers} processes side by side, {_SAMPLES} samples each after {_WARM_UP} in each "
        f"scene; references at {_MOST_SPP} spp at most, extrapolated in proportion. "
        f"Totals are extrapolated from these samples.",
        _cost("this dataset", spec, ours, workers),
        _cost("the paper's", paper, theirs, workers),
    ]
    return "\n".join(lines)


def _cost(name: str, spec: DatasetSpec, seconds: dict[str, float], workers: int) -> str:
    """Of all scenes in total."""
    evaluated = sum(seconds[stage] for stage in STAGES)
    train = evaluated - seconds["reference"]
    scenes, judged = len(spec.scenes), spec.val + spec.test
    processes = -(-(spec.train + judged) // SAMPLES_PER_JOB)
    hours = (spec.train * train + judged * evaluated + processes * seconds["start"]) / workers / 3600
    size = spec.train * spec.nbytes("train") + judged * spec.nbytes("test")
    return (
        f"{name}: {scenes} scenes x ({spec.train:,} + {judged:,}) samples of {spec.resolution}x{spec.resolution}: "
        f"{scenes * hours:.2f} h with {workers} workers ({1e3 * train:.0f} ms a training sample, "
        f"{1e3 * evaluated:.0f} ms an evaluated one, {seconds['start']:.1f} s to start a process), "
        f"{scenes * size / 1e9:.2f} GB"
    )


def _measure(spec: DatasetSpec, spp: list[int], workers: int, bar: tqdm) -> dict[str, float]:
    """Mean seconds per sample by stage, and `start`: what a process costs besides its samples.

    `spp`: the samples per pixel of each half of a scene's references, by scene.
    """
    results = []
    for scene in range(len(spec.scenes)):
        few = replace(spec, train=_WARM_UP + _SAMPLES, val=0, test=0, reference_spp=spp[scene])
        try:
            runs = [
                Process(_time, few, scene, max(1, available_cpus() // workers), time.time()) for _ in range(workers)
            ]
            results += [run.result() for run in runs]
        except Died as error:
            raise UserError(f"the renderer died while it was tried out ({error})") from None
        bar.update()
    return {stage: float(np.mean([result[stage] for result in results])) for stage in results[0]}


def _time(spec: DatasetSpec, scene: int, threads: int, began: float) -> dict[str, float]:
    render = SampleRenderer(spec, scene, threads)
    sample = render.sample("train", 0)
    with tempfile.TemporaryDirectory() as folder:
        frames = [laps(render, k, lambda: write_shard(Path(folder) / "shard", [sample])) for k in range(spec.train)]
    seconds = {stage: float(np.mean([frame[stage] for frame in frames[_WARM_UP:]])) for stage in STAGES}
    start = time.time() - began - sum(seconds.values()) * len(frames)
    seconds["reference"] *= 2 * spec.reference_spp / timed_spp(spec)
    return seconds | {"start": start}


def timed_spp(spec: DatasetSpec) -> int:
    """Samples per pixel at which the reference is timed; its seconds are in proportion."""
    return min(spec.reference_spp, _MOST_SPP)


def laps(render: SampleRenderer, k: int, store: Callable[[], None]) -> dict[str, float]:
    """Seconds by stage of a training sample, and of one half of a reference at `timed_spp`; `store` is timed too."""
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
    lap("G-buffer", lambda: trace.gbuffer(camera))
    lap("photons", lambda: trace.photons(spec.photons, k))
    lap("reference", lambda: trace.radiance(camera, timed_spp(spec), k))
    lap("storing", store)
    return seconds
