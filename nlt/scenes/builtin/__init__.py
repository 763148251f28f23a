"""Built-in scenes, made from small parametric furniture functions: no model files, no downloads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import mitsuba as mi
import numpy as np

from nlt.scenes.builtin.rooms import bathroom, bedroom, egg, kitchen, living_room
from nlt.scenes.builtin.shapes import BuiltinShape, Shapes
from nlt.scenes.lanes import owned

__all__ = ["BUILTINS", "BuiltinShape", "Shapes", "living_room", "mitsuba_scene"]

# Scene name -> shapes by stable id.
BUILTINS: dict[str, Callable[[], Shapes]] = {
    "egg": egg,
    "living_room": living_room,
    "bathroom": bathroom,
    "kitchen": kitchen,
    "bedroom": bedroom,
}


def mitsuba_scene(name: str) -> mi.Scene:
    """The scene as a live Mitsuba scene, in the variant that is set."""
    bsdfs: dict[int, Any] = {}  # by the dict's identity: each BSDF instance costs tracing time
    meshes: dict[str, Any] = {}
    shapes = BUILTINS[name]()
    for key, shape in shapes.items():
        if id(shape.bsdf) not in bsdfs:
            bsdfs[id(shape.bsdf)] = mi.load_dict(shape.bsdf)
        props = mi.Properties()
        props["mesh_bsdf"] = bsdfs[id(shape.bsdf)]
        if shape.emitter is not None:
            props["mesh_emitter"] = mi.load_dict(shape.emitter)
        mesh = mi.Mesh(
            key,
            len(shape.mesh.vertices),
            len(shape.mesh.faces),
            props=props,
            has_vertex_normals=shape.smooth,
            has_vertex_texcoords=shape.uv is not None,
        )
        mesh.set_id(key)
        params = mi.traverse(mesh)
        params["vertex_positions"] = owned(np.asarray(shape.mesh.vertices, np.float32))
        params["faces"] = owned(np.asarray(shape.mesh.faces, np.uint32))
        if shape.uv is not None:
            params["vertex_texcoords"] = owned(np.asarray(shape.uv, np.float32))
        if shape.smooth:
            params["vertex_normals"] = owned(np.asarray(shape.mesh.vertex_normals, np.float32))
        params.update()
        meshes[key] = mesh
    return mi.load_dict({"type": "scene", **meshes})
