"""`nlt compare`: generate, train, evaluate and time all methods; write the results, from which the rest is drawn."""

from __future__ import annotations

import hashlib
import json
import pydoc
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import yaml
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from nlt import training
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.generate import generate
from nlt.data.spec import load_spec, read_configs
from nlt.errors import DivergedError, UserError
from nlt.evaluation.clock import Clock
from nlt.evaluation.frames import Frames
from nlt.evaluation.paper import order, tables
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.report import draw
from nlt.evaluation.results import (
    DIVERGED,
    FAILED,
    OK,
    RUNS,
    VIEWS,
    load,
    write_images,
    write_manifest,
    write_rows,
)
from nlt.evaluation.tables import live_header, live_row, write_tables
from nlt.metrics.image_metrics import ImageMetrics
from nlt.metrics.jackknife import fid_and_kid_without
from nlt.models.method import Batch, Method
from nlt.models.module import PROJECTION, RenderingModule
from nlt.models.projection import visible_pixels
from nlt.paths import CONFIGS, config_names, find_config
from nlt.training import newest_checkpoint

_KEYS = ("table", "data", "scale", "methods", "seed")
_SHOWN = 32  # test views whose images are kept
_BATCH = 16
_MAX_CACHED = 512  # test images whose reference features (4 MB each) are kept for the next method


@dataclass
class Comparison:
    """What a config of configs/compare asks for."""

    name: str
    data: Path
    scale: Path
    table: str | None = None
    methods: list[str] = field(default_factory=list)
    seeds: list[int] = field(default_factory=lambda: [0])

    @classmethod
    def load(
        cls, config: str, scale: str | None, data: str | None, methods: list[str] | None, seeds: int = 1
    ) -> Comparison:
        """Read a config by name or path; the other arguments override it.

        Raises:
            UserError: an unknown key, table, method or file.
        """
        file = find_config("compare", config)
        content = read_configs([str(file)])
        for key in content:
            if key not in _KEYS:
                raise UserError(f"{file}: {key}: unknown key; known are {', '.join(_KEYS)}")
        for key, value in (("data", data), ("scale", scale)):
            content[key] = value or content.get(key)
            if not isinstance(content[key], str):
                raise UserError(f"{file}: {key}: missing; name a config of configs/{key}")
        table, seed = content.get("table"), content.get("seed", 0)
        if table is not None and table not in tables():
            raise UserError(f"{file}: table: must be one of {', '.join(tables())}, is {table!r}")
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise UserError(f"{file}: seed: must be a whole number of at least 0, is {seed!r}")
        known = sorted(config_names("model"), key=order)
        # Those in folders belong to a comparison that names them.
        wanted = methods or content.get("methods") or [name for name in known if "/" not in name]
        for method in wanted:
            if method not in known:
                raise UserError(f"{file}: methods: no method {method!r} in configs/model; known are {', '.join(known)}")
        return cls(
            name=file.stem,
            data=find_config("data", content["data"]),
            scale=find_config("scale", content["scale"]),
            table=table,
            methods=sorted(wanted, key=order),
            seeds=list(range(seed, seed + seeds)),
        )

    def jobs(self) -> list[tuple[str, int]]:
        """The rows to make: a method and a seed each; what is not trained has one seed."""
        return [(m, seed) for m in self.methods for seed in (self.seeds[:1] if untrained(m) else self.seeds)]

    def configs(self, method: str) -> list[str]:
        """The config files of a method's training, in order."""
        return [str(self.data), str(CONFIGS / "model" / f"{method}.yaml"), str(self.scale)]


def compare(
    config: str,
    out: str | None = None,
    scale: str | None = None,
    data: str | None = None,
    methods: list[str] | None = None,
    seeds: int = 1,
) -> Path:
    """Everything that a table needs, of which what is there already is kept. Returns its directory."""
    start, begun = time.time(), origin()
    comparison = Comparison.load(config, scale, data, methods, seeds)
    directory = Path(out or Path("results") / comparison.name)
    spec, root = load_spec([str(comparison.data), str(comparison.scale)])
    if not spec.test:
        raise UserError(f"{comparison.scale}: data.dataset.test: is 0; a comparison needs test samples")
    dataset = generate(spec, root)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    frames = Frames(LightTransportDataset(dataset, spec, "test"))
    test, clock = Evaluation(frames, device), Clock(frames, device)
    test.write_references(directory)
    record = {
        **begun,
        **surroundings(device),
        "comparison": comparison.name,
        "table": comparison.table,
        "methods": comparison.methods,
        "seeds": comparison.seeds,
        "dataset": dataset.name,
        "scenes": [description.name for description in spec.descriptions],
        "n_test": len(test),
        "shown": test.shown,
        "configs": {method: read_configs(comparison.configs(method)) for method in comparison.methods},
    }
    runs: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    jobs = comparison.jobs()
    for number, (method, seed) in enumerate(jobs, 1):
        print(f"\n[{number}/{len(jobs)}] {method}, seed {seed}", flush=True)
        run: dict[str, Any] = {"method": method, "seed": seed, "status": OK, "message": ""}
        try:
            module, took = obtain(comparison, method, seed, Path("runs") / dataset.name, device)
            metrics, each, radiance = test.evaluate(module)
            run |= clock.time(module) | metrics | clock.size(module) | took
            run |= {"family": type(module).__name__, "pixel_fraction": module.pixel_fraction}
            run["spp"] = (module.spp or spec.input_spp) if "path_tracing" in module.stages else 0
            views += [{"method": method, "seed": seed, **row} for row in each]
            if seed == comparison.seeds[0]:
                write_images(directory, method, radiance=radiance)
        except DivergedError as error:
            run |= {"status": DIVERGED, "message": str(error)}
        except (UserError, OSError):
            raise
        except Exception as error:  # whatever it is, the other rows go on
            run |= {"status": FAILED, "message": " ".join(f"{type(error).__name__}: {error}".split())}
        runs.append(run)
        if number == 1:
            print(live_header())
        print(live_row(run), flush=True)
        write_rows(directory / RUNS, runs)
        write_rows(directory / VIEWS, views)
        write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
        write_tables(load(directory))
    print("\n" + "\n".join([live_header(), *(live_row(run) for run in runs)]))
    draw(directory)
    print(f"\nwritten to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")
    return directory


def untrained(method: str) -> Method | None:
    """The method, if its class is one that needs no training; None for one that does."""
    file = CONFIGS / "model" / f"{method}.yaml"
    model = read_configs([str(file)]).get("model", {})
    kind = pydoc.locate(str(model.get("class_path")))
    if not (isinstance(kind, type) and issubclass(kind, Method)) or issubclass(kind, RenderingModule):
        return None  # what it is that is no class at all, training will say
    try:
        return kind(**model.get("init_args", {}))
    except TypeError as error:
        raise UserError(f"{file}: model.init_args: {error}") from None


def obtain(
    comparison: Comparison, method: str, seed: int, root: Path, device: torch.device
) -> tuple[Method, dict[str, Any]]:
    """The method, trained if it needs to be, and what that took.

    Raises:
        DivergedError: its training diverged, now or when it was tried before.
    """
    if module := untrained(method):
        return module, {}
    checkpoint, took = train(comparison, method, seed, root)
    took["run"] = str(checkpoint.parents[1])
    return RenderingModule.load_from_checkpoint(checkpoint, map_location=device).eval(), took


def train(comparison: Comparison, method: str, seed: int, root: Path) -> tuple[Path, dict[str, Any]]:
    """The checkpoint of a finished training and what it took; trains, or goes on training, if need be.

    A run belongs to a hash of all that decides its outcome, so a method is trained anew only when that changed.
    A training that dies is gone on with once; one that diverged is not tried again.
    """
    files = comparison.configs(method)
    merged = read_configs(files)
    decides = {key: merged.get(key) for key in ("data", "model", "trainer")} | {"seed": seed}
    key = hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]
    run = root / f"{method}-{key}"
    done = run / "done.json"
    if not (done.exists() and ("diverged" in done.read_text() or newest_checkpoint(run))):
        try:
            try:
                took = _fit(run, files, seed)
            except (UserError, OSError):
                raise
            except Exception as error:
                print(f"died of {type(error).__name__}: {error}; once more", flush=True)
                took = _fit(run, files, seed)
        except DivergedError as error:
            took = {"diverged": str(error)}
        write_bytes(done, json.dumps(took).encode())
    took = json.loads(done.read_text())
    if "diverged" in took:
        raise DivergedError(took["diverged"])
    checkpoint = newest_checkpoint(run)
    assert checkpoint is not None
    return checkpoint, took


def _fit(run: Path, files: list[str], seed: int) -> dict[str, Any]:
    """Train in the directory `run`, from its newest checkpoint if it has one; what that took."""
    run.mkdir(parents=True, exist_ok=True)
    own = run / "run.yaml"
    own.write_text(yaml.safe_dump(_run_config(run, seed)))
    arguments = ["fit", *(f"--config={file}" for file in [*files, own])]
    checkpoint = newest_checkpoint(run)
    if checkpoint:
        print(f"resuming from {checkpoint}")
        arguments.append(f"--ckpt_path={checkpoint}")
    begin = time.time()
    cli = training.run_lightning(arguments)
    steps = cli.trainer.global_step
    return {
        "train_s": time.time() - begin,
        "steps": steps,
        "images_seen": steps * cli.datamodule.batch_size * cli.trainer.world_size,
        "trained_at_commit": origin()["commit"],
        "resumed": checkpoint is not None,
    }


def _run_config(run: Path, seed: int) -> dict[str, Any]:
    # Hyperparameters are logged when the metrics are known: nlt/evaluation/dashboard.py.
    logger = {"save_dir": str(run), "name": "", "version": "", "default_hp_metric": False}
    return {
        "seed_everything": seed,
        "model": {"init_args": {"seed": seed}},
        "data": {"seed": seed},
        "trainer": {
            "enable_model_summary": False,
            "logger": {"class_path": "lightning.pytorch.loggers.TensorBoardLogger", "init_args": logger},
        },
    }


class Evaluation:
    """The test split, judged by one set of metrics; reference features are computed once for all methods."""

    def __init__(self, frames: Frames, device: torch.device) -> None:
        self.frames, self.device = frames, device
        self.directory, self.spec = frames.dataset.directory, frames.dataset.spec
        self._features: dict[int, dict[str, Tensor] | None] = {}
        self.shown = list(range(0, len(self), max(1, len(self) // _SHOWN)))[:_SHOWN]

    def __len__(self) -> int:
        return self.spec.test * len(self.spec.scenes)

    def write_references(self, directory: Path) -> None:
        """images/reference.npz, noisy.npz and gbuffer.npz of the shown views."""
        samples = [self.frames.dataset[k] for k in self.shown]
        stack = {name: np.stack([sample[name].numpy() for sample in samples]) for name in samples[0]}
        reference = (stack["reference_a"] + stack["reference_b"]) / 2
        view = np.array(self.shown)
        write_images(directory, "reference", radiance=reference, exposure=stack["exposure"], view=view)
        write_images(directory, "noisy", radiance=stack["noisy"])
        buffers = {name: stack[name] for name in ("albedo", "normal", "depth")}
        write_images(directory, "gbuffer", **buffers, light_in_view=self._light_in_view(samples))

    @staticmethod
    def _light_in_view(samples: list[Batch]) -> np.ndarray:
        """(V,) bool: a point that emits light is seen in the sample's image."""
        batch = default_collate(samples)
        camera = {name: batch[name] for name in PROJECTION}
        emits = batch["point_visible"] & (batch["point_emission"] > 0).any(-1)
        pixels = visible_pixels(batch["point_position"], emits, **camera)
        return (pixels < batch["depth"][0].numel()).any(1).numpy()

    @torch.inference_mode()
    def evaluate(self, method: Method) -> tuple[dict[str, float], list[dict[str, Any]], np.ndarray]:
        """All metrics of a method; those of each view; its radiance (V, 3, H, W) of the views that are shown.

        Raises:
            DivergedError: a prediction is not finite.
        """
        method = method.to(self.device).eval()
        metrics = ImageMetrics(perceptual=True).to(self.device)
        dataset = LightTransportDataset(self.directory, self.spec, "test", method.inputs)
        shown, rows = [], []
        pools: list[tuple[Tensor, Tensor]] = []
        for k, cpu_batch in enumerate(DataLoader(dataset, batch_size=_BATCH)):
            indices = cpu_batch["index"].tolist()
            if "traced" in method.inputs and method.spp:
                cpu_batch["traced"] = torch.stack([self.frames.traced(index, method.spp) for index in indices])
            batch = {name: value.to(self.device) for name, value in cpu_batch.items()}
            prediction = method(batch)
            if not prediction.isfinite().all():
                raise DivergedError(f"a prediction is not finite, among test samples {indices}")
            reference = (batch["reference_a"], batch["reference_b"], batch["exposure"])
            of_reference = self._of_reference(k, reference)
            each = metrics.update(prediction, *reference, of_reference=of_reference)
            if of_reference and "pool" in each:
                pools.append((each.pop("pool"), of_reference["pool"]))
            columns = {name: values.tolist() for name, values in each.items()}
            rows += [{"view": index, **{n: c[i] for n, c in columns.items()}} for i, index in enumerate(indices)]
            shown.append(prediction[[i for i, index in enumerate(indices) if index in self.shown]].cpu())
        if pools:
            without = fid_and_kid_without(*(torch.cat(part) for part in zip(*pools, strict=True)))
            for key, column in without.items():
                for row, value in zip(rows, column.tolist(), strict=True):
                    row[key] = value
        values = {name: float(value) for name, value in metrics.compute().items()}
        return values, rows, torch.cat(shown).numpy()

    def _of_reference(self, k: int, reference: tuple[Tensor, Tensor, Tensor]) -> dict[str, Tensor] | None:
        if len(self) > _MAX_CACHED:
            return ImageMetrics.reference_features(*reference)
        if k not in self._features:
            self._features[k] = ImageMetrics.reference_features(*reference)
        return self._features[k]
