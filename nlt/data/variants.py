"""What the stress suites do to a scene and to a view of it. Each change is a function of one number, its value.

The point cloud stays that of training, row by row, for what is learned of a point belongs to its row. What a renderer
knows of a point is brought up to date: where it is, its albedo, material and emission. The points of a mesh that is
replaced lie on the new one, uniform by area; of a second light, every other point of the first lies on it.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.data.dataset import place_points
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.scenes.assembly import Scene, light_quad, read_shape, read_triangles
from nlt.scenes.camera import Camera
from nlt.scenes.description import MATERIALS, MOVING_LIGHT, SceneDescription
from nlt.scenes.lanes import is_jit
from nlt.scenes.meshes import live_mesh
from nlt.scenes.model import Triangles
from nlt.scenes.pointcloud import material, surface, uniform_points
from nlt.scenes.state import SceneState

Points = dict[str, np.ndarray]
_SECOND_LIGHT = "second_light"
_BELOW = 0.02  # metres: a second light below the first one's height, so that the two never coincide
_RED = np.array([2.4, 0.4, 0.2])  # of the same mean as white
_METAL = 0.9  # reflectance
_SPARE = 0.7  # of the scene's diagonal: a shape as large is the room, where nothing says what an object is
_NEAR_FROM, _GRAZING_AT = 1.0, 0.75  # metres: points are looked for beyond; grazed from
_TRIES = 200


# --- changes of the scene itself: each is loaded anew ---


class ChangedScene(Scene):
    """A scene with other meshes, surfaces or lights than its file's: `change` (of `MESHES`) at `value`."""

    def __init__(
        self, description: SceneDescription, experiment: str, change: str, value: float, points: Points, seed: int
    ) -> None:
        self._change, self._value, self._points = change, value, points
        self._touched: frozenset[str] = frozenset()  # shapes whose points change
        self._axes: dict[str, np.ndarray] = {}  # where those that get thinner have their object's middle
        self._second = np.zeros(3)  # from the moving light at rest to the second one
        self.rng = np.random.default_rng(seed)
        super().__init__(description, experiment)

    def _assemble(self, meshes: dict[str, Any]) -> None:
        self._names = list(meshes)
        changed = MESHES[self._change](self, meshes, self._value)
        units = self.description.units_per_metre
        # Nothing may be left alive of the surfaces that are gone: kernels would be compiled with them.
        self.shapes |= {name: read_shape(mesh, units, False) for name, mesh in changed.items() if name in meshes}
        super()._assemble(meshes | changed)

    def objects(self, meshes: dict[str, Any]) -> list[list[str]]:
        """The shapes of each object that can be changed: none emits. Without movable objects, each shape is one."""
        groups = [list(movable.shapes) for movable in self.movables if movable.name != MOVING_LIGHT]
        if not groups:
            low, high = (np.array([f(s.vertices, 0) for s in self.shapes.values()]) for f in (np.min, np.max))
            whole = np.linalg.norm(high.max(0) - low.min(0))
            small = np.linalg.norm(high - low, axis=1) < _SPARE * whole
            groups = [[name] for name, is_small in zip(self.shapes, small, strict=True) if is_small]
        groups = [[name for name in group if not meshes[name].is_emitter()] for group in groups]
        return [group for group in groups if group]

    def some_objects(self, meshes: dict[str, Any], share: float) -> list[str]:
        """The shapes of a share of the objects, the same ones and more at a larger share."""
        groups = self.objects(meshes)
        order = self.rng.permutation(len(groups))[: max(1, round(share * len(groups)))]
        return [name for k in order for name in groups[k]]

    def mean_albedo(self, name: str) -> np.ndarray:
        """(3,) of a shape, by its points; grey where it has none."""
        mine = self._points["shape"] == self._names.index(name)
        return self._points["albedo"][mine].mean(0) if mine.any() else np.full(3, 0.5)

    def moved_points(self, points: Points) -> Points:
        """Training's points as a renderer of this scene knows them."""
        points = {name: array.copy() for name, array in points.items()}
        for k, name in enumerate(self._names):
            mine, shape = np.flatnonzero(points["shape"] == k), self.shapes[name]
            if not len(mine) or name not in self._touched:
                continue
            if self._change == "mesh_thinner":
                points["position"][mine] = self._thin(points["position"][mine], name)
                continue
            uv = np.zeros((len(mine), 2))
            if self._change == "mesh_replaced":
                _, points["position"][mine], uv = uniform_points([shape], len(mine), self.rng)
            points["albedo"][mine], _ = surface(shape, uv)
            points["material"][mine] = MATERIALS.index(material(shape.bsdf))
        if self._change == "second_light":
            lit = np.flatnonzero(points["object"] == len(self.movables) - 1)
            points["emission"][lit] *= 1 - self._value
            second = lit[::2]
            points["emission"][second] *= self._value / (1 - self._value)
            points["position"][second] += self._second
            points["object"][second] = -1
        return points

    def surfaces(self, meshes: dict[str, Any], bsdfs: dict[str, Any]) -> dict[str, Any]:
        """The meshes of these shapes with other BSDFs."""
        self._touched = frozenset(bsdfs)
        live = {str(bsdf): mi.load_dict(bsdf) for bsdf in bsdfs.values()}  # equal ones share one
        return {name: live_mesh(name, read_triangles(meshes[name]), live[str(bsdf)]) for name, bsdf in bsdfs.items()}

    def _thin(self, position: np.ndarray, name: str) -> np.ndarray:
        """Drawn towards its object's vertical axis; metres."""
        across = np.where(self.description.up == 0, self._value, 1.0)
        return (position - self._axes[name]) * across + self._axes[name]


def _roughness(scene: ChangedScene, meshes: dict[str, Any], alpha: float) -> dict[str, Any]:
    """Every object of one surface: 1 is diffuse, 0 a mirror, between them rough metal."""
    names = scene.some_objects(meshes, 1)
    if alpha == 1:
        return scene.surfaces(meshes, {name: _diffuse(scene.mean_albedo(name)) for name in names})
    kind = {"type": "roughconductor", "alpha": alpha} if alpha else {"type": "conductor"}
    metal = {**kind, "material": "none", "specular_reflectance": {"type": "rgb", "value": [_METAL] * 3}}
    return scene.surfaces(meshes, {name: {"type": "twosided", "inner": metal} for name in names})


def _albedo(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Every shape of an object diffuse, its mean albedo mixed with a saturated colour drawn for it."""
    bsdfs = {}
    for name in scene.some_objects(meshes, 1):
        colour = np.where(np.eye(3)[scene.rng.integers(3)] > 0, 0.9, 0.05)
        bsdfs[name] = _diffuse((1 - share) * scene.mean_albedo(name) + share * colour)
    return scene.surfaces(meshes, bsdfs)


def _glass(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """A share of the objects of glass."""
    names = scene.some_objects(meshes, share)
    return scene.surfaces(meshes, {name: {"type": "dielectric", "int_ior": 1.5} for name in names})


def _replaced(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Every shape of a share of the objects gives way to a knot that fills its bounding box, of its surface."""
    names, knot, changed = scene.some_objects(meshes, share), _knot(), {}
    scene._touched = frozenset(names)
    for name in names:
        old = read_triangles(meshes[name]).vertices
        vertices = old.min(0) + knot.vertices * (old.max(0) - old.min(0))
        changed[name] = live_mesh(name, dataclasses.replace(knot, vertices=vertices), meshes[name].bsdf())
    return changed


def _thinner(scene: ChangedScene, meshes: dict[str, Any], factor: float) -> dict[str, Any]:
    """Every object drawn towards its vertical axis."""
    changed = {}
    for group in scene.objects(meshes):
        vertices = np.concatenate([scene.shapes[name].vertices for name in group])
        scene._axes |= dict.fromkeys(group, (vertices.min(0) + vertices.max(0)) / 2)
    scene._touched = frozenset(scene._axes)
    units = scene.description.units_per_metre
    for name in scene._axes:
        old = read_triangles(meshes[name])
        thin = Triangles(scene._thin(old.vertices / units, name) * units, old.faces, None, old.uv)
        changed[name] = live_mesh(name, thin, meshes[name].bsdf())
    return changed


def _second_light(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """A share of the power from a second light, in a corner of the first one's box."""
    light, up = scene.description.light, scene.description.up
    assert light is not None
    scene.description = dataclasses.replace(
        scene.description, light=dataclasses.replace(light, radiance=light.radiance * (1 - share))
    )
    vertices, faces = light_quad(scene.description)
    scene._second = light.box[0] - light.centre - _BELOW * up
    radiance = {"type": "rgb", "value": (light.radiance * share).tolist()}
    quad = Triangles((vertices + scene._second) * scene.description.units_per_metre, faces)
    emitter, black = mi.load_dict({"type": "area", "radiance": radiance}), mi.load_dict(_diffuse(np.zeros(3)))
    return {_SECOND_LIGHT: live_mesh(_SECOND_LIGHT, quad, black, emitter)}


MESHES: dict[str, Callable[[ChangedScene, dict[str, Any], float], dict[str, Any]]] = {
    "roughness": _roughness,
    "albedo": _albedo,
    "glass": _glass,
    "mesh_replaced": _replaced,
    "mesh_thinner": _thinner,
    "second_light": _second_light,
}


def _diffuse(albedo: np.ndarray) -> dict[str, Any]:
    reflectance = {"type": "rgb", "value": albedo.tolist()}
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": reflectance}}


def _knot(along: int = 96, around: int = 12) -> Triangles:
    """A tube around a trefoil knot, in the unit cube."""
    t, s = (g.ravel() for g in np.meshgrid(*(2 * np.pi * np.arange(n + 1) / n for n in (along, around)), indexing="ij"))
    curve = lambda t: np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], 1)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    tangent = unit(curve(t + 1e-4) - curve(t - 1e-4))
    side = unit(np.cross(tangent, [0.0, 0.0, 1.0]))
    normals = np.cos(s)[:, None] * side + np.sin(s)[:, None] * np.cross(side, tangent)
    vertices = curve(t) + 0.5 * normals
    vertices = (vertices - vertices.min(0)) / (vertices.max(0) - vertices.min(0))
    first = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).reshape(-1, 1)
    below = first + around + 1
    faces = np.concatenate([np.hstack([first, first + 1, below]), np.hstack([below, first + 1, below + 1])])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if (np.cross(b - a, c - a) * normals[faces[:, 0]]).sum() < 0:
        faces = faces[:, ::-1]
    return Triangles(vertices, faces, None, np.stack([t, s], 1) / (2 * np.pi))


# --- changes of light, state and camera, in the scene as it is ---


class Stage:
    """The test views of a scene, as they are or changed: `place` one, then render it."""

    def __init__(self, render: SampleRenderer, points: Points, seed: int) -> None:
        self.render, self.scene, self.points, self._seed = render, render.scene, points, seed
        self._description = render.scene.description
        self.objects = np.array([m.name != MOVING_LIGHT for m in self.scene.movables], bool)
        self._lit = not self.objects.all()
        if self._lit:
            self._emitter = mi.traverse(self.scene.mi_scene)
            self._emitter.keep([f"emitter_{MOVING_LIGHT}.emitter.radiance.value"])

    def place(self, index: int, change: str | None = None, value: float = 0.0) -> Camera:
        """Put the scene into the state of a test sample, with the change (of `PLACES`); the camera."""
        self.rng = np.random.default_rng([self._seed, self.render.index, index])
        self.light_size, self.light_gain = 1.0, np.ones(3)
        if self._lit:
            self._set_light()  # before a view is chosen, for the light may be before the lens
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
        """Training's points under the light as it is now."""
        if self.light_size == 1 and (self.light_gain == 1).all():
            return self.points
        points = {name: array.copy() for name, array in self.points.items()}
        light, lit = self._description.light, points["object"] == len(self.objects) - 1
        assert light is not None
        points["position"][lit] = light.centre + (points["position"][lit] - light.centre) * self.light_size
        points["emission"][lit] *= self.light_gain.astype(np.float32)
        return points

    # --- what changes are made of ---

    def move(self, translation: np.ndarray, present: np.ndarray) -> None:
        """Another state; another camera where the old one no longer shows the room."""
        translation = np.where(present[:, None], translation, 0).astype(np.float32)
        self.scene.set_state(SceneState(translation, present))
        if not self.render.views.passes(self.camera):
            self.camera = self.render.views.sample(self.camera.height, self.rng)

    def look(self, position: np.ndarray, target: np.ndarray) -> None:
        """The camera elsewhere, of the same lens."""
        camera, up = self.camera, self._description.up
        self.camera = Camera.look_at(position, target, up, camera.fov, camera.width, camera.height)

    def lens(self, fov: float | None = None, width: float | None = None, height: float | None = None) -> None:
        """Another horizontal field of view, in degrees, or image size."""
        old = self.camera
        width, height = max(1, round(width or old.width)), max(1, round(height or old.height))
        focal = width / 2 / np.tan(np.radians(fov or old.fov) / 2)
        matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]], np.float32)
        self.camera = Camera(matrix, old.world_to_view, width, height)

    def sees(self, eye: np.ndarray, target: np.ndarray) -> bool:
        """Nothing lies between them, and the view is not straight up or down."""
        reach = np.linalg.norm(target - eye)
        direction = (target - eye) / reach
        distance, *_ = self.render.views.look(eye, direction[None])
        return bool(abs(distance[0] - reach) < 1e-2 * reach) and abs(direction @ self._description.up) < 0.99

    def surface_points(self) -> Iterator[np.ndarray]:
        """Points (3,) that the camera sees from a metre or more, those of objects first, in random order."""
        state = self.scene.state
        owner = self.points["object"]
        position, there = place_points(self.points, state.translation, state.present)
        of_objects = np.concatenate([self.objects, [False]])[owner]
        eye, tried = self.camera.position, 0
        for candidates in (np.flatnonzero(there & of_objects), np.flatnonzero(there & (owner < 0))):
            for k in self.rng.permutation(candidates)[: _TRIES // 2]:
                tried += 1
                if np.linalg.norm(position[k] - eye) >= _NEAR_FROM and self.sees(eye, position[k]):
                    yield position[k].astype(float)
        raise UserError(f"{self._description.file}: none of {tried} points is seen from a test view's camera")

    def largest(self, among: np.ndarray) -> int:
        """The movable with the most points among some (M,) bool."""
        owner = self.points["object"]
        return int(np.where(among, np.bincount(owner[owner >= 0], minlength=len(among)), -1).argmax())

    @property
    def horizontal(self) -> np.ndarray:
        """The indices (2,) of the horizontal axes."""
        return np.flatnonzero(self._description.up == 0)

    @property
    def middle(self) -> np.ndarray:
        """(3,) of the room, or of the camera's box."""
        room = self._description.room
        return (self._description.camera if room is None else room).mean(0)


def _light_lowered(stage: Stage, metres: float) -> None:
    """Under the bottom of its box."""
    state, light, up = stage.scene.state, len(stage.objects) - 1, stage._description.up
    box = stage.scene.movables[light].box
    moved = state.translation.astype(float)
    moved[light] += up * (box[0] @ up - moved[light] @ up - metres)
    stage.move(moved, state.present)


def _light_size(stage: Stage, factor: float) -> None:
    """Its sides times `factor`, its power as it was."""
    stage.light_size, stage.light_gain = factor, np.full(3, factor**-2.0)


def _light_colour(stage: Stage, share: float) -> None:
    """Mixed with red of the same mean."""
    stage.light_gain = 1 - share + share * _RED


def _light_power(stage: Stage, factor: float) -> None:
    stage.light_gain = np.full(3, factor)


def _turned_from_light(stage: Stage, degrees: float) -> None:
    """The camera turned about the vertical, until it looks so far past the light in azimuth."""
    (first, second), up = stage.horizontal, stage._description.up
    state, light = stage.scene.state, stage._description.light
    assert light is not None
    eye, ahead = stage.camera.position, stage.camera.rotation[:, 2]
    to_light = light.centre + state.translation[-1] - eye
    level, sign = np.sqrt(1 - (ahead @ up) ** 2), stage.rng.choice([-1, 1])
    for side in (sign, -sign):  # the other way round where that is what shows the room
        azimuth = np.arctan2(to_light[second], to_light[first]) + np.radians(degrees) * side
        direction = (ahead @ up) * up
        direction[[first, second]] = level * np.array([np.cos(azimuth), np.sin(azimuth)])
        stage.look(eye, eye + direction)
        if stage.render.views.passes(stage.camera):
            return


def _object_outside(stage: Stage, metres: float) -> None:
    """The largest object, by its points, beyond the horizontal side of its box that faces the room's middle."""
    state = stage.scene.state
    k = stage.largest(stage.objects & state.present if (stage.objects & state.present).any() else stage.objects)
    box, centre = stage.scene.movables[k].box, stage.scene._centres[stage.scene.movables[k].name]
    to_middle = stage.middle - centre
    axis = max(stage.horizontal, key=lambda a: abs(to_middle[a]))
    moved, present = state.translation.copy(), state.present.copy()
    moved[k, axis] = box[1, axis] + metres if to_middle[axis] > 0 else box[0, axis] - metres
    present[k] = True
    stage.move(moved, present)


def _objects_removed(stage: Stage, share: float) -> None:
    """A share of all objects, the same ones and more at a larger share; the others as they were."""
    state, objects = stage.scene.state, np.flatnonzero(stage.objects)
    present = state.present.copy()
    present[stage.rng.permutation(objects)[: round(share * len(objects))]] = False
    stage.move(state.translation, present)


def _objects_crowded(stage: Stage, share: float) -> None:
    """Every object present, and by this share of the way where the room's middle is."""
    state = stage.scene.state
    moved, present = state.translation.astype(float), state.present | stage.objects
    for k in np.flatnonzero(stage.objects):
        towards = stage.middle - stage.scene._centres[stage.scene.movables[k].name] - moved[k]
        moved[k, stage.horizontal] += share * towards[stage.horizontal]
    stage.move(moved, present)


def _near(stage: Stage, metres: float) -> None:
    """A point of an object from so near, in the same direction."""
    target = next(stage.surface_points())
    direction = target - stage.camera.position
    stage.look(target - metres * direction / np.linalg.norm(direction), target)


def _grazing(stage: Stage, degrees: float) -> None:
    """A point from 75 cm, at this angle to its surface."""
    eye, up = stage.camera.position, stage._description.up
    for target in stage.surface_points():
        ray = Camera.look_at(eye, target, up, 1.0, 1, 1)
        normal = stage.render.renderer.gbuffer(ray)["normal"][:, 0, 0].astype(float)
        back = eye - target
        normal *= np.sign(normal @ back)
        along = back - (back @ normal) * normal
        if np.linalg.norm(along) < 1e-3 or not normal.any():
            continue
        angle = np.radians(degrees)
        place = target + _GRAZING_AT * (
            np.cos(angle) * along / np.linalg.norm(along) + np.sin(angle) * normal / np.linalg.norm(normal)
        )
        if stage.sees(place, target):
            stage.look(place, target)
            return


def _field_of_view(stage: Stage, degrees: float) -> None:
    stage.lens(fov=degrees)


def _corner(stage: Stage, metres: float) -> None:
    """So far from an edge between two walls, at the camera's height, the room's middle in view."""
    room, position = stage._description.room, stage.camera.position
    assert room is not None
    a, b = stage.horizontal
    target = stage.middle.copy()
    best: tuple[float, Camera] | None = None
    for i, j in stage.rng.permutation([(0, 0), (0, 1), (1, 0), (1, 1)]):
        place = position.copy()
        inwards = np.sign(stage.middle - np.where(np.arange(3) == a, room[i], room[j]))
        place[a], place[b] = room[i, a] + inwards[a] * metres, room[j, b] + inwards[b] * metres
        stage.look(place, target)
        behind = stage.render.views.shares(stage.camera).back
        if best is None or behind < best[0]:
            best = behind, stage.camera
    assert best is not None
    stage.camera = best[1]


def _resolution(stage: Stage, factor: float) -> None:
    stage.lens(width=stage.camera.width * factor, height=stage.camera.height * factor)


def _aspect(stage: Stage, ratio: float) -> None:
    """So many times as wide as high, of as many pixels."""
    stage.lens(width=stage.camera.width * ratio**0.5, height=stage.camera.height / ratio**0.5)


PLACES: dict[str, Callable[[Stage, float], None]] = {
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
    """What a change needs and a scene does not have."""
    description = spec.descriptions[scene]
    if change in _NEEDS_LIGHT and spec.experiment != "moving_lights":
        return "a moving light"
    if change in _NEEDS_OBJECTS and not (description.objects and spec.experiment != "static"):
        return "movable objects"
    if change == "corner" and description.room is None:
        return f"a room in {description.file}"
    return None


# --- smooth paths ---


def path(stage: Stage, kind: str, length: float, frames: int) -> Iterator[Camera]:
    """Put the scene into the frames of a smooth path, one after the other; their cameras.

    The camera goes `length` metres to its right, the light or the largest object `length` of its box along the box's
    longest side, both about where the first test sample has them.
    """
    camera = stage.place(0)
    state = stage.scene.state
    for t in np.linspace(-0.5, 0.5, frames):
        if kind == "camera":
            place = camera.position + t * length * camera.rotation[:, 0]
            stage.look(place, place + camera.rotation[:, 2])
        else:
            k = stage.largest(stage.objects if kind == "object" else ~stage.objects)
            box, moved, present = stage.scene.movables[k].box, state.translation.copy(), state.present.copy()
            axis = int((box[1] - box[0]).argmax())
            moved[k] = box.mean(0)
            moved[k, axis] += t * length * (box[1] - box[0])[axis]
            present[k] = True
            stage.scene.set_state(SceneState(moved, present))
        yield stage.camera
