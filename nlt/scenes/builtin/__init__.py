"""Built-in scenes of parametric furniture: no model files, no downloads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi

from nlt.scenes.builtin.rooms import bathroom, bedroom, egg, kitchen, living_room
from nlt.scenes.builtin.shapes import BuiltinShape, Shapes
from nlt.scenes.meshes import live_mesh
from nlt.scenes.model import Triangles

__all__ = ["BUILTINS", "BuiltinShape", "Shapes", "living_room", "mitsuba_scene"]

# Scene name -> function that returns the shapes by id.
BUILTINS: dict[str, Callable[[], Shapes]] = {
    "egg": egg,
    "living_room": living_room,
    "bathroom": bathroom,
    "kitchen": kitchen,
    "bedroom": bedroom,
}


def mitsuba_scene(name: str) -> mi.Scene:
    """Build a built-in scene in the active Mitsuba variant."""
    bsdfs: dict[int, Any] = {}  # by identity of the dict, because each BSDF instance costs tracing time
    meshes: dict[str, Any] = {}
    shapes = BUILTINS[name]()
    for key, shape in shapes.items():
        if id(shape.bsdf) not in bsdfs:
            bsdfs[id(shape.bsdf)] = mi.load_dict(shape.bsdf)
        light = None if shape.emitter is None else mi.load_dict(shape.emitter)
        normals = shape.mesh.vertex_normals if shape.smooth else None
        triangles = Triangles(shape.mesh.vertices, shape.mesh.faces, normals, shape.uv)
        meshes[key] = live_mesh(key, triangles, bsdfs[id(shape.bsdf)], light)
    return mi.load_dict({"type": "scene", **meshes})
