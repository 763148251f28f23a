"""The shapes of the built-in scenes, and the primitives of which furniture consists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import trimesh

from nlt.scenes.builtin.materials import Bsdf, Vec


@dataclass(frozen=True)
class BuiltinShape:
    """One triangle mesh with its material."""

    mesh: trimesh.Trimesh  # world coordinates, metres, y up; faces outward
    uv: np.ndarray | None  # (V, 2)
    bsdf: Bsdf  # Mitsuba dict; shapes that hold the same dict object share one BSDF
    emitter: dict[str, Any] | None = None  # Mitsuba dict of an area emitter
    smooth: bool = False  # shade with the mesh's vertex normals


Shapes = dict[str, BuiltinShape]
Box = tuple[Vec, Vec]  # centre, size
Profile = Sequence[tuple[float, float]]  # (radius, height), upwards along the outside


def quads(
    bsdf: Bsdf,
    *corners: tuple[Vec, Vec, Vec],
    tile: float | None = 1.0,
    emitter: dict[str, Any] | None = None,
) -> BuiltinShape:
    """Flat parallelograms (origin, u, v) that face u x v; a texture repeats every `tile` metres; None fits it once."""
    points, uvs = [], []
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    for origin, u, v in corners:
        points.append(np.asarray(origin) + square @ np.array([u, v], dtype=float))
        lengths = np.array([np.linalg.norm(u), np.linalg.norm(v)])
        uvs.append(square if tile is None else square * lengths / tile)
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners))[:, None, None]
    mesh = trimesh.Trimesh(np.concatenate(points), faces.reshape(-1, 3), process=False)
    return BuiltinShape(mesh, np.concatenate(uvs), bsdf, emitter)


def boxes(bsdf: Bsdf, *parts: Box, tile: float | None = 1.0) -> BuiltinShape:
    """Flat-shaded boxes (centre, size) as one shape; wood grain (u) runs along a face's longer side."""
    faces = []
    for centre, size in parts:
        half = np.asarray(size) / 2
        for axis in range(3):
            u, v = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] * 2 * half
            normal = np.eye(3)[axis] * half
            for n, a, b in ((normal, u, v), (-normal, v, u)):
                if np.linalg.norm(b) > np.linalg.norm(a):
                    a, b = b, -a  # same normal, longer side first
                faces.append((np.asarray(centre) + n - (a + b) / 2, a, b))
    return quads(bsdf, *faces, tile=tile)


def rounded(bsdf: Bsdf, *parts: Box, radius: float = 0.05, tile: float = 1.0, subdivisions: int = 3) -> BuiltinShape:
    """Boxes with round edges as one shape; a texture lies on top and hangs down the sides like cloth."""
    meshes, uvs = [], []
    for centre, size in parts:
        half = np.asarray(size) / 2
        mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
        normal = np.round(mesh.vertices, 9)
        r = np.minimum(radius, half)
        mesh.vertices = normal * r + np.sign(normal) * (half - r)
        x, y, z = mesh.vertices.T
        side = np.abs(normal[:, 0]) > np.abs(normal[:, 2])
        down = half[1] - y
        uvs.append(np.stack([x + np.sign(x) * down * side, -z - np.sign(z) * down * ~side], 1) / tile)
        meshes.append(mesh.apply_translation(centre))
    return BuiltinShape(_concatenate(meshes), np.concatenate(uvs), bsdf, smooth=True)


def lathe(
    bsdf: Bsdf, profile: Profile, at: Vec = (0, 0, 0), stretch: Vec = (1, 1, 1), sections: int = 32
) -> BuiltinShape:
    """A solid of revolution about y, then stretched along the axes."""
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=sections)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    mesh.vertices *= stretch
    return smooth(bsdf, mesh, at)


def ring(bsdf: Bsdf, radius: float, width: float, height: float, at: Vec = (0, 0, 0)) -> BuiltinShape:
    inner = radius - width
    return lathe(bsdf, [(inner, 0), (radius, 0), (radius, height), (inner, height), (inner, 0)], at)


def disc(bsdf: Bsdf, radius: float, light: dict[str, Any], sections: int = 32) -> BuiltinShape:
    """A circular light that shines upwards, with its centre at the origin."""
    angle = np.linspace(0, -2 * np.pi, sections, endpoint=False)
    rim = radius * np.stack([np.cos(angle), 0 * angle, np.sin(angle)], 1)
    k = np.arange(sections)
    faces = np.stack([0 * k, 1 + k, 1 + (k + 1) % sections], 1)
    return BuiltinShape(trimesh.Trimesh(np.vstack([[[0, 0, 0]], rim]), faces, process=False), None, bsdf, light)


def rod(bsdf: Bsdf, start: Vec, end: Vec, radius: float) -> BuiltinShape:
    mesh = trimesh.creation.cylinder(radius, sections=16, segment=np.array([start, end], float))
    return smooth(bsdf, mesh, (0, 0, 0))


def ball(bsdf: Bsdf, radius: float, at: Vec, stretch: Vec = (1, 1, 1), subdivisions: int = 4) -> BuiltinShape:
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.vertices *= stretch
    return smooth(bsdf, mesh, at)


def smooth(bsdf: Bsdf, mesh: trimesh.Trimesh, at: Vec) -> BuiltinShape:
    """Create a mesh with smooth shading except across edges sharper than 40 degrees."""
    mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(40), facet_minarea=None)
    mesh.apply_translation(at)
    return BuiltinShape(mesh, None, bsdf, smooth=True)


def join(*shapes: BuiltinShape) -> BuiltinShape:
    """Join shapes of one material into one shape without texture coordinates."""
    mesh = _concatenate([shape.mesh for shape in shapes])
    return BuiltinShape(mesh, None, shapes[0].bsdf, smooth=True)  # a flat shape's vertex normals are flat too


def _concatenate(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


def transform(shape: BuiltinShape, at: Vec = (0, 0, 0), turn: float = 0.0, axis: Vec = (0, 1, 0)) -> BuiltinShape:
    """Turn a shape about an axis through the origin by `turn` degrees, then move it."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(turn), axis)
    matrix[:3, 3] = at
    return replace(shape, mesh=shape.mesh.copy().apply_transform(matrix))  # copied: trimesh transforms in place


def place(shapes: Shapes, name: str, at: Vec, turn: float = 0.0) -> Shapes:
    """Name the shapes `name_part`, turn them about y by `turn` degrees and move them."""
    return {f"{name}_{part}": transform(shape, at, turn) for part, shape in shapes.items()}
