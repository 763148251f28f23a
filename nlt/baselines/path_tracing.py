"""What a user has without any learning of ours: path tracing alone, and Intel Open Image Denoise after it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from nlt.errors import UserError
from nlt.models.method import Batch, Method

Quality = Literal["fast", "balanced", "high"]


class PathTracing(Method):
    """Every pixel at `spp` samples, and nothing after it."""

    inputs: tuple[str, ...] = ("traced",)
    stages: tuple[str, ...] = ("path_tracing",)

    def __init__(self, spp: int = 1) -> None:
        """`spp`: samples per pixel."""
        super().__init__()
        self._spp = spp

    @property
    def spp(self) -> int:
        return self._spp

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        return {}

    def forward(self, batch: Batch) -> Tensor:
        return batch["traced"]


class OpenImageDenoise(PathTracing):
    """Path tracing at `spp`, denoised by OIDN's ray-tracing filter with albedo and normal (Áfra, Intel).

    Both guides are free of noise and are given as such. The filter sees exposed radiance.
    """

    inputs = ("traced", "albedo", "normal")
    stages = ("gbuffer", "path_tracing")

    def __init__(self, spp: int = 1, quality: Quality = "high") -> None:
        """`spp`: samples per pixel; `quality`: OIDN's mode, from the fastest to the slowest."""
        super().__init__(spp)
        if quality not in get_args(Quality):
            raise UserError(f"model.init_args.quality: must be one of {', '.join(get_args(Quality))}, is {quality!r}")
        self._quality = quality

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        return {"denoise": self.denoise}

    def forward(self, batch: Batch) -> Tensor:
        return self.denoise(batch)

    def denoise(self, batch: Batch, _: Any = None) -> Tensor:
        """The denoised radiance (B, 3, H, W)."""
        import mitsuba_oidn as oidn

        exposure = batch["exposure"].view(-1, 1, 1, 1)
        images = (batch["traced"] * exposure, batch["albedo"], batch["normal"])
        last = [image.permute(0, 2, 3, 1).float().contiguous() for image in images]
        how = {"hdr": True, "clean_aux": True, "quality": oidn.Quality[self._quality.capitalize()]}
        denoised = [
            torch.from_dlpack(oidn.denoise(colour, albedo=albedo, normal=normal, **how))
            for colour, albedo, normal in zip(*last, strict=True)
        ]
        return torch.stack(denoised).permute(0, 3, 1, 2).contiguous() / exposure
