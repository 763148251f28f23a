"""Baseline "CNN only": the U-Net sees only the G-buffer."""

from typing import Any

from torch import Tensor

from nlt.models.module import GBUFFER, GBUFFER_CHANNELS, Batch, RenderingModule


class CNN(RenderingModule):
    """Sec. "Baselines" (1): the U-Net on the G-buffer."""

    feature_channels = GBUFFER_CHANNELS
    inputs = GBUFFER
    stages = ("gbuffer",)

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        return self.gbuffer(batch)
