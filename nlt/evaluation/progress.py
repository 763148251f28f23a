"""Progress of trainings on any machine: each writes it to its directory, and the comparison reads them all."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import lightning as L
from tqdm import tqdm

from nlt.data.files import write_bytes
from nlt.evaluation.results import DIVERGED, FAILED

# Files in a training's directory: its progress and, once it has ended, its outcome.
PROGRESS, DONE = "progress.json", "done.json"
_WRITE, _READ, _PRINT = 2.0, 2.0, 60.0  # seconds between two writes, reads and prints
_WAITING, _TRAINING, _DIED = "waiting", "training", "died"


class Progress(L.Callback):
    """Writes progress.json into the directory `run`, at most every few seconds, and calls `tick` at every step.

    `history` holds the validation metrics along the training, with step, images_seen and train_s. Checkpoints store
    `history` and `seconds`, so that a resumed training continues both.
    """

    def __init__(self, run: Path, tick: Callable[[int], None]) -> None:
        self._file, self._tick = run / PROGRESS, tick
        self.history: list[dict[str, float]] = []
        self._start = time.monotonic()

    @property
    def seconds(self) -> float:
        """Training time so far, without time lost when a process was killed."""
        return time.monotonic() - self._start

    def state_dict(self) -> dict[str, Any]:
        return {"history": self.history, "seconds": self.seconds}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        self.history = state_dict["history"]
        self._start -= state_dict["seconds"]

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._first_step, self._train_start = trainer.global_step, time.monotonic()
        self._write(trainer)

    def on_train_batch_end(self, trainer: L.Trainer, *_: Any) -> None:
        self._tick(1)
        if time.monotonic() - self._written > _WRITE:
            self._write(trainer)

    def on_validation_end(self, trainer: L.Trainer, *_: Any) -> None:
        metrics = {k.removeprefix("val/"): float(v) for k, v in trainer.callback_metrics.items() if k[:4] == "val/"}
        images = images_seen(trainer)
        self.history.append({"step": trainer.global_step, "images_seen": images, "train_s": self.seconds, **metrics})

    def _write(self, trainer: L.Trainer) -> None:
        self._written = time.monotonic()
        step, steps = trainer.global_step, trainer.estimated_stepping_batches
        rate = (step - self._first_step) / (self._written - self._train_start or math.inf)
        state = {"state": _TRAINING, "step": step, "steps": steps, "eta_s": (steps - step) / rate if rate else math.nan}
        loss = trainer.callback_metrics.get("train/loss", math.nan)
        if trainer.is_global_zero:
            write_bytes(self._file, json.dumps({**state, "loss": float(loss)}).encode())

    def record_error(self, error: Exception) -> None:
        """Write the error that ended the training."""
        message = " ".join(f"{type(error).__name__}: {error}".split())
        write_bytes(self._file, json.dumps({"state": _DIED, "message": message}).encode())


def images_seen(trainer: L.Trainer) -> int:
    """Return the number of images seen so far, in all optimiser steps and on all devices."""
    return trainer.global_step * trainer.datamodule.batch_size * trainer.world_size  # type: ignore[attr-defined]


@dataclass
class _Row:
    """A training's progress as last read."""

    state: str = _WAITING
    step: int = 0
    steps: float = math.nan
    loss: float = math.nan
    eta_s: float = math.nan
    message: str = ""

    @classmethod
    def read(cls, run: Path) -> _Row:
        try:
            if (run / DONE).exists():
                outcome = json.loads((run / DONE).read_text())
                return cls(DIVERGED if DIVERGED in outcome else "done", message=outcome.get(DIVERGED, ""))
            return cls(**json.loads((run / PROGRESS).read_text()))
        except FileNotFoundError:
            return cls()

    @property
    def fraction(self) -> float:
        """The fraction of steps done; 1 after the end."""
        if self.state in (_WAITING, _TRAINING, _DIED):
            return self.step / self.steps if self.step else 0.0
        return 1.0

    def __str__(self) -> str:
        if self.state != _TRAINING:
            return f"{self.state:9} {self.message}".rstrip()
        eta = "?" if math.isnan(self.eta_s) else tqdm.format_interval(self.eta_s)
        loss = "?" if math.isnan(self.loss) else f"{self.loss:.4g}"  # before the first step
        return f"{self.state:9} step {self.step:6} of {self.steps:<7g} loss {loss:9} ETA {eta}"


class ProgressTable:
    """Prints a table of all trainings in lines that are never overwritten, so that a log file shows the same.

    A row is printed when its state changes, and every minute during training; a summary of all trainings follows.
    """

    def __init__(self, names: dict[Path, str]) -> None:
        """Args: names: the trainings' names, by directory."""
        self._names, self._width = names, max(map(len, names.values()))
        self._start, self._read, self._printed = time.monotonic(), -math.inf, -math.inf
        self.rows = dict.fromkeys(names, _Row(""))
        self._first_fraction: dict[Path, float] = {}  # fraction done when a training started here
        for run in names:  # left by an earlier comparison that was killed or lost its checkpoints
            for name in (PROGRESS, DONE):
                (run / name).unlink(missing_ok=True)

    def show(self, failures: Mapping[Path, str], last: bool = False) -> None:
        """Print new states; `failures` has the trainings that failed for good, and why."""
        now = time.monotonic()
        if now - self._read < _READ and not last:
            return
        self._read, before = now, self.rows
        self.rows = {run: _Row.read(run) for run in self._names}
        for run, reason in failures.items():
            self.rows[run] = _Row(FAILED, message=self.rows[run].message or reason)
        due = now - self._printed > _PRINT
        new = {run: r for run, r in self.rows.items() if r.state != before[run].state or (due and r.state == _TRAINING)}
        for run, row in new.items():
            if row.state == _TRAINING:
                self._first_fraction.setdefault(run, row.fraction)
            print(f"  {self._names[run]:{self._width}}  {row}")
        if new:
            self._printed = now
            print(self._summary(now - self._start), flush=True)

    def _summary(self, seconds: float) -> str:
        states = [row.state for row in self.rows.values()]
        counts = ", ".join(f"{states.count(state)} {state}" for state in dict.fromkeys(states))
        gained = sum(row.fraction - self._first_fraction.get(run, 0) for run, row in self.rows.items())
        left = sum(1 - row.fraction for row in self.rows.values())
        eta = f", ETA {tqdm.format_interval(seconds * left / gained)}" if gained > 0 and left else ""
        return f"{tqdm.format_interval(seconds)} trainings: {counts}{eta}"
