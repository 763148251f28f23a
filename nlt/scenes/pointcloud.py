"""The static point cloud of a scene (supplementary, Point Cloud Sampling) and its attributes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.scenes.assembly import Scene, Shape
from nlt.scenes.description import MATERIALS
from nlt.scenes.lanes import freeze, is_jit, launch
from nlt.scenes.masks import first_surface, is_mask, is_transparent
from nlt.scenes.state import SceneState, rest_state
from nlt.scenes.views import Views

_EYES = 64
_RECESS = 0.6  # metres
_SURFACE = 1e-4  # of the way from an eye to a point: what is hit there is the point's own surface
_MOST_CANDIDATES = 1000  # per point
_BATCH = 1 << 20


def sample_cdf(weights: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Discrete inverse transform sampling by bisection: indices with probability in proportion to `weights`."""
    cdf = np.cumsum(weights)
    return np.searchsorted(cdf, uniform * cdf[-1], side="right").clip(max=len(weights) - 1)


def sample_points(scene: Scene, count: int, seed: int) -> dict[str, np.ndarray]:
    """The scene's points, every object in its place in the scene file: all fields of `POINT_FIELDS`.

    Points are uniform by area on what may come to be seen: on movable objects, and on what is in direct sight of one
    of 64 random views while all movable objects are removed. (Glass is a surface, as in the G-buffer: it hides what is
    behind it. The transparent parts of opacity masks have no points and hide nothing.) In a scene with a `room`,
    nothing is further from it than 0.6 m, the depth of a window's recess.

    Raises:
        UserError: less than a thousandth of the scene's surface is so.
    """
    rng = np.random.default_rng(seed)
    shapes = list(scene.shapes.values())
    owner = {name: k for k, movable in enumerate(scene.movables) for name in movable.shapes}
    owners = np.array([owner.get(shape.id, -1) for shape in shapes])
    in_sight = _InSight(scene, rng.spawn(1)[0])
    kept: list[tuple[np.ndarray, ...]] = []
    found = tried = 0
    with scene.in_state(in_sight.state):
        while found < count:
            if tried >= _MOST_CANDIDATES * count:
                raise UserError(
                    f"{scene.description.file}: camera: only {found} of {tried} points of the scene's surface can be "
                    f"seen from it; move the box into the room, or take the surroundings out of the scene"
                )
            width = min(int(1.1 * (count - found) * max(tried, 1) / max(found, 1)) + 64, _BATCH)
            which, position, uv = uniform_points(shapes, width, rng)
            if scene.masks:
                solid = ~_transparent(shapes, which, uv)
                which, position, uv = which[solid], position[solid], uv[solid]
            seen = np.flatnonzero(in_sight(position, owners[which] >= 0))
            kept.append((which[seen], position[seen], uv[seen]))
            found, tried = found + len(seen), tried + width
    which, position, uv = (np.concatenate(column)[:count] for column in zip(*kept, strict=True))
    points: dict[str, np.ndarray] = {
        "position": position.astype(np.float32),
        "material": np.zeros(count, np.uint8),
        "albedo": np.zeros((count, 3), np.float32),
        "emission": np.zeros((count, 3), np.float32),
        "shape": which.astype(np.int32),
        "object": owners[which].astype(np.int32),
        "area_share": np.array(found / tried, np.float32),
    }
    for k in np.unique(which):
        mine = which == k
        points["material"][mine] = MATERIALS.index(material(shapes[k].bsdf))
        points["albedo"][mine], points["emission"][mine] = surface(shapes[k], uv[mine])
    return points


def uniform_points(shapes: list[Shape], count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Points uniform by area: shape (count,), position (count, 3) in metres, texture coordinates (count, 2).

    Shapes are drawn by area, then triangles by area, then a uniform point in the triangle.
    """
    areas = [shape.face_areas for shape in shapes]
    which = sample_cdf(np.array([a.sum() for a in areas]), rng.random(count))
    position, uv = np.zeros((count, 3)), np.zeros((count, 2))
    for k in np.unique(which):
        shape, mine = shapes[k], np.flatnonzero(which == k)
        triangle = shape.faces[sample_cdf(areas[k], rng.random(len(mine)))]
        weights = _barycentric(rng.random((len(mine), 2)))
        position[mine] = np.einsum("nk,nkd->nd", weights, shape.vertices[triangle])
        if shape.uv is not None:
            uv[mine] = np.einsum("nk,nkd->nd", weights, shape.uv[triangle])
    return which, position, uv


class _InSight:
    """Which points may come to be seen. To be asked while the scene is in `state`, without its movable objects."""

    def __init__(self, scene: Scene, rng: np.random.Generator) -> None:
        self.scene = scene
        rest = rest_state(scene.description, scene.experiment)
        self.state = SceneState(rest.translation, np.zeros_like(rest.present))
        views = Views(scene)
        with scene.in_state(self.state):
            self.eyes = [views.sample(1, rng).position for _ in range(_EYES)]
        self._clear = freeze(_clear)

    def __call__(self, position: np.ndarray, movable: np.ndarray) -> np.ndarray:
        """(n,) bool of positions (n, 3) in metres that lie on movable objects or not (n,)."""
        room, units = self.scene.description.room, self.scene.description.units_per_metre
        outside = np.zeros(len(position), bool)
        if room is not None:
            outside = ((position < room[0] - _RECESS) | (position > room[1] + _RECESS)).any(1)
        seen = movable & ~outside
        for eye in self.eyes:
            rows = np.flatnonzero(~seen & ~outside)
            if len(rows):
                lanes = {
                    "origin": ("Point3f", np.tile(eye * units, (len(rows), 1))),
                    "reach": ("Vector3f", (position[rows] - eye) * units),
                }
                seen[rows] = launch(self._clear, lanes, scene=self.scene.mi_scene, masks=self.scene.masks)[0]
        return seen


def _clear(scene: Any, masks: bool, origin: Any, reach: Any) -> tuple:
    ray = mi.Ray3f(origin, reach)
    if masks:
        return (first_surface(scene, ray, masks).t > 1 - _SURFACE,)
    ray.maxt = 1 - _SURFACE  # type: ignore[assignment]
    return (~scene.ray_test(ray) if is_jit() else not scene.ray_test(ray),)


def _transparent(shapes: list[Shape], which: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """(n,) bool: points at texture coordinates uv (n, 2) of shapes which (n,) lie on a transparent part of a mask."""
    transparent = np.zeros(len(which), bool)
    for k in np.unique(which):
        bsdf, mine = shapes[k].bsdf, which == k
        if is_mask(bsdf):
            kernel = lambda uv, bsdf=bsdf: (is_transparent(bsdf, _interaction(uv)),)
            (transparent[mine],) = launch(kernel, {"uv": ("Point2f", uv[mine])})
    return transparent


def _barycentric(uniform: np.ndarray) -> np.ndarray:
    """(n, 3) weights of a point uniform in a triangle."""
    root = np.sqrt(uniform[:, 0])
    return np.stack([1 - root, root * (1 - uniform[:, 1]), root * uniform[:, 1]], axis=1)


def material(bsdf: Any) -> str:
    """The entry of `MATERIALS` that describes a BSDF's lobes (opacity masks count as what they mask)."""
    flags = int(bsdf.flags())
    has = lambda *names: any(flags & int(getattr(mi.BSDFFlags, name)) for name in names)
    # Thin glass lets light through unbent, and its flags say what those of a mirror behind an opacity mask say.
    if has("DeltaTransmission", "GlossyTransmission") or bsdf.class_name() == "ThinDielectric":
        return "glass"
    specular = has("GlossyReflection", "DeltaReflection")
    if has("DiffuseReflection", "DiffuseTransmission"):
        return "coated" if specular else "diffuse"
    if has("DeltaReflection"):
        return "mirror"
    return "glossy" if specular else "other"


def diffuse_albedo(bsdf: Any, interaction: Any, active: Any = True) -> Any:
    """Diffuse reflectance in [0, 1]: zero for BSDFs without a diffuse lobe.

    Mitsuba's default answers with the BSDF's value there, which for a conductor can be 18: a mirror or a
    glass has no diffuse reflectance, so its albedo is black.
    """
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    value = mi.Color3f(bsdf.eval_diffuse_reflectance(interaction, active))
    return dr.select(diffuse & active, dr.clip(value, 0, 1), 0)


def surface(shape: Shape, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and emitted radiance (n, 3) at texture coordinates (n, 2) of a shape."""

    def kernel(uv: Any) -> tuple:
        interaction = _interaction(uv)
        emitted = shape.emitter.eval(interaction) if shape.emitter else mi.Color3f(0 * uv.x)
        return diffuse_albedo(shape.bsdf, interaction), mi.Color3f(emitted)

    albedo, emission = launch(kernel, {"uv": ("Point2f", uv)})
    return albedo, emission


def _interaction(uv: Any) -> Any:
    """An interaction at texture coordinates, seen along the normal."""
    interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
    interaction.uv = uv
    interaction.wi = mi.Vector3f(0, 0, 1)
    interaction.t = mi.Float(1)  # type: ignore[assignment]
    return interaction
