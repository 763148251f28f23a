"""The trainings behind a comparison: independent jobs, each in a directory of its own, none made twice."""

from __future__ import annotations

import fcntl
import hashlib
import json
import os
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import yaml

from nlt.data.engines import find_engine
from nlt.data.files import write_bytes
from nlt.data.spec import merge, read_configs
from nlt.errors import DivergedError, UserError, to_user_error
from nlt.evaluation.comparison import Comparison, build_if_untrained
from nlt.evaluation.progress import DONE, Progress, ProgressTable, images_seen
from nlt.evaluation.provenance import origin
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.training import check_configs, newest_checkpoint, run_lightning


@dataclass(frozen=True)
class Training:
    """A job: a method's training with a seed, on all training images or the first `train_images` of each scene.

    Its directory `run` belongs to a hash of all that decides the outcome, so a method is trained anew only when that
    changed. There lie its checkpoints, its log, how far it is, and, once it has come to an end, what it took.
    """

    method: str
    seed: int
    run: Path
    files: tuple[str, ...]
    precision: str
    train_images: int | None = None

    @classmethod
    def of(
        cls, comparison: Comparison, method: str, seed: int, root: Path, train_images: int | None = None
    ) -> Training:
        """A comparison's training, in a directory below `root`."""
        files = comparison.configs(method)
        merged = read_configs(files)
        if train_images:
            merged = merge(merged, {"data": {"train_images": train_images}})
        # What was trained on another device, in its precision, is evaluated and timed on this one as it is.
        wanted = ("auto", "32", "bf16") if comparison.precision == "auto" else (comparison.precision,)
        precisions = dict.fromkeys(Policy.for_device(default_device(), name).precision for name in wanted)
        runs = {precision: root / f"{method}-{_key(merged, seed, precision)}" for precision in precisions}
        precision = next((p for p, run in runs.items() if (run / DONE).exists()), next(iter(runs)))
        # Absolute: processes elsewhere have other working directories.
        paths = tuple(os.path.abspath(file) for file in files)
        return cls(method, seed, runs[precision].absolute(), paths, precision, train_images)

    @property
    def name(self) -> str:
        """As it is printed."""
        images = f", {self.train_images} images" if self.train_images else ""
        return f"{self.method}, seed {self.seed}{images}"

    @property
    def took(self) -> dict[str, Any] | None:
        """What it took, or how it diverged, and its `history` (progress.py); None if it has not come to an end."""
        done = self.run / DONE
        took = json.loads(done.read_text()) if done.exists() else None
        return took if took and ("diverged" in took or newest_checkpoint(self.run)) else None

    def load(self, device: torch.device) -> tuple[RenderingModule, dict[str, Any]]:
        """The trained method and what that took.

        Raises:
            DivergedError: it diverged, now or when it was tried before.
        """
        took, checkpoint = self.took or {}, newest_checkpoint(self.run)
        took.pop("history", None)
        if "diverged" in took:
            raise DivergedError(took["diverged"])
        assert checkpoint is not None
        module = RenderingModule.load_from_checkpoint(checkpoint, map_location=device).eval()
        return module, took | {"run": os.path.relpath(self.run)}


def check(comparison: Comparison) -> None:
    """Raises UserError if a config of any method would not do, before the first is trained."""
    for method in comparison.methods:
        if not build_if_untrained(method):
            check_configs(comparison.configs(method))


def train(
    trainings: list[Training], scheduler: str, workers: int | None, slurm: Mapping[str, str]
) -> dict[Training, str]:
    """Train what has not come to an end yet; what died twice, and of what.

    Each has a process of its own: it may be killed for its memory, and Lightning keeps state. Here these are forked
    from one that has imported Lightning, which takes seconds.

    Raises:
        UserError: a config or the dataset is wrong, or the disk is full.
    """
    left = [training for training in trainings if not training.took]
    died: dict[Training, str] = {}
    if not left:
        return died
    engine = find_engine(scheduler, workers or (1 if scheduler == "local" else None), slurm, preload=(__name__,))
    table = ProgressTable({t.run: t.name for t in left})
    print(f"\n{len(left)} of {len(trainings)} trainings to do, {engine.workers} side by side", flush=True)
    with closing(engine.run(_train, left, died)) as ticks:
        for _ in ticks:
            table.show({t.run: reason for t, reason in died.items()})
    table.show({t.run: reason for t, reason in died.items()}, last=True)
    for training in left:
        if training not in died and not training.took:
            raise UserError(f"{training.run}: still without {DONE}: do all machines see this directory?")
    return {training: table.rows[training.run].message for training in died}


def _train(training: Training, threads: int, tick: Callable[[int], None]) -> None:
    """A job, in a process of its own; whatever it has to say goes to log.txt."""
    run = training.run
    run.mkdir(parents=True, exist_ok=True)
    with (run / "log.txt").open("ab") as log, (run / "lock").open("w") as lock:
        for stream in (1, 2):
            os.dup2(log.fileno(), stream)
        with suppress(OSError):  # file systems without locks
            fcntl.flock(lock, fcntl.LOCK_EX)  # until one is done that an earlier, killed comparison left in a queue
        if training.took:
            return
        torch.set_num_threads(threads)
        progress = Progress(run, tick)
        try:
            took = _fit(training, progress) | {"threads": threads}
        except DivergedError as error:
            took = {"diverged": str(error)}
        except UserError:
            raise
        except OSError as error:
            raise to_user_error(error) from None
        except Exception as error:
            progress.died(error)
            raise
        write_bytes(run / DONE, json.dumps({**took, "history": progress.history}).encode())


def _key(config: dict[str, Any], seed: int, precision: str) -> str:
    decides = {key: config.get(key) for key in ("data", "model")} | {"seed": seed}
    decides["trainer"] = {"precision": precision, **config.get("trainer", {})}
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]


def _fit(training: Training, progress: Progress) -> dict[str, Any]:
    """Train, from the newest checkpoint if there is one; what that took."""
    own = training.run / "run.yaml"
    own.write_text(yaml.safe_dump(_run_config(training)))
    arguments = ["fit", *(f"--config={file}" for file in (*training.files, own))]
    checkpoint = newest_checkpoint(training.run)
    if checkpoint:
        print(f"resuming from {checkpoint}", flush=True)
        arguments.append(f"--ckpt_path={checkpoint}")
    trainer = run_lightning(arguments, [progress]).trainer
    return {
        "train_s": progress.seconds,
        "steps": trainer.global_step,
        "images_seen": images_seen(trainer),
        "trained_at_commit": origin()["commit"],
        "resumed": checkpoint is not None,
    }


def _run_config(training: Training) -> dict[str, Any]:
    # Hyperparameters are logged when the metrics are known: nlt/report/dashboard.py.
    logger = {"save_dir": str(training.run), "name": "", "version": "", "default_hp_metric": False}
    trainer = read_configs(list(training.files)).get("trainer") or {}
    return {
        "seed_everything": training.seed,
        "model": {"init_args": {"seed": training.seed}},
        "data": {"seed": training.seed} | ({"train_images": training.train_images} if training.train_images else {}),
        "trainer": {
            # Not what a machine elsewhere would choose: the directory belongs to this one.
            "precision": trainer.get("precision", training.precision),
            # Side by side are jobs; and Lightning's processes for more devices would run the whole command.
            "devices": trainer.get("devices", 1),
            "enable_model_summary": False,
            "enable_progress_bar": False,
            "logger": {"class_path": "lightning.pytorch.loggers.TensorBoardLogger", "init_args": logger},
        },
    }
