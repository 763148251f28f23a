"""Methods that we do not train: path tracing, alone or denoised by Intel Open Image Denoise."""

from collections.abc import Callable
from typing import Any, Literal, get_args

import torch
from torch import Tensor

from nlt.errors import UserError
from nlt.models.method import Batch, Method

Quality = Literal["fast", "balanced", "high"]


class PathTracing(Method):
    """Path tracing of every pixel at `spp` samples, without denoising."""

    def __init__(self, spp: int = 1) -> None:
        """Render at `spp` samples per pixel."""
        super().__init__()
        self._spp = spp

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("traced",)

    @property
    def spp(self) -> int:
        return self._spp

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        return {}

    def forward(self, batch: Batch) -> Tensor:
        return batch["traced"]


class OpenImageDenoise(PathTracing):
    """Path tracing at `spp`, denoised by OIDN's ray-tracing filter with albedo and normal (Áfra, Intel).

    The filter is told that both guides are free of noise. It sees exposed radiance.
    """

    def __init__(self, spp: int = 1, quality: Quality = "high", mirrors: bool = False) -> None:
        """Denoise a rendering.

        Args:
            spp: samples per pixel.
            quality: OIDN's mode, from fastest to slowest.
            mirrors: the albedo guide is `seen_albedo`: where metal or glass is seen, of what it shows. A frame is
                then charged for `Renderer.direct`, which also traces shadow rays that OIDN does not need.
        """
        super().__init__(spp)
        if quality not in get_args(Quality):
            raise UserError(f"model.init_args.quality: must be one of {', '.join(get_args(Quality))}, is {quality!r}")
        self._quality = quality
        self._mirrors = mirrors

    @property
    def inputs(self) -> tuple[str, ...]:
        return ("traced", "albedo", "normal", *(("seen_albedo",) if self._mirrors else ()))

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        return {"denoise": self.denoise}

    def forward(self, batch: Batch) -> Tensor:
        return self.denoise(batch)

    def denoise(self, batch: Batch, _: Any = None) -> Tensor:
        """Return the denoised radiance (B, 3, H, W)."""
        import mitsuba_oidn as oidn

        exposure = batch["exposure"].view(-1, 1, 1, 1)
        albedo = batch["seen_albedo" if self._mirrors else "albedo"]
        images = (batch["traced"] * exposure, albedo, batch["normal"])
        channels_last = [image.permute(0, 2, 3, 1).float().contiguous() for image in images]
        options = {"hdr": True, "clean_aux": True, "quality": oidn.Quality[self._quality.capitalize()]}
        denoised = [
            torch.from_dlpack(oidn.denoise(colour, albedo=albedo, normal=normal, **options))
            for colour, albedo, normal in zip(*channels_last, strict=True)
        ]
        return torch.stack(denoised).permute(0, 3, 1, 2).contiguous() / exposure
