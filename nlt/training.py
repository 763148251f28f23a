"""Training and evaluation through LightningCLI: `nlt fit|validate|test|predict`."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path
from typing import Any

import torch
from jsonargparse import ArgumentError
from lightning.pytorch.callbacks import LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI

from nlt.data.datamodule import LightTransportDataModule
from nlt.errors import UserError
from nlt.models.image_grid import ImageGrid
from nlt.models.module import RenderingModule

# Advice for other set-ups than ours; what it says is either decided on purpose or untrue here.
_NOISE = (".*does not have many workers.*", ".*LeafSpec.*", ".*log_every_n_steps.*", ".*GPU available but not used.*")


class Checkpoints(ModelCheckpoint):
    """The last finished epoch's checkpoint, and the one before until the new one is written whole."""

    def __init__(self) -> None:
        super().__init__(filename="{epoch}-{step}", save_top_k=1, save_on_train_epoch_end=True)


class NLTCLI(LightningCLI):
    """LightningCLI in subclass mode: one DataModule, any method."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name in ("num_scenes", "num_points"):
            parser.link_arguments(f"data.{name}", f"model.init_args.{name}", apply_on="instantiate")

    def _parse_ckpt_path(self) -> None:
        """Not Lightning's: that would silently replace the config's model by the checkpoint's."""


def run_lightning(arguments: list[str]) -> NLTCLI:
    """Run a subcommand such as `fit --config ...` and return what it made.

    Raises:
        UserError: a config, a checkpoint or the dataset is wrong.
    """
    logging.getLogger("lightning.pytorch").setLevel(logging.WARNING)
    for pattern in _NOISE:
        warnings.filterwarnings("ignore", pattern)
    torch.set_float32_matmul_precision("high")
    try:
        return NLTCLI(
            RenderingModule,
            LightTransportDataModule,
            subclass_mode_model=True,
            seed_everything_default=0,
            # The samplers are ours: Lightning's would repeat samples at evaluation.
            trainer_defaults=trainer_defaults(),
            save_config_kwargs={"overwrite": True},
            parser_kwargs={"exit_on_error": False},
            args=arguments,
        )
    except ArgumentError as error:
        raise UserError(" ".join(str(error).split())) from None
    except FileNotFoundError as error:
        raise UserError(f"{error.filename or error}: no such file") from None


def trainer_defaults() -> dict[str, Any]:
    """What the trainer does unless a config says otherwise."""
    return {
        "use_distributed_sampler": False,
        "num_sanity_val_steps": 0,
        "default_root_dir": "runs",
        "callbacks": [LearningRateMonitor(logging_interval="epoch"), Checkpoints(), ImageGrid()],
    }


def newest_checkpoint(run: Path) -> Path | None:
    """The latest checkpoint of a run that can be read: one that was being written at a kill -9 is passed over."""
    for path in sorted(run.glob("checkpoints/*.ckpt"), key=lambda p: p.stat().st_mtime, reverse=True):
        try:
            torch.load(path, map_location="cpu", weights_only=True)
        except Exception:  # whatever a truncated file makes the unpickler raise
            continue
        return path
    return None
