"""`nlt compare`: generate, train, evaluate and time all methods; write the table, the pictures, the manifest."""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch
import yaml
from torch import Tensor
from torch.utils.data import DataLoader

from nlt.data.datamodule import LightTransportDataset
from nlt.data.files import AnyPath
from nlt.data.generate import generate
from nlt.data.spec import DatasetSpec, load_spec, read_configs
from nlt.errors import UserError
from nlt.evaluation.clock import Clock
from nlt.evaluation.figures import draw_samples, draw_speed_accuracy
from nlt.evaluation.paper import order, tables
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.tables import live_header, live_row, write_tables
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.module import Batch, RenderingModule
from nlt.paths import CONFIGS, find_config

_KEYS = ("table", "data", "scale", "methods", "seed")
_VIEWS = 6  # in samples.png
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
    seed: int = 0

    @classmethod
    def load(cls, config: str, scale: str | None, data: str | None, methods: list[str] | None) -> Comparison:
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
        known = sorted((path.stem for path in (CONFIGS / "model").glob("*.yaml")), key=order)
        wanted = methods or content.get("methods") or known
        for method in wanted:
            if method not in known:
                raise UserError(f"{file}: methods: no method {method!r} in configs/model; known are {', '.join(known)}")
        return cls(
            name=file.stem,
            data=find_config("data", content["data"]),
            scale=find_config("scale", content["scale"]),
            table=table,
            methods=sorted(wanted, key=order),
            seed=seed,
        )

    def configs(self, method: str) -> list[str]:
        """The config files of a method's training, in order."""
        return [str(self.data), str(CONFIGS / "model" / f"{method}.yaml"), str(self.scale)]


def compare(
    config: str,
    out: str | None = None,
    scale: str | None = None,
    data: str | None = None,
    methods: list[str] | None = None,
) -> Path:
    """Everything that a table needs, of which what is there already is kept. Returns its directory."""
    start, begun = time.time(), origin()
    comparison = Comparison.load(config, scale, data, methods)
    directory = Path(out or Path("results") / comparison.name)
    spec, root = load_spec([str(comparison.data), str(comparison.scale)])
    if not spec.test:
        raise UserError(f"{comparison.scale}: data.dataset.test: is 0; a comparison needs test samples")
    dataset = generate(spec, root)
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    test = Evaluation(dataset, spec, device)
    clock = Clock(LightTransportDataset(dataset, spec, "test"), device)
    rows: list[dict[str, Any]] = []
    predictions: dict[str, Tensor] = {}
    trained: dict[str, Any] = {}
    for number, method in enumerate(comparison.methods, 1):
        print(f"\n[{number}/{len(comparison.methods)}] {method}", flush=True)
        checkpoint, trained[method] = train(comparison, method, Path("runs") / dataset.name)
        module = RenderingModule.load_from_checkpoint(checkpoint, map_location=device).eval()
        metrics, predictions[method] = test.evaluate(module)
        times = clock.time(module)
        parameters = sum(p.numel() for p in module.parameters())
        more = {"n_test": len(test), "seed": comparison.seed, "parameters": parameters, **trained[method]}
        rows.append({"method": method, **times, **metrics, **more, "pixel_fraction": module.pixel_fraction})
        if number == 1:
            print(live_header())
        print(live_row(rows[-1]), flush=True)
        write_tables(directory, rows, comparison.table)
    print("\n" + "\n".join([live_header(), *(live_row(row) for row in rows)]))
    draw_samples(directory / "samples.png", test.views(), predictions)
    draw_speed_accuracy(directory / "speed_accuracy.png", rows)
    record = {
        **begun,
        "wall_time_s": round(time.time() - start, 1),
        **surroundings(device),
        "comparison": comparison.name,
        "seed": comparison.seed,
        "dataset": dataset.name,
        "n_test": len(test),
        "configs": {method: read_configs(comparison.configs(method)) for method in comparison.methods},
        "training": trained,
    }
    (directory / "manifest.json").write_text(json.dumps(record, indent=1, default=str) + "\n")
    print(f"\nwritten to {directory}: table.md, table.csv, samples.png, speed_accuracy.png, manifest.json")
    return directory


def train(comparison: Comparison, method: str, root: Path) -> tuple[Path, dict[str, Any]]:
    """The checkpoint of a finished training and what it took; trains, or goes on training, if need be.

    A run belongs to a hash of all that decides its outcome, so a method is trained anew only when that changed.
    """
    from nlt.training import newest_checkpoint, run_lightning

    files = comparison.configs(method)
    merged = read_configs(files)
    decides = {key: merged.get(key) for key in ("data", "model", "trainer")} | {"seed": comparison.seed}
    key = hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]
    run = root / f"{method}-{key}"
    done = run / "done.json"
    checkpoint = newest_checkpoint(run)
    if not (done.exists() and checkpoint):
        run.mkdir(parents=True, exist_ok=True)
        own = run / "run.yaml"
        own.write_text(yaml.safe_dump(_run_config(run, comparison.seed)))
        arguments = ["fit", *(f"--config={file}" for file in [*files, own])]
        resumed = checkpoint is not None
        if resumed:
            print(f"resuming from {checkpoint}")
            arguments.append(f"--ckpt_path={checkpoint}")
        begin = time.time()
        cli = run_lightning(arguments)
        batch = cli.datamodule.batch_size * cli.trainer.world_size
        steps = cli.trainer.global_step
        took = {"train_s": time.time() - begin, "steps": steps, "images_seen": steps * batch}
        took["trained_at_commit"] = origin()["commit"]
        checkpoint = newest_checkpoint(run)
        assert checkpoint is not None
        done.write_text(json.dumps(took | {"resumed": resumed}))
    return checkpoint, json.loads(done.read_text())


def _run_config(run: Path, seed: int) -> dict[str, Any]:
    logger = {"save_dir": str(run), "name": "", "version": ""}
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

    def __init__(self, directory: AnyPath, spec: DatasetSpec, device: torch.device) -> None:
        self.directory, self.spec, self.device = directory, spec, device
        self._features: dict[int, dict[str, Tensor] | None] = {}
        count = len(self)
        step = max(1, count // _VIEWS)
        self._shown = list(range(0, count, step))[:_VIEWS]

    def __len__(self) -> int:
        return self.spec.test * len(self.spec.scenes)

    def views(self) -> Batch:
        """The samples that are shown, with all targets."""
        dataset = LightTransportDataset(self.directory, self.spec, "test", ())
        return torch.utils.data.default_collate([dataset[k] for k in self._shown])

    @torch.inference_mode()
    def evaluate(self, module: RenderingModule) -> tuple[dict[str, float], Tensor]:
        """All metrics of a method, and its predictions of the views that are shown."""
        metrics = ImageMetrics(perceptual=True).to(self.device)
        dataset = LightTransportDataset(self.directory, self.spec, "test", module.inputs)
        shown = []
        for k, cpu_batch in enumerate(DataLoader(dataset, batch_size=_BATCH)):
            batch = {name: value.to(self.device) for name, value in cpu_batch.items()}
            prediction = module(batch)
            reference = (batch["reference_a"], batch["reference_b"], batch["exposure"])
            metrics.update(prediction, *reference, of_reference=self._of_reference(k, reference))
            chosen = [i for i, index in enumerate(cpu_batch["index"].tolist()) if index in self._shown]
            shown.append(prediction[chosen].cpu())
        return {name: float(value) for name, value in metrics.compute().items()}, torch.cat(shown)

    def _of_reference(self, k: int, reference: tuple[Tensor, Tensor, Tensor]) -> dict[str, Tensor] | None:
        if len(self) > _MAX_CACHED:
            return None
        if k not in self._features:
            self._features[k] = ImageMetrics.reference_features(*reference)
        return self._features[k]
