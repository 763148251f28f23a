"""The interface that the comparison needs of a method, trained or not."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from nlt.data.sample import BUFFERS, DIRECT, TRACED

Batch = dict[str, Tensor]


class Method(nn.Module):
    """Maps a batch to radiance in steps that the clock times, after stages that the renderer performs.

    A batch is a dict with the names in `nlt.data.sample`; every batch has `exposure`, `scene` and `index`.
    """

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the batch fields that the method's features are computed from, besides exposure, scene and index.

        "traced" is rendered for the method: path-traced radiance (B, 3, H, W) at its `spp`.
        """
        raise NotImplementedError

    @property
    def fields(self) -> tuple[str, ...]:
        """Names of all batch fields that `forward` reads: `inputs` and any others that its image depends on."""
        return self.inputs

    @property
    def stages(self) -> tuple[str, ...]:
        """The renderer stages that a frame needs, out of "gbuffer", "photons" and "path_tracing"."""
        stages = {
            "gbuffer": self._reads(*BUFFERS, *DIRECT),
            "photons": any(name.startswith("photon_") for name in self.inputs),
            "path_tracing": self.pixel_fraction > 0,
        }
        return tuple(name for name, needed in stages.items() if needed)

    @property
    def reads_direct_light(self) -> bool:
        """Whether the stage "gbuffer" also traces shadow rays."""
        return self._reads(*DIRECT)

    @property
    def pixel_fraction(self) -> float:
        """The fraction of the pixels that the stage "path_tracing" traces."""
        return float(self._reads(*TRACED, "traced"))

    def _reads(self, *names: str) -> bool:
        return not {*names}.isdisjoint(self.inputs)

    @property
    def spp(self) -> int | None:
        """Samples per pixel of the stage "path_tracing"; None for as many as the dataset's `noisy_input` has."""
        return None

    @property
    def num_photons(self) -> int | None:
        """Number of photons of the stage "photons"; None for as many as the dataset has."""
        return None

    def subsample(self, batch: Batch) -> Batch:
        """Return the part of a batch that the method uses: all of it, unless overridden."""
        return batch

    def mask(self, batch: Batch, height: int, width: int) -> Tensor:
        """Return the pixels (B, 1, height, width) that the stage "path_tracing" traces: all, unless overridden."""
        return torch.ones(len(batch["scene"]), 1, height, width, dtype=torch.bool, device=batch["scene"].device)

    def steps(self) -> dict[str, Callable[[Batch, Any], Any]]:
        """Return the steps after the stages, in order; each maps the batch and the last step's result to the next."""
        raise NotImplementedError

    def forward(self, batch: Batch) -> Tensor:
        """Return the predicted linear radiance (B, 3, H, W), W·sr⁻¹·m⁻²."""
        result: Any = None
        for step in self.steps().values():
            result = step(batch, result)
        return result
