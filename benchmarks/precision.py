"""Measures what bfloat16 and 8-bit integers cost in accuracy: trained methods on their test views, in three precisions.

    python benchmarks/precision.py                           # writes results/bench/precision.json
    python benchmarks/precision.py --config table2_real --methods cnn --seeds 3

Uses the trainings of `nlt compare --config CONFIG --seeds SEEDS`; a method without a training is left out, which is
printed. A policy's figure is relative to float32's on the same weights and views: 0.001 is a tenth of a percent.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import torch
from torch.utils.data import DataLoader

from nlt.data.dataset import LightTransportDataset, identity_collate
from nlt.data.files import write_bytes
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.evaluate import evaluate
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.trainings import Training
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, accelerate

POLICIES = {"float32": Policy(), "bfloat16": Policy(True, True), "int8": Policy(True, True, True)}
KEYS = ("mse", "mssim")


def judge(method: RenderingModule, dataset: LightTransportDataset, policy: Policy) -> dict[str, float]:
    """Return the means over the views of the metrics in KEYS."""
    metrics = ImageMetrics(perceptual=False)
    batches = DataLoader(dataset, batch_size=16, collate_fn=identity_collate)
    for _ in evaluate(accelerate(method, policy, torch.device("cpu")), batches, metrics):
        pass  # `metrics` accumulates the batches
    values = metrics.compute()
    return {key: float(values[key]) for key in KEYS}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--config", default="sizes")
    parser.add_argument("--methods", nargs="+", default=["nlt_photons@paper", "cnn@paper", "nlt_photons@large"])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--out", type=Path, default=Path("results/bench/precision.json"))
    options = parser.parse_args()
    comparison = Comparison.load(options.config, None, None, options.methods, options.seeds)
    spec, root = comparison.spec, comparison.root
    directory, device = spec.directory(root), torch.device("cpu")
    report: dict[str, Any] = {"options": {k: str(v) for k, v in vars(options).items()}, "views": spec.test}
    report |= {"manifest": origin() | surroundings(device), "methods": {}, "missing": []}
    for name in comparison.methods:
        for seed in comparison.seeds:
            training = Training.of(comparison, name, seed, Path("runs") / directory.name)
            if not training.outcome:
                report["missing"].append(training.name)
                print(f"{training.name}: not trained; nlt compare --config {options.config} trains it", flush=True)
                continue
            method, _ = training.load(device)
            dataset = LightTransportDataset(directory, spec, "test", method.fields)
            values = {policy: judge(method, dataset, POLICIES[policy]) for policy in POLICIES}
            row: dict[str, Any] = {"float32": values["float32"]}
            for policy in ("bfloat16", "int8"):
                row[policy] = {key: values[policy][key] / values["float32"][key] - 1 for key in KEYS}
            report["methods"][training.name] = row
            print(training.name, row, flush=True)
    for policy in ("bfloat16", "int8"):
        rows = report["methods"].values()
        report[f"{policy}_worst"] = {key: max((abs(row[policy][key]) for row in rows), default=None) for key in KEYS}
        print(f"{policy}: at most {report[f'{policy}_worst']} from float32")
    write_bytes(options.out, (json.dumps(report, indent=1) + "\n").encode())


if __name__ == "__main__":
    main()
