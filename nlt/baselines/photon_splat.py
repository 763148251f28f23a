"""Photon splat, not in the paper: the photons' irradiance in each pixel feeds the U-Net, without a 3D network."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.models.clouds import CloudMethod
from nlt.models.module import PROJECTION, Batch, join_channels, log_exposed
from nlt.models.projection import total, visible_pixels

_RADII = (1, 2, 4, 8)  # of footprints, in pixels from the middle one
_GRAZING = 0.01  # least cosine: at a grazing angle a pixel sees less than the plane, which reaches the horizon


def seen_area(batch: Batch) -> Tensor:
    """Return the area in m² (B, 1, H, W) that each pixel sees of the plane through its centre; 0 where no hit.

    It is the pixel's solid angle times the squared distance, over the cosine between normal and view direction.
    """
    camera, view = batch["camera_matrix"], batch["view_direction"]
    focal = (camera[:, 0, 0] * camera[:, 1, 1]).view(-1, 1, 1, 1)
    # Not a matmul, which may run in bfloat16.
    along = (batch["world_to_view"][:, 2, :3, None, None] * view).sum(1, keepdim=True)
    cosine = (batch["normal"] * view).sum(1, keepdim=True).abs().clamp(min=_GRAZING)
    return (batch["depth"].square() * along / (focal * cosine)).abs()


def box_sums(table: Tensor, radius: int) -> Tensor:
    """Return the sums (B, C, H, W) over the pixels within `radius` rows and columns, from a summed-area table.

    `table` (B, C, H + 1, W + 1) has the sum over all pixels above and to the left of each pixel corner (Crow 1984).
    """
    for axis in (2, 3):
        size = table.shape[axis] - 1
        pixel = torch.arange(size, device=table.device)
        first, behind = (pixel - radius).clamp(min=0), (pixel + radius + 1).clamp(max=size)
        table = table.index_select(axis, behind) - table.index_select(axis, first)
    return table


class PhotonSplat(CloudMethod):
    """The U-Net on the G-buffer and the log of the irradiance, a photon density estimate (Jensen 1996)."""

    architecture = (*CloudMethod.architecture, "footprint")

    def __init__(self, footprint: int = 4, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            footprint: number of photons that an estimate needs. It uses the smallest footprint that holds as many: the
                pixel itself, or 3x3, 5x5, 9x9 or at most 17x17 pixels. 0: always the pixel itself, which is unbiased;
                choosing the footprint by its photons biases the estimate by about a tenth.
        """
        super().__init__(**kwargs)

    @property
    def feature_channels(self) -> int:
        return self.gbuffer_channels + 3

    @property
    def inputs(self) -> tuple[str, ...]:
        photons = ("photon_flux", "photon_hit", "photon_valid")
        return tuple(dict.fromkeys((*self.gbuffer_inputs, *PROJECTION, *photons)))

    def irradiance(self, batch: Batch) -> Tensor:
        """Return the irradiance (B, 3, H, W), W·m⁻², from emitters on the surface in each pixel; 0 where no hit."""
        depth, flux = batch["depth"], batch["photon_flux"]
        camera = (batch["camera_matrix"], batch["world_to_view"])
        pixels = visible_pixels(batch["photon_hit"], batch["photon_valid"], *camera, depth, batch["normal"])
        carried = torch.cat([flux, torch.ones_like(flux[..., :1])], dim=-1)
        arrived = torch.where(depth > 0, total(carried, pixels, *depth.shape[-2:]), 0)
        sums = torch.cat([arrived, seen_area(batch)], dim=1)
        chosen = sums
        if self.hparams["footprint"]:
            table = F.pad(sums.double().cumsum(2).cumsum(3), (1, 0, 1, 0))  # in float32, differences would lose digits
            for radius in _RADII:
                wider = box_sums(table, radius).to(sums.dtype)
                chosen = torch.where(chosen[:, 3:4] < self.hparams["footprint"], wider, chosen)
        return torch.where(depth > 0, chosen[:, :3] / chosen[:, 4:], 0)

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        return join_channels([self.gbuffer(batch), log_exposed(self.irradiance(batch), batch["exposure"])])
