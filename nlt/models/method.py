"""What the comparison needs of a method, trained or not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

Batch = dict[str, Tensor]


class Method(nn.Module):
    """From a batch to radiance, in steps that the clock times, after stages that a renderer does.

    A batch is a dict by the names in `nlt.data.sample`; `exposure`, `scene` and `index` are in every batch.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the batch fields the method's features are made of, besides exposure, scene and index.

        "traced" is rendered for the method: path-traced radiance (B, 3, H, W) at its `spp`.
        """
        raise NotImplementedError

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all batch fields that `forward` reads: `inputs`, and what else its image is made of."""
        return self.inputs

    @property
    def stages(self) -> tuple[str, ...]:
        """What has to be rendered for a frame, out of "gbuffer", "photons" and "path_tracing"."""
        raise NotImplementedError

    @property
    def pixel_fraction(self) -> float:
        """Fraction of the pixels that the stage "path_tracing" traces."""
        return float("path_tracing" in self.stages)

    @property
    def spp(self) -> int | None:
        """Samples per pixel of the stage "path_tracing"; None for those of the dataset's `noisy_input`."""
        return None

    @property
    def num_photons(self) -> int | None:
        """Photons of the stage "photons"; None for as many as the dataset has."""
        return None

    def subsample(self, batch: Batch) -> Batch:
        """What the method takes of a batch: all of it, unless overridden."""
        return batch

    def mask(self, batch: Batch, height: int, width: int) -> Tensor:
        """The pixels (B, 1, height, width) that the stage "path_tracing" traces; all, unless overridden."""
        return torch.ones(len(batch["scene"]), 1, height, width, dtype=torch.bool, device=batch["scene"].device)

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        """What is computed after the stages, in order: from the batch and the last step's result to the next."""
        raise NotImplementedError

    def forward(self, batch: Batch) -> Tensor:
        """The predicted linear radiance (B, 3, H, W), W·sr⁻¹·m⁻²."""
        result: Any = None
        for step in self.steps().values():
            result = step(batch, result)
        return result
