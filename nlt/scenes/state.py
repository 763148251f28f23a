"""Sample states and views of a scene as in the supplementary (Scene Modification, View Sampling)."""

from dataclasses import dataclass

import numpy as np

from nlt.scenes.camera import Camera
from nlt.scenes.description import SceneDescription


@dataclass(frozen=True)
class SceneState:
    """The state of the M movable objects: `translation` (M, 3) float32 and `present` (M,) bool.

    Translations are in metres, from the position in the scene file; that of a removed object is zero.
    """

    translation: np.ndarray
    present: np.ndarray

    @property
    def key(self) -> bytes:
        """Bytes that are equal for equal states."""
        return self.translation.tobytes() + self.present.tobytes()


def rest_state(description: SceneDescription, experiment: str) -> SceneState:
    """The state in which every object is present, at its position in the scene file."""
    count = len(description.movables(experiment))
    return SceneState(np.zeros((count, 3), np.float32), np.ones(count, bool))


def sample_state(description: SceneDescription, experiment: str, rng: np.random.Generator) -> SceneState:
    """Sample a state: translations are uniform in the objects' boxes; objects are removed with probability 0.2."""
    movables = description.movables(experiment)
    if not movables:
        return rest_state(description, experiment)
    boxes = np.stack([m.box for m in movables])
    translation = rng.uniform(boxes[:, 0], boxes[:, 1])
    removed = rng.random(len(movables)) < 0.2
    present = ~removed | np.array([not m.removable for m in movables])
    return SceneState(np.where(present[:, None], translation, 0.0).astype(np.float32), present)


def sample_view(description: SceneDescription, resolution: int, rng: np.random.Generator) -> Camera:
    """Sample a view: the position is uniform in the box `camera`, the target uniform in the box `look_at`."""
    while True:
        position, target = rng.uniform(*description.camera), rng.uniform(*description.look_at)
        direction = target - position
        sine = np.linalg.norm(np.cross(direction, description.up))
        # Draw again if the view is vertical or has zero length, because its orientation is then undefined.
        if sine > 1e-3 * np.linalg.norm(direction):
            return Camera.look_at(position, target, description.up, description.fov, resolution, resolution)
