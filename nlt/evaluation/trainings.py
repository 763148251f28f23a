"""The trainings behind a comparison: one per method and seed, each in a directory of its own, none made twice."""

from __future__ import annotations

import hashlib
import json
import time
from pathlib import Path
from typing import Any

import torch
import yaml

from nlt import training
from nlt.data.files import write_bytes
from nlt.data.spec import read_configs
from nlt.errors import DivergedError, UserError
from nlt.evaluation.comparison import Comparison, untrained
from nlt.evaluation.provenance import origin
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.training import newest_checkpoint


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
    # What was trained on another device, in its precision, is evaluated and timed on this one as it is.
    precisions = dict.fromkeys((training.trainer_defaults()["precision"], *training.PRECISIONS))
    runs = [root / f"{method}-{_key(merged, seed, precision)}" for precision in precisions]
    run = next((run for run in runs if (run / "done.json").exists()), runs[0])
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


def _key(config: dict[str, Any], seed: int, precision: str) -> str:
    decides = {key: config.get(key) for key in ("data", "model")} | {"seed": seed}
    decides["trainer"] = {"precision": precision, **config.get("trainer", {})}
    return hashlib.sha256(json.dumps(decides, sort_keys=True).encode()).hexdigest()[:8]


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
