"""Not in the paper, "Photon splat": no 3D network; the irradiance that photons bring to each pixel feeds the U-Net."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.models.module import GBUFFER, GBUFFER_CHANNELS, PROJECTION, Batch, RenderingModule, join, log_exposed
from nlt.models.projection import total, visible_pixels

_GRAZING = 0.01  # the least cosine: at a grazing angle a pixel sees less than its plane's area to the horizon


def seen_area(batch: Batch) -> Tensor:
    """Surface area in m² (B, 1, H, W) that each pixel sees, of the plane through its centre; 0 where no hit.

    Its solid angle, times the squared distance, over the cosine between normal and view direction.
    """
    camera, view = batch["camera_matrix"], batch["view_direction"]
    focal = (camera[:, 0, 0] * camera[:, 1, 1]).abs().view(-1, 1, 1, 1)
    # Not a matmul, which may run in bfloat16.
    along = (batch["world_to_view"][:, 2, :3, None, None] * view).sum(1, keepdim=True)
    cosine = (batch["normal"] * view).sum(1, keepdim=True).abs().clamp(min=_GRAZING)
    return batch["depth"].square() * along / (focal * cosine)


class PhotonSplat(RenderingModule):
    """G-buffer and, three channels, the logarithm of the density estimate of irradiance that photons give of a pixel.

    Jensen 1996, with the pixel as the kernel.
    """

    architecture = (*RenderingModule.architecture, "scales", "footprint")
    inputs = tuple(dict.fromkeys((*GBUFFER, *PROJECTION, "photon_flux", "photon_hit", "photon_valid")))
    stages = ("gbuffer", "photons")

    def __init__(self, scales: int = 1, footprint: int = 0, **kwargs: Any) -> None:
        """The base class takes the keyword arguments.

        Args:
            scales: estimates per pixel, three channels each: over 1x1, 3x3, 5x5, 9x9 ... pixels.
            footprint: one estimate instead, over the fewest of these pixels that hold so many photons.
        """
        super().__init__(**kwargs)

    @property
    def feature_channels(self) -> int:
        return GBUFFER_CHANNELS + 3 * (1 if self.hparams["footprint"] else self.hparams["scales"])

    def irradiance(self, batch: Batch) -> list[Tensor]:
        """Estimates (B, 3, H, W) of the irradiance from emitters, W·m⁻², of what each pixel sees; 0 where no hit."""
        depth, flux = batch["depth"], batch["photon_flux"]
        camera = (batch["camera_matrix"], batch["world_to_view"])
        pixels = visible_pixels(batch["photon_hit"], batch["photon_valid"], *camera, depth, batch["normal"])
        one = torch.ones_like(flux[..., :1])
        sums = total(torch.cat([flux, one], dim=-1), pixels, *depth.shape[-2:])
        sums = torch.cat([torch.where(depth > 0, sums, 0), seen_area(batch)], dim=1)
        estimates = []
        for k in range(self.hparams["scales"]):
            radius = 2 ** (k - 1) if k else 0
            box = F.avg_pool2d(sums, 2 * radius + 1, 1, radius)
            flux, count, area = box.split([3, 1, 1], dim=1)
            density = torch.where(area > 0, flux / area, 0)
            estimates.append((density, count * (2 * radius + 1) ** 2))
        if not self.hparams["footprint"]:
            return [density for density, _ in estimates]
        chosen = estimates[-1][0]
        for density, count in reversed(estimates[:-1]):
            chosen = torch.where(count >= self.hparams["footprint"], density, chosen)
        return [chosen]

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        estimates = [log_exposed(irradiance, batch["exposure"]) for irradiance in self.irradiance(batch)]
        return join([self.gbuffer(batch), *estimates])
