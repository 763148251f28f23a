"""Training and evaluation through LightningCLI: `nlt fit|validate|test|predict`."""

import argparse
import logging
import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import lightning as L
import yaml
from jsonargparse import ArgumentError
from lightning.pytorch.callbacks import BasePredictionWriter, LearningRateMonitor, ModelCheckpoint
from lightning.pytorch.cli import LightningArgumentParser, LightningCLI
from lightning.pytorch.utilities.exceptions import MisconfigurationException
from PIL import Image

from nlt.config import read_configs
from nlt.data.datamodule import LightTransportDataModule
from nlt.data.files import write_bytes
from nlt.data.sample import BUFFERS
from nlt.display import display
from nlt.errors import UserError
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


class Checkpoints(ModelCheckpoint):
    """Saves the last finished epoch's checkpoint and keeps the previous one until the new one is complete."""

    def __init__(self) -> None:
        super().__init__(filename="{epoch}-{step}", save_top_k=1, save_on_train_epoch_end=True)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Mark the last epoch as completed when a run resumes with max_steps, as Lightning does with max_epochs.

        Otherwise Lightning would end that epoch a second time, after one more batch.
        """
        super().on_train_start(trainer, pl_module)
        loop: Any = trainer.fit_loop
        if loop.restarted_on_epoch_end:
            loop.epoch_progress.increment_completed()
            loop._restarting = loop.epoch_loop.restarting = False
            loop.reset_restart_stage()
            loop.epoch_loop.reset_restart_stage()


class Predictions(BasePredictionWriter):
    """Writes the images of `nlt predict` as displayed to predictions/ in the run's directory, by sample index.

    With `exr`, it also writes multi-layer EXRs, whose reference is the mean of the two halves.
    """

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self.exr = False

    def on_predict_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.directory = Path(trainer.log_dir or trainer.default_root_dir) / "predictions"
        self.directory.mkdir(parents=True, exist_ok=True)

    def write_on_batch_end(
        self, trainer: Any, pl_module: Any, prediction: Any, indices: Any, batch: Any, *_: Any
    ) -> None:
        images = (255 * display(prediction, batch["exposure"])).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        for index, image in zip(batch["index"].tolist(), images, strict=True):
            Image.fromarray(image).save(self.directory / f"{index:07d}.png")
        if self.exr:
            from nlt.rendering.exr import exr  # here, because it needs Mitsuba

            layers = {"radiance": prediction, **{name: batch[name] for name in BUFFERS}}
            layers["reference"] = (batch["reference_a"] + batch["reference_b"]) / 2
            for row, index in enumerate(batch["index"].tolist()):
                content = exr({name: images[row].float().cpu().numpy() for name, images in layers.items()})
                write_bytes(self.directory / f"{index:07d}.exr", content)

    def on_predict_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            print(self.directory)


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
            raise UserError(_one_line(str(error))) from None

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
        raise UserError(_with_source(str(error), sources, command)) from None
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


def _one_line(message: str) -> str:
    """Return a message of jsonargparse or Lightning in one line, without the alternatives that were not meant."""
    message = " ".join(message.split())
    message = re.sub(r"Group '([\w.]+)' does not accept option '(\w+)'", r"Option '\1.\2' is not accepted", message)
    message = re.sub(r"Does not validate .*? Errors: - (.*?) - Expected a <class 'NoneType'>.*", r"\1", message)
    message = re.sub(
        r"""Parser key "model": Problem with given class_path '(?:\w+\.)*(\w+)': (?=Parser|Option)""", r"\1: ", message
    )
    return re.sub(r'Parser key "([\w.]+)": Expected an? (.+?)\. Got value: ', _must_be, message)


_KINDS = {"<class 'int'>": "a whole number", "<class 'float'>": "a number", "<class 'bool'>": "true or false"}


def _must_be(found: re.Match[str]) -> str:
    """Return jsonargparse's "Parser key K: Expected a KIND. Got value: " in the words of `nlt.config`."""
    key, kind = found.groups()
    options = re.fullmatch(r"typing\.Literal\[(.*)\]", kind)
    expected = f"one of {options[1].replace(chr(39), '')}" if options else _KINDS.get(kind, kind)
    return f"{key}: must be {expected}, is "


def _with_source(message: str, sources: dict[str, str], command: str) -> str:
    """Return jsonargparse's message in one line that begins with the files or arguments that it is about."""
    message = _one_line(message)
    keys = re.findall(r"""[Oo]ption ['"]([\w.]+)['"]|Parser key ['"]([\w.]+)['"]|([\w.]+): must be""", message)
    words = "".join(keys[-1]).split(".") if keys else []
    matching = [name for name, text in sources.items() if all(re.search(rf"\b{word}\b", text) for word in words)]
    # Settings override configs.
    place = " + ".join([name for name in matching if "=" in name] or matching or sources) or f"nlt {command}"
    return f"{place}: {message}; see nlt {command} --help"


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
