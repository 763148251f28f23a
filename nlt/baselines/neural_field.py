"""A neural field beside photons, not in the paper: what a room does to light is learned by place, not by point."""

import math
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlt.models.module import Batch, check_at_least, join_channels
from nlt.models.nlt import NeuralLightTransport
from nlt.models.transport import PhotonNetwork

_LONGEST, _OCTAVES = 8.0, 6  # waves of the position: 8 m, 4 m, ... 25 cm
_HIDDEN = 64
_NEAREST = 0.1  # m; keeps what is computed at a lamp's own surface finite
_ATTRIBUTES = 3 * 2 * _OCTAVES + 3 + 3 + 2  # waves, normal, direction to the light, its cosine and log distance


def surface_positions(batch: Batch) -> Tensor:
    """Return the surface in each pixel's centre (B, H, W, 3), in metres and world space; the camera where no hit."""
    view, depth = (batch[name].permute(0, 2, 3, 1) for name in ("view_direction", "depth"))
    rotation, offset = batch["world_to_view"][:, None, None, :3, :3], batch["world_to_view"][:, None, None, :3, 3:]
    camera = -(rotation * offset).sum(-2)  # not a matmul, which may run in bfloat16
    return camera + view * depth / (rotation[..., 2, :] * view).sum(-1, keepdim=True)


def mean_light(batch: Batch) -> Tensor:
    """Return the mean origin of the photons (B, 3), in metres, weighted by their power; 0 without any."""
    power = batch["photon_flux"].sum(-1, keepdim=True) * batch["photon_valid"][..., None]
    return (power * batch["photon_origin"]).sum(1) / power.sum(1).clamp(min=torch.finfo(power.dtype).tiny)


class NeuralField(NeuralLightTransport):
    """The paper's method, whose U-Net also sees a field: a small network of a pixel's place (Mildenhall et al. 2020).

    The network reads position, normal, and where the light is: the mean origin of the photons, weighted by their power.
    Like the embeddings of points, the field remembers its training scenes; unlike them, it is smooth and has no gaps.
    """

    architecture = (*NeuralLightTransport.architecture, "field_width")

    def __init__(
        self, field_width: int = 16, use_points: bool = False, use_photons: bool = True, **kwargs: Any
    ) -> None:
        """The keyword arguments are those of the base class.

        Args:
            field_width: channels of the field; 0 for no field.
            use_points: use the points, as the paper's method does.
            use_photons: project the photons' features, as the paper's method does.
        """
        check_at_least(0, field_width=field_width)
        super().__init__(use_points, use_photons, **kwargs)
        if field_width:
            inputs = _ATTRIBUTES + self.hparams["num_scenes"]
            self.field = nn.Sequential(PhotonNetwork(inputs, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, field_width))

    @property
    def learns_its_scenes(self) -> bool:
        return super().learns_its_scenes or bool(self.hparams["field_width"])

    @property
    def feature_channels(self) -> int:
        return super().feature_channels + self.hparams["field_width"]

    @property
    def inputs(self) -> tuple[str, ...]:
        field = ("world_to_view", "photon_origin", "photon_flux", "photon_valid") if self.hparams["field_width"] else ()
        return tuple(dict.fromkeys((*super().inputs, *field)))

    def gbuffer(self, batch: Batch) -> Tensor:
        """Return the G-buffer and the field (B, gbuffer_channels + field_width, H, W)."""
        gbuffer = super().gbuffer(batch)
        if not self.hparams["field_width"]:
            return gbuffer
        return join_channels([gbuffer, self.field(self._place(batch)).permute(0, 3, 1, 2)])

    def _place(self, batch: Batch) -> Tensor:
        """Return what the field reads of each pixel (B, H, W, _ATTRIBUTES + num_scenes), in world space."""
        position, normal = surface_positions(batch), batch["normal"].permute(0, 2, 3, 1)
        to_light = mean_light(batch)[:, None, None] - position
        distance = torch.linalg.vector_norm(to_light, dim=-1, keepdim=True) + _NEAREST
        cosine = (to_light * normal).sum(-1, keepdim=True) / distance
        angle = position[..., None] * (2 * math.pi / _LONGEST * 2 ** torch.arange(_OCTAVES, device=position.device))
        waves = torch.cat([angle.sin(), angle.cos()], dim=-1).flatten(-2)
        scene = F.one_hot(batch["scene"], self.hparams["num_scenes"])[:, None, None].expand(*distance.shape[:3], -1)
        return torch.cat([waves, normal, to_light / distance, cosine, distance.log(), scene], dim=-1)
