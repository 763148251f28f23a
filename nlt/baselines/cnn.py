"""Baseline "CNN only": the U-Net sees only the G-buffer."""

from typing import Any

from torch import Tensor

from nlt.models.module import Batch, RenderingModule


class CNN(RenderingModule):
    """Sec. "Baselines" (1): the U-Net on the G-buffer."""

    @property
    def feature_channels(self) -> int:
        return self.gbuffer_channels

    @property
    def inputs(self) -> tuple[str, ...]:
        return self.gbuffer_inputs

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        return self.gbuffer(batch)
