"""`nlt bench`: the cost of a frame, a step and a sample, compared with the plain path and the machine's ceilings."""

from __future__ import annotations

import json
import math
import os
import shutil
import statistics
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import lightning as L
import numpy as np
import torch
from tqdm import tqdm

from nlt.bench import ceilings
from nlt.bench.bare import Bare
from nlt.bench.output import BENCH, write_report
from nlt.bench.plain import plain
from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.generate import fill, plan
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec, load_spec
from nlt.data.stats import laps, timed_spp
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
from nlt.models.policy import Policy, accelerate, default_device
from nlt.paths import config_names, find_config
from nlt.rendering.variant import choose_variant
from nlt.training import quiet, trainer_defaults

# The settings of the dataset, the model and the training, and the number of frames rendered at once.
_DATASET, _MODEL, _DATA = ("resolution", "points", "photons"), ("width", "depth"), ("batch_size", "workers")
SETTINGS = (*_DATASET, *_MODEL, *_DATA, "batch")
# The factors over which the growth of costs is measured, one at a time around the settings.
GRID: dict[str, Sequence[int]] = {
    "resolution": (64, 128, 256, 512, 1024),
    "points": (1_000, 3_000, 10_000, 30_000, 100_000),
    "photons": (1_000, 3_000, 10_000, 30_000, 100_000),
    "width": (8, 16, 32, 64, 128),
    "batch": (1, 2, 4, 8, 16),
}
_POWER = {"resolution": 2, "width": 2}  # power of a factor by which costs grow at most; 1 for other factors
_SAMPLES = 8  # least number rendered for the frames
_TRAINING_STEPS = 40
_RECORDED = 2  # first calls, in which dr.freeze records; the second, because the first assumes constants
_JOURNAL, _WORK = "points.jsonl", "samples"  # in the directory for work in progress
_SAFE = 0.8  # share of the free memory that a measurement may need


@dataclass(frozen=True)
class Part:
    """One measurement: its kind, its method, and the setting that is changed."""

    kind: str
    method: str = ""
    factor: str = ""
    value: int = 0

    @property
    def key(self) -> str:
        """The part's name in the journal."""
        return " ".join(str(word) for word in (self.kind, self.method, self.factor, self.value) if word)


def bench(
    out: str,
    data: str = "demo",
    scale: str = "demo",
    methods: list[str] | None = None,
    changed: Mapping[str, str] | None = None,
    checkpoint: str | None = None,
    device: str | None = None,
    seconds: float = 20.0,
    growth: list[str] | None = None,
) -> Path:
    """Measure costs and write bench.json, bench.md and the figures to the directory `out`.

    After a kill, the same command at the same commit reuses the finished measurements.

    Args:
        out: the directory of the results.
        data: a config in configs/data, by name or path.
        scale: a config in configs/scale.
        methods: configs in configs/model; None for all except the ablation's.
        changed: settings, out of `SETTINGS`, that override the configs'.
        checkpoint: weights of the only method; None for random weights.
        device: cpu or cuda; None for cuda where there is one.
        seconds: time limit of a measurement.
        growth: methods whose cost is measured over every factor of `GRID` that affects them.

    Returns:
        `out` as a path.

    Raises:
        UserError: a config, method, setting or device is unknown, or the checkpoint is another method's.
    """
    begun, start, load = origin(), time.time(), os.getloadavg()
    run = _Bench(Path(out), data, scale, methods, changed or {}, checkpoint, device, seconds, growth or [])
    done = run.resume(begun)
    parts = run.parts()
    with tqdm(total=len(parts), desc="measuring", unit="part", file=sys.stderr) as bar:
        for part in parts:
            bar.set_postfix_str(part.key)
            if part.key not in done:
                done[part.key] = run.measure(part, done)
                run.note(part, done[part.key])
            bar.update()
    manifest = {
        **begun,
        **surroundings(run.device),
        "clock": {"seconds": seconds, "least_frames": LEAST_FRAMES},
        "load_average": {"before": load, "after": os.getloadavg()},
        "wall_time_s": round(time.time() - start, 1),
        "scenes": run.spec.scenes,
        "experiment": run.spec.experiment,
        "settings": run.settings,
        "methods": run.methods,
        "checkpoint": checkpoint,
    }
    rows = [{**part.__dict__, **done[part.key]} for part in parts]
    write_bytes(run.out / BENCH, (json.dumps({"manifest": manifest, "parts": rows}, indent=1) + "\n").encode())
    write_report(run.out)
    shutil.rmtree(run.work)
    print((run.out / "bench.md").read_text())
    return run.out


class _Bench:
    """The checked arguments of `bench`, and the measurement of each part."""

    def __init__(
        self,
        out: Path,
        data: str,
        scale: str,
        methods: list[str] | None,
        changed: Mapping[str, str],
        checkpoint: str | None,
        device: str | None,
        seconds: float,
        growth: list[str],
    ) -> None:
        self.out, self.work, self.seconds, self.checkpoint = out, out / ".bench", seconds, checkpoint
        self.device = _device(device)
        self.files = [str(find_config("data", data)), str(find_config("scale", scale))]
        self.config = read_configs(self.files)
        self.spec, _ = load_spec(self.files)
        known = config_names("model")
        self.methods = sorted(methods or all_methods(), key=order)
        for option, names in (("--methods", self.methods), ("--growth", growth)):
            for name in names:
                if name not in known:
                    raise UserError(f"{option}: no method {name!r} in configs/model; known are {', '.join(known)}")
        if checkpoint and (len(self.methods) != 1 or growth):
            raise UserError("--ckpt: holds one method; name only that one with --methods, without --growth")
        self.growth = growth
        self.settings = self._settings(changed)
        self.spec = self._sized(self.settings, 1)
        self._renderer = cache(lambda scene: SampleRenderer(self.spec, scene))
        if checkpoint:
            self.settings |= {name: self._loaded(self.methods[0]).hparams[name] for name in _MODEL}

    def _settings(self, changed: Mapping[str, str]) -> dict[str, int]:
        defaults = {"width": 64, "depth": 3} | self.config.get("model", {}).get("init_args", {})
        loading = {"batch_size": 32, "workers": 1} | self.config["data"]
        settings = {name: getattr(self.spec, name) for name in _DATASET}
        settings |= {name: defaults[name] for name in _MODEL} | {name: loading[name] for name in _DATA} | {"batch": 1}
        for name, text in changed.items():
            if name not in SETTINGS:
                raise UserError(f"--set: {name}: unknown; known are {', '.join(SETTINGS)}")
            least = {"resolution": 8, "workers": 0, "depth": 0}.get(name, 1)
            if not text.isdecimal() or int(text) < least:
                raise UserError(f"--set: {name}: must be a whole number of at least {least}, is {text!r}")
            settings[name] = int(text)
        return settings

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
                if _touches(factor, method)
                for value in sorted({*values, self.settings[factor]})
            ]
        return parts

    # --- the journal of finished measurements ---

    def resume(self, begun: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
        """Return the journal's results, by key, if it is of the same command and code; otherwise begin a new one."""
        same = {name: begun[name] for name in ("command", "commit", "uncommitted_changes")}
        journal, done = self.work / _JOURNAL, dict[str, dict[str, Any]]()
        header, *lines = _read_lines(journal) or [None]
        if header == same:
            done = {line["part"]: line["result"] for line in lines}
        if not done:
            shutil.rmtree(self.work, ignore_errors=True)
        text = [json.dumps(same), *(json.dumps({"part": key, "result": result}) for key, result in done.items())]
        write_bytes(journal, "".join(f"{line}\n" for line in text).encode())
        return done

    def note(self, part: Part, result: dict[str, Any]) -> None:
        """Append a result to the journal."""
        with (self.work / _JOURNAL).open("a") as file:
            file.write(json.dumps({"part": part.key, "result": result}) + "\n")

    # --- data and methods ---

    def _sized(self, settings: Mapping[str, int], count: int) -> DatasetSpec:
        """Return a spec of the settings' size with `count` training samples per scene and no others."""
        sizes: dict[str, Any] = {name: settings[name] for name in _DATASET}
        return replace(self.spec, val=0, test=0, train=count, shard_size=count, **sizes)

    def data(self) -> LightTransportDataModule:
        """Return the data module of the unchanged settings' samples, as in training."""
        dataset = self.dataset(self.settings, self._count())
        batch_size, workers = (self.settings[name] for name in _DATA)
        return LightTransportDataModule(dataset.spec, str(self.work / _WORK), batch_size, workers)

    def renderer(self, spec: DatasetSpec, scene: int) -> SampleRenderer:
        """Return the renderer of a scene, which is loaded once for all sizes."""
        render = self._renderer(scene)
        render.spec = spec
        return render

    def dataset(self, settings: Mapping[str, int], count: int) -> LightTransportDataset:
        """Return at least `count` rendered samples in training's format; render those that do not exist yet."""
        spec = self._sized(settings, -(-count // len(self.spec.scenes)))
        directory = spec.directory(self.work / _WORK)
        for job in plan(spec, missing_files(directory, spec), 1):
            fill(self.renderer(spec, job.scene), directory, job, lambda _: None)
        write_manifest(directory, spec, choose_variant().name)
        return LightTransportDataset(directory, spec, "train")

    def frames(self, settings: Mapping[str, int], count: int) -> Frames:
        """Return frames for the clock."""
        dataset = self.dataset(settings, count)
        return Frames(dataset, lambda scene: self.renderer(dataset.spec, scene))

    def method(self, name: str, settings: Mapping[str, int]) -> Method:
        """Return a method with random weights or the checkpoint's."""
        if self.checkpoint:
            return self._loaded(name)
        file = find_config("model", name)
        config = read_configs([self.files[0], str(file), self.files[1]])
        torch.manual_seed(0)
        arguments = {key: settings[key] for key in _MODEL} | {"num_scenes": len(self.spec.scenes)}
        return build(config, file, **arguments, num_points=settings["points"])

    def _loaded(self, name: str) -> RenderingModule:
        method = load_method(str(self.checkpoint), "--ckpt", self.device)
        file = find_config("model", name)
        wanted = method_class(read_configs([file]), file)
        if type(method) is not wanted:
            raise UserError(f"--ckpt: {self.checkpoint}: is of {type(method).__name__}, not {wanted.__name__}")
        points = self.settings["points"]
        points = min(points, method.hparams["max_points"] or points)
        for key, here in (("num_points", points), ("num_scenes", len(self.spec.scenes))):
            if key in method.architecture and method.hparams[key] != here:
                raise UserError(
                    f"--ckpt: {self.checkpoint}: has {key}={method.hparams[key]}, these settings have {here}: "
                    "use the --data, --scale and --set points it was trained with"
                )
        return method

    # --- the measurements ---

    def measure(self, part: Part, done: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        """Measure a part and return its result, or `skipped` with the reason; `done` holds the earlier results."""
        if part.kind == "ceilings":
            render = self.renderer(replace(self.spec, train=1), 0)
            computing = ceilings.computing(self.device, self.seconds)
            return {"computing": computing, "bare_s": ceilings.rendering(render, self.seconds)}
        if part.kind in ("generation", "loading"):
            return {"generation": self._generation, "loading": self._loading}[part.kind]()
        if part.kind == "training":
            return self._training(part.method, done[Part("frame", part.method).key])
        if part.kind == "frame":
            return self._frame(part.method)
        return self._growth(part, done)

    def _count(self) -> int:
        return max(_SAMPLES, 2 * self.settings["batch_size"])

    def _frame(self, name: str) -> dict[str, Any]:
        clock = Clock(self.frames(self.settings, self._count()), self.device, self.settings["batch"])
        method = self.method(name, self.settings)
        if not isinstance(method, RenderingModule):
            timed = clock.time_interleaved({"": method.eval()}, self.seconds)[""]
            return summary(timed) | {"timed_frames": len(timed)} | clock.size(method)
        fast = accelerate(method, Policy.for_device(self.device), self.device)
        timed, slow = clock.time_interleaved({"": fast, "plain": plain(method)}, 2 * self.seconds).values()
        network = [[_network(frame) for frame in path] for path in (slow, timed)]
        ratios = [s / t for s, t in zip(*network, strict=True)]
        speedup = dict(zip(("p5", "median", "p95"), np.percentile(ratios, (5, 50, 95)).tolist(), strict=True))
        return {
            **summary(timed),
            **clock.size(method),
            "timed_frames": len(timed),
            "plain": summary(slow),
            "speedup": speedup | {"of_least": min(network[0]) / min(network[1])},  # other work only slows a frame
            **_precision_and_flops(clock, method),
        }

    def _growth(self, part: Part, done: Mapping[str, dict[str, Any]]) -> dict[str, Any]:
        settings = self.settings | {part.factor: part.value}
        if settings == self.settings:  # the same as in the other factors
            for other in GRID:
                if result := done.get(replace(part, factor=other, value=self.settings[other]).key):
                    return result
        smaller = [
            (value, done[key])
            for value in (*GRID[part.factor], self.settings[part.factor])
            if value < part.value and (key := replace(part, value=value).key) in done
        ]
        if smaller:
            value, last = max(smaller, key=lambda pair: pair[0])
            if "skipped" in last:
                return {"skipped": f"{part.factor} {value:,} was skipped"}
            factor = (part.value / value) ** _POWER.get(part.factor, 1)
            predicted, free = factor * last["time_per_frame_s"], _free_memory(self.device)
            if predicted > self.seconds:
                return {"skipped": f"a frame is predicted to take {predicted:.1f} s, more than {self.seconds:g} s"}
            if (need := factor * last.get("peak_memory_bytes", 0)) > _SAFE * free:
                return {"skipped": f"predicted to need {need / 2**30:.1f} GiB, but {free / 2**30:.1f} GiB are free"}
        count = LEAST_FRAMES if part.factor in _DATASET and settings != self.settings else self._count()
        clock = Clock(self.frames(settings, count), self.device, settings["batch"])
        method = self.method(part.method, settings)
        timed = clock.time_interleaved({"": method.eval()}, self.seconds)[""]
        return summary(timed) | {"timed_frames": len(timed)} | clock.size(method)

    def _training(self, name: str, frame: Mapping[str, Any]) -> dict[str, Any]:
        """Measure the trainer's images per second and the share of a step in which it waits for data."""
        size = self.settings["batch_size"]
        step = 3 * size * _network(frame, "_s") / self.settings["batch"]
        if 2 * step > self.seconds:
            why = f"2 steps of batch {size} are predicted to take {2 * step:.0f} s, more than {self.seconds:g} s"
            return {"skipped": why}
        data, method = self.data(), self.method(name, self.settings)
        assert isinstance(method, RenderingModule)
        steps = _Steps(self.seconds, self.device)
        precision = {**trainer_defaults(), **self.config.get("trainer", {})}.get("precision")
        quiet()
        trainer = L.Trainer(
            max_epochs=-1, accelerator="gpu" if self.device.type == "cuda" else "cpu", devices=1, callbacks=[steps],
            logger=False, enable_checkpointing=False, enable_progress_bar=False, enable_model_summary=False,
            use_distributed_sampler=False, limit_val_batches=0, precision=precision,
        )  # fmt: skip
        trainer.fit(method.train(), datamodule=data)
        whole = [a + b for a, b in zip(steps.waited, steps.computed, strict=True)]
        return {
            "images_per_second": size / statistics.median(whole),
            "step_s": statistics.median(whole),
            "step_p95_s": float(np.percentile(whole, 95)),
            "waiting_share": sum(steps.waited) / sum(whole),
            "timed_steps": len(whole),
        }

    def _loading(self) -> dict[str, Any]:
        """Measure samples per second of the DataLoader alone, with all fields and CRCs, from cached files."""
        data = self.data()
        data.setup("fit")
        loader = data.train_dataloader()
        rates: list[float] = []
        begin = time.perf_counter()
        while len(rates) < 2 or time.perf_counter() - begin < self.seconds / 2:
            start = time.perf_counter()
            samples = sum(len(batch["scene"]) for batch in loader)
            rates.append(samples / (time.perf_counter() - start))
        rate = statistics.median(rates[1:])
        return {"samples_per_second": rate, "bytes_per_second": rate * data.spec.nbytes("train")}

    def _generation(self) -> dict[str, Any]:
        """Measure samples per second of one process and, with interleaved timing, the ratio to a bare loop."""
        spec = replace(self.spec, train=_SAMPLES)
        render = self.renderer(spec, 0)
        bare = Bare(render, frozen=True)
        views = [(render.place("train", k), render.scene.state) for k in range(_SAMPLES)]
        stages: list[dict[str, float]] = []
        pairs: list[tuple[float, float]] = []
        begin = time.perf_counter()
        while len(pairs) < _RECORDED + LEAST_FRAMES or (
            time.perf_counter() - begin < self.seconds and len(pairs) < _TRAINING_STEPS
        ):
            k = len(pairs) % _SAMPLES
            sample, ours = _timed(partial(render.sample, "train", k))
            camera, state = views[k - 1]  # another view, so that the bare loop moves the objects too
            _, theirs = _timed(partial(bare.sample, state, camera, "train", k))
            pairs.append((ours, theirs))
            stages.append(laps(render, k, partial(write_shard, self.work / "shard", [sample])))
        medians = {name: statistics.median(s[name] for s in stages[_RECORDED:]) for name in stages[0]}
        medians["reference"] *= 2 * spec.reference_spp / timed_spp(spec)
        whole = sum(medians.values())
        return {
            "stages_s": medians,
            "train_per_second": 1 / (whole - medians["reference"]),
            "evaluated_per_second": 1 / whole,
            "of_bare_loop": statistics.median(b / a for a, b in pairs[_RECORDED:]),
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
        steps = len(self.waited)
        trainer.should_stop = steps >= _TRAINING_STEPS or (steps > 0 and now - self.begin > self.seconds)


def _read_lines(journal: Path) -> list[Any]:
    """Return the journal's lines, without a last one that a kill cut off."""
    lines = []
    for line in journal.read_text().splitlines() if journal.exists() else []:
        try:
            lines.append(json.loads(line))
        except ValueError:
            break
    return lines


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start


def _network(seconds: Mapping[str, Any], suffix: str = "") -> float:
    return sum(seconds.get(f"{name}{suffix}", 0.0) for name in NETWORK_STAGES)


def _precision_and_flops(clock: Clock, method: RenderingModule) -> dict[str, Any]:
    """Return the precision of the last convolution's output and the operations of each step, on one batch."""
    dtypes: list[torch.dtype] = []
    hook = method.unet.conv_out.register_forward_hook(lambda _, __, output: dtypes.append(output.dtype))
    flops = clock.flops(method)
    hook.remove()
    return {"precision": str(dtypes[0]).removeprefix("torch."), "step_flops": flops}


def _touches(factor: str, method: Method) -> bool:
    if factor in ("points", "photons"):
        return any(name.startswith(factor[:-1]) for name in method.fields)
    return factor != "width" or isinstance(method, RenderingModule)


def _device(name: str | None) -> torch.device:
    if name not in (None, "cpu", "cuda"):
        raise UserError(f"--device: must be cpu or cuda, is {name!r}")
    if name == "cuda" and not torch.cuda.is_available():
        raise UserError("--device: cuda: this machine has none; use --device cpu")
    return torch.device(name) if name else default_device()


def _free_memory(device: torch.device) -> float:
    """Return the free memory in bytes, infinite where it is unknown."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    try:
        lines = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        return 1024 * float(lines["MemAvailable"].split()[0])
    except (OSError, KeyError):
        return math.inf
