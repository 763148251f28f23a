"""Photon splat, not in the paper: the photons' irradiance in each pixel feeds the U-Net, without a 3D network."""

from collections.abc import Iterator, Sequence
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.models.clouds import CloudMethod
from nlt.models.module import GBUFFER, GBUFFER_CHANNELS, PROJECTION, Batch, join_channels, log_exposed
from nlt.models.projection import total, visible_pixels

_RADII = (1, 2, 4, 8)  # of footprints, in pixels from the middle one
_WIDE_RADII = (2, 8, 32)  # each has about sixteen times as many pixels as the one before
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

    architecture = (*CloudMethod.architecture, "footprint", "every_footprint")
    inputs = tuple(dict.fromkeys((*GBUFFER, *PROJECTION, "photon_flux", "photon_hit", "photon_valid")))
    stages = ("gbuffer", "photons")

    def __init__(self, footprint: int = 4, every_footprint: bool = False, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            footprint: number of photons that an estimate needs. It uses the smallest footprint that holds as many: the
                pixel itself, or 3x3, 5x5, 9x9 or at most 17x17 pixels. 0: always the pixel itself, which is unbiased;
                choosing the footprint by its photons biases the estimate by about a tenth.
            every_footprint: give the U-Net the estimates of the pixel itself and of 5x5, 17x17 and 65x65 pixels, each
                with the log of its number of photons, instead of one estimate. `footprint` is then unused.
        """
        super().__init__(**kwargs)

    @property
    def feature_channels(self) -> int:
        return GBUFFER_CHANNELS + (4 * (1 + len(_WIDE_RADII)) if self.hparams["every_footprint"] else 3)

    def _footprints(self, batch: Batch, radii: Sequence[int]) -> Iterator[Tensor]:
        """Yield flux, photons and seen area (B, 5, H, W), summed over each pixel, then over each radius's footprint."""
        depth, flux = batch["depth"], batch["photon_flux"]
        camera = (batch["camera_matrix"], batch["world_to_view"])
        pixels = visible_pixels(batch["photon_hit"], batch["photon_valid"], *camera, depth, batch["normal"])
        carried = torch.cat([flux, torch.ones_like(flux[..., :1])], dim=-1)
        arrived = torch.where(depth > 0, total(carried, pixels, *depth.shape[-2:]), 0)
        sums = torch.cat([arrived, seen_area(batch)], dim=1)
        yield sums
        if radii:
            table = F.pad(sums.double().cumsum(2).cumsum(3), (1, 0, 1, 0))  # in float32, differences would lose digits
            for radius in radii:
                yield box_sums(table, radius).to(sums.dtype)

    def irradiance(self, batch: Batch) -> Tensor:
        """Return the irradiance (B, 3, H, W), W·m⁻², from emitters on the surface in each pixel; 0 where no hit."""
        wanted = self.hparams["footprint"]
        chosen, *wider = self._footprints(batch, _RADII if wanted else ())
        for sums in wider:
            chosen = torch.where(chosen[:, 3:4] < wanted, sums, chosen)
        return torch.where(batch["depth"] > 0, chosen[:, :3] / chosen[:, 4:], 0)

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        if not self.hparams["every_footprint"]:
            return join_channels([self.gbuffer(batch), log_exposed(self.irradiance(batch), batch["exposure"])])
        maps = [self.gbuffer(batch)]
        for sums in self._footprints(batch, _WIDE_RADII):
            irradiance = torch.where(batch["depth"] > 0, sums[:, :3] / sums[:, 4:], 0)
            maps += [log_exposed(irradiance, batch["exposure"]), torch.log1p(sums[:, 3:4])]
        return join_channels(maps)
