"""What all methods share: U-Net, loss, optimiser, logging, metrics; a method says what feeds the U-Net."""

from __future__ import annotations

import importlib
import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import lightning as L
import torch
from torch import Tensor, nn
from torch.nn.utils import clip_grad_norm_, clip_grad_value_
from torch.optim.lr_scheduler import ExponentialLR, LambdaLR

from nlt.errors import DivergedError, UserError
from nlt.metrics.display import expose
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models import losses
from nlt.models.method import Batch, Method
from nlt.models.policy import project_sparsely
from nlt.models.projection import SparseMap, average_sparsely, project, visible_pixels
from nlt.models.transport import PointEmbedding
from nlt.models.unet import UNet

# The names in a batch that the two shared inputs read.
GBUFFER = ("depth", "normal", "albedo", "view_direction")
PROJECTION = ("depth", "normal", "camera_matrix", "world_to_view")

GBUFFER_CHANNELS = 10

_WARM_UP = 0.05  # share of the steps, with the schedule "cosine"

Cloud = tuple[Tensor, Tensor, Tensor]  # features (B, N, C), positions (B, N, 3), which are valid (B, N)
Features = Tensor | tuple[Tensor, list[SparseMap]]

# What checkpoints have that were written before it could be chosen.
_FIXED = {"points": True, "point_width": 64, "photon_width": 64, "output": "radiance", "add_emission": True}


def log_exposed(radiance: Tensor, exposure: Tensor) -> Tensor:
    """log(1 + exposure * radiance), of (B, ...) and (B,).

    Network inputs of high dynamic range go through this: a lamp or a firefly is orders of magnitude above
    the rest, and fed linearly would swamp every feature it is mixed with.
    """
    return torch.log1p(radiance * exposure.view(-1, *[1] * (radiance.ndim - 1)))


def warm_up_and_cosine(step: int, steps: int) -> float:
    """The factor to the learning rate at a step, out of `steps`: up to 1 in the first 5 %, then down to 0."""
    warm_up = math.ceil(_WARM_UP * steps)
    if step < warm_up:
        return (step + 1) / warm_up
    return (1 + math.cos(math.pi * (step - warm_up) / max(1, steps - warm_up))) / 2


def join(maps: Sequence[Tensor]) -> Tensor:
    """Maps (B, C, H, W) to one of all their channels, in the layout and precision that the convolutions read."""
    device = maps[0].device.type
    dtype = torch.get_autocast_dtype(device) if torch.is_autocast_enabled(device) else maps[0].dtype
    return torch.cat([x.to(dtype, memory_format=torch.channels_last) for x in maps], dim=1)


class RenderingModule(Method, L.LightningModule):
    """Base of all methods that are trained. A subclass gives `feature_channels`, `inputs`, `stages` and `features`.

    A frame is three steps, which can be timed apart: `transport` (3D), `features` (projection, and what else
    feeds the U-Net) and `synthesize` (2D).
    """

    # Hyperparameters that a checkpoint must share to be loaded.
    architecture: tuple[str, ...] = ("width", "depth", "output", "add_emission")

    def __init__(
        self,
        width: int = 64,
        depth: int = 3,
        point_width: int = 64,
        photon_width: int = 64,
        output: Literal["radiance", "demodulated"] = "radiance",
        add_emission: bool = True,
        loss: Literal["mse", "relative_mse"] = "mse",
        learning_rate: float = 5e-4,
        lr_schedule: Literal["paper", "cosine"] = "paper",
        lr_decay: float = 0.99,
        embedding_lr: float = 1.0,
        embedding_decay: float = 0.0,
        clip_share: float = 1.0,
        num_scenes: int = 1,
        num_points: int = 1,
        max_points: int | None = None,
        max_photons: int | None = None,
        seed: int = 0,
    ) -> None:
        """Defaults are the paper's.

        Args:
            width: feature maps of the U-Net's first level.
            depth: number of times the U-Net halves the resolution.
            point_width: features of a point, even; of methods with a PointNet.
            photon_width: features of a photon; of methods with a photon network.
            output: how the U-Net's channels become an image. "radiance" is the paper's: three channels are the image.
                "demodulated": albedo times the first three channels, plus the last three. A method that is not given
                the albedo predicts radiance either way.
            add_emission: with "demodulated", add the radiance that the camera sees directly from lamps and sky, which
                the renderer knows exactly.
            loss: a function in nlt.models.losses.
            learning_rate: the rate of Adam; with the schedule "cosine", its peak.
            lr_schedule: "paper" multiplies the rate by `lr_decay` after each epoch. "cosine" changes it at every step:
                a linear warm-up over the first 5 % of the steps, then half a cosine down to zero.
            lr_decay: factor to the learning rate after each epoch, with the schedule "paper".
            embedding_lr: factor to the learning rate of what is learned of each point.
            embedding_decay: weight decay, apart from the gradient (Loshchilov and Hutter 2019), of the same.
            clip_share: share of the steps, from the first, in which the trainer's gradient_clip_val applies.
            num_scenes: scenes in the dataset; linked from the data.
            num_points: points per scene; linked from the data.
            max_points: use so many of them; None for all.
            max_photons: use so many photons of a sample, each with more flux; None for all.
            seed: of what a method draws at random in training.
        """
        super().__init__()
        transport = (("point_width", point_width, 2), ("photon_width", photon_width, 1))
        for name, value, least in (("width", width, 1), ("depth", depth, 0), *transport):
            if value < least:
                raise UserError(f"model.init_args.{name}: must be at least {least}, is {value}")
        if not 0 <= clip_share <= 1:
            raise UserError(f"model.init_args.clip_share: must be between 0 and 1, is {clip_share}")
        for name, most in (("max_points", max_points), ("max_photons", max_photons)):
            if most is not None and most < 1:
                raise UserError(f"model.init_args.{name}: must be at least 1, is {most}")
        if point_width % 2:
            raise UserError(f"model.init_args.point_width: must be even, is {point_width}")
        self.save_hyperparameters()
        self.hparams["num_points"] = min(num_points, max_points or num_points)  # the embeddings that it has
        self.loss = getattr(losses, loss)
        # channels_last: the convolutions' fastest layout
        unet = UNet(self.feature_channels, width, depth, 6 if self.demodulates else 3)
        self.unet = unet.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._metrics: list[ImageMetrics] = []  # a list hides it from the parameters and the checkpoint

    # --- what a method is ---

    @property
    def feature_channels(self) -> int:
        """Channels of what `features` returns."""
        raise NotImplementedError

    @property
    def demodulates(self) -> bool:
        """Whether the U-Net's output is multiplied by the albedo: see the argument `output`."""
        return self.hparams["output"] == "demodulated" and "albedo" in self.inputs

    @property
    def fields(self) -> tuple[str, ...]:
        return (*self.inputs, "emission") if self.demodulates and self.hparams["add_emission"] else self.inputs

    @property
    def state_inputs(self) -> tuple[str, ...]:
        """The batch fields that do not depend on the camera: all that `transport` may read."""
        return (*(name for name in self.inputs if name.startswith(("point_", "photon_"))), "scene", "exposure")

    def transport(self, batch: Batch) -> Any:
        """Light transport, of the `state_inputs`: whatever `features` takes up again; None for a method without."""
        return None

    def features(self, batch: Batch, transported: Any = None) -> Features:
        """The U-Net's input (B, feature_channels, H, W), from the batch and what `transport` returned.

        Or its first channels, and maps of the others: see `nlt.models.policy.Policy.sparse`.
        """
        raise NotImplementedError

    # --- what methods share ---

    def gbuffer(self, batch: Batch) -> Tensor:
        """(B, 10, H, W): depth, normal, albedo and view direction."""
        return join([batch[name] for name in GBUFFER])

    def project(self, batch: Batch, features: Tensor, positions: Tensor, valid: Tensor) -> Tensor:
        """Eq. (1) with the batch's camera: features (B, N, C) at positions (B, N, 3) to (B, C, H, W)."""
        camera = (batch["camera_matrix"], batch["world_to_view"])
        return project(features, positions, valid, *camera, batch["depth"], batch["normal"])

    def gbuffer_and(self, batch: Batch, clouds: Sequence[Cloud]) -> Features:
        """The G-buffer and behind it each cloud's own map; a mean over all would mix their kinds of feature."""
        gbuffer = self.gbuffer(batch)
        if project_sparsely(max((len(valid[0]) for *_, valid in clouds), default=0), gbuffer[0, 0].numel()):
            view: dict[str, Any] = {name: batch[name] for name in PROJECTION}
            found = ((features, visible_pixels(places, valid, **view)) for features, places, valid in clouds)
            return gbuffer, [average_sparsely(*pair, *gbuffer.shape[-2:]) for pair in found]
        return join([gbuffer, *(self.project(batch, *cloud) for cloud in clouds)])

    def synthesize(self, batch: Batch, features: Features) -> Tensor:
        """Features to linear radiance (B, 3, H, W)."""
        dense, sparse = (features, []) if isinstance(features, Tensor) else features
        channels = self.unet(dense.contiguous(memory_format=torch.channels_last), sparse)
        # Out of the layout and, under autocast, the precision that the convolutions ran in.
        return self.to_radiance(batch, channels.contiguous().to(batch["exposure"].dtype))

    def to_radiance(self, batch: Batch, channels: Tensor) -> Tensor:
        """The U-Net's output (B, 3 or 6, H, W), in exposed radiance, as linear radiance (B, 3, H, W).

        It is affine in the output either way, so that Lemma 1 holds: the gradient towards a noisy, unbiased target has
        the expectation of the gradient towards the noise-free one.
        """
        if not self.demodulates:
            return expose(channels, 1 / batch["exposure"])
        scale, offset = channels.split(3, dim=1)
        radiance = expose(batch["albedo"] * scale + offset, 1 / batch["exposure"])
        return radiance + batch["emission"] if self.hparams["add_emission"] else radiance

    @property
    def has_point_embeddings(self) -> bool:
        """Whether something is learned of each point, which holds for these scenes' points alone."""
        return any(isinstance(part, PointEmbedding) for part in self.modules())

    @property
    def num_photons(self) -> int | None:
        return self.hparams["max_photons"]

    def subsample(self, batch: Batch) -> Batch:
        """The batch with `max_points` points and `max_photons` photons at most; the photons' flux sums to the same."""
        points, photons = self.hparams["max_points"], self.hparams["max_photons"]
        if points:  # in the order in which they were drawn: any of them are a uniform sample
            batch = {k: v[:, :points] if k.startswith("point_") else v for k, v in batch.items()}
        total = batch["photon_flux"].shape[1] if "photon_flux" in batch else 0
        if photons and total > photons:  # they lie by emitter: of each its share
            chosen = ((torch.arange(photons, device=batch["photon_flux"].device) + 0.5) * (total / photons)).long()
            batch = {k: v[:, chosen] if k.startswith("photon_") else v for k, v in batch.items()}
            batch["photon_flux"] = batch["photon_flux"] * (total / photons)
        return batch

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        """Transport, projection, synthesis."""
        transport = lambda batch, _: self.transport(self.subsample(batch))
        features = lambda batch, transported: self.features(self.subsample(batch), transported)
        return {"transport": transport, "projection": features, "synthesis": self.synthesize}

    # --- training and evaluation ---

    def training_step(self, batch: Batch, batch_idx: int) -> Tensor:
        loss = self.loss(self(batch), batch["noisy"], batch["exposure"])
        if not loss.isfinite():
            raise DivergedError(
                f"train/loss is {loss.item()} at step {self.global_step}, in a batch of scenes "
                f"{batch['scene'].tolist()}, samples {batch['index'].tolist()}: check these for values that "
                "are not finite, or lower model.init_args.learning_rate"
            )
        self.log("train/loss", loss, prog_bar=True, batch_size=len(batch["scene"]))
        return loss

    def configure_optimizers(self) -> Any:
        chosen = self.hparams
        rate, embeddings = chosen["learning_rate"], self._embeddings()
        known = {id(parameter) for parameter in embeddings}
        groups: list[dict[str, Any]] = [{"params": [p for p in self.parameters() if id(p) not in known]}]
        if embeddings:
            own = {"lr": rate * chosen["embedding_lr"], "weight_decay": chosen["embedding_decay"]}
            groups.append({"params": embeddings, **own})
        optimizer = torch.optim.Adam(groups, lr=rate, decoupled_weight_decay=True, fused=True)
        if chosen["lr_schedule"] == "paper":
            return [optimizer], [ExponentialLR(optimizer, gamma=chosen["lr_decay"])]
        steps = int(self.trainer.estimated_stepping_batches)
        schedule = LambdaLR(optimizer, lambda step: warm_up_and_cosine(step, steps))
        return [optimizer], [{"scheduler": schedule, "interval": "step"}]

    def _embeddings(self) -> list[nn.Parameter]:
        return [p for part in self.modules() if isinstance(part, PointEmbedding) for p in part.parameters()]

    def configure_gradient_clipping(
        self, optimizer: Any, gradient_clip_val: Any = None, gradient_clip_algorithm: Any = None
    ) -> None:
        """Clip as the trainer says, in the first `clip_share` of the steps.

        Lightning's own method refuses a fused Adam in mixed precision, but here no loss is scaled.
        """
        share = self.hparams["clip_share"]
        if gradient_clip_val and (share == 1 or self.global_step < share * self.trainer.estimated_stepping_batches):
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
        # Against the noisy target too, to stand beside train/loss.
        loss = self.loss(prediction, batch["noisy"], batch["exposure"])
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
        """Import path: the method's identity in a checkpoint."""
        return f"{cls.__module__}.{cls.__qualname__}"

    def on_save_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        # Not left to "hyper_parameters": load_from_checkpoint overwrites those with its arguments.
        checkpoint["method"] = self.class_path()
        checkpoint["architecture"] = {name: self.hparams[name] for name in self.architecture}

    def on_load_checkpoint(self, checkpoint: dict[str, Any]) -> None:
        """Raises UserError if the checkpoint is of another method or another size."""
        path = self._trainer.ckpt_path if self._trainer else None
        if checkpoint.get("method") != self.class_path():
            raise _wrong_method(path, checkpoint, type(self))
        saved = _FIXED | checkpoint["architecture"]
        different = [name for name in self.architecture if saved[name] != self.hparams[name]]
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
        """As Lightning's. `RenderingModule.load_from_checkpoint` takes a checkpoint of any method.

        Raises UserError if the checkpoint is not of `cls`, or `kwargs` change its size.
        """
        # Before Lightning builds `cls` from hyperparameters that may be another method's; meta: no tensors.
        checkpoint = torch.load(checkpoint_path, map_location="meta", weights_only=True)
        module, _, name = str(checkpoint.get("method", "")).rpartition(".")
        try:
            method = getattr(importlib.import_module(module), name)
        except (ImportError, AttributeError, ValueError):
            method = None
        if not (isinstance(method, type) and issubclass(method, cls)):
            raise _wrong_method(checkpoint_path, checkpoint, cls)
        return super(RenderingModule, method).load_from_checkpoint(checkpoint_path, *args, **kwargs)


def _wrong_method(path: str | Path | None, checkpoint: dict[str, Any], wanted: type) -> UserError:
    name = str(checkpoint.get("method", "an unknown method")).rpartition(".")[2]
    return UserError(
        f"{path or 'given'}: checkpoint is of {name}, not {wanted.__name__}: "
        "give the model configuration it was trained with, or another checkpoint"
    )
