"""The trainings of a comparison: independent jobs, each in its own directory, none run twice."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import lightning as L
import torch
import yaml

from nlt.config import merge
from nlt.data import engines
from nlt.data.files import AnyPath, write_bytes
from nlt.errors import DivergedError, UserError, to_user_error
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.progress import DONE, Progress, ProgressTable, images_seen
from nlt.evaluation.provenance import origin
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.training import run_lightning


@dataclass(frozen=True)
class Training:
    """A job: a method's training with a seed, on all training images or the first `train_images` of each scene.

    The name of its directory `run` has a hash of all that determines the outcome, so a method is trained again only
    when that changes. The directory holds checkpoints, log, progress and, after the end, the outcome. `config` is JSON.
    `start` is the training whose weights this one starts from.
    """

    method: str
    seed: int
    run: Path
    config: str
    train_images: int | None = None
    start: Training | None = None

    @classmethod
    def of(
        cls,
        comparison: Comparison,
        method: str,
        seed: int,
        root: Path,
        train_images: int | None = None,
        changes: Mapping[str, Any] | None = None,
    ) -> Training:
        """Create a comparison's training, with a directory below `root`."""
        config = merge(comparison.configs[method], changes or {})
        if train_images:
            config = merge(config, {"data": {"train_images": train_images}})
        start = comparison.starts.get(method)
        start_training = Training.of(comparison, start, seed, comparison.runs(start)) if start else None
        if start_training:  # part of the directory's hash
            config = merge(config, {"start_from": start_training.run.name})
        # A method that was trained on another device, in that device's precision, is not trained again on this one.
        choices = ("auto", "32", "bf16") if comparison.precision == "auto" else (comparison.precision,)
        precisions = dict.fromkeys(Policy.for_device(default_device(), name).precision for name in choices)
        runs = {precision: root / f"{method}-{_config_hash(config, seed, precision)}" for precision in precisions}
        precision = next((p for p, run in runs.items() if (run / DONE).exists()), next(iter(runs)))
        # The precision is fixed here, because the machine that trains might choose another one than the hash's.
        config = merge({"trainer": {"precision": precision}}, config)
        # An absolute path, because processes on other machines have other working directories.
        return cls(method, seed, runs[precision].absolute(), json.dumps(config), train_images, start_training)

    @property
    def name(self) -> str:
        """The printed name."""
        images = f", {self.train_images} images" if self.train_images else ""
        return f"{self.method}, seed {self.seed}{images}"

    @property
    def outcome(self) -> dict[str, Any] | None:
        """Time, steps and `history` (progress.py), or how it diverged; None before the end."""
        done = self.run / DONE
        content = json.loads(done.read_text()) if done.exists() else None
        return content if content and ("diverged" in content or newest_checkpoint(self.run)) else None

    def load(self, device: torch.device) -> tuple[RenderingModule, dict[str, Any]]:
        """Load the trained method and the facts about its training, without `history`.

        Raises:
            DivergedError: the training diverged, now or in an earlier comparison.
        """
        outcome, checkpoint = self.outcome or {}, newest_checkpoint(self.run)
        outcome.pop("history", None)
        if "diverged" in outcome:
            raise DivergedError(outcome["diverged"])
        assert checkpoint is not None
        module = RenderingModule.load_from_checkpoint(checkpoint, map_location=device).eval()
        return module, outcome | {"run": os.path.relpath(self.run)}


def generate_datasets(
    comparison: Comparison, workers: int | None = None, scheduler: str = "local", slurm: Mapping[str, str] | None = None
) -> AnyPath:
    """Render what is missing of the compared dataset and of those that its methods train on; return the former."""
    from nlt.data.generate import generate  # here, because it imports Mitsuba

    specs = [comparison.spec]
    for spec in comparison.training_specs.values():
        if spec not in specs:
            specs.append(spec)
    directories = [generate(spec, comparison.root, workers, scheduler, slurm) for spec in specs]
    return directories[0]


def train(
    trainings: list[Training], scheduler: str, workers: int | None, slurm: Mapping[str, str]
) -> dict[Training, str]:
    """Run the trainings that have not ended yet; return those that failed twice, with the reason.

    Those that start from another training's weights run after all others.

    Each has its own process, because it may be killed for its memory and because Lightning keeps global state. On
    this machine they are forked from a process that has imported Lightning, which takes seconds, but not Mitsuba: its
    import initialises CUDA, which a forked process cannot use. On its processor, several trainings run side by side and
    share the cores, which is faster than all cores for one after the other; there are never more than cores, because
    threads that wait for a core slow down all others.

    Raises:
        UserError: a config or the dataset is wrong, or the disk is full.
    """
    starts = [training.start for training in trainings if training.start]
    first = list(dict.fromkeys([*(training for training in trainings if not training.start), *starts]))
    failures = _train_side_by_side(first, scheduler, workers, slurm)
    second = [training for training in trainings if training.start and training.start not in failures]
    failures |= {t: f"{t.start.name}: {failures[t.start]}" for t in trainings if t.start and t.start in failures}
    return failures | _train_side_by_side(second, scheduler, workers, slurm)


def _train_side_by_side(
    trainings: list[Training], scheduler: str, workers: int | None, slurm: Mapping[str, str]
) -> dict[Training, str]:
    """Run independent trainings as `train` does."""
    unfinished = [training for training in trainings if not training.outcome]
    failures: dict[Training, str] = {}
    if not unfinished:
        return failures
    if scheduler == "local":
        # All trainings count, not only the unfinished ones, so that a resumed one has the same number of threads.
        most = min(engines.available_cpus(), len(trainings)) if default_device().type == "cpu" else None
        workers = min(workers or most, most) if most else workers or 1
    engine = engines.find_engine(scheduler, workers, slurm, preload=(__name__,))
    table = ProgressTable({t.run: t.name for t in unfinished})
    print(f"\n{len(unfinished)} of {len(trainings)} trainings to run, {engine.workers} in parallel", flush=True)
    with closing(engine.run(_train, unfinished, failures)) as ticks:
        for _ in ticks:
            table.show({t.run: reason for t, reason in failures.items()})
    table.show({t.run: reason for t, reason in failures.items()}, last=True)
    for training in unfinished:
        if training not in failures and not training.outcome:
            raise UserError(f"{training.run}: {DONE} is missing; use a directory that all machines share")
    return {training: table.rows[training.run].message for training in failures}


def _train(training: Training, threads: int, tick: Callable[[int], None]) -> None:
    """Run a job in its own process; its output goes to log.txt."""
    run = training.run
    run.mkdir(parents=True, exist_ok=True)
    with (run / "log.txt").open("ab") as log, (run / "lock").open("w") as lock:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        with suppress(OSError):  # some file systems have no locks
            fcntl.flock(lock, fcntl.LOCK_EX)  # wait for a job that a killed comparison left in a queue
        if training.outcome:
            return
        torch.set_num_threads(threads)
        progress = Progress(run, tick)
        try:
            outcome = _fit(training, progress) | {"threads": threads}
        except DivergedError as error:
            outcome = {"diverged": str(error)}
        except UserError:
            raise
        except OSError as error:
            raise to_user_error(error) from None
        except Exception as error:
            progress.record_error(error)
            raise
        write_bytes(run / DONE, json.dumps({**outcome, "history": progress.history}).encode())


def _config_hash(config: dict[str, Any], seed: int, precision: str) -> str:
    inputs = {key: config[key] for key in ("data", "model", "start_from") if key in config} | {"seed": seed}
    inputs["trainer"] = {"precision": precision, **config.get("trainer", {})}
    return hashlib.sha256(json.dumps(inputs, sort_keys=True).encode()).hexdigest()[:8]


def _fit(training: Training, progress: Progress) -> dict[str, Any]:
    """Run a job's training and return the facts about it."""
    resumed = newest_checkpoint(training.run) is not None
    config = json.loads(training.config)
    if start := training.start:
        if diverged := (start.outcome or {}).get("diverged"):
            raise DivergedError(f"{start.name}: {diverged}")
        config["start_from"] = str(newest_checkpoint(start.run))
    trainer = fit(training.run, config, training.seed, [progress])
    return {
        "train_s": progress.seconds,
        "steps": trainer.global_step,
        "images_seen": images_seen(trainer),
        "trained_at_commit": origin()["commit"],
        "resumed": resumed,
    }


def fit(run: Path, config: Mapping[str, Any], seed: int, callbacks: Sequence[L.Callback] = ()) -> L.Trainer:
    """Train with a seed in the directory `run`, from its newest checkpoint if there is one."""
    # nlt/report/dashboard.py logs hyperparameters, once the metrics are known.
    logger = {"save_dir": str(run), "name": "", "version": "", "default_hp_metric": False}
    own = {
        "seed_everything": seed,
        "model": {"init_args": {"seed": seed}},
        "data": {"seed": seed},
        "trainer": {
            "enable_model_summary": False,
            "enable_progress_bar": False,
            "logger": {"class_path": "lightning.pytorch.loggers.TensorBoardLogger", "init_args": logger},
        },
    }
    # Jobs run in parallel instead; Lightning's processes for more devices would run the whole command.
    config = merge(merge({"trainer": {"devices": 1}}, config), own)
    write_bytes(run / "run.yaml", yaml.safe_dump(config).encode())
    arguments = ["fit", f"--config={run / 'run.yaml'}"]
    if checkpoint := newest_checkpoint(run):
        print(f"resuming from {checkpoint}", flush=True)
        arguments.append(f"--ckpt_path={checkpoint}")
    return run_lightning(arguments, callbacks).trainer


def newest_checkpoint(run: Path) -> Path | None:
    """Return a run's latest complete checkpoint, or None; one that a killed process left unfinished is skipped."""
    for path in sorted(run.glob("checkpoints/*.ckpt"), key=lambda p: p.stat().st_mtime, reverse=True):
        if is_zipfile(path):  # a zip file's directory is written last
            return path
    return None
