"""Not in the paper, "Photon splat": no 3D network; the irradiance that photons bring to each pixel feeds the U-Net."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.models.module import GBUFFER, GBUFFER_CHANNELS, PROJECTION, Batch, RenderingModule, join, log_exposed
from nlt.models.projection import total, visible_pixels

_RADII = (1, 2, 4, 8)  # of footprints, in pixels beside the one in the middle
_GRAZING = 0.01  # the least cosine: at a grazing angle a pixel sees less than its plane's area to the horizon


def seen_area(batch: Batch) -> Tensor:
    """Surface area in m² (B, 1, H, W) that each pixel sees, of the plane through its centre; 0 where no hit.

    Its solid angle, times the squared distance, over the cosine between normal and view direction.
    """
    camera, view = batch["camera_matrix"], batch["view_direction"]
    focal = (camera[:, 0, 0] * camera[:, 1, 1]).view(-1, 1, 1, 1)
    # Not a matmul, which may run in bfloat16.
    along = (batch["world_to_view"][:, 2, :3, None, None] * view).sum(1, keepdim=True)
    cosine = (batch["normal"] * view).sum(1, keepdim=True).abs().clamp(min=_GRAZING)
    return (batch["depth"].square() * along / (focal * cosine)).abs()


class PhotonSplat(RenderingModule):
    """G-buffer and, in three channels, the logarithm of a density estimate of irradiance by photons (Jensen 1996)."""

    architecture = (*RenderingModule.architecture, "footprint")
    inputs = tuple(dict.fromkeys((*GBUFFER, *PROJECTION, "photon_flux", "photon_hit", "photon_valid")))
    stages = ("gbuffer", "photons")
    feature_channels = GBUFFER_CHANNELS + 3

    def __init__(self, footprint: int = 4, **kwargs: Any) -> None:
        """The base class takes the keyword arguments.

        Args:
            footprint: photons that an estimate is made of, if the pixel itself or the 3x3, 5x5, 9x9 or 17x17 pixels
                around it hold so many; the fewest pixels that do are taken. 0: always the pixel alone, which is
                unbiased; choosing by what has arrived is not, by about a tenth.
        """
        super().__init__(**kwargs)

    def irradiance(self, batch: Batch) -> Tensor:
        """(B, 3, H, W), W·m⁻²: from emitters, on what each pixel sees; 0 where no hit."""
        depth, flux = batch["depth"], batch["photon_flux"]
        camera = (batch["camera_matrix"], batch["world_to_view"])
        pixels = visible_pixels(batch["photon_hit"], batch["photon_valid"], *camera, depth, batch["normal"])
        carried = torch.cat([flux, torch.ones_like(flux[..., :1])], dim=-1)
        arrived = torch.where(depth > 0, total(carried, pixels, *depth.shape[-2:]), 0)
        sums = torch.cat([arrived, seen_area(batch)], dim=1)
        chosen = sums
        for radius in _RADII if self.hparams["footprint"] else ():
            wider = F.avg_pool2d(sums, 2 * radius + 1, 1, radius, divisor_override=1)
            chosen = torch.where(chosen[:, 3:4] < self.hparams["footprint"], wider, chosen)
        return torch.where(depth > 0, chosen[:, :3] / chosen[:, 4:], 0)

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        return join([self.gbuffer(batch), log_exposed(self.irradiance(batch), batch["exposure"])])
