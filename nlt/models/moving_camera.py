"""Further views of a state, without computing anew what does not depend on the camera."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from nlt.models.method import Batch
from nlt.models.module import RenderingModule


class MovingCamera:
    """A trained method at inference, whose light transport is kept for as long as the scene's state stays the same.

    A further view then costs the G-buffer, projection and synthesis, and the image is the same to the bit.
    """

    def __init__(self, method: RenderingModule) -> None:
        self.method = method.eval()
        self._state: Batch = {}
        self._transported: Any = None

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Tensor:
        """As the method: from a batch to radiance (B, 3, H, W)."""
        state = {name: batch[name] for name in self.method.state_inputs}
        if state.keys() != self._state.keys() or not all(torch.equal(state[name], self._state[name]) for name in state):
            self._transported = self.method.transport(state)
            self._state = {name: value.clone() for name, value in state.items()}  # it may be changed in place
        return self.method.synthesize(batch, self.method.features(batch, self._transported))
