"""Training and evaluation through LightningCLI: `nlt fit|validate|test|predict`."""

from __future__ import annotations

import argparse
import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from zipfile import is_zipfile

import lightning as L
import torch
from jsonargparse import ArgumentError
from lightning.pytorch.callbacks import BasePredictionWriter, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from PIL import Image

from nlt.data.datamodule import LightTransportDataModule
from nlt.data.spec import read_configs
from nlt.errors import UserError
from nlt.metrics.display import display
from nlt.models.image_grid import ImageGrid
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device

# Advice for other set-ups than ours; what it says is either decided on purpose or untrue here.
_NOISE = (
    ".*does not have many workers.*",
    ".*LeafSpec.*",
    ".*log_every_n_steps.*",
    ".*GPU available but not used.*",
    ".*LightningCLI's args parameter.*",
    ".*The dirpath has changed.*",
    ".*callbacks used to create the checkpoint need to be provided.*",
    ".*Checkpoint directory .* exists and is not empty.*",
)
# Checkpoints that Lightning finds by itself.
_LIGHTNINGS_OWN = ("best", "last", "hpc")


class Checkpoints(ModelCheckpoint):
    """The last finished epoch's checkpoint, and the one before until the new one is written whole."""

    def __init__(self) -> None:
        super().__init__(filename="{epoch}-{step}", save_top_k=1, save_on_train_epoch_end=True)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Resuming with max_steps, Lightning would end the last epoch anew, on a batch more: as with max_epochs."""
        super().on_train_start(trainer, pl_module)
        loop: Any = trainer.fit_loop
        if loop.restarted_on_epoch_end:
            loop.epoch_progress.increment_completed()
            loop._restarting = loop.epoch_loop.restarting = False
            loop.reset_restart_stage()
            loop.epoch_loop.reset_restart_stage()


class Predictions(BasePredictionWriter):
    """`nlt predict`: every predicted image as displayed, in the run's directory predictions/, by sample index."""

    def __init__(self) -> None:
        super().__init__(write_interval="batch")

    def on_predict_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.directory = Path(trainer.log_dir or trainer.default_root_dir) / "predictions"
        self.directory.mkdir(parents=True, exist_ok=True)

    def write_on_batch_end(
        self, trainer: Any, pl_module: Any, prediction: Any, indices: Any, batch: Any, *_: Any
    ) -> None:
        images = (255 * display(prediction, batch["exposure"])).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        for index, image in zip(batch["index"].tolist(), images, strict=True):
            Image.fromarray(image).save(self.directory / f"{index:07d}.png")

    def on_predict_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            print(self.directory)


class NLTCLI(LightningCLI):
    """LightningCLI in subclass mode: one DataModule, any method."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        for name in ("num_scenes", "num_points"):
            parser.link_arguments(f"data.{name}", f"model.init_args.{name}", apply_on="instantiate")

    def _parse_ckpt_path(self) -> None:
        """Not Lightning's: that would silently replace the config's model by the checkpoint's."""
        command = self.config.subcommand
        path = self.config[command].get("ckpt_path")
        if path is None and command != "fit":
            raise UserError(f"--ckpt_path: missing; nlt {command} needs a checkpoint of nlt fit")
        if path and path not in _LIGHTNINGS_OWN:
            try:
                read_checkpoint(path)
            except OSError as error:
                raise UserError(f"--ckpt_path: {path}: cannot be read: {error.strerror}") from None
            except Exception:  # whatever a damaged file makes the unpickler raise
                raise UserError(f"--ckpt_path: {path}: not a checkpoint, or damaged; give another one") from None

    def instantiate_classes(self) -> None:
        """Lightning's, refusals of a model or the trainer said as a user's mistake."""
        try:
            super().instantiate_classes()
        except (ValueError, MisconfigurationException) as error:
            raise UserError(_one_line(str(error))) from None


def quiet() -> None:
    """Lightning says what is wrong, and no more."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for pattern in _NOISE:
        warnings.filterwarnings("ignore", pattern)


class _Parser(NLTCLI):
    """Parses a config, and makes nothing of it."""

    def _set_seed(self) -> None: ...

    def _parse_ckpt_path(self) -> None: ...

    def instantiate_classes(self) -> None: ...


def check_configs(files: list[str]) -> None:
    """Raises UserError if `nlt fit` would not take these configs: for a key or a type, before anything is made."""
    arguments = ["fit", *(f"--config={file}" for file in files)]
    _run(_Parser, arguments[1:], _sources(arguments), run=False)


def run_lightning(arguments: list[str], callbacks: Sequence[L.Callback] = ()) -> NLTCLI:
    """Run a subcommand such as `fit --config ...` and return what it made.

    Raises:
        UserError: a config, a checkpoint or the dataset is wrong.
    """
    return _run(NLTCLI, arguments, _sources(arguments), callbacks)


def _run(
    kind: type[NLTCLI],
    arguments: list[str],
    given: dict[str, str],
    callbacks: Sequence[L.Callback] = (),
    run: bool = True,
) -> NLTCLI:
    quiet()
    try:
        return kind(
            RenderingModule,
            LightTransportDataModule,
            subclass_mode_model=True,
            seed_everything_default=0,
            # The samplers are ours: Lightning's would repeat samples at evaluation.
            trainer_defaults=trainer_defaults(callbacks),
            save_config_kwargs={"overwrite": True},
            parser_kwargs={"exit_on_error": False},
            args=arguments,
            run=run,
        )
    except ArgumentError as error:
        raise UserError(_with_place(str(error), given, arguments[0] if run else "fit")) from None
    except UserError as error:  # one from a loader process comes with that process's traceback
        raise type(error)(str(error).rpartition("UserError: ")[2].strip()) from None


def _sources(arguments: list[str]) -> dict[str, str]:
    """What settings come from: --config files, once they can be read, and other arguments, with their text.

    Raises:
        UserError: a file cannot be read, or settings of a model come before the model.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-c", "--config", action="append", nargs="?", default=[])
    options, rest = parser.parse_known_args(arguments[1:])
    files = [file for file in options.config if file]
    known = any(argument.startswith("--model") for argument in rest)
    for file in files:
        model = read_configs([file]).get("model")
        known = known or (isinstance(model, Mapping) and "class_path" in model)
        if model and not known:
            raise UserError(f"{file}: model.class_path: missing; give a --config of configs/model before this one")
    return {file: Path(file).read_text() for file in files} | {argument: argument for argument in rest}


def _one_line(message: str) -> str:
    """jsonargparse's or Lightning's message, without the alternatives that were not meant."""
    message = " ".join(message.split())
    message = re.sub(r"Group '([\w.]+)' does not accept option '(\w+)'", r"Option '\1.\2' is not accepted", message)
    return re.sub(r"Does not validate .*? Errors: - (.*?) - Expected a <class 'NoneType'>.*", r"\1", message)


def _with_place(message: str, given: dict[str, str], command: str) -> str:
    """jsonargparse's message as one line, headed by the files or arguments it is about."""
    message = _one_line(message)
    keys = re.findall(r"""(?:[Oo]ption|Parser key) ['"]([\w.]+)['"]""", message)
    words = keys[-1].split(".") if keys else []
    about = [name for name, text in given.items() if all(re.search(rf"\b{word}\b", text) for word in words)]
    place = " + ".join(about or given) or f"nlt {command}"
    return f"{place}: {message}; see nlt {command} --help"


def trainer_defaults(callbacks: Sequence[L.Callback] = ()) -> dict[str, Any]:
    """What the trainer does unless a config says otherwise."""
    return {
        "precision": Policy.for_device(default_device()).precision,
        "use_distributed_sampler": False,
        "num_sanity_val_steps": 0,
        "default_root_dir": "runs",
        "callbacks": [
            LearningRateMonitor(logging_interval="epoch"),
            Checkpoints(),
            ImageGrid(),
            Predictions(),
            *callbacks,
        ],
    }


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """A checkpoint, without running any code that it may hold. A file that is none raises anything."""
    checkpoint = torch.load(path, map_location="cpu", weights_only=True)
    return dict(checkpoint)


def load_method(path: str, place: str, device: torch.device | str = "cpu") -> RenderingModule:
    """The method of a checkpoint; `place` is what asks for it, such as an option.

    Raises:
        UserError: it cannot be read, or is none.
    """
    try:
        return RenderingModule.load_from_checkpoint(path, map_location=device)
    except OSError as error:
        raise UserError(f"{place}: {path}: cannot be read: {error.strerror}") from None
    except UserError:
        raise
    except Exception:  # whatever a damaged file makes the unpickler raise
        raise UserError(f"{place}: {path}: not a checkpoint, or damaged; give another one") from None


def newest_checkpoint(run: Path) -> Path | None:
    """The latest checkpoint of a run that can be read: one that was being written at a kill -9 is passed over."""
    for path in sorted(run.glob("checkpoints/*.ckpt"), key=lambda p: p.stat().st_mtime, reverse=True):
        if is_zipfile(path):  # its directory is written last, so nothing need be read
            return path
    return None
