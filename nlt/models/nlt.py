"""The paper's method: light transport on points, optionally with photons, projected and synthesized."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.data.sample import MATERIALS
from nlt.models.module import GBUFFER, GBUFFER_CHANNELS, PROJECTION, Batch, RenderingModule, log_exposed
from nlt.models.transport import PhotonNetwork, PointEmbedding, PointNet

TRANSPORT_FEATURES = 64  # of a point and of a photon
POINT_ATTRIBUTES = 3 + len(MATERIALS) + 3 + 3 + 1  # position, material, albedo, emission, visibility
PHOTON_ATTRIBUTES = 3 + 3 + 3  # origin, direction, colour


class NeuralLightTransport(RenderingModule):
    """Sec. "Method": G-buffer and projected point features, with `photons` also projected photon features."""

    architecture = (*RenderingModule.architecture, "num_scenes", "num_points", "photons", "embedding")

    def __init__(self, photons: bool = False, embedding: int = 32, **kwargs: Any) -> None:
        """The base class takes the keyword arguments.

        Args:
            photons: use the photons too ("w/ Photons").
            embedding: channels of the learned embedding of each point.
        """
        super().__init__(**kwargs)
        hparams = self.hparams
        self.embedding = PointEmbedding(hparams["num_scenes"], hparams["num_points"], embedding)
        self.pointnet = PointNet(embedding + POINT_ATTRIBUTES, TRANSPORT_FEATURES)
        self.photon_network = PhotonNetwork(PHOTON_ATTRIBUTES, TRANSPORT_FEATURES) if photons else None

    @property
    def feature_channels(self) -> int:
        return GBUFFER_CHANNELS + TRANSPORT_FEATURES * (1 + self.hparams["photons"])

    @property
    def inputs(self) -> tuple[str, ...]:
        points = tuple(f"point_{name}" for name in ("position", "visible", "material", "albedo", "emission"))
        photons = tuple(f"photon_{name}" for name in ("origin", "direction", "flux", "hit", "valid"))
        names = (*GBUFFER, *PROJECTION, *points, *(photons if self.hparams["photons"] else ()))
        return tuple(dict.fromkeys(names))

    @property
    def stages(self) -> tuple[str, ...]:
        return ("gbuffer", "photons") if self.hparams["photons"] else ("gbuffer",)

    def transport(self, batch: Batch) -> tuple[Tensor, Tensor | None]:
        """Features of the points (B, N, 64), and of the photons (B, P, 64) or None."""
        exposure, visible = batch["exposure"], batch["point_visible"]
        points = [
            self.embedding(batch["scene"]),
            batch["point_position"],
            F.one_hot(batch["point_material"], len(MATERIALS)),
            batch["point_albedo"],
            log_exposed(batch["point_emission"], exposure),
            visible[..., None],
        ]
        point_features = self.pointnet(torch.cat([x.to(points[0].dtype) for x in points], dim=-1), visible)
        if self.photon_network is None:
            return point_features, None
        # Times their number: a photon carries that share of the power that arrives.
        power = batch["photon_flux"] * batch["photon_valid"].sum(1).view(-1, 1, 1)
        colour = log_exposed(power, exposure)
        photons = torch.cat([batch["photon_origin"], batch["photon_direction"], colour], dim=-1)
        return point_features, self.photon_network(photons)

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        points, photons = transported
        maps = [
            self.gbuffer(batch),
            self.project(batch, points, batch["point_position"], batch["point_visible"]),
        ]
        if photons is not None:  # a map of their own: a mean over both would mix two kinds of feature
            maps.append(self.project(batch, photons, batch["photon_hit"], batch["photon_valid"]))
        return torch.cat(maps, dim=1)
