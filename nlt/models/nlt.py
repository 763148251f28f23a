"""The paper's method: light transport on points and optionally photons, projection and image synthesis."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.data.sample import MATERIALS
from nlt.models.clouds import CloudMethod
from nlt.models.module import PROJECTION, Batch, Features, log_exposed
from nlt.models.projection import average_rows, visible_pixels, visible_rows
from nlt.models.transport import PhotonNetwork, PointEmbedding, PointNet

POINT_ATTRIBUTES = 3 + len(MATERIALS) + 3 + 3 + 1  # position, material, albedo, emission, visibility
PHOTON_ATTRIBUTES = 3 + 3 + 3  # origin, direction, colour


class NeuralLightTransport(CloudMethod):
    """Sec. "Method": the U-Net sees the G-buffer, projected point features and, with `use_photons`, photon features."""

    architecture = (
        *CloudMethod.architecture, "num_scenes", "num_points", "use_points", "use_photons", "embedding",
        "point_width", "photon_width",
    )  # fmt: skip

    def __init__(self, use_points: bool = True, use_photons: bool = False, embedding: int = 32, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            use_points: use the points; without them there is no PointNet and no embedding.
            use_photons: use the photons ("w/ Photons").
            embedding: channels of the learned embedding of each point.
        """
        super().__init__(**kwargs)
        hparams = self.hparams
        if use_points:
            self.embedding = PointEmbedding(hparams["num_scenes"], hparams["num_points"], embedding)
            self.pointnet = PointNet(embedding + POINT_ATTRIBUTES, hparams["point_width"])
        if use_photons:
            self.photon_network = PhotonNetwork(PHOTON_ATTRIBUTES, hparams["photon_width"])

    @property
    def feature_channels(self) -> int:
        chosen = self.hparams
        points = chosen["point_width"] * chosen["use_points"]
        return self.gbuffer_channels + points + chosen["photon_width"] * chosen["use_photons"]

    @property
    def inputs(self) -> tuple[str, ...]:
        points = tuple(f"point_{name}" for name in ("position", "visible", "material", "albedo", "emission"))
        photons = tuple(f"photon_{name}" for name in ("origin", "direction", "flux", "hit", "valid"))
        used = (points if self.hparams["use_points"] else ()) + (photons if self.hparams["use_photons"] else ())
        return tuple(dict.fromkeys((*self.gbuffer_inputs, *(PROJECTION if used else ()), *used)))

    def transport(self, batch: Batch) -> tuple[Tensor | None, Tensor | None]:
        """Return features of the points (B, N, point_width) and photons (B, P, photon_width), None if not used.

        In training, `features` computes the photons' features, because it knows which photons the view sees.
        """
        points = self._point_features(batch) if self.hparams["use_points"] else None
        all_photons = self.hparams["use_photons"] and not (self.training and torch.is_grad_enabled())
        return points, self.photon_network(self._photons(batch)) if all_photons else None

    def _point_features(self, batch: Batch) -> Tensor:
        exposure, visible = batch["exposure"], batch["point_visible"]
        points = [
            self.embedding(batch["scene"]),
            batch["point_position"],
            F.one_hot(batch["point_material"], len(MATERIALS)),
            batch["point_albedo"],
            log_exposed(batch["point_emission"], exposure),
            visible[..., None],
        ]
        return self.pointnet(torch.cat([x.to(points[0].dtype) for x in points], dim=-1), visible)

    def _photons(self, batch: Batch) -> Tensor:
        """Return the photon network's input (B, P, 9)."""
        # Times their number: each photon carries only its share of the arriving power.
        power = batch["photon_flux"] * batch["photon_valid"].sum(1).view(-1, 1, 1)
        colour = log_exposed(power, batch["exposure"])
        return torch.cat([batch["photon_origin"], batch["photon_direction"], colour], dim=-1)

    def features(self, batch: Batch, transported: Any = None) -> Features:
        points, photons = transported
        clouds = []
        if points is not None:
            clouds.append((points, batch["point_position"], batch["point_visible"]))
        if photons is not None:
            clouds.append((photons, batch["photon_hit"], batch["photon_valid"]))
        delayed = self.hparams["use_photons"] and photons is None
        return self.gbuffer_and(batch, clouds, [self._seen_photons(batch)] if delayed else ())

    def _seen_photons(self, batch: Batch) -> Tensor:
        """Return the photons' map (B, photon_width, H, W), computing features only for photons that the view sees.

        Training logs their share as `train/photons_seen`.
        """
        images, _, height, width = batch["depth"].shape
        view: dict[str, Any] = {name: batch[name] for name in PROJECTION}
        seen, at = visible_rows(visible_pixels(batch["photon_hit"], batch["photon_valid"], **view), height, width)
        if self._trainer is not None and self._trainer.training:
            self.log("train/photons_seen", len(at) / batch["photon_valid"].sum(), batch_size=images)
        return average_rows(self.photon_network(self._photons(batch)[seen]), at, images, height, width)
