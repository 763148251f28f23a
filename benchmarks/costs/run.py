"""The measurements of benchmarks/bench.py."""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import lightning as L
import numpy as np
import torch
from costs import ceilings
from costs.bare import Bare
from costs.output import BENCH, write_report
from costs.plain import plain
from pydantic import Field, NonNegativeInt, PositiveInt
from tqdm import tqdm

from nlt.config import Settings, parse, read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import LightTransportDataset
from nlt.data.engines import Process
from nlt.data.files import write_bytes
from nlt.data.generate import fill, plan, timed_spp
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec, load_spec
from nlt.data.stats import laps
from nlt.data.store import missing_files, write_manifest, write_shard
from nlt.errors import UserError
from nlt.evaluation.clock import LEAST_FRAMES, Clock, summary
from nlt.evaluation.comparison import all_methods, build_if_untrained
from nlt.evaluation.frames import Frames
from nlt.evaluation.paper import order
from nlt.evaluation.provenance import origin, surroundings
from nlt.metrics.quantities import NETWORK_STAGES
from nlt.models.factory import build, load_method, method_class
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.models.policy import accelerate, default_device
from nlt.paths import config_names, find_config
from nlt.rendering.variant import choose_variant
from nlt.training import quiet, trainer_defaults
from nlt.waiting import as_the_user_said

_DATASET, _MODEL = ("resolution", "num_points", "num_photons"), ("width", "depth")
# The factors over which the growth of costs is measured, one at a time around the settings.
GRID: dict[str, Sequence[int]] = {
    "resolution": (64, 128, 256, 512, 1024),
    "num_points": (1_000, 3_000, 10_000, 30_000, 100_000),
    "num_photons": (1_000, 3_000, 10_000, 30_000, 100_000),
    "width": (8, 16, 32, 64, 128),
    "batch": (1, 2, 4, 8, 16),
}
_POWER = {"resolution": 2, "width": 2}  # power of a factor by which costs grow at most; 1 for other factors
_SAMPLES = 8  # least number rendered for the frames
_TRAINING_STEPS = _TURNS = 40
_RECORDED = 2  # first calls, in which dr.freeze records; the second, because the first assumes constants
JOURNAL, _SAMPLES_FOLDER = "done.json", "samples"  # in the directory for work in progress
_SAFE = 0.8  # share of the free memory that a measurement may need


class Sizes(Settings):
    """The settings of the dataset, the model and the training; `batch` is the number of frames rendered at once."""

    resolution: int = Field(ge=8)
    num_points: PositiveInt
    num_photons: PositiveInt
    width: PositiveInt = 64
    depth: NonNegativeInt = 3
    batch_size: PositiveInt = 32
    workers: NonNegativeInt = 1
    batch: PositiveInt = 1


class Part(NamedTuple):
    """One measurement: its kind, its method, and the setting that is changed."""

    kind: str
    method: str = ""
    factor: str = ""
    value: int = 0

    def __str__(self) -> str:
        return " ".join(str(word) for word in self if word)


def time_training(
    method: RenderingModule, data: LightTransportDataModule, device: torch.device, precision: Any, seconds: float
) -> dict[str, Any]:
    """Train for up to `seconds`; return images per second, the time of a step and the share of waiting for data."""
    steps = _Steps(seconds, device)
    quiet()
    trainer = L.Trainer(
        max_steps=1 + _TRAINING_STEPS, accelerator="gpu" if device.type == "cuda" else "cpu", devices=1,
        callbacks=[steps], logger=False, enable_checkpointing=False, enable_progress_bar=False,
        enable_model_summary=False, use_distributed_sampler=False, limit_val_batches=0, precision=precision,
    )  # fmt: skip
    trainer.fit(method.train(), datamodule=data)
    whole = [a + b for a, b in zip(steps.waited, steps.computed, strict=True)]
    return {
        "images_per_second": data.batch_size / statistics.median(whole),
        "step_s": statistics.median(whole),
        "step_p95_s": float(np.percentile(whole, 95)),
        "waiting_share": sum(steps.waited) / sum(whole),
        "timed_steps": len(whole),
    }


class Benchmark:
    """Measures costs and writes bench.json, bench.md and the figures; `options` are those of benchmarks/bench.py.

    Raises:
        UserError: a config, method or setting is unknown, there is no such device, or the checkpoint is another
            method's.
    """

    def __init__(self, options: argparse.Namespace) -> None:
        if options.device == "cuda" and not torch.cuda.is_available():
            raise UserError("--device: cuda: this machine has none; use --device cpu")
        self.device = torch.device(options.device) if options.device else default_device()
        self.out, self.seconds, self.checkpoint = Path(options.out), options.seconds, options.checkpoint
        self.work = self.out / ".bench"
        self.done: dict[Part, dict[str, Any]] = {}
        self.files = [str(find_config("data", options.data)), str(find_config("scale", options.scale))]
        self.config = read_configs(self.files)
        self.spec, _ = load_spec(self.files)
        self.methods = sorted(options.methods or all_methods(), key=order)
        self.growth = ["nlt_photons"] if options.growth == [] else options.growth or []
        known = config_names("model")
        for option, names in (("--methods", self.methods), ("--growth", self.growth)):
            for name in names:
                if name not in known:
                    raise UserError(f"{option}: no method {name!r} in configs/model; known are {', '.join(known)}")
        if self.checkpoint and (len(self.methods) != 1 or self.growth):
            raise UserError("--ckpt: holds one method; name only that one with --methods, without --growth")
        given = {**vars(self.spec), **self.config.get("model", {}).get("init_args", {}), **self.config["data"]}
        given = {name: value for name, value in given.items() if name in Sizes.model_fields}
        given |= {name: int(text) if text.isdecimal() else text for name, text in options.changed}
        self.settings: dict[str, int] = parse(Sizes, given, "--set").model_dump()
        self.spec = self._sized(self.settings, 1)
        self._renderer = cache(lambda scene: SampleRenderer(self.spec, scene))
        if self.checkpoint:
            self.settings |= {name: self._loaded(self.methods[0]).hparams[name] for name in _MODEL}

    def run(self) -> None:
        """Measure, write and print. After a kill, the same command at the same commit goes on where it was."""
        begun, start, load = origin(), time.time(), os.getloadavg()
        code = {name: begun[name] for name in ("command", "commit", "uncommitted_changes")}
        journal = self.work / JOURNAL
        stored = json.loads(journal.read_text()) if journal.exists() else {}
        if stored.get("code") == code:
            self.done = {Part(*part): result for part, result in stored["done"]}
        else:  # of another command or other code
            shutil.rmtree(self.work, ignore_errors=True)
        parts = self.parts()
        with tqdm(parts, desc="measuring", unit="part", file=sys.stderr) as bar:
            for part in bar:
                bar.set_postfix_str(str(part))
                if part not in self.done:
                    self.done[part] = self.measure(part)
                    write_bytes(journal, json.dumps({"code": code, "done": list(self.done.items())}).encode())
        manifest = {
            **begun,
            **surroundings(self.device),
            "clock": {"seconds": self.seconds, "least_frames": LEAST_FRAMES},
            "load_average": {"before": load, "after": os.getloadavg()},
            "wall_time_s": round(time.time() - start, 1),
            "scenes": self.spec.scenes,
            "experiment": self.spec.experiment,
            "settings": self.settings,
            "methods": self.methods,
            "checkpoint": self.checkpoint,
        }
        rows = [{**part._asdict(), **self.done[part]} for part in parts]
        write_bytes(self.out / BENCH, (json.dumps({"manifest": manifest, "parts": rows}, indent=1) + "\n").encode())
        write_report(self.out)
        shutil.rmtree(self.work)
        print((self.out / "bench.md").read_text())

    def parts(self) -> list[Part]:
        """Return all measurements in order, those of growth from small to large."""
        trained = [name for name in self.methods if not build_if_untrained(name)]
        parts = [Part("ceilings"), Part("generation"), Part("loading")]
        parts += [Part("frame", name) for name in self.methods] + [Part("training", name) for name in trained]
        for name in self.growth:
            method = self.method(name, self.settings)
            parts += [
                Part("growth", name, factor, value)
                for factor, values in GRID.items()
                if _affects(factor, method)
                for value in sorted({*values, self.settings[factor]})
            ]
        return parts

    # --- data and methods ---

    def _sized(self, settings: Mapping[str, int], count: int) -> DatasetSpec:
        """Return a spec of the settings' size with `count` training samples per scene and no others."""
        sizes: dict[str, Any] = {name: settings[name] for name in _DATASET}
        return replace(self.spec, val=0, test=0, train=count, shard_size=count, **sizes)

    def data(self) -> LightTransportDataModule:
        """Return the data module of the unchanged settings' samples, as in training."""
        dataset = self.dataset(self.settings, self._count())
        root, settings = str(self.work / _SAMPLES_FOLDER), self.settings
        return LightTransportDataModule(dataset.spec, root, settings["batch_size"], settings["workers"])

    def renderer(self, spec: DatasetSpec, scene: int) -> SampleRenderer:
        """Return the renderer of a scene, which is loaded once for all sizes."""
        render = self._renderer(scene)
        render.spec = spec
        return render

    def dataset(self, settings: Mapping[str, int], count: int) -> LightTransportDataset:
        """Return at least `count` rendered samples in training's format; render those that do not exist yet."""
        spec = self._sized(settings, -(-count // len(self.spec.scenes)))
        directory = spec.directory(self.work / _SAMPLES_FOLDER)
        for job in plan(spec, missing_files(directory, spec), 1):
            fill(self.renderer(spec, job.scene), directory, job, lambda *_: None)
        write_manifest(directory, spec, choose_variant().name)
        return LightTransportDataset(directory, spec, "train")

    def method(self, name: str, settings: Mapping[str, int]) -> Method:
        """Return a method with random weights or the checkpoint's."""
        if method := build_if_untrained(name):
            return method
        if self.checkpoint:
            return self._loaded(name)
        file = find_config("model", name)
        config = read_configs([self.files[0], str(file), self.files[1]])
        torch.manual_seed(0)
        arguments = {key: settings[key] for key in _MODEL} | {"num_scenes": len(self.spec.scenes)}
        return build(config, file, **arguments, num_points=settings["num_points"])

    def _loaded(self, name: str) -> RenderingModule:
        method = load_method(str(self.checkpoint), "--ckpt")
        file = find_config("model", name)
        wanted = method_class(read_configs([file]), file)
        if type(method) is not wanted:
            raise UserError(f"--ckpt: {self.checkpoint}: is of {type(method).__name__}, not {wanted.__name__}")
        points = self.settings["num_points"]
        points = min(points, method.hparams.get("max_points") or points)
        for key, here in (("num_points", points), ("num_scenes", len(self.spec.scenes))):
            if key in method.architecture and method.hparams[key] != here:
                raise UserError(
                    f"--ckpt: {self.checkpoint}: has {key}={method.hparams[key]}, these settings have {here}: "
                    "use the --data, --scale and --set num_points it was trained with"
                )
        return method

    # --- the measurements ---

    def measure(self, part: Part) -> dict[str, Any]:
        """Measure a part and return its result, or `skipped` with the reason."""
        measurements: dict[str, Callable[[], dict[str, Any]]] = {
            "ceilings": self._ceilings,
            "generation": self._generation,
            "loading": self._loading,
            "frame": partial(self._frame, part.method),
            "training": partial(self._training, part.method),
            "growth": partial(self._growth, part),
        }
        return measurements[part.kind]()

    def _ceilings(self) -> dict[str, Any]:
        computing = ceilings.computing(self.device, self.seconds)
        return {"computing": computing, "bare_s": ceilings.rendering(self.renderer(self.spec, 0), self.seconds)}

    def _count(self) -> int:
        return max(_SAMPLES, 2 * self.settings["batch_size"])

    def _clock(self, settings: Mapping[str, int], count: int) -> Clock:
        """Return a clock of at least `count` frames."""
        dataset = self.dataset(settings, count)
        frames = Frames(dataset, lambda scene: self.renderer(dataset.spec, scene))
        return Clock(frames, self.device, settings["batch"])

    def _frame(self, name: str) -> dict[str, Any]:
        """Time a method and, interleaved, its plain path; compare the time in the network frame by frame."""
        clock, method = self._clock(self.settings, self._count()), self.method(name, self.settings)
        if not isinstance(method, RenderingModule):
            return self._cost(clock, method)
        paths = {"": accelerate(method, clock.policy, self.device), "plain": plain(method).to(self.device).eval()}
        timed, slow = clock.time_interleaved(paths, 2 * self.seconds).values()
        network = [np.array([_network(frame) for frame in path]) for path in (slow, timed)]
        p5, median, p95 = np.percentile(network[0] / network[1], (5, 50, 95)).tolist()
        least = float(network[0].min() / network[1].min())  # other work only slows a frame
        return {
            **summary(timed),
            **clock.size(method),
            "timed_frames": len(timed),
            "plain": summary(slow),
            "speedup": {"p5": p5, "median": median, "p95": p95, "of_least": least},
            "precision": str(paths[""].unet.conv_out.weight.dtype).removeprefix("torch."),
            "step_flops": clock.flops(method),
        }

    def _cost(self, clock: Clock, method: Method) -> dict[str, Any]:
        timed = clock.time_interleaved({"": accelerate(method, clock.policy, self.device)}, self.seconds)[""]
        return summary(timed) | {"timed_frames": len(timed)} | clock.size(method)

    def _growth(self, part: Part) -> dict[str, Any]:
        """Time a method at a changed setting, unless the next smaller one predicts that it takes too much."""
        settings = self.settings | {part.factor: part.value}
        if settings == self.settings:  # the same as in the other factors
            for done, result in self.done.items():
                if done[:2] == part[:2] and done.value == self.settings[done.factor]:
                    return result
        smaller = [done for done in self.done if done[:3] == part[:3] and done.value < part.value]
        if smaller and (why := self._reason_to_skip(part, max(smaller))):
            return {"skipped": why}
        count = LEAST_FRAMES if part.factor in _DATASET and settings != self.settings else self._count()
        return self._cost(self._clock(settings, count), self.method(part.method, settings))

    def _reason_to_skip(self, part: Part, smaller: Part) -> str:
        """Return why a part is predicted to take too much time or memory, or nothing."""
        last, factor = self.done[smaller], (part.value / smaller.value) ** _POWER.get(part.factor, 1)
        if "skipped" in last:
            return f"{part.factor} {smaller.value:,} was skipped"
        if (predicted := factor * last["time_per_frame_s"]) > self.seconds:
            return f"a frame is predicted to take {predicted:.1f} s, more than {self.seconds:g} s"
        need, free = factor * last.get("peak_memory_bytes", 0), _free_memory(self.device)
        if need > _SAFE * free:
            return f"predicted to need {need / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free"
        return ""

    def _training(self, name: str) -> dict[str, Any]:
        """Measure the trainer's images per second and the share of a step in which it waits for data."""
        size = self.settings["batch_size"]
        step = 3 * size * _network(self.done[Part("frame", name)], "_s") / self.settings["batch"]
        if 2 * step > self.seconds:
            why = f"2 steps of batch {size} are predicted to take {2 * step:.0f} s, more than {self.seconds:g} s"
            return {"skipped": why}
        precision = {**trainer_defaults(), **self.config.get("trainer", {})}.get("precision")
        with as_the_user_said():  # a process of its own, whose threads wait as those of `nlt fit` do
            training = Process(
                time_training, self.method(name, self.settings), self.data(), self.device, precision, self.seconds
            )
        return training.result()

    def _loading(self) -> dict[str, Any]:
        """Measure samples per second of the DataLoader alone, with all fields and CRCs, from cached files."""
        data = self.data()
        data.setup("fit")
        loader = data.train_dataloader()
        count = lambda: sum(len(batch["scene"]) for batch in loader)
        rate = count() / ceilings.timer(count).blocked_autorange(min_run_time=self.seconds / 2).median
        return {"samples_per_second": rate, "bytes_per_second": rate * data.spec.nbytes("train")}

    def _generation(self) -> dict[str, Any]:
        """Measure samples per second of one process and, with interleaved timing, the ratio to a bare loop."""
        spec = self._sized(self.settings, _SAMPLES)
        render = self.renderer(spec, 0)
        bare = Bare(render, frozen=True)
        views = [(render.place("train", k), render.scene.state) for k in range(_SAMPLES)]
        stages: list[dict[str, float]] = []
        ratios: list[float] = []
        begin = time.perf_counter()
        for turn in range(_TURNS):
            if turn >= _RECORDED + LEAST_FRAMES and time.perf_counter() - begin > self.seconds:
                break
            k = turn % _SAMPLES
            start = time.perf_counter()
            sample = render.sample("train", k)
            middle = time.perf_counter()
            camera, state = views[k - 1]  # another view, so that the bare loop moves the objects too
            bare.sample(state, camera, "train", k)
            ratios.append((time.perf_counter() - middle) / (middle - start))
            stages.append(laps(render, k, partial(write_shard, self.work / "shard", [sample])))
        medians = {name: statistics.median(s[name] for s in stages[_RECORDED:]) for name in stages[0]}
        medians["reference"] *= 2 * spec.reference_spp / timed_spp(spec)
        whole = sum(medians.values())
        return {
            "stages_s": medians,
            "train_per_second": 1 / (whole - medians["reference"]),
            "evaluated_per_second": 1 / whole,
            "of_bare_loop": statistics.median(ratios[_RECORDED:]),
        }


class _Steps(L.Callback):
    """Records the seconds that each training step waits for its batch and computes."""

    def __init__(self, seconds: float, device: torch.device) -> None:
        self.waited, self.computed = list[float](), list[float]()
        self.seconds, self.device, self.end = seconds, device, 0.0
        self.begin = self.start = time.perf_counter()

    def on_train_batch_start(self, *_: Any) -> None:
        self.start = time.perf_counter()

    def on_train_batch_end(self, trainer: Any, *_: Any) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        now = time.perf_counter()
        if self.end:  # the first step warms up
            self.waited.append(self.start - self.end)
            self.computed.append(now - self.start)
        self.end = now
        trainer.should_stop = bool(self.waited) and now - self.begin > self.seconds


def _network(seconds: Mapping[str, Any], suffix: str = "") -> float:
    return sum(seconds.get(f"{name}{suffix}", 0.0) for name in NETWORK_STAGES)


def _affects(factor: str, method: Method) -> bool:
    if factor in ("num_points", "num_photons"):
        return any(name.startswith(factor.removeprefix("num_")[:-1]) for name in method.fields)
    return factor != "width" or isinstance(method, RenderingModule)


def _free_memory(device: torch.device) -> float:
    """Return the free memory in bytes, infinite where it is unknown."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return 1024 * float(lines["MemAvailable"].split()[0])
    except (OSError, KeyError):
        return math.inf
