"""The stress suite "training": short trainings with other seeds, learning rates, precision or corrupted samples."""

import inspect
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import lightning as L
import torch

from nlt.config import read_configs
from nlt.errors import DivergedError, UserError
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.results import DIVERGED, FAILED, OK, read_rows, write_rows
from nlt.evaluation.trainings import Training, train
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.stress.suites import STRESS, TRAININGS, Trainings


class Corruption(L.Callback):
    """Adds fireflies to the targets of a share of the samples, the same ones in every epoch."""

    def __init__(self, share: float) -> None:
        self.every = max(1, round(1 / share))

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, batch_idx: int) -> None:
        """Multiply the radiance of one in 100 pixels by 10,000."""
        for k in torch.nonzero(batch["index"] % self.every == 0).flatten().tolist():
            batch[pl_module.target][k].view(3, -1)[:, k % 100 :: 100] *= 1e4


def train_suite(
    directory: Path,
    comparison: Comparison,
    suite: Trainings,
    runs: Path,
    error: Callable[[Method], float],
    device: torch.device,
) -> None:
    """Train one method of each kind in every variation and write training.csv, a row each, with its relative `error`.

    Raises:
        UserError: the scale has no trainer.max_steps.
    """
    path = directory / TRAININGS
    finished = [row for row in read_rows(path) if row["status"] == OK] if path.exists() else []
    known = {row["run"]: row["error"] for row in finished}
    first_of_kind: dict[str, str] = {}  # the first trained method of each class and set of inputs
    for method in comparison.trained:
        model = read_configs([comparison.files[method][1]])["model"]
        inputs = {name: value for name, value in model.get("init_args", {}).items() if type(value) is not int}
        first_of_kind.setdefault(f"{model['class_path']} {inputs}", method)
    jobs: list[tuple[dict[str, Any], Training]] = []
    for method in first_of_kind.values():
        for variation, value, seed, changes in _variations(comparison, method, suite):
            training = Training.of(comparison, method, seed, runs / STRESS, changes=changes)
            jobs.append(({"method": method, "variation": variation, "value": value, "seed": seed}, training))
    failures = train([training for _, training in jobs], "local", None, {})
    for row, training in jobs:
        run = training.run.name
        row |= {"status": FAILED if training in failures else OK, "message": failures.get(training, ""), "run": run}
        try:
            if row["status"] == OK:
                row["error"] = known[run] if run in known else error(training.load(device)[0])
        except DivergedError as problem:
            row |= {"status": DIVERGED, "message": str(problem)}
    write_rows(path, (row for row, _ in jobs))


def _variations(
    comparison: Comparison, method: str, suite: Trainings
) -> Iterator[tuple[str, str, int, dict[str, Any]]]:
    """Yield each variation's kind, value, seed, and the config that overrides the method's own."""
    config, seed = comparison.configs[method], comparison.seeds[0]
    steps = config.get("trainer", {}).get("max_steps")
    if not steps:
        raise UserError(f"{comparison.scale}: trainer.max_steps: missing; the suite training needs it")
    default = inspect.signature(RenderingModule).parameters["learning_rate"].default
    rate = config["model"].get("init_args", {}).get("learning_rate", default)
    trainer = {"max_steps": max(1, round(suite.share * steps)), "limit_val_batches": 0, "precision": "32-true"}
    for k in range(seed, seed + suite.seeds):
        yield "seed", str(k), k, {"trainer": trainer}
    for factor in suite.learning_rate:
        model = {"init_args": {"learning_rate": rate * factor}}
        yield "learning rate", f"x{factor:g}", seed, {"trainer": trainer, "model": model}
    yield "precision", suite.precision, seed, {"trainer": trainer | {"precision": suite.precision}}
    damage = {"class_path": f"{__name__}.{Corruption.__name__}", "init_args": {"share": suite.corrupted}}
    yield "corrupted samples", f"{suite.corrupted:.0%}", seed, {"trainer": trainer | {"callbacks": [damage]}}
