"""The stress suites' changes of a test view's light, state and camera, in an unchanged scene."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.data.dataset import place_points
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points
from nlt.errors import UserError
from nlt.scenes.camera import Camera
from nlt.scenes.description import MOVING_LIGHT
from nlt.scenes.lanes import is_jit
from nlt.scenes.state import SceneState

_RED = np.array([2.4, 0.4, 0.2])  # same mean as white
_NEAR_FROM, _GRAZING_AT = 1.0, 0.75  # metres: least distance of a chosen point; distance of a grazing view
_TRIES = 200


class ViewPerturber:
    """The test views of a scene, unchanged or changed: `place` one, then render it."""

    def __init__(self, render: SampleRenderer, points: Points, seed: int) -> None:
        self.render, self.scene, self.points, self._seed = render, render.scene, points, seed
        self._description = render.scene.description
        self.objects = np.array([m.name != MOVING_LIGHT for m in self.scene.movables], bool)
        self._lit = not self.objects.all()
        if self._lit:
            self._emitter = mi.traverse(self.scene.mi_scene)
            self._emitter.keep([f"emitter_{MOVING_LIGHT}.emitter.radiance.value"])

    def place(self, index: int, change: str | None = None, value: float = 0.0) -> Camera:
        """Put the scene into a test sample's state, with a change (a key of `PLACES`), and return the camera."""
        self.rng = np.random.default_rng([self._seed, self.render.index, index])
        self.light_size, self.light_gain = 1.0, np.ones(3)
        if self._lit:
            self._set_light()  # before a view is chosen, because the light may hide it
        self.camera = self.render.place("test", index)
        if change is not None:
            PLACES[change](self, value)
            if self._lit:
                self._set_light()
                self.scene.set_state(self.scene.state)
        return self.camera

    def _set_light(self) -> None:
        light = self._description.light
        assert light is not None
        size, radiance = light.size * self.light_size, light.radiance * self.light_gain
        self.scene.description = dataclasses.replace(
            self._description, light=dataclasses.replace(light, size=size, radiance=radiance)
        )
        (key,) = self._emitter.keys()
        self._emitter[key] = mi.Color3f(radiance.tolist())
        if is_jit():
            dr.make_opaque(self._emitter[key])
        self._emitter.update()

    def lit_points(self) -> Points:
        """Return training's points under the current light."""
        if self.light_size == 1 and (self.light_gain == 1).all():
            return self.points
        points = {name: array.copy() for name, array in self.points.items()}
        light, lit = self._description.light, points["object"] == len(self.objects) - 1
        assert light is not None
        points["position"][lit] = light.centre + (points["position"][lit] - light.centre) * self.light_size
        points["emission"][lit] *= self.light_gain.astype(np.float32)
        return points

    # --- the parts of changes ---

    def move(self, translation: np.ndarray, present: np.ndarray) -> None:
        """Set another state, and another camera where the old one no longer shows the room."""
        translation = np.where(present[:, None], translation, 0).astype(np.float32)
        self.scene.set_state(SceneState(translation, present))
        if not self.render.views.passes(self.camera):
            self.camera = self.render.views.sample(self.camera.height, self.rng)

    def look(self, position: np.ndarray, target: np.ndarray) -> None:
        """Move the camera to a position and aim it at a target, with the same lens."""
        camera, up = self.camera, self._description.up
        self.camera = Camera.look_at(position, target, up, camera.fov, camera.width, camera.height)

    def lens(self, fov: float | None = None, width: float | None = None, height: float | None = None) -> None:
        """Set another horizontal field of view, in degrees, or image size."""
        old = self.camera
        width, height = max(1, round(width or old.width)), max(1, round(height or old.height))
        focal = width / 2 / np.tan(np.radians(fov or old.fov) / 2)
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
        self.camera = Camera(matrix, old.world_to_view, width, height)

    def sees(self, eye: np.ndarray, target: np.ndarray) -> bool:
        """Return whether nothing lies between eye and target and the view is not straight up or down."""
        reach = np.linalg.norm(target - eye)
        direction = (target - eye) / reach
        distance, *_ = self.render.views.look(eye, direction[None])
        return bool(abs(distance[0] - reach) < 1e-2 * reach) and abs(direction @ self._description.up) < 0.99

    def surface_points(self) -> Iterator[np.ndarray]:
        """Yield points (3,) that the camera sees from a metre or more, those of objects first, in random order.

        Raises:
            UserError: the camera sees none of the points.
        """
        state = self.scene.state
        owner = self.points["object"]
        position, present = place_points(self.points, state.translation, state.present)
        on_objects = np.concatenate([self.objects, [False]])[owner]
        eye, tried = self.camera.position, 0
        for candidates in (np.flatnonzero(present & on_objects), np.flatnonzero(present & (owner < 0))):
            for k in self.rng.permutation(candidates)[: _TRIES // 2]:
                tried += 1
                if np.linalg.norm(position[k] - eye) >= _NEAR_FROM and self.sees(eye, position[k]):
                    yield position[k].astype(float)
        raise UserError(f"{self._description.file}: none of {tried} points is seen from a test view's camera")

    def largest(self, among: np.ndarray) -> int:
        """Return the movable with the most points out of those in `among` (M,) bool."""
        owner = self.points["object"]
        return int(np.where(among, np.bincount(owner[owner >= 0], minlength=len(among)), -1).argmax())

    @property
    def horizontal(self) -> np.ndarray:
        """The indices (2,) of the horizontal axes."""
        return np.flatnonzero(self._description.up == 0)

    @property
    def middle(self) -> np.ndarray:
        """The middle (3,) of the room, or of the camera's box where no room is given."""
        room = self._description.room
        return (self._description.camera if room is None else room).mean(0)


def _light_lowered(perturber: ViewPerturber, metres: float) -> None:
    """Lower the light by `metres` under the bottom of its box."""
    state, light, up = perturber.scene.state, len(perturber.objects) - 1, perturber._description.up
    box = perturber.scene.movables[light].box
    moved = state.translation.astype(float)
    moved[light] += up * (box[0] @ up - moved[light] @ up - metres)
    perturber.move(moved, state.present)


def _light_size(perturber: ViewPerturber, factor: float) -> None:
    """Scale the light's sides by `factor`, at the same power."""
    perturber.light_size, perturber.light_gain = factor, np.full(3, factor**-2.0)


def _light_colour(perturber: ViewPerturber, share: float) -> None:
    """Mix the light with red of the same mean."""
    perturber.light_gain = 1 - share + share * _RED


def _light_power(perturber: ViewPerturber, factor: float) -> None:
    perturber.light_gain = np.full(3, factor)


def _turned_from_light(perturber: ViewPerturber, degrees: float) -> None:
    """Turn the camera about the vertical until its azimuth is `degrees` away from the light's."""
    (first, second), up = perturber.horizontal, perturber._description.up
    state, light = perturber.scene.state, perturber._description.light
    assert light is not None
    eye, ahead = perturber.camera.position, perturber.camera.rotation[:, 2]
    to_light = light.centre + state.translation[-1] - eye
    level, sign = np.sqrt(1 - (ahead @ up) ** 2), perturber.rng.choice([-1, 1])
    for side in (sign, -sign):  # the other side if the first one does not show the room
        azimuth = np.arctan2(to_light[second], to_light[first]) + np.radians(degrees) * side
        direction = (ahead @ up) * up
        direction[[first, second]] = level * np.array([np.cos(azimuth), np.sin(azimuth)])
        perturber.look(eye, eye + direction)
        if perturber.render.views.passes(perturber.camera):
            return


def _object_outside(perturber: ViewPerturber, metres: float) -> None:
    """Move the object with the most points out of its box, horizontally towards the room's middle."""
    state = perturber.scene.state
    k = perturber.largest(
        perturber.objects & state.present if (perturber.objects & state.present).any() else perturber.objects
    )
    box, centre = perturber.scene.movables[k].box, perturber.scene._centres[perturber.scene.movables[k].name]
    to_middle = perturber.middle - centre
    axis = max(perturber.horizontal, key=lambda a: abs(to_middle[a]))
    moved, present = state.translation.copy(), state.present.copy()
    moved[k, axis] = box[1, axis] + metres if to_middle[axis] > 0 else box[0, axis] - metres
    present[k] = True
    perturber.move(moved, present)


def _objects_removed(perturber: ViewPerturber, share: float) -> None:
    """Remove a share of all objects; a larger share includes the objects of a smaller one."""
    state, objects = perturber.scene.state, np.flatnonzero(perturber.objects)
    present = state.present.copy()
    present[perturber.rng.permutation(objects)[: round(share * len(objects))]] = False
    perturber.move(state.translation, present)


def _objects_crowded(perturber: ViewPerturber, share: float) -> None:
    """Make every object present and move it this share of the way to the room's middle."""
    state = perturber.scene.state
    moved, present = state.translation.astype(float), state.present | perturber.objects
    for k in np.flatnonzero(perturber.objects):
        towards = perturber.middle - perturber.scene._centres[perturber.scene.movables[k].name] - moved[k]
        moved[k, perturber.horizontal] += share * towards[perturber.horizontal]
    perturber.move(moved, present)


def _near(perturber: ViewPerturber, metres: float) -> None:
    """Look at a point of an object from `metres` away, in the same direction."""
    target = next(perturber.surface_points())
    direction = target - perturber.camera.position
    perturber.look(target - metres * direction / np.linalg.norm(direction), target)


def _grazing(perturber: ViewPerturber, degrees: float) -> None:
    """Look at a point from 75 cm away, at this angle to its surface."""
    eye, up = perturber.camera.position, perturber._description.up
    for target in perturber.surface_points():
        ray = Camera.look_at(eye, target, up, 1.0, 1, 1)
        normal = perturber.render.renderer.gbuffer(ray)["normal"][:, 0, 0].astype(float)
        back = eye - target
        normal *= np.sign(normal @ back)
        along = back - (back @ normal) * normal
        if np.linalg.norm(along) < 1e-3 or not normal.any():
            continue
        angle = np.radians(degrees)
        place = target + _GRAZING_AT * (
            np.cos(angle) * along / np.linalg.norm(along) + np.sin(angle) * normal / np.linalg.norm(normal)
        )
        if perturber.sees(place, target):
            perturber.look(place, target)
            return


def _field_of_view(perturber: ViewPerturber, degrees: float) -> None:
    perturber.lens(fov=degrees)


def _corner(perturber: ViewPerturber, metres: float) -> None:
    """Put the camera this far from both walls of a corner, at its height, aimed at the room's middle."""
    room, position = perturber._description.room, perturber.camera.position
    assert room is not None
    a, b = perturber.horizontal
    target = perturber.middle.copy()
    best: tuple[float, Camera] | None = None
    for i, j in perturber.rng.permutation([(0, 0), (0, 1), (1, 0), (1, 1)]):
        place = position.copy()
        inwards = np.sign(perturber.middle - np.where(np.arange(3) == a, room[i], room[j]))
        place[a], place[b] = room[i, a] + inwards[a] * metres, room[j, b] + inwards[b] * metres
        perturber.look(place, target)
        behind = perturber.render.views.shares(perturber.camera).back
        if best is None or behind < best[0]:
            best = behind, perturber.camera
    assert best is not None
    perturber.camera = best[1]


def _resolution(perturber: ViewPerturber, factor: float) -> None:
    perturber.lens(width=perturber.camera.width * factor, height=perturber.camera.height * factor)


def _aspect(perturber: ViewPerturber, ratio: float) -> None:
    """Make the image `ratio` times as wide as high, with as many pixels."""
    perturber.lens(width=perturber.camera.width * ratio**0.5, height=perturber.camera.height / ratio**0.5)


PLACES: dict[str, Callable[[ViewPerturber, float], None]] = {
    "light_lowered": _light_lowered,
    "light_size": _light_size,
    "light_colour": _light_colour,
    "light_power": _light_power,
    "turned_from_light": _turned_from_light,
    "object_outside": _object_outside,
    "objects_removed": _objects_removed,
    "objects_crowded": _objects_crowded,
    "near": _near,
    "grazing": _grazing,
    "field_of_view": _field_of_view,
    "corner": _corner,
    "resolution": _resolution,
    "aspect": _aspect,
}
_NEEDS_LIGHT = ("light_lowered", "light_size", "light_colour", "light_power", "turned_from_light", "second_light")
_NEEDS_OBJECTS = ("object_outside", "objects_removed", "objects_crowded")


def lacks(spec: DatasetSpec, scene: int, change: str) -> str | None:
    """Return what a change needs and a scene lacks; None if the change is possible."""
    description = spec.descriptions[scene]
    if change in _NEEDS_LIGHT and spec.experiment != "moving_lights":
        return "a moving light"
    if change in _NEEDS_OBJECTS and not (description.objects and spec.experiment != "static"):
        return "movable objects"
    if change == "corner" and description.room is None:
        return f"a room in {description.file}"
    return None


# --- smooth paths ---


def path(perturber: ViewPerturber, kind: str, length: float, frames: int) -> Iterator[Camera]:
    """Put the scene into each frame of a smooth path in turn, and yield the frame's camera.

    The camera moves `length` metres to its right, centred on its place in the first test sample. The light or the
    largest object moves along the longest side of its box, by `length` times that side, centred on the box.
    """
    camera = perturber.place(0)
    state = perturber.scene.state
    for t in np.linspace(-0.5, 0.5, frames):
        if kind == "camera":
            place = camera.position + t * length * camera.rotation[:, 0]
            perturber.look(place, place + camera.rotation[:, 2])
        else:
            k = perturber.largest(perturber.objects if kind == "object" else ~perturber.objects)
            box, moved, present = perturber.scene.movables[k].box, state.translation.copy(), state.present.copy()
            axis = int((box[1] - box[0]).argmax())
            moved[k] = box.mean(0)
            moved[k, axis] += t * length * (box[1] - box[0])[axis]
            present[k] = True
            perturber.scene.set_state(SceneState(moved, present))
        yield perturber.camera
