"""Guided denoising of one sample per pixel, not in the paper: path tracing, the G-buffer, and points or photons."""

from typing import Any

from torch import Tensor

from nlt.models.module import Batch, join_channels, log_exposed
from nlt.models.nlt import NeuralLightTransport

_LEAST_ALBEDO = 0.05  # added to the albedo, which is 0 on mirrors


class GuidedOneSample(NeuralLightTransport):
    """The paper's method, whose U-Net also sees path-traced radiance at 1 spp; by default without points and photons.

    It reads the 1-spp image, which other methods train towards, and trains towards the 4-spp image, which denoisers
    read: the two have independent noise, so the Lemma holds (Lehtinen et al. 2018).
    """

    def __init__(self, use_points: bool = False, use_photons: bool = False, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            use_points: use the points, as the paper's method does.
            use_photons: use the photons, as the paper's method does.
        """
        super().__init__(use_points, use_photons, **kwargs)

    @property
    def feature_channels(self) -> int:
        return super().feature_channels + 3

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*super().inputs, "emission", "noisy")

    @property
    def stages(self) -> tuple[str, ...]:
        return (*super().stages, "path_tracing")

    def gbuffer(self, batch: Batch) -> Tensor:
        """Return the G-buffer and the noisy radiance without lamps in view, divided by the albedo (B, 13, H, W)."""
        reflected = (batch["noisy"] - batch["emission"]).clamp(min=0) / (batch["albedo"] + _LEAST_ALBEDO)
        return join_channels([super().gbuffer(batch), log_exposed(reflected, batch["exposure"])])
