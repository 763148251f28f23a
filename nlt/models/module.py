"""The base class of trained methods: U-Net, loss, optimiser, logging, metrics. A method defines the U-Net's input."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from torch import Tensor
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim.lr_scheduler import ExponentialLR, LambdaLR

from nlt.data.sample import DIRECT
from nlt.display import expose
from nlt.errors import DivergedError, UserError
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models import losses
from nlt.models.method import Batch, Method
from nlt.models.muon import Muon
from nlt.models.projection import SparseMap
from nlt.models.unet import UNet

# Batch fields that the G-buffer input and the projection read.
GBUFFER = ("depth", "normal", "albedo", "view_direction")
PROJECTION = ("depth", "normal", "camera_matrix", "world_to_view")

_WARM_UP = 0.05  # share of the steps, with lr_schedule "cosine"

Steps = dict[str, Callable[[Batch, Any], Any]]
Features = Tensor | tuple[Tensor, list[SparseMap]]


def log_exposed(radiance: Tensor, exposure: Tensor) -> Tensor:
    """Return log(1 + exposure * radiance): radiance (B, ...) and exposure (B,), or (B, 3, H, W) and (B, 3).

    Network inputs of high dynamic range are compressed this way: a lamp or a firefly is orders of magnitude brighter
    than the rest, and its linear value would swamp every feature it is mixed with.
    """
    return torch.log1p(radiance * exposure.view(*exposure.shape, *[1] * (radiance.ndim - exposure.ndim)))


def warm_up_and_cosine(step: int, steps: int) -> float:
    """Return the learning rate's factor at `step` of `steps`: a rise to 1 in the first 5 %, then half a cosine to 0."""
    warm_up = math.ceil(_WARM_UP * steps)
    if step < warm_up:
        return (step + 1) / warm_up
    return (1 + math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))) / 2


def check_at_least(least: int, **values: int | None) -> None:
    """Raise UserError if a hyperparameter is below `least`; None means that it is not set."""
    for name, value in values.items():
        if value is not None and value < least:
            raise UserError(f"model.init_args.{name}: must be at least {least}, is {value}")


def join_channels(maps: Sequence[Tensor]) -> Tensor:
    """Concatenate maps (B, C, H, W) along the channels, in the layout and precision that the convolutions read."""
    device = maps[0].device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else maps[0].dtype
    return torch.cat([x.to(dtype, memory_format=torch.channels_last) for x in maps], dim=1)


class RenderingModule(Method, L.LightningModule):
    """The base of all trained methods. A subclass defines `feature_channels`, `inputs` and `features`.

    A frame takes three steps, which can be timed separately: `transport` (3D), `features` (projection and all other
    inputs of the U-Net) and `synthesize` (2D).
    """

    # Hyperparameters that a checkpoint must share to be loaded.
    architecture: tuple[str, ...] = ("width", "depth", "patch", "output", "add_emission", "direct_light")
    # Fast paths at inference, which `nlt.models.policy.accelerate` switches on; see `Policy`.
    sparse = in_bfloat16 = False

    def __init__(
        self,
        width: int = 64,
        depth: int = 3,
        patch: int = 1,
        output: Literal["radiance", "demodulated"] = "radiance",
        add_emission: bool = True,
        direct_light: bool = False,
        cleaner_target: bool = False,
        loss: Literal["mse", "relative_mse"] = "mse",
        optimizer: Literal["adam", "muon"] = "adam",
        learning_rate: float = 5e-4,
        lr_schedule: Literal["paper", "cosine"] = "paper",
        lr_decay: float = 0.99,
        seed: int = 0,
    ) -> None:
        """The defaults are the paper's.

        Args:
            width: feature maps of the U-Net's first level.
            depth: number of times the U-Net halves the resolution.
            patch: the U-Net's first level has one pixel for each patch of so many pixels squared; 1 in the paper.
            output: how the U-Net's channels become an image. "radiance" is the paper's: three channels are the image.
                "demodulated": albedo times the first three channels, plus the last three. A method without the albedo
                as input predicts radiance either way.
            add_emission: with "demodulated", add the radiance that the camera sees directly from lamps and sky, which
                the renderer knows exactly.
            direct_light: also read the direct light and the seen albedo, in metal and glass and under a coat, which
                the renderer gives without noise (`Renderer.gbuffer`); with "demodulated", the output adds seen albedo
                times direct light, so that the network predicts the rest. Only for methods that read the G-buffer; not
                in the paper.
            cleaner_target: train towards the `target` image of 16 spp instead of the paper's `noisy` image of 1 spp.
            loss: name of a function in nlt.models.losses.
            optimizer: "adam" is the paper's. "muon" orthogonalises the steps of all weights but the last layer's, the
                biases and the embeddings (nlt/models/muon.py).
            learning_rate: the optimiser's learning rate; with the schedule "cosine", its peak.
            lr_schedule: "paper" multiplies the rate by `lr_decay` after each epoch. "cosine" changes it at every step:
                a linear warm-up over the first 5 % of the steps, then half a cosine down to zero.
            lr_decay: factor on the learning rate after each epoch, with the schedule "paper".
            seed: seed of the random numbers that a method draws in training.
        """
        super().__init__()
        check_at_least(1, width=width, patch=patch)
        check_at_least(0, depth=depth)
        self.save_hyperparameters()
        if direct_light and not self.reads_direct_light:
            name = type(self).__name__
            raise UserError(f"model.init_args.direct_light: {name} does not read the G-buffer; leave it out")
        self.loss = getattr(losses, loss)
        # channels_last is the fastest layout of the convolutions.
        unet = UNet(self.feature_channels, width, depth, 6 if self.demodulates else 3, patch)
        self.unet = unet.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._metrics: list[ImageMetrics] = []  # in a list, which keeps them out of the parameters and the checkpoint

    # --- what a method defines ---

    @property
    def has_point_embeddings(self) -> bool:
        """Whether the method learns embeddings, which are valid for the training scenes' points only."""
        return False

    @property
    def learns_its_scenes(self) -> bool:
        """Whether the method learns something that holds in its training scenes only: embeddings or a field."""
        return self.has_point_embeddings

    @property
    def feature_channels(self) -> int:
        """Number of channels that `features` returns."""
        raise NotImplementedError

    @property
    def demodulates(self) -> bool:
        """Whether the U-Net's output is multiplied by the albedo; see the argument `output`."""
        return self.hparams["output"] == "demodulated" and "albedo" in self.inputs

    @property
    def fields(self) -> tuple[str, ...]:
        return (*self.inputs, "emission") if self.demodulates and self.hparams["add_emission"] else self.inputs

    @property
    def target(self) -> str:
        """The noisy image that training compares with: one that the method does not read, so that the noise differs."""
        return "target" if self.hparams["cleaner_target"] else "noisy"

    @property
    def training_fields(self) -> tuple[str, ...]:
        """Names of the batch fields that a training step reads."""
        return (*self.fields, self.target)

    @property
    def state_inputs(self) -> tuple[str, ...]:
        """The batch fields that do not depend on the camera, which are all that `transport` may read."""
        return (*(name for name in self.inputs if name.startswith(("point_", "photon_"))), "scene", "exposure")

    def transport(self, batch: Batch) -> Any:
        """Compute light transport from the `state_inputs`, as an input of `features`; None in methods without any."""
        return None

    def features(self, batch: Batch, transported: Any = None) -> Features:
        """Return the U-Net's input (B, feature_channels, H, W), from the batch and the result of `transport`.

        With `sparse`, return the input's first channels and sparse maps of the others.
        """
        raise NotImplementedError

    # --- what all methods share ---

    @property
    def gbuffer_inputs(self) -> tuple[str, ...]:
        """The batch fields that `gbuffer` reads."""
        return (*GBUFFER, *DIRECT) if self.hparams["direct_light"] else GBUFFER

    @property
    def gbuffer_channels(self) -> int:
        """The number of channels that `gbuffer` returns."""
        return 16 if self.hparams["direct_light"] else 10

    def gbuffer(self, batch: Batch) -> Tensor:
        """Return the maps of `GBUFFER` and, if chosen, of direct light (B, 10 or 16, H, W)."""
        maps = [batch[name] for name in GBUFFER]
        if self.hparams["direct_light"]:
            mirrors_and_coats = batch["seen_albedo"] - batch["albedo"]
            maps += [log_exposed(batch["direct"], self.exposure(batch)), mirrors_and_coats]
        return join_channels(maps)

    def albedo(self, batch: Batch) -> Tensor:
        """Return the albedo (B, 3, H, W); with direct light, the seen one: in metal and glass, and under a coat."""
        return batch["seen_albedo" if self.hparams["direct_light"] else "albedo"]

    def synthesize(self, batch: Batch, features: Features) -> Tensor:
        """Run the U-Net on the features and return linear radiance (B, 3, H, W)."""
        dense, sparse = (features, []) if isinstance(features, Tensor) else features
        channels = self.unet(dense.contiguous(memory_format=torch.channels_last), sparse)
        # Leave the convolutions' layout and, under autocast, their precision.
        return self.to_radiance(batch, channels.contiguous().to(batch["exposure"].dtype))

    def to_radiance(self, batch: Batch, channels: Tensor) -> Tensor:
        """Convert the U-Net's output (B, 3 or 6, H, W), in exposed radiance, to linear radiance (B, 3, H, W).

        The radiance is affine in the output either way, so Lemma 1 holds: the expected gradient for a noisy, unbiased
        target is the gradient for the noise-free one.
        """
        unexpose = 1 / self.exposure(batch)
        if not self.demodulates:
            return expose(channels, unexpose)
        scale, offset = channels.split(3, dim=1)
        albedo = self.albedo(batch)
        radiance = expose(albedo * scale + offset, unexpose)
        if self.hparams["direct_light"]:
            radiance = radiance + albedo * batch["direct"]
        return radiance + batch["emission"] if self.hparams["add_emission"] else radiance

    def exposure(self, batch: Batch) -> Tensor:
        """Return the exposure (B,) or (B, 3) of the radiance that the U-Net reads and predicts: the scene's."""
        return batch["exposure"]

    def steps(self) -> Steps:
        """Return the steps "transport", "projection" and "synthesis"."""
        transport = lambda batch, _: self.transport(self.subsample(batch))
        features = lambda batch, transported: self.features(self.subsample(batch), transported)
        steps: Steps = {"transport": transport, "projection": features, "synthesis": self.synthesize}
        return {name: _in_bfloat16(step) for name, step in steps.items()} if self.in_bfloat16 else steps

    # --- training and evaluation ---

    def noisy_loss(self, prediction: Tensor, batch: Batch) -> Tensor:
        """Return the loss of a prediction (B, 3, H, W) against the noisy target."""
        return self.loss(prediction, batch[self.target], batch["exposure"])

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.noisy_loss(self(batch), batch)
        if not loss.isfinite():
            raise DivergedError(
                f"train/loss is {loss.item()} at step {self.global_step}, in a batch of scenes "
                f"{batch['scene'].tolist()}, samples {batch['index'].tolist()}: check these for values that "
                "are not finite, or lower model.init_args.learning_rate"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch["scene"]))
        return loss

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return the optimiser's parameter groups: the network's, and those with options of their own."""
        return [{"params": list(self.parameters())}]

    def build_optimizer(self) -> torch.optim.Adam:
        """Return the optimiser, without its schedule, which needs a trainer."""
        chosen = self.hparams
        groups, rate = self.parameter_groups(), chosen["learning_rate"]
        kind: type[torch.optim.Adam] = torch.optim.Adam
        if chosen["optimizer"] == "muon":
            kind, (network, *others) = Muon, groups
            is_matrix = lambda p: p.ndim > 1 and p is not self.unet.conv_out.weight
            matrices, rest = [[p for p in network["params"] if is_matrix(p) == wanted] for wanted in (True, False)]
            groups = [{"params": rest}, {"params": matrices, "orthogonal": True}, *others]
        return kind(groups, lr=rate, decoupled_weight_decay=True, fused=True)

    def configure_optimizers(self) -> Any:
        chosen, optimizer = self.hparams, self.build_optimizer()
        if chosen["lr_schedule"] == "paper":
            return [optimizer], [ExponentialLR(optimizer, gamma=chosen["lr_decay"])]
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = LambdaLR(optimizer, lambda step: warm_up_and_cosine(step, steps))
        return [optimizer], [{"scheduler": schedule, "interval": "step"}]

    def configure_gradient_clipping(
        self, optimizer: Any, gradient_clip_val: Any = None, gradient_clip_algorithm: Any = None
    ) -> None:
        """Clip gradients as the trainer is configured.

        Lightning's own method rejects a fused Adam in mixed precision, which is safe here because no loss is scaled.
        """
        if gradient_clip_val:
            clip = clip_grad_value_ if gradient_clip_algorithm == "value" else clip_grad_norm_
            clip(self.parameters(), gradient_clip_val)

    def _evaluation_step(self, batch: Batch) -> Tensor:
        prediction = self(batch)
        self._metrics[0].update(prediction, batch["reference_a"], batch["reference_b"], batch["exposure"])
        return prediction

    def _log_metrics(self, prefix: str) -> None:
        self.log_dict({f"{prefix}/{name}": value for name, value in self._metrics[0].compute().items()})

    def on_validation_epoch_start(self) -> None:
        self._metrics = [ImageMetrics(perceptual=False).to(self.device)]

    def validation_step(self, batch: Batch, batch_idx: int) -> Tensor:
        prediction = self._evaluation_step(batch)
        # Against the noisy target, to be comparable with train/loss.
        loss = self.noisy_loss(prediction, batch)
        self.log("val/loss", loss, batch_size=len(batch["scene"]))
        return prediction

    def on_validation_epoch_end(self) -> None:
        self._log_metrics("val")

    def on_test_epoch_start(self) -> None:
        self._metrics = [ImageMetrics(perceptual=True).to(self.device)]

    def test_step(self, batch: Batch, batch_idx: int) -> Tensor:
        return self._evaluation_step(batch)

    def on_test_epoch_end(self) -> None:
        self._log_metrics("test")

    # --- checkpoints ---

    @classmethod
    def class_path(cls) -> str:
        """Return the import path, which identifies the method in a checkpoint."""
        return f"{cls.__module__}.{cls.__qualname__}"

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # Not taken from "hyper_parameters", which load_from_checkpoint overwrites with its arguments.
        checkpoint["method"] = self.class_path()
        checkpoint["architecture"] = {name: self.hparams[name] for name in self.architecture}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        self.check_checkpoint(checkpoint, self._trainer.ckpt_path if self._trainer else None)

    def check_checkpoint(
        self, checkpoint: Mapping[str, Any], path: str | Path | None, may_differ: Collection[str] = ()
    ) -> None:
        """Check that a checkpoint, read from `path`, fits this method; hyperparameters in `may_differ` do not count.

        Raises:
            UserError: the checkpoint is of another method or another size.
        """
        if checkpoint.get("method") != self.class_path():
            raise _wrong_method(path, checkpoint, type(self))
        # An option that is younger than the checkpoint had no effect in its training.
        saved = dict.fromkeys(self.architecture, False) | {"patch": 1} | checkpoint["architecture"]
        different = [name for name in self.architecture if name not in may_differ and saved[name] != self.hparams[name]]
        if different:
            raise UserError(
                f"{path or 'given'}: checkpoint has {', '.join(f'{name}={saved[name]}' for name in different)}, "
                f"this model {', '.join(f'{name}={self.hparams[name]}' for name in different)}: "
                "use the configuration the checkpoint was trained with"
            )

    @classmethod
    def load_from_checkpoint(  # type: ignore[override]
        cls, checkpoint_path: str | Path, *args: Any, **kwargs: Any
    ) -> RenderingModule:
        """Load a checkpoint as Lightning does; `RenderingModule.load_from_checkpoint` accepts one of any method.

        Raises:
            UserError: the checkpoint is not of `cls`, or `kwargs` change its size.
        """
        # Checked before Lightning builds `cls` from another method's hyperparameters; "meta" loads no tensors.
        checkpoint = torch.load(checkpoint_path, map_location="meta", weights_only=True)
        module, _, name = str(checkpoint.get("method", "")).rpartition(".")
        try:
            method = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError):
            method = None
        if not (isinstance(method, type) and issubclass(method, cls)):
            raise _wrong_method(checkpoint_path, checkpoint, cls)
        return super(RenderingModule, method).load_from_checkpoint(checkpoint_path, *args, **kwargs)


def _in_bfloat16(step: Callable[[Batch, Any], Any]) -> Callable[[Batch, Any], Any]:
    def run(batch: Batch, result: Any) -> Any:
        with torch.autocast(batch["exposure"].device.type, torch.bfloat16):
            return step(batch, result)

    return run


def _wrong_method(path: str | Path | None, checkpoint: Mapping[str, Any], wanted: type) -> UserError:
    name = str(checkpoint.get("method", "an unknown method")).rpartition(".")[2]
    return UserError(
        f"{path or 'given'}: checkpoint is of {name}, not {wanted.__name__}: "
        "give the model configuration it was trained with, or another checkpoint"
    )
