"""States of a scene and views of it, sampled as the supplementary says (Scene Modification, View Sampling)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlt.scenes.camera import Camera
from nlt.scenes.description import SceneDescription

REMOVAL_PROBABILITY = 0.2


@dataclass(frozen=True)
class SceneState:
    """Where each of the M movable objects is.

    Attributes:
        translation: (M, 3) float32, metres, from the place in the scene file; zero for a removed object.
        present: (M,) bool.
    """

    translation: np.ndarray
    present: np.ndarray

    @property
    def key(self) -> bytes:
        """Equal for equal states."""
        return self.translation.tobytes() + self.present.tobytes()


def rest_state(description: SceneDescription, experiment: str) -> SceneState:
    """Every object present, in its place in the scene file."""
    count = len(description.movables(experiment))
    return SceneState(np.zeros((count, 3), np.float32), np.ones(count, bool))


def sample_state(description: SceneDescription, experiment: str, rng: np.random.Generator) -> SceneState:
    """A translation per movable object uniform in its box; each object removed with probability 0.2."""
    movables = description.movables(experiment)
    if not movables:
        return rest_state(description, experiment)
    boxes = np.stack([m.box for m in movables])
    translation = rng.uniform(boxes[:, 0], boxes[:, 1])
    removed = rng.random(len(movables)) < REMOVAL_PROBABILITY
    present = ~removed | np.array([not m.removable for m in movables])
    return SceneState(np.where(present[:, None], translation, 0.0).astype(np.float32), present)


def sample_view(description: SceneDescription, resolution: int, rng: np.random.Generator) -> Camera:
    """A position uniform in the camera box, looking at a point uniform in a box half its size."""
    while True:
        position, target = rng.uniform(*description.camera), rng.uniform(*description.look_at)
        direction = target - position
        sine = np.linalg.norm(np.cross(direction, description.up))
        # A view straight up or down has no horizon, and one of zero length no direction: draw again.
        if sine > 1e-3 * np.linalg.norm(direction):
            return Camera.look_at(position, target, description.up, description.fov, resolution, resolution)
