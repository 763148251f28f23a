"""Sample views that show the room: not from behind a wall, from inside a closed object or with a blocked lens."""

import zlib
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.state import rest_state, sample_view

_RAYS = 256  # around the camera, and the same number through the image
_NEAR = 0.2  # metres
_PROBES = 16  # camera positions that reveal which shapes are inside out
_TRIES = 100
# Thresholds that separate good from bad views in the six real rooms (test_real_scenes.py repeats a part). Of 900
# views from the camera boxes, 98% pass: in 99%, back is below 0.2 and nothing below 0.42; in 95%, near is 0. Of 381
# views from inside closed meshes, none passes: in 99%, back is above 0.46. Of 430 views from outside the rooms, 3%
# pass, most of them from the recess of a window.
_LIMITS = {"back": 0.3, "near": 0.3, "nothing": 0.5}


class Views:
    """Samples random views of a scene."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._first_hit = freeze(_first_hit)
        # a Fibonacci lattice
        z = 1 - 2 * (np.arange(_RAYS) + 0.5) / _RAYS
        angle = np.pi * (1 + np.sqrt(5)) * np.arange(_RAYS)
        radius = np.sqrt(1 - z**2)
        self._sphere = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], 1)
        # Shapes are inside out if most rays from the camera volume hit their backs.
        rng, description = np.random.default_rng(0), scene.description
        (low, high), room = description.camera, description.room
        # A stage that is seen from outside does not surround the camera.
        self._from_outside = room is not None and bool((low > room[1]).any() or (high < room[0]).any())
        with scene.in_state(rest_state(description, scene.experiment)):
            looks = [self.look(rng.uniform(*description.camera), self._sphere) for _ in range(_PROBES)]
        distance, behind, shape = (np.concatenate(column) for column in zip(*looks, strict=True))
        hit = np.isfinite(distance)
        numbers, inverse = np.unique(shape[hit], return_inverse=True)
        self._inverted = numbers[np.bincount(inverse, behind[hit]) > np.bincount(inverse) / 2]

    def sample(self, resolution: int, rng: np.random.Generator) -> Camera:
        """Return a random view of the scene in its current state that passes the check.

        Raises:
            UserError: none of 100 views passes.
        """
        for _ in range(_TRIES):
            camera = sample_view(self.scene.description, resolution, rng)
            if self.passes(camera):
                return camera
        shares = self.shares(camera)
        raise UserError(
            f"{self.scene.description.file}: camera: none of {_TRIES} random views shows the room (of the last one's "
            f"rays, {shares['back']:.0%} hit surfaces from behind, {shares['near']:.0%} hit surfaces within {_NEAR} m, "
            f"{shares['nothing']:.0%} hit none); move the box into the room"
        )

    def passes(self, camera: Camera) -> bool:
        return all(share <= _LIMITS[name] for name, share in self.shares(camera).items())

    def shares(self, camera: Camera) -> dict[str, float]:
        """Return the shares of rays that mark a bad view, in the current state.

        `back` hit a surface from behind, and `nothing` hit no surface; each is the larger share of two: around the
        camera and through the image. Where the box of cameras lies outside the box of the room, the rays around the
        camera do not count. `near` is the share through the image that hits a surface within 0.2 m.
        """
        side = int(np.sqrt(_RAYS))
        rows, columns = (np.mgrid[:side, :side] + 0.5) / side
        image = camera.directions(np.stack([columns.ravel() * camera.width, rows.ravel() * camera.height], 1))
        distance, behind, shape = self.look(camera.position, np.concatenate([self._sphere, image]))
        back = behind ^ np.isin(shape, self._inverted)
        share = lambda mask: max(half.mean() for half in np.split(mask, 2)[self._from_outside :])
        return {"back": share(back), "near": (distance[_RAYS:] < _NEAR).mean(), "nothing": share(np.isinf(distance))}

    def look(self, position: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return, for each ray, the distance in metres, whether it hits the back of a shape, and a shape number."""
        units = self.scene.description.units_per_metre
        origins = np.tile(position * units, (len(directions), 1))
        lanes = {"origin": ("Point3f", origins), "direction": ("Vector3f", directions)}
        distance, behind, shape = launch(self._first_hit, lanes, scene=self.scene.mi_scene)
        return distance / units, behind, shape


def _first_hit(scene: Any, origin: Any, direction: Any) -> tuple:
    interaction = scene.ray_intersect(mi.Ray3f(origin, direction))
    valid = interaction.is_valid()
    behind = valid & (dr.dot(interaction.n, direction) > 0)
    if is_jit():
        shape = dr.reinterpret_array(mi.UInt32, interaction.shape)
    else:
        shape = mi.UInt32(zlib.crc32(interaction.shape.id().encode()) if valid else 0)
    return interaction.t, behind, shape
