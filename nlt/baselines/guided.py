"""Guided denoising of a few samples per pixel, not in the paper: path tracing, G-buffer, points, photons or a field."""

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.baselines.neural_field import NeuralField
from nlt.models.correction import LEAST_ALBEDO, corrected
from nlt.models.module import Batch, check_at_least, join_channels, log_exposed

_DARKEST = 1e-6  # W·sr⁻¹·m⁻²; keeps the exposure of a black image finite


class GuidedOneSample(NeuralField):
    """The paper's method, whose U-Net also sees path-traced radiance at 1 spp; by default without points or photons.

    It reads the 1-spp image, towards which the paper's methods train, so it trains towards the `target` image. The
    noise of the two is independent, so the Lemma holds (Lehtinen et al. 2018).
    """

    architecture = (*NeuralField.architecture, "relative", "gap", "rows_only", "corrected")
    radiance = "noisy"  # the batch field of path-traced radiance
    target = "target"  # whatever `cleaner_target` says

    def __init__(
        self,
        use_points: bool = False,
        use_photons: bool = False,
        relative: bool = False,
        gap: int = 0,
        rows_only: bool = False,
        field_width: int = 0,
        corrected: bool = False,
        **kwargs: Any,
    ) -> None:
        """The keyword arguments are those of the base class.

        Args:
            use_points: use the points, as the paper's method does.
            use_photons: use the photons, as the paper's method does.
            relative: read and predict radiance relative to the noisy image's own mean in each colour channel. Light
                transport is linear in each channel, so the method then follows any colour and brightness of the light.
            gap: leave out as many pixels between two traced ones, in rows and columns. With k = gap + 1, a traced pixel
                stands for the k x k pixels around it.
            rows_only: leave out rows, not columns; a traced pixel stands for the k pixels around it in its column.
            field_width: channels of the field (nlt/baselines/neural_field.py); 0 for no field.
            corrected: add what the image lacks in areas, by its noisy pixels (nlt/models/correction.py); in training,
                too.
        """
        check_at_least(0, gap=gap)
        super().__init__(field_width, use_points, use_photons, **kwargs)

    @property
    def feature_channels(self) -> int:
        return super().feature_channels + 3

    @property
    def inputs(self) -> tuple[str, ...]:
        return (*super().inputs, "emission", self.radiance)

    @property
    def pixel_fraction(self) -> float:
        rows, columns = self._steps
        return 1 / (rows * columns)

    def mask(self, batch: Batch, height: int, width: int) -> Tensor:
        """Return the pixels to trace (B, 1, height, width), the same ones in every image."""
        mask = torch.zeros(len(batch["scene"]), 1, height, width, dtype=torch.bool, device=batch["scene"].device)
        self._traced(mask)[:] = True
        return mask

    def gbuffer(self, batch: Batch) -> Tensor:
        """Return the G-buffer, any field, and the noisy radiance without lamps in view, divided by the albedo."""
        reflected = F.interpolate(log_exposed(self._reflected(batch), self.exposure(batch)), batch["depth"].shape[2:])
        return join_channels([super().gbuffer(batch), reflected])

    def to_radiance(self, batch: Batch, channels: Tensor) -> Tensor:
        image = super().to_radiance(batch, channels)
        if not self.hparams["corrected"]:
            return image
        return corrected(image, batch[self.radiance], batch, self.albedo(batch), self._traced)

    def exposure(self, batch: Batch) -> Tensor:
        """Return the scene's exposure (B,), or that which the noisy image itself asks for in each channel (B, 3)."""
        if not self.hparams["relative"]:
            return super().exposure(batch)
        # This mean grows in proportion to the light, as the usual one does, but a firefly hardly changes it.
        mean = self._reflected(batch).sqrt().mean((2, 3)) ** 2
        return 1 / mean.clamp(min=_DARKEST)

    def _reflected(self, batch: Batch) -> Tensor:
        """Return the traced pixels' radiance without lamps in view, divided by the albedo (B, 3, rows, columns)."""
        noisy, emission, albedo = map(self._traced, (batch[self.radiance], batch["emission"], self.albedo(batch)))
        return (noisy - emission).clamp(min=0) / (albedo + LEAST_ALBEDO)

    def _traced(self, image: Tensor) -> Tensor:
        """Return the traced pixels of an image (B, C, H, W), each in the middle of those that it stands for."""
        rows, columns = self._steps
        return image[..., rows // 2 :: rows, columns // 2 :: columns]

    @property
    def _steps(self) -> tuple[int, int]:
        """The distance from a traced pixel to the next, in rows and in columns."""
        k = self.hparams["gap"] + 1
        return k, 1 if self.hparams["rows_only"] else k


class GuidedFourSamples(GuidedOneSample):
    """The same with 4 spp in each traced pixel."""

    radiance = "noisy_input"
