"""Scenes with other meshes, surfaces or lights than their files': the stress suites' changes of the scene itself.

The point cloud keeps training's rows, because a learned embedding belongs to a row. The attributes that a renderer
knows are updated: position, albedo, material and emission. The points of a replaced mesh lie on the new mesh, uniformly
by area. Every other point of the moving light moves to the second light.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from nlt.data.store import Points
from nlt.scenes.assembly import Scene, light_quad, read_shape, read_triangles
from nlt.scenes.description import MATERIALS, MOVING_LIGHT, SceneDescription
from nlt.scenes.meshes import live_mesh
from nlt.scenes.model import Triangles
from nlt.scenes.pointcloud import material, surface, uniform_points

_SECOND_LIGHT = "second_light"
_BELOW = 0.02  # metres from a second light up to the first one's height, so that the two never coincide
_METAL = 0.9  # reflectance
_ROOM_SIZE = 0.7  # share of the scene's diagonal; without movable objects, a larger shape is not an object


class ChangedScene(Scene):
    """A scene with one change, a key of `MESHES`, at `value`."""

    def __init__(
        self, description: SceneDescription, experiment: str, change: str, value: float, points: Points, seed: int
    ) -> None:
        self._change, self._value, self._points = change, value, points
        self._axes: dict[str, np.ndarray] = {}  # by thinned shape, the middle of its object
        self._second = np.zeros(3)  # offset from the moving light at rest to the second one
        self.rng = np.random.default_rng(seed)
        super().__init__(description, experiment)

    def _assemble(self, meshes: dict[str, Any]) -> None:
        self._names = list(meshes)
        changed = MESHES[self._change](self, meshes, self._value)
        self._changed = [name for name in meshes if name in changed]
        units = self.description.units_per_metre
        # Drop the replaced surfaces entirely: kernels would be compiled with any that stay alive.
        self.shapes |= {name: read_shape(changed[name], units, False) for name in self._changed}
        super()._assemble(meshes | changed)

    def objects(self, meshes: dict[str, Any]) -> list[list[str]]:
        """Return the shapes of each object that can change and does not emit; without movables, each shape is one."""
        groups = [list(movable.shapes) for movable in self.movables if movable.name != MOVING_LIGHT]
        if not groups:
            low, high = (np.array([f(s.vertices, 0) for s in self.shapes.values()]) for f in (np.min, np.max))
            whole = np.linalg.norm(high.max(0) - low.min(0))
            small = np.linalg.norm(high - low, axis=1) < _ROOM_SIZE * whole
            groups = [[name] for name, is_small in zip(self.shapes, small, strict=True) if is_small]
        groups = [[name for name in group if not meshes[name].is_emitter()] for group in groups]
        return [group for group in groups if group]

    def some_objects(self, meshes: dict[str, Any], share: float) -> list[str]:
        """Return the shapes of a share of the objects; a larger share includes those of a smaller one."""
        groups = self.objects(meshes)
        order = self.rng.permutation(len(groups))[: max(1, round(share * len(groups)))]
        return [name for k in order for name in groups[k]]

    def mean_albedo(self, name: str) -> np.ndarray:
        """Return the mean albedo (3,) of a shape's points; grey where it has none."""
        mine = self._points["shape"] == self._names.index(name)
        return self._points["albedo"][mine].mean(0) if mine.any() else np.full(3, 0.5)

    def moved_points(self) -> Points:
        """Return training's points with the attributes of this scene."""
        points = {name: array.copy() for name, array in self._points.items()}
        for name in self._changed:
            mine, shape = np.flatnonzero(points["shape"] == self._names.index(name)), self.shapes[name]
            if not len(mine):
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

    def _thin(self, position: np.ndarray, name: str) -> np.ndarray:
        """Return positions in metres, drawn towards the vertical axis of the shape's object."""
        across = np.where(self.description.up == 0, self._value, 1.0)
        return (position - self._axes[name]) * across + self._axes[name]


def _with_surfaces(meshes: dict[str, Any], bsdfs: dict[str, Any]) -> dict[str, Any]:
    """Return the meshes that are keys of `bsdfs`, with these BSDFs."""
    live = {str(bsdf): mi.load_dict(bsdf) for bsdf in bsdfs.values()}  # equal BSDFs share an instance
    return {name: live_mesh(name, read_triangles(meshes[name]), live[str(bsdf)]) for name, bsdf in bsdfs.items()}


# --- the changes, each with its value; they return the changed and added meshes ---


def roughness(scene: ChangedScene, meshes: dict[str, Any], alpha: float) -> dict[str, Any]:
    """Give every object the same surface: 1 is diffuse, 0 a mirror, values between are rough metal."""
    names = scene.some_objects(meshes, 1)
    if alpha == 1:
        return _with_surfaces(meshes, {name: _diffuse(scene.mean_albedo(name)) for name in names})
    kind = {"type": "roughconductor", "alpha": alpha} if alpha else {"type": "conductor"}
    metal = {**kind, "material": "none", "specular_reflectance": {"type": "rgb", "value": [_METAL] * 3}}
    return _with_surfaces(meshes, {name: {"type": "twosided", "inner": metal} for name in names})


def albedo(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Make every shape of an object diffuse, its mean albedo mixed with a random saturated colour."""
    bsdfs = {}
    for name in scene.some_objects(meshes, 1):
        colour = np.where(np.eye(3)[scene.rng.integers(3)] > 0, 0.9, 0.05)
        bsdfs[name] = _diffuse((1 - share) * scene.mean_albedo(name) + share * colour)
    return _with_surfaces(meshes, bsdfs)


def glass(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Turn a share of the objects into glass."""
    names = scene.some_objects(meshes, share)
    return _with_surfaces(meshes, {name: {"type": "dielectric", "int_ior": 1.5} for name in names})


def mesh_replaced(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Replace every shape of a share of the objects by a knot with its bounding box and BSDF."""
    knot, changed = _knot(), {}
    for name in scene.some_objects(meshes, share):
        old = read_triangles(meshes[name]).vertices
        vertices = old.min(0) + knot.vertices * (old.max(0) - old.min(0))
        changed[name] = live_mesh(name, dataclasses.replace(knot, vertices=vertices), meshes[name].bsdf())
    return changed


def mesh_thinner(scene: ChangedScene, meshes: dict[str, Any], factor: float) -> dict[str, Any]:
    """Draw every object towards its vertical axis."""
    changed = {}
    for group in scene.objects(meshes):
        vertices = np.concatenate([scene.shapes[name].vertices for name in group])
        scene._axes |= dict.fromkeys(group, (vertices.min(0) + vertices.max(0)) / 2)
    units = scene.description.units_per_metre
    for name in scene._axes:
        old = read_triangles(meshes[name])
        thin = Triangles(scene._thin(old.vertices / units, name) * units, old.faces, None, old.uv)
        changed[name] = live_mesh(name, thin, meshes[name].bsdf())
    return changed


def second_light(scene: ChangedScene, meshes: dict[str, Any], share: float) -> dict[str, Any]:
    """Give a share of the power to a second light in a corner of the first one's box."""
    light, up = scene.description.light, scene.description.up
    assert light is not None
    dimmed = dataclasses.replace(light, radiance=light.radiance * (1 - share))
    scene.description = dataclasses.replace(scene.description, light=dimmed)
    vertices, faces = light_quad(scene.description)
    scene._second = light.box[0] - light.centre - _BELOW * up
    radiance = {"type": "rgb", "value": (light.radiance * share).tolist()}
    quad = Triangles((vertices + scene._second) * scene.description.units_per_metre, faces)
    emitter, black = mi.load_dict({"type": "area", "radiance": radiance}), mi.load_dict(_diffuse(np.zeros(3)))
    return {_SECOND_LIGHT: live_mesh(_SECOND_LIGHT, quad, black, emitter)}


MESHES: dict[str, Callable[[ChangedScene, dict[str, Any], float], dict[str, Any]]] = {
    change.__name__: change for change in (roughness, albedo, glass, mesh_replaced, mesh_thinner, second_light)
}


def _diffuse(albedo: np.ndarray) -> dict[str, Any]:
    reflectance = {"type": "rgb", "value": albedo.tolist()}
    return {"type": "twosided", "inner": {"type": "diffuse", "reflectance": reflectance}}


def _knot() -> Triangles:
    """Return a tube around a trefoil knot, in the unit cube."""
    along, around = 96, 12
    t, s = (g.ravel() for g in np.meshgrid(*(2 * np.pi * np.arange(n + 1) / n for n in (along, around)), indexing="ij"))
    curve = lambda t: np.stack([np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], 1)
    unit = lambda v: v / np.linalg.norm(v, axis=1, keepdims=True)
    tangent = unit(curve(t + 1e-4) - curve(t - 1e-4))
    side = unit(np.cross(tangent, [0.0, 0.0, 1.0]))
    vertices = curve(t) + 0.5 * (np.cos(s)[:, None] * side + np.sin(s)[:, None] * np.cross(side, tangent))
    vertices = (vertices - vertices.min(0)) / (vertices.max(0) - vertices.min(0))
    first = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).reshape(-1, 1)
    below = first + around + 1
    faces = np.concatenate([np.hstack([below, first + 1, first]), np.hstack([below + 1, first + 1, below])])
    return Triangles(vertices, faces, None, np.stack([t, s], 1) / (2 * np.pi))
