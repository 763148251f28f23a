"""The static point cloud of a scene (supplementary, Point Cloud Sampling) and its attributes."""

from collections.abc import Callable
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

_EYES = 64  # random views that decide which points are visible
_RECESS = 0.6  # metres; depth of a window's recess
_SURFACE = 1e-4  # last fraction of the way to a point, in which a hit is the point's own surface
_MOST_CANDIDATES = 1000  # at most, per requested point
_BATCH = 1 << 20


def sample_cdf(weights: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Draw indices with probability proportional to `weights`, by inverse transform sampling of `uniform`."""
    cdf = np.cumsum(weights)
    return np.searchsorted(cdf, uniform * cdf[-1], side="right").clip(max=len(weights) - 1)


def sample_points(scene: Scene, count: int, seed: int) -> dict[str, np.ndarray]:
    """Sample the points of a scene at rest: all fields of `POINT_FIELDS`.

    Points are uniform by area on all surfaces that can become visible: movable objects, and surfaces in direct sight
    of at least one of 64 random views while all movable objects are removed. Glass counts as a surface, as in the
    G-buffer, and hides what is behind it. The transparent parts of opacity masks have no points and hide nothing. In a
    scene with a `room`, no point is farther from it than 0.6 m, the depth of a window's recess.

    Raises:
        UserError: less than a thousandth of the scene's surface can become visible.
    """
    rng = np.random.default_rng(seed)
    shapes = list(scene.shapes.values())
    owner = {name: k for k, movable in enumerate(scene.movables) for name in movable.shapes}
    owners = np.array([owner.get(shape.id, -1) for shape in shapes])
    views, unoccluded, rest = Views(scene), freeze(_unoccluded), rest_state(scene.description, scene.experiment)
    (eye_rng,) = rng.spawn(1)
    kept: list[tuple[np.ndarray, ...]] = []
    accepted = tried = 0
    with scene.in_state(SceneState(rest.translation, np.zeros_like(rest.present))):
        eyes = [views.sample(1, eye_rng).position for _ in range(_EYES)]
        while accepted < count:
            if tried >= _MOST_CANDIDATES * count:
                raise UserError(
                    f"{scene.description.file}: camera: only {accepted} of {tried} points of the scene's surface can "
                    f"be seen from it; move the box into the room, or remove the surroundings from the scene"
                )
            width = min(int(1.1 * (count - accepted) * max(tried, 1) / max(accepted, 1)) + 64, _BATCH)
            shape_index, position, uv = uniform_points(shapes, width, rng)
            if scene.masks:
                solid = ~_transparent(shapes, shape_index, uv)
                shape_index, position, uv = shape_index[solid], position[solid], uv[solid]
            seen = np.flatnonzero(_visible(scene, unoccluded, eyes, position, owners[shape_index] >= 0))
            kept.append((shape_index[seen], position[seen], uv[seen]))
            accepted, tried = accepted + len(seen), tried + width
    shape_index, position, uv = (np.concatenate(column)[:count] for column in zip(*kept, strict=True))
    points: dict[str, np.ndarray] = {
        "position": position.astype(np.float32),
        "material": np.zeros(count, np.uint8),
        "albedo": np.zeros((count, 3), np.float32),
        "emission": np.zeros((count, 3), np.float32),
        "shape": shape_index.astype(np.int32),
        "object": owners[shape_index].astype(np.int32),
        "area_share": np.array(accepted / tried, np.float32),
    }
    for k in np.unique(shape_index):
        rows = shape_index == k
        points["material"][rows] = MATERIALS.index(material(shapes[k].bsdf))
        points["albedo"][rows], points["emission"][rows] = surface(shapes[k], uv[rows])
    return points


def uniform_points(shapes: list[Shape], count: int, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Sample points uniformly by area: shape (count,), position (count, 3) in metres, texture coordinates (count, 2).

    A shape is drawn by area, then one of its triangles by area, then a uniform point in the triangle.
    """
    areas = [shape.face_areas for shape in shapes]
    shape_index = sample_cdf(np.array([a.sum() for a in areas]), rng.random(count))
    position, uv = np.zeros((count, 3)), np.zeros((count, 2))
    for k in np.unique(shape_index):
        shape, rows = shapes[k], np.flatnonzero(shape_index == k)
        triangle = shape.faces[sample_cdf(areas[k], rng.random(len(rows)))]
        weights = barycentric(rng.random((len(rows), 2)))
        position[rows] = np.einsum("nk,nkd->nd", weights, shape.vertices[triangle])
        if shape.uv is not None:
            uv[rows] = np.einsum("nk,nkd->nd", weights, shape.uv[triangle])
    return shape_index, position, uv


def _visible(
    scene: Scene, unoccluded: Callable, eyes: list[np.ndarray], position: np.ndarray, movable: np.ndarray
) -> np.ndarray:
    """Return (n,) bool: which points (n, 3), in metres, lie near the room and are `movable` (n,) or seen by an eye."""
    room, units = scene.description.room, scene.description.units_per_metre
    inside = np.ones(len(position), bool)
    if room is not None:
        inside = ((position >= room[0] - _RECESS) & (position <= room[1] + _RECESS)).all(1)
    seen = movable & inside
    for eye in eyes:
        rows = np.flatnonzero(inside & ~seen)
        if len(rows):
            origin, reach = np.tile(eye * units, (len(rows), 1)), (position[rows] - eye) * units
            lanes = {"origin": ("Point3f", origin), "reach": ("Vector3f", reach)}
            (seen[rows],) = launch(unoccluded, lanes, scene=scene.mi_scene, masks=scene.masks)
    return seen


def _unoccluded(scene: Any, masks: bool, origin: Any, reach: Any) -> tuple:
    ray = mi.Ray3f(origin, reach)
    if masks:
        return (first_surface(scene, ray, masks).t > 1 - _SURFACE,)
    ray.maxt = 1 - _SURFACE  # type: ignore[assignment]
    return (~scene.ray_test(ray) if is_jit() else not scene.ray_test(ray),)


def _transparent(shapes: list[Shape], shape_index: np.ndarray, uv: np.ndarray) -> np.ndarray:
    """Return (n,) bool: whether each point, at `uv` (n, 2), lies on a transparent part of a mask."""
    transparent = np.zeros(len(shape_index), bool)
    for k in np.unique(shape_index):
        bsdf, rows = shapes[k].bsdf, shape_index == k
        if is_mask(bsdf):
            kernel = lambda uv, bsdf=bsdf: (is_transparent(bsdf, _interaction(uv)),)
            (transparent[rows],) = launch(kernel, {"uv": ("Point2f", uv[rows])})
    return transparent


def barycentric(uniform: np.ndarray) -> np.ndarray:
    """Barycentric weights (n, 3) of uniform points in a triangle."""
    root = np.sqrt(uniform[:, 0])
    return np.stack([1 - root, root * (1 - uniform[:, 1]), root * uniform[:, 1]], axis=1)


def material(bsdf: Any) -> str:
    """Return the entry of `MATERIALS` for the lobes of a BSDF; an opacity mask counts as the BSDF inside it."""
    flags = int(bsdf.flags())
    has = lambda *names: any(flags & int(getattr(mi.BSDFFlags, name)) for name in names)
    # The flags of thin glass equal those of a mirror inside an opacity mask.
    if has("DeltaTransmission", "GlossyTransmission") or bsdf.class_name() == "ThinDielectric":
        return "glass"
    specular = has("GlossyReflection", "DeltaReflection")
    if has("DiffuseReflection", "DiffuseTransmission"):
        return "coated" if specular else "diffuse"
    if has("DeltaReflection"):
        return "mirror"
    return "glossy" if specular else "other"


def diffuse_albedo(bsdf: Any, interaction: Any, active: Any = True) -> Any:
    """Return the diffuse reflectance in [0, 1]; it is zero for BSDFs without a diffuse lobe, like metal and glass.

    For those, Mitsuba's default returns the value of the BSDF, which can be 18 for a conductor.
    """
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.DiffuseReflection)
    value = mi.Color3f(bsdf.eval_diffuse_reflectance(interaction, active))
    return dr.select(diffuse & active, dr.clip(value, 0, 1), 0)


def surface(shape: Shape, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the albedo (n, 3) and the emitted radiance (n, 3) at texture coordinates `uv` (n, 2) of a shape."""

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
