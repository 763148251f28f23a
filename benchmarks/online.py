"""Compares training on a stored set, seen again every epoch, and on samples rendered online, at equal wall time.

    python benchmarks/online.py --minutes 30 --sizes 256 1024 4096

Every arm trains the same method with the same settings for the same time; its weights are saved 20 times on the way and
evaluated on the test split afterwards. The stored sets are generated first, on all cores, and timed. The learning rate
does not decay, because arms differ in the length of an epoch. Writes table.md, table.csv, curve.png and manifest.json;
a finished arm is not run again.
"""

from __future__ import annotations

import argparse
import copy
import hashlib
import json
import shutil
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import lightning as L
import matplotlib.pyplot as plt
import numpy as np
import torch
from tqdm import tqdm

from nlt.cli import exit_code
from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.dataset import LightTransportDataset, identity_collate
from nlt.data.files import write_bytes
from nlt.data.generate import generate
from nlt.data.spec import DatasetSpec, load_spec
from nlt.data.store import dataset_files
from nlt.evaluation.evaluate import evaluate
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import write_manifest, write_rows
from nlt.metrics.image_metrics import ImageMetrics
from nlt.metrics.quantities import METRICS
from nlt.models import factory
from nlt.models.module import Batch, RenderingModule
from nlt.models.policy import default_device
from nlt.paths import find_config
from nlt.report import plots
from nlt.report.table_writer import grid
from nlt.training import quiet

Row = dict[str, Any]  # a snapshot
SNAPSHOTS, SHOWN, ONLINE = 20, ("mse", "mssim"), "online"
ACCOUNTS = {"without_generation": "Training time alone", "with_generation": "With the time to generate the stored set"}


class Snapshots(L.Callback):
    """Saves the weights at `times` in seconds, without counting the time to save, and ends the training."""

    def __init__(self, times: list[float], label: str) -> None:
        self.times, self.begin, self.taken = list(times), time.perf_counter(), list[Row]()
        self.bar = tqdm(total=round(times[-1]), desc=label, unit="s", file=sys.stderr)

    def on_train_batch_end(self, trainer: Any, pl_module: Any, *_: Any) -> None:
        now = time.perf_counter() - self.begin
        self.bar.update(min(round(now), self.bar.total) - self.bar.n)
        if now < self.times[0]:
            return
        self.times = [mark for mark in self.times if mark > now]
        seen = trainer.global_step * trainer.datamodule.batch_size
        weights = copy.deepcopy(pl_module.state_dict())
        self.taken.append({"train_s": now, "steps": trainer.global_step, "images_seen": seen, "weights": weights})
        self.begin += time.perf_counter() - self.begin - now
        trainer.should_stop = not self.times


def train(config: Row, spec: DatasetSpec, root: Path, size: int | None, seed: int, times: list[float]) -> list[Row]:
    """Train one arm, on a stored set of `size` samples per scene or online if None, and return its snapshots."""
    L.seed_everything(seed, verbose=False)
    module = build(config, spec, seed)
    keys = {name: config["data"][name] for name in ("batch_size", "workers") if name in config["data"]}
    keys["workers"] = max(1, keys.get("workers", 1))
    data = LightTransportDataModule(
        replace(spec, train=size or spec.train), str(root), seed=seed, online=size is None, **keys
    )
    snapshots = Snapshots(times, f"{label(size)}, seed {seed}")
    trainer = L.Trainer(
        max_epochs=-1, devices=1, callbacks=[snapshots], logger=False, enable_checkpointing=False,
        enable_progress_bar=False, enable_model_summary=False, use_distributed_sampler=False, limit_val_batches=0,
    )  # fmt: skip
    trainer.fit(module, datamodule=data)
    snapshots.bar.close()
    return snapshots.taken


def build(config: Row, spec: DatasetSpec, seed: int) -> RenderingModule:
    sizes = {"num_scenes": len(spec.scenes), "num_points": spec.num_points}
    module = factory.build(config, "the config", lr_schedule="paper", lr_decay=1.0, seed=seed, **sizes)
    assert isinstance(module, RenderingModule)
    return module


def judge(module: RenderingModule, batches: list[Batch], snapshots: list[Row]) -> list[Row]:
    """Return the snapshots with metrics in place of weights."""
    rows = []
    for snapshot in snapshots:
        module.load_state_dict(snapshot["weights"])
        metrics = ImageMetrics(perceptual=False).to(module.device)
        for _ in evaluate(module, batches, metrics):
            pass  # `metrics` accumulates the batches
        values = {name: float(value) for name, value in metrics.compute().items()}
        rows.append({key: value for key, value in snapshot.items() if key != "weights"} | values)
    return rows


def generate_timed(spec: DatasetSpec, root: Path, base: Path) -> float:
    """Return the seconds to generate a set's training samples, from a record if there is one.

    The evaluated samples are copied from `base`.
    """
    directory = Path(str(spec.directory(root)))
    record = root / f"{directory.name}.json"
    if not record.exists():
        shutil.rmtree(directory, ignore_errors=True)  # begun but not timed; only this benchmark writes here
        for name in dataset_files(spec.without_train()):
            (directory / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(base / name, directory / name)
        begin = time.perf_counter()
        generate(spec, root)
        write_bytes(record, json.dumps(time.perf_counter() - begin).encode())
    return float(json.loads(record.read_text()))


def label(size: int | None) -> str:
    return ONLINE if size is None else f"{size:,} stored"


def at(rows: list[Row], arm: str, key: str, budget: float, account: str) -> float | None:
    """Return an arm's metric after `budget` seconds, interpolated, mean over seeds; None before a first snapshot."""
    values = []
    for seed in sorted({row["seed"] for row in rows if row["arm"] == arm}):
        mine = [row for row in rows if (row["arm"], row["seed"]) == (arm, seed)]
        spent = [row["train_s"] + (row["generation_s"] if account == "with_generation" else 0) for row in mine]
        if budget < spent[0]:
            return None
        values.append(float(np.interp(budget, spent, [row[key] for row in mine])))
    return sum(values) / len(values)


def write_table(path: Path, rows: list[Row], budgets: list[float]) -> None:
    """Write a table per metric and account: a row per budget, a column per arm, the best in bold."""
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    last = {arm: [r for r in rows if r["arm"] == arm][-1] for arm in arms}
    lines = ["# Stored sets against online rendering at equal wall time", ""]
    table = [
        ["generating the set (s)", *(f"{last[a]['generation_s']:.0f}" for a in arms)],
        ["images trained on per second", *(f"{last[a]['images_seen'] / last[a]['train_s']:.1f}" for a in arms)],
    ]
    lines += grid(["", *arms], table)
    for key in SHOWN:
        metric = METRICS[key]
        for account, title in ACCOUNTS.items():
            lines += [f"{metric.label}, {metric.direction} is better. {title}:", ""]
            table = []
            for budget in budgets:
                values = {arm: at(rows, arm, key, budget, account) for arm in arms}
                reached = {arm: value for arm, value in values.items() if value is not None}
                pick = min if metric.direction == "lower" else max
                best = pick(reached, key=lambda arm: reached[arm]) if reached else ""
                cells = ["" if v is None else f"{v:{metric.format}}" for v in values.values()]
                cells = [f"**{c}**" if arm == best else c for arm, c in zip(arms, cells, strict=True)]
                table.append([f"{budget / 60:g}", *cells, best])
            lines += grid(["minutes", *arms, "best"], table)
    lines += ["An empty cell: the set was still being generated, or no snapshot was made yet. Means over seeds."]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def draw(directory: Path, rows: list[Row]) -> None:
    """Plot MSE over wall time: on the left training alone, on the right with generation; a thin line per seed."""
    arms = list(dict.fromkeys(row["arm"] for row in rows))
    figure, axes = plt.subplots(1, 2, figsize=(10, 4), sharey=True)
    for axis, (account, title) in zip(axes, ACCOUNTS.items(), strict=True):
        for k, arm in enumerate(arms):
            for seed in sorted({row["seed"] for row in rows}):
                mine = [row for row in rows if (row["arm"], row["seed"]) == (arm, seed)]
                extra = [row["generation_s"] * (account == "with_generation") for row in mine]
                minutes = [(row["train_s"] + e) / 60 for row, e in zip(mine, extra, strict=True)]
                style = {"color": "black", "lw": 2} if arm == ONLINE else {"color": f"C{k}", "lw": 1.2}
                axis.plot(minutes, [row["mse"] for row in mine], label=None if seed else arm, **style)
        axis.set(xlabel="wall time (min)", title=title, yscale="log")
    axes[0].set_ylabel(f"{METRICS['mse'].label} on the test split")
    axes[0].legend()
    figure.tight_layout()
    plots.save(figure, directory, "curve", ("png",))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", default="demo", help="a config in configs/data")
    parser.add_argument("--scale", default="demo", help="a config in configs/scale, whose train is an epoch online")
    parser.add_argument("--method", default="nlt", help="a config in configs/model")
    parser.add_argument("--minutes", type=float, default=20.0, help="training time of each arm")
    parser.add_argument("--sizes", type=int, nargs="+", default=[256, 1024], help="samples per scene in stored sets")
    parser.add_argument("--seeds", type=int, default=1, help="trainings of each arm")
    parser.add_argument("--out", default="results/online")
    options = parser.parse_args()
    quiet()
    begun = origin()
    files = [str(find_config(kind, getattr(options, name))) for kind, name in
             (("data", "data"), ("model", "method"), ("scale", "scale"))]  # fmt: skip
    spec, _ = load_spec([files[0], files[2]])
    config = read_configs(files)
    decides = {key: config.get(key) for key in ("data", "model")} | {"minutes": options.minutes, **spec.manifest}
    work = Path("runs/online") / hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]
    root, out = work / "datasets", Path(options.out)
    base = Path(str(generate(spec.without_train(), root)))
    generation = {size: generate_timed(replace(spec, train=size), root, base) for size in options.sizes}
    arms: list[int | None] = [*options.sizes, None]
    times = [options.minutes * 60 * (k + 1) / SNAPSHOTS for k in range(SNAPSHOTS)]
    print(f"{len(arms)} arms x {options.seeds} seeds x {options.minutes:g} min", flush=True)
    device = default_device()
    module = build(config, spec, 0).to(device).eval()
    test = LightTransportDataset(base, spec.without_train(), "test", module.fields)
    batches = [
        {name: value.to(device) for name, value in batch.items()}
        for batch in torch.utils.data.DataLoader(test, batch_size=16, collate_fn=identity_collate)
    ]
    rows: list[Row] = []
    for seed in range(options.seeds):
        for size in arms:
            record = work / f"{size or ONLINE}-{seed}.json"
            if not record.exists():
                snapshots = train(config, spec, root, size, seed, times)
                write_bytes(record, json.dumps(judge(module, batches, snapshots)).encode())
            about = {"arm": label(size), "seed": seed, "generation_s": generation.get(size or 0, 0.0)}
            rows += [about | row for row in json.loads(record.read_text())]
            write_rows(out / "table.csv", rows)
            write_table(out / "table.md", rows, [options.minutes * 60 * share for share in (0.25, 0.5, 0.75, 1)])
            draw(out, rows)
            details = {"configs": config, "lr_decay": 1.0, "n_test": len(test), "generation_s": generation}
            details |= {"minutes": options.minutes, "seeds": options.seeds}
            write_manifest(out, begun | surroundings(device) | details)
    print((out / "table.md").read_text())


if __name__ == "__main__":
    sys.exit(exit_code(main))
