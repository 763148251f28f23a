"""Create Mitsuba meshes, BSDFs and emitters from arrays, and triangulate Mitsuba's curved shapes."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from PIL import Image

from nlt.scenes.lanes import owned
from nlt.scenes.mitsuba_xml import linear
from nlt.scenes.model import Material, Triangles

_COLUMNS, _ROWS = 64, 32  # around and along a curved shape; a sphere's area is 0.3% too small


def live_mesh(name: str, triangles: Triangles, surface: Any = None, light: Any = None) -> mi.Mesh:
    """Create a mesh in the active variant. `surface` is a Mitsuba BSDF object, `light` a Mitsuba emitter object."""
    properties = mi.Properties()
    for key, value in (("mesh_bsdf", surface), ("mesh_emitter", light)):
        if value is not None:
            properties[key] = value
    mesh = mi.Mesh(
        name,
        len(triangles.vertices),
        len(triangles.faces),
        props=properties,
        has_vertex_normals=triangles.normals is not None,
        has_vertex_texcoords=triangles.uv is not None,
    )
    mesh.set_id(name)
    values = mi.traverse(mesh)
    values["faces"] = owned(np.asarray(triangles.faces, np.uint32))
    for key, array in (("positions", triangles.vertices), ("normals", triangles.normals), ("texcoords", triangles.uv)):
        if array is not None:
            values[f"vertex_{key}"] = owned(np.asarray(array, np.float32))
    values.update()
    return mesh


def curved(kind: str) -> Triangles:
    """Triangulate Mitsuba's unit `sphere`, `disk` or `cylinder` (along z, 0 to 1), with normals and `uv`."""
    rows = _ROWS if kind == "sphere" else 1
    along, around = (
        g.ravel() for g in np.meshgrid(np.linspace(0, 1, rows + 1), np.linspace(0, 1, _COLUMNS + 1), indexing="ij")
    )
    circle = np.stack([np.cos(2 * np.pi * around), np.sin(2 * np.pi * around), 0 * around], axis=1)
    z, uv = np.array([0.0, 0.0, 1.0]), np.stack([around, along], axis=1)
    if kind == "sphere":
        normals = vertices = np.sin(np.pi * along)[:, None] * circle + np.cos(np.pi * along)[:, None] * z
    elif kind == "disk":
        vertices, normals, uv = along[:, None] * circle, np.tile(z, (len(along), 1)), uv[:, ::-1]
    else:
        vertices, normals = circle + along[:, None] * z, circle
    first = (np.arange(rows)[:, None] * (_COLUMNS + 1) + np.arange(_COLUMNS)).reshape(-1, 1)
    below = first + _COLUMNS + 1
    faces = np.concatenate([np.hstack([first, first + 1, below]), np.hstack([below, first + 1, below + 1])])
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    face_normals = np.cross(b - a, c - a)
    faces = np.where((face_normals * normals[faces].mean(1)).sum(1, keepdims=True) < 0, faces[:, ::-1], faces)
    return Triangles(vertices, faces[np.linalg.norm(face_normals, axis=1) > 1e-9], normals, uv)


def bsdf(material: Material) -> dict[str, Any]:
    """Return the nearest Mitsuba BSDF: diffuse, plastic, conductor or glass if one of these fits, else `principled`."""
    colour = texture(material.colour, material.image)
    prefix, alpha = "rough", {"alpha": max(material.roughness**2, 1e-3)}
    if material.roughness < 0.05 or (material.transmission > 0.5 and material.thin):
        prefix, alpha = "", {}
    inner: dict[str, Any]
    if material.transmission > 0.5:
        kind = "thindielectric" if material.thin else f"{prefix}dielectric"
        return {"type": kind, "int_ior": material.ior, "specular_transmittance": colour, **alpha}
    if material.rough_image is not None or 0.01 < material.metallic < 0.99:
        inner = {
            "type": "principled",
            "base_color": colour,
            "roughness": _channel(material.roughness, material.rough_image, 1),
            "metallic": _channel(material.metallic, material.rough_image, 2),
        }
    elif material.metallic >= 0.99:
        inner = {"type": f"{prefix}conductor", "material": "none", "specular_reflectance": colour, **alpha}
    elif material.roughness > 0.9:
        inner = {"type": "diffuse", "reflectance": colour}
    else:
        inner = {"type": f"{prefix}plastic", "diffuse_reflectance": colour, "int_ior": material.ior}
        inner |= {"nonlinear": True, **alpha}
    inner = {"type": "twosided", "inner": inner}
    if material.alpha < 1 or material.alpha_image is not None:
        opacity = _channel(material.alpha, material.alpha_image, 0, material.cutoff)
        return {"type": "mask", "opacity": opacity, "masked": inner}
    return inner


def texture(colour: tuple[float, ...], image: Image.Image | None) -> dict[str, Any]:
    """Return a linear colour, multiplied by an sRGB image if there is one."""
    if image is None:
        return {"type": "rgb", "value": list(colour)}
    pixels = np.asarray(image.convert("RGB"))
    if all(c == 1 for c in colour):
        return {"type": "bitmap", "bitmap": mi.Bitmap(pixels.copy())}
    values = (linear(np.arange(256) / 255)[pixels] * colour).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(values), "raw": True}


def _channel(factor: float, image: Image.Image | None, band: int, cutoff: float | None = None) -> Any:
    """Return a number, multiplied by one band of an image if there is one; a cutoff rounds it to 0 or 1."""
    if image is None:
        return factor if cutoff is None else float(factor >= cutoff)
    bands = np.asarray(image.convert("L") if len(image.getbands()) == 1 else image.convert("RGB"), np.float32) / 255
    values = factor * (bands if bands.ndim == 2 else bands[..., band])
    rounded = values if cutoff is None else values >= cutoff
    return {"type": "bitmap", "bitmap": mi.Bitmap(rounded.astype(np.float32)[..., None]), "raw": True}
