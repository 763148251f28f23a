"""Training and evaluation through LightningCLI: `nlt fit|validate|test|predict`."""

import argparse
import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import lightning as L
import yaml
from jsonargparse import ArgumentError
from lightning.pytorch.callbacks import LearningRateMonitor
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import MisconfigurationException

from nlt.callbacks import Checkpoints, Predictions
from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.errors import UserError
from nlt.lightning_errors import one_line, with_source
from nlt.models.clouds import CloudMethod
from nlt.models.factory import load_method, method_class, read_checkpoint, without_unused
from nlt.models.image_grid import ImageGrid
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device

# Advice for other set-ups: it contradicts deliberate choices or does not apply here.
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
# Names of checkpoints that Lightning finds by itself.
_LIGHTNING_CHECKPOINTS = ("best", "last", "hpc")
# A setting as `key=value`, without the dashes of Lightning's `--key=value`.
_SETTING = re.compile(r"(data|model|trainer|seed_everything|ckpt_path|start_from)\b[\w.+]*=")


class NLTCLI(LightningCLI):
    """LightningCLI in subclass mode, for one DataModule and any method."""

    def add_arguments_to_parser(self, parser: LightningArgumentParser) -> None:
        """Add `start_from`, which `nlt fit` reads; the other commands accept it because a run's config contains it."""
        parser.add_argument(
            "--start_from",
            type=str | None,
            default=None,
            help="a checkpoint of the same method, trained in any rooms, whose weights `fit` starts from",
        )

    def _prepare_subcommand_parser(self, klass: type, subcommand: str, **kwargs: Any) -> LightningArgumentParser:
        parser = super()._prepare_subcommand_parser(klass, subcommand, **kwargs)
        if subcommand == "predict":
            parser.add_argument("--exr", action="store_true", help="also write multi-layer EXRs")
        return parser

    def before_instantiate_classes(self) -> None:
        """Tell a method with points their number; a linked argument would reach methods without points, too."""
        config = self.config[self.config.subcommand]
        if issubclass(method_class(config.as_dict(), "--config"), CloudMethod):
            dataset = config.data.dataset
            config.model.init_args.num_scenes = len(dataset.scenes)
            config.model.init_args.num_points = dataset.num_points

    def _parse_ckpt_path(self) -> None:
        """Check the checkpoint; Lightning's version would silently replace the config's model by the checkpoint's."""
        command = self.config.subcommand
        path = self.config[command].get("ckpt_path")
        if path is None and command != "fit":
            raise UserError(f"--ckpt_path: missing; nlt {command} needs a checkpoint from nlt fit")
        if path and path not in _LIGHTNING_CHECKPOINTS:
            try:
                read_checkpoint(path)
            except OSError as error:
                raise UserError(f"--ckpt_path: {path}: cannot be read: {error.strerror}") from None
            except Exception:  # a damaged file can make the unpickler raise anything
                raise UserError(f"--ckpt_path: {path}: not a checkpoint, or damaged; give another one") from None

    def instantiate_classes(self) -> None:
        """Instantiate the classes and report errors of the model or trainer as user errors."""
        try:
            super().instantiate_classes()
            if self.subcommand == "fit" and self.config.fit.start_from:
                self._start_from(self.config.fit.start_from)
            if self.subcommand == "predict" and self.config.predict.exr:
                self.datamodule.gbuffer = True
                trainer: Any = self.trainer
                for callback in trainer.callbacks:
                    if isinstance(callback, Predictions):
                        callback.exr = True
        except (ValueError, MisconfigurationException) as error:
            raise UserError(one_line(str(error))) from None

    def _start_from(self, checkpoint: str) -> None:
        """Copy the weights of a checkpoint; with `ckpt_path`, Lightning overrides them by those of the resumed run.

        Raises:
            UserError: it is not a checkpoint, of another method or size, or of one that learns its training scenes.
        """
        if self.model.learns_its_scenes:
            raise UserError(
                f"--start_from: {checkpoint}: the method learns its training scenes (embeddings or a field); use a "
                "method without them, such as photons_only, or resume with --ckpt_path"
            )
        weights = load_method(checkpoint, "--start_from").state_dict()
        # Only embeddings and fields, which are refused above, depend on the number of scenes and points.
        self.model.check_checkpoint(read_checkpoint(checkpoint), checkpoint, ("num_scenes", "num_points"))
        self.model.load_state_dict(weights)


def quiet() -> None:
    """Silence all messages of Lightning except relevant warnings and errors."""
    for name in ("lightning.pytorch", "lightning.fabric"):
        logging.getLogger(name).setLevel(logging.WARNING)
    for pattern in _NOISE:
        warnings.filterwarnings("ignore", pattern)


class _ConfigChecker(NLTCLI):
    """Parses a config without instantiating anything."""

    def _set_seed(self) -> None: ...

    def _parse_ckpt_path(self) -> None: ...

    def before_instantiate_classes(self) -> None: ...

    def instantiate_classes(self) -> None: ...


def check_configs(files: list[str]) -> None:
    """Check that `nlt fit` accepts the keys and types in these configs, without instantiating anything.

    Raises:
        UserError: a key is unknown or a value has the wrong type.
    """
    _run(_ConfigChecker, ["fit", *(f"--config={file}" for file in files)], run=False)


def run_lightning(arguments: list[str], callbacks: Sequence[L.Callback] = ()) -> NLTCLI:
    """Run a subcommand, for example `fit --config data/demo ...`, and return its LightningCLI.

    Settings are given as `--key=value`, `--key value` or `key=value`; they override all configs.

    Raises:
        UserError: a config, a checkpoint or the dataset is wrong.
    """
    return _run(NLTCLI, arguments, callbacks)


def _run(kind: type[NLTCLI], arguments: list[str], callbacks: Sequence[L.Callback] = (), run: bool = True) -> NLTCLI:
    quiet()
    command, configs, settings = arguments[0], *_parse(arguments[1:])
    try:
        return kind(
            RenderingModule,
            LightTransportDataModule,
            subclass_mode_model=True,
            seed_everything_default=0,
            # These disable Lightning's samplers, which would repeat samples in evaluation.
            trainer_defaults=trainer_defaults(callbacks),
            save_config_kwargs={"overwrite": True},
            parser_kwargs={"exit_on_error": False},
            args=[command] * run + _merged(configs, settings) + settings,
            run=run,
        )
    except ArgumentError as error:
        sources = {file: yaml.safe_dump(read_configs([file])) for file in configs}
        sources |= {setting: setting for setting in settings}
        raise UserError(with_source(str(error), sources, command)) from None
    except UserError as error:  # an error from a loader process contains its traceback
        raise type(error)(str(error).rpartition("UserError: ")[2].strip()) from None


def _parse(arguments: list[str]) -> tuple[list[str], list[str]]:
    """Return the configs and the other arguments, in which `key=value` has become `--key=value`."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("-c", "--config", action="append", nargs="?", default=[])
    options, others = parser.parse_known_args(arguments)
    settings = [f"--{word}" if _SETTING.match(word) else word for word in others]
    return [file for file in options.config if file], settings + ["--config"] * (None in options.config)


def _merged(configs: list[str], settings: list[str]) -> list[str]:
    """Return the configs as one argument, so that their order is free where they do not override each other.

    Raises:
        UserError: a file cannot be read, or there are settings of a model that none of the configs chooses.
    """
    content, place = read_configs(configs), " + ".join(configs)
    model = content.get("model")
    if isinstance(model, Mapping) and "class_path" in model:
        content = without_unused(content, method_class(content, place))
    elif model and not any(setting.startswith("--model") for setting in settings):
        raise UserError(f"{place}: model.class_path: missing; add a --config from configs/model")
    return [f"--config={yaml.safe_dump(content)}"] if configs else []


def trainer_defaults(callbacks: Sequence[L.Callback] = ()) -> dict[str, Any]:
    """Return the trainer's settings, which configs can override."""
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
