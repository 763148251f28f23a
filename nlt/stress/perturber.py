"""The stress suites' changes of a test view's light, state and camera, in an unchanged scene."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

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
_TRIES = 100  # points on objects, and as many elsewhere, out of which one is chosen


class ViewPerturber:
    """The test views of a scene, unchanged or changed: `place` one, then render it."""

    def __init__(self, render: SampleRenderer, points: Points, seed: int) -> None:
        self.render, self.scene, self.points, self._seed = render, render.scene, points, seed
        self.description = render.scene.description
        self.up, self.horizontal = self.description.up, np.flatnonzero(self.description.up == 0)
        room = self.description.room
        self.middle = (self.description.camera if room is None else room).mean(0)
        self.light: Any = self.description.light  # None unless there is a moving light
        self.centres = [self.scene.centres[m.name] for m in self.scene.movables]  # at rest
        self.objects = np.array([m.name != MOVING_LIGHT for m in self.scene.movables], bool)
        self._emitter: Any = {}  # the moving light's, if there is one
        if not self.objects.all():
            self._emitter = mi.traverse(self.scene.mi_scene)
            self._emitter.keep([f"emitter_{MOVING_LIGHT}.emitter.radiance.value"])

    def place(self, index: int, change: str | None = None, value: float = 0.0) -> Camera:
        """Put the scene into a test sample's state, make a change (a key of `PLACES`) and return the camera."""
        self.rng = np.random.default_rng([self._seed, self.render.index, index])
        self.set_light()  # before a view is chosen, because the light may hide it
        self.camera = self.render.place("test", index)
        if change in PLACES:
            PLACES[change](self, value)
        return self.camera

    def lit_points(self) -> Points:
        """Return training's points under the current light."""
        if self.light_size == 1 and (self.light_gain == 1).all():
            return self.points
        centre, lit = self.light.centre, self.points["object"] == len(self.objects) - 1
        position, emission = self.points["position"].copy(), self.points["emission"].copy()
        position[lit] = centre + (position[lit] - centre) * self.light_size
        emission[lit] *= self.light_gain.astype(np.float32)
        return self.points | {"position": position, "emission": emission}

    # --- the parts of changes ---

    def set_light(self, size: float = 1.0, gain: float | np.ndarray = 1.0) -> None:
        """Scale the sides and the radiance (3,) of the moving light, if there is one."""
        self.light_size, self.light_gain = size, np.broadcast_to(gain, 3)
        for key in self._emitter.keys():  # noqa: SIM118
            light = dataclasses.replace(self.light, size=self.light.size * size, radiance=self.light.radiance * gain)
            self.scene.description = dataclasses.replace(self.description, light=light)
            self._emitter[key] = mi.Color3f(light.radiance.tolist())
            if is_jit():
                dr.make_opaque(self._emitter[key])
            self._emitter.update()
            self.scene.set_state(self.scene.state)

    def move(self, translation: np.ndarray, present: np.ndarray) -> None:
        """Set another state, and another camera where the old one no longer shows the room."""
        translation = np.where(present[:, None], translation, 0).astype(np.float32)
        self.scene.set_state(SceneState(translation, present))
        if not self.render.views.passes(self.camera):
            self.camera = self.render.views.sample(self.camera.height, self.rng)

    def camera_at(self, position: np.ndarray, target: np.ndarray) -> Camera:
        """Return a camera with the same lens as the current one, at a position and aimed at a target."""
        return Camera.look_at(position, target, self.up, self.camera.fov, self.camera.width, self.camera.height)

    def set_lens(self, fov: float | None = None, width: float = 1.0, height: float = 1.0) -> None:
        """Set another horizontal field of view, in degrees, and scale the image's width and height."""
        old = self.camera
        columns, rows = max(1, round(old.width * width)), max(1, round(old.height * height))
        focal = columns / 2 / np.tan(np.radians(fov or old.fov) / 2)
        matrix = np.array([[focal, 0, columns / 2], [0, focal, rows / 2], [0, 0, 1]], np.float32)
        self.camera = Camera(matrix, old.world_to_view, columns, rows)

    def sees(self, eye: np.ndarray, target: np.ndarray) -> bool:
        """Return whether nothing lies between eye and target and the view is not straight up or down."""
        reach = np.linalg.norm(target - eye)
        direction = (target - eye) / reach
        distance, *_ = self.render.views.look(eye, direction[None])
        return bool(abs(distance[0] - reach) < 1e-2 * reach) and abs(direction @ self.up) < 0.99

    def surface_points(self) -> Iterator[np.ndarray]:
        """Yield points (3,) that the camera sees from a metre or more, those of objects first, in random order.

        Raises:
            UserError: there are no more such points.
        """
        owner, state = self.points["object"], self.scene.state
        position, present = place_points(self.points, state.translation, state.present)
        on_objects = np.append(self.objects, False)[owner]
        for chosen in (on_objects, owner < 0):
            for k in self.rng.permutation(np.flatnonzero(present & chosen))[:_TRIES]:
                distance = np.linalg.norm(position[k] - self.camera.position)
                if distance >= _NEAR_FROM and self.sees(self.camera.position, position[k]):
                    yield position[k].astype(float)
        raise UserError(f"{self.description.file}: camera: a test view sees no suitable point; move or enlarge the box")

    def largest(self, among: np.ndarray) -> int:
        """Return the movable with the most points out of those in `among` (M,) bool."""
        owner = self.points["object"]
        return int(np.where(among, np.bincount(owner[owner >= 0], minlength=len(among)), -1).argmax())


# --- the changes, each with its value ---


def light_lowered(view: ViewPerturber, metres: float) -> None:
    """Lower the light by `metres` under the bottom of its box."""
    state, light = view.scene.state, len(view.objects) - 1
    moved = state.translation.astype(float)
    moved[light] += view.up * (view.scene.movables[light].box[0] @ view.up - moved[light] @ view.up - metres)
    view.move(moved, state.present)


def turned_from_light(view: ViewPerturber, degrees: float) -> None:
    """Turn the camera about the vertical until its azimuth is `degrees` away from the light's."""
    (first, second), eye, ahead = view.horizontal, view.camera.position, view.camera.rotation[:, 2]
    to_light = view.light.centre + view.scene.state.translation[-1] - eye
    level, sign = np.sqrt(1 - (ahead @ view.up) ** 2), view.rng.choice([-1, 1])
    for side in (sign, -sign):  # the other side if the first one does not show the room
        azimuth = np.arctan2(to_light[second], to_light[first]) + np.radians(degrees) * side
        direction = (ahead @ view.up) * view.up
        direction[[first, second]] = level * np.array([np.cos(azimuth), np.sin(azimuth)])
        view.camera = view.camera_at(eye, eye + direction)
        if view.render.views.passes(view.camera):
            return


def object_outside(view: ViewPerturber, metres: float) -> None:
    """Move the object with the most points out of its box, horizontally towards the room's middle."""
    state = view.scene.state
    shown = view.objects & state.present
    k = view.largest(shown if shown.any() else view.objects)
    box, to_middle = view.scene.movables[k].box, view.middle - view.centres[k]
    axis = max(view.horizontal, key=lambda a: abs(to_middle[a]))
    moved, present = state.translation.copy(), state.present.copy()
    moved[k, axis] = box[1, axis] + metres if to_middle[axis] > 0 else box[0, axis] - metres
    present[k] = True
    view.move(moved, present)


def objects_removed(view: ViewPerturber, share: float) -> None:
    """Remove a share of all objects; a larger share includes the objects of a smaller one."""
    objects, present = np.flatnonzero(view.objects), view.scene.state.present.copy()
    present[view.rng.permutation(objects)[: round(share * len(objects))]] = False
    view.move(view.scene.state.translation, present)


def objects_crowded(view: ViewPerturber, share: float) -> None:
    """Make every object present and move it this share of the way to the room's middle."""
    state = view.scene.state
    moved = state.translation.astype(float)
    for k in np.flatnonzero(view.objects).tolist():
        moved[k, view.horizontal] += share * (view.middle - view.centres[k] - moved[k])[view.horizontal]
    view.move(moved, state.present | view.objects)


def near(view: ViewPerturber, metres: float) -> None:
    """Look at a point of an object from `metres` away, in the same direction."""
    target = next(view.surface_points())
    direction = target - view.camera.position
    view.camera = view.camera_at(target - metres * direction / np.linalg.norm(direction), target)


def grazing(view: ViewPerturber, degrees: float) -> None:
    """Look at a point from 75 cm away, at this angle to its surface."""
    eye, angle = view.camera.position, np.radians(degrees)
    for target in view.surface_points():
        ray = Camera.look_at(eye, target, view.up, 1.0, 1, 1)
        normal = view.render.renderer.gbuffer(ray)["normal"][:, 0, 0].astype(float)
        back = eye - target
        normal *= np.sign(normal @ back)
        along = back - (back @ normal) * normal
        if np.linalg.norm(along) < 1e-3 or not normal.any():
            continue
        along, normal = along / np.linalg.norm(along), normal / np.linalg.norm(normal)
        place = target + _GRAZING_AT * (np.cos(angle) * along + np.sin(angle) * normal)
        if view.sees(place, target):
            view.camera = view.camera_at(place, target)
            return


def corner(view: ViewPerturber, metres: float) -> None:
    """Put the camera this far from both walls of a corner, at its height, aimed at the room's middle.

    Of the four corners, the one with the least surfaces seen from behind is taken.
    """
    room, cameras = view.description.room, []
    assert room is not None
    for ends in view.rng.permutation([(0, 0), (0, 1), (1, 0), (1, 1)]):
        walls, place = room[ends, view.horizontal], view.camera.position
        place[view.horizontal] = walls + np.sign(view.middle[view.horizontal] - walls) * metres
        cameras.append(view.camera_at(place, view.middle))
    view.camera = min(cameras, key=lambda camera: view.render.views.shares(camera)["back"])


_LIGHT_CHANGES: dict[str, Callable[[ViewPerturber, float], None]] = {
    "light_lowered": light_lowered,
    "light_size": lambda view, factor: view.set_light(size=factor, gain=factor**-2.0),  # of the same power
    "light_colour": lambda view, share: view.set_light(gain=1 - share + share * _RED),  # mixed with red
    "light_power": lambda view, factor: view.set_light(gain=factor),
    "turned_from_light": turned_from_light,
}
_OBJECT_CHANGES = {
    "object_outside": object_outside, "objects_removed": objects_removed, "objects_crowded": objects_crowded,
}  # fmt: skip
PLACES = _LIGHT_CHANGES | _OBJECT_CHANGES | {
    "near": near,
    "grazing": grazing,
    "field_of_view": lambda view, degrees: view.set_lens(fov=degrees),
    "corner": corner,
    "resolution": lambda view, factor: view.set_lens(width=factor, height=factor),
    "aspect": lambda view, ratio: view.set_lens(width=ratio**0.5, height=ratio**-0.5),  # width over height
}  # fmt: skip


def lacks(spec: DatasetSpec, scene: int, change: str) -> str | None:
    """Return what a change needs and a scene lacks; None if the change is possible."""
    description = spec.descriptions[scene]
    if change in (*_LIGHT_CHANGES, "second_light") and spec.experiment != "moving_lights":
        return "a moving light"
    if change in _OBJECT_CHANGES and not (description.objects and spec.experiment != "static"):
        return "movable objects"
    if change == "corner" and description.room is None:
        return f"a room in {description.file}"
    return None


def path(view: ViewPerturber, moving: str, length: float, frames: int) -> Iterator[Camera]:
    """Put the scene into each frame of a smooth path in turn, and yield the frame's camera.

    The camera moves `length` metres to its right, centred on its place in the first test sample. The light or the
    largest object moves along the longest side of its box, by `length` times that side, centred on the box.
    """
    camera, state = view.place(0), view.scene.state
    k = -1 if moving == "camera" else view.largest(view.objects if moving == "object" else ~view.objects)
    for t in np.linspace(-0.5, 0.5, frames) * length:
        if moving == "camera":
            place = camera.position + t * camera.rotation[:, 0]
            view.camera = view.camera_at(place, place + camera.rotation[:, 2])
        else:
            (low, high), moved, present = view.scene.movables[k].box, state.translation.copy(), state.present.copy()
            longest = int((high - low).argmax())
            moved[k], present[k] = (low + high) / 2, True
            moved[k, longest] += t * (high - low)[longest]
            view.scene.set_state(SceneState(moved, present))
        yield view.camera
