"""Baseline "Denoising": the U-Net sees path-traced radiance in a random subset of the pixels."""

from typing import Any

import torch
from torch import Tensor

from nlt.models.module import Batch, RenderingModule, join_channels, log_exposed


def _hash(x: Tensor) -> Tensor:
    """Mix 32-bit integers, held in int64, bijectively and equally on every device."""
    x = x & 0xFFFFFFFF
    for _ in range(2):
        x = ((x ^ (x >> 16)) * 0x45D9F3B) & 0xFFFFFFFF
    return x ^ (x >> 16)


def pixel_mask(seeds: Tensor, height: int, width: int, one_in: int) -> Tensor:
    """Return a uniformly random subset of exactly round(height * width / one_in) pixels for each seed.

    `seeds` (B,) int64; returns (B, 1, height, width) bool, which depends only on the arguments.
    """
    pixels = height * width
    # The hash is bijective, so no two pixels of a sample have the same key.
    keys = _hash(_hash(torch.arange(pixels, device=seeds.device)) + _hash(seeds)[:, None])
    chosen = keys.argsort(dim=1)[:, : round(pixels / one_in)]
    mask = torch.zeros_like(keys, dtype=torch.bool).scatter_(1, chosen, True)
    return mask.view(-1, 1, height, width)


class SparseDenoising(RenderingModule):
    """Sec. "Baselines" (2), similar to Lehtinen et al. 2018: 4 spp in 1 of `one_in` pixels, 0 in the others.

    The paper names noisy renderings as the only input, and its times and errors agree with that, so the G-buffer is
    left out by default.
    """

    architecture = (*RenderingModule.architecture, "one_in", "gbuffer")

    def __init__(self, one_in: int = 1, gbuffer: bool = False, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            one_in: path trace one in this many pixels.
            gbuffer: also use the G-buffer, which makes it guided denoising.
        """
        super().__init__(**kwargs)

    @property
    def feature_channels(self) -> int:
        return 4 + self.gbuffer_channels * self.hparams["gbuffer"]  # radiance and mask

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*(self.gbuffer_inputs if self.hparams["gbuffer"] else ()), "noisy_input")

    @property
    def pixel_fraction(self) -> float:
        return 1 / self.hparams["one_in"]

    def mask(self, batch: Batch, height: int, width: int) -> Tensor:
        """Return the pixels to trace (B, 1, height, width): new at each training step, else fixed for each sample."""
        seeds = _hash(_hash(batch["scene"]) + batch["index"])
        if self.training:  # from the step, not from a generator's state, so that resuming is exact
            seeds = _hash(_hash(seeds + self.global_step) + self.hparams["seed"])
        return pixel_mask(seeds, height, width, self.hparams["one_in"])

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        mask = self.mask(batch, *batch["noisy_input"].shape[-2:])
        radiance = log_exposed(batch["noisy_input"], batch["exposure"]).masked_fill(~mask, 0)
        maps = [radiance, mask.to(radiance.dtype)]
        if self.hparams["gbuffer"]:
            maps.append(self.gbuffer(batch))
        return join_channels(maps)
