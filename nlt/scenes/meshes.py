"""Triangle meshes: live ones of Mitsuba from arrays, and the curved shapes of Mitsuba as triangles."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mitsuba as mi
import numpy as np

from nlt.scenes.lanes import owned

_COLUMNS, _ROWS = 64, 32  # around and along a curved shape: a sphere's area is 0.3% short


@dataclass(frozen=True)
class Triangles:
    """`vertices` (V, 3), `faces` (F, 3); `normals` (V, 3) and `uv` (V, 2) or None."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None


def live_mesh(name: str, triangles: Triangles, bsdf: Any = None, emitter: Any = None) -> mi.Mesh:
    """A mesh of the variant that is set; `bsdf` and `emitter` are live objects."""
    properties = mi.Properties()
    for key, value in (("mesh_bsdf", bsdf), ("mesh_emitter", emitter)):
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
    """Mitsuba's unit `sphere`, `disk` or `cylinder` (along z, 0 to 1), with its normals and texture coordinates."""
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
    across = np.cross(b - a, c - a)
    faces = np.where((across * normals[faces].mean(1)).sum(1, keepdims=True) < 0, faces[:, ::-1], faces)
    return Triangles(vertices, faces[np.linalg.norm(across, axis=1) > 1e-9], normals, uv)
