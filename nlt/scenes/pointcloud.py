"""The static point cloud of a scene (supplementary, Point Cloud Sampling) and its attributes."""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from nlt.scenes.assembly import Scene, Shape
from nlt.scenes.description import MATERIALS
from nlt.scenes.lanes import launch


def sample_cdf(weights: np.ndarray, uniform: np.ndarray) -> np.ndarray:
    """Discrete inverse transform sampling by bisection: indices with probability in proportion to `weights`."""
    cdf = np.cumsum(weights)
    return np.searchsorted(cdf, uniform * cdf[-1], side="right").clip(max=len(weights) - 1)


def sample_points(scene: Scene, count: int, seed: int) -> dict[str, np.ndarray]:
    """The scene's points, every object in its place in the scene file: all fields of `POINT_FIELDS`.

    Shapes are drawn by area, then triangles by area, then a uniform point in the triangle.
    """
    rng = np.random.default_rng(seed)
    shapes = list(scene.shapes.values())
    areas = [shape.face_areas for shape in shapes]
    owner = {name: k for k, movable in enumerate(scene.movables) for name in movable.shapes}
    which = sample_cdf(np.array([a.sum() for a in areas]), rng.random(count))
    points: dict[str, np.ndarray] = {
        "position": np.zeros((count, 3), np.float32),
        "material": np.zeros(count, np.uint8),
        "albedo": np.zeros((count, 3), np.float32),
        "emission": np.zeros((count, 3), np.float32),
        "shape": which.astype(np.int32),
        "object": np.full(count, -1, np.int32),
    }
    for k in np.unique(which):
        shape, mine = shapes[k], np.flatnonzero(which == k)
        triangle = shape.faces[sample_cdf(areas[k], rng.random(len(mine)))]
        weights = _barycentric(rng.random((len(mine), 2)))
        points["position"][mine] = np.einsum("nk,nkd->nd", weights, shape.vertices[triangle])
        uv = np.zeros((len(mine), 2)) if shape.uv is None else np.einsum("nk,nkd->nd", weights, shape.uv[triangle])
        points["material"][mine] = MATERIALS.index(material(shape.bsdf))
        points["albedo"][mine], points["emission"][mine] = _surface(shape, uv)
        points["object"][mine] = owner.get(shape.id, -1)
    return points


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


def _surface(shape: Shape, uv: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo and emitted radiance (n, 3) at texture coordinates (n, 2) of a shape."""

    def kernel(uv: Any) -> tuple:
        interaction = dr.zeros(mi.SurfaceInteraction3f, dr.width(uv))
        interaction.uv = uv
        interaction.wi = mi.Vector3f(0, 0, 1)
        interaction.t = mi.Float(1)  # type: ignore[assignment]
        emitted = shape.emitter.eval(interaction) if shape.emitter else mi.Color3f(0 * uv.x)
        return diffuse_albedo(shape.bsdf, interaction), mi.Color3f(emitted)

    albedo, emission = launch(kernel, {"uv": ("Point2f", uv)})
    return albedo, emission
