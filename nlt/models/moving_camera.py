"""Further views of a scene state, without recomputing what does not depend on the camera."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import torch
from torch import Tensor

from nlt.models.method import Batch
from nlt.models.module import RenderingModule


class MovingCamera:
    """A trained method at inference that reuses its light transport while the scene's state stays the same.

    A further view then costs only the G-buffer, projection and synthesis, and its image is bitwise identical. Each step
    runs in the context `stage(name)`, for example a stopwatch.
    """

    def __init__(
        self, method: RenderingModule, stage: Callable[[str], AbstractContextManager[Any]] = nullcontext
    ) -> None:
        self.method, self.stage = method.eval(), stage
        self._state: Batch = {}
        self._transported: Any = None

    @torch.no_grad()
    def __call__(self, batch: Batch) -> Tensor:
        """Return the radiance (B, 3, H, W) of a batch, as the method does."""
        steps = self.method.steps()
        state = {name: batch[name] for name in self.method.state_inputs}
        if state.keys() != self._state.keys() or not all(torch.equal(state[name], self._state[name]) for name in state):
            with self.stage("transport"):
                self._transported = steps["transport"](state, None)
            self._state = {name: value.clone() for name, value in state.items()}  # the batch may change in place
        with self.stage("projection"):
            features = steps["projection"](batch, self._transported)
        with self.stage("synthesis"):
            return steps["synthesis"](batch, features)
