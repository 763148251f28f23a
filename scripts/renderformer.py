"""Convert a scene of RenderFormer (github.com/microsoft/renderformer, MIT) to Mitsuba 3, with one PLY per object.

    python scripts/renderformer.py renderformer/examples/room.json scenes/renderformer-room

RenderFormer's own `scene_processor` is the reference: an object is rotated about x, y and z, then scaled, then
translated; smooth objects keep edges above 30 degrees. A specular colour becomes Mitsuba's principled BSDF with that
reflectance at normal incidence; its GGX lobe is close to that of Blender, which rendered RenderFormer's references.
"""

import json
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import trimesh

from nlt.cli import exit_code
from nlt.errors import UserError


def convert(source: Path, folder: Path) -> None:
    """Write `scene.xml` and its meshes to `folder`; the shapes' ids are RenderFormer's names of the objects.

    Raises:
        UserError: the triangles of an object have random colours.
    """
    content = json.loads(source.read_text())
    folder.mkdir(parents=True, exist_ok=True)
    scene = ET.Element("scene", version="3.0.0")
    camera = content["cameras"][0]
    sensor = _add(scene, "sensor", type="perspective")
    _add(sensor, "float", name="fov", value=camera["fov"])
    pose = {key: _numbers(camera[name]) for key, name in (("origin", "position"), ("target", "look_at"), ("up", "up"))}
    _add(_add(sensor, "transform", name="to_world"), "lookat", **pose)
    for name, part in content["objects"].items():
        material = part["material"]
        if material.get("rand_tri_diffuse_seed") is not None:
            raise UserError(
                f"{source}: objects.{name}.material.rand_tri_diffuse_seed: no random colours; set it to null"
            )
        mesh = _place(source.parent / part["mesh_path"], part["transform"], material["smooth_shading"])
        emits = any(material["emissive"])
        if emits and np.einsum("fx,fx->", mesh.face_normals, mesh.triangles_center) > 0:
            mesh.invert()  # RenderFormer's lights emit on both sides; Mitsuba's do on one, which must face the scene
        mesh.export(folder / f"{name}.ply", vertex_normal=material["smooth_shading"])
        shape = _add(scene, "shape", type="ply", id=name)
        _add(shape, "string", name="filename", value=f"{name}.ply")
        _add(shape, "boolean", name="face_normals", value=str(not material["smooth_shading"]).lower())
        _write_bsdf(_add(shape, "bsdf", type="twosided"), material)
        if emits:
            emitter = _add(shape, "emitter", type="area")
            _add(emitter, "rgb", name="radiance", value=_numbers(material["emissive"]))
    ET.indent(scene)
    (folder / "scene.xml").write_text(ET.tostring(scene, encoding="unicode") + "\n")


def _place(file: Path, transform: dict, smooth: bool) -> trimesh.Trimesh:
    """Return the mesh in world space, with the vertices of sharp edges doubled if it is smooth."""
    mesh = trimesh.load(file, process=False, force="mesh")
    if transform["normalize"]:
        mesh.vertices -= mesh.vertices.mean(0)
        mesh.vertices /= 2 * np.linalg.norm(mesh.vertices, axis=1).max()
    for axis, degrees in zip(np.eye(3), transform["rotation"], strict=True):
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), axis))
    mesh.apply_scale(transform["scale"])
    mesh.apply_translation(transform["translation"])
    return trimesh.graph.smooth_shade(mesh, angle=np.radians(30)) if smooth else mesh


def _write_bsdf(parent: ET.Element, material: dict) -> None:
    """Add a diffuse BSDF, or a principled one where there is a specular reflectance."""
    reflectance = max(material["specular"])
    if reflectance == 0:
        bsdf = _add(parent, "bsdf", type="diffuse")
        _add(bsdf, "rgb", name="reflectance", value=_numbers(material["diffuse"]))
        return
    bsdf = _add(parent, "bsdf", type="principled")
    _add(bsdf, "rgb", name="base_color", value=_numbers(material["diffuse"]))
    _add(bsdf, "float", name="roughness", value=material["roughness"])
    root = np.sqrt(reflectance)
    _add(bsdf, "float", name="eta", value=(1 + root) / (1 - root))  # Fresnel's equation at normal incidence, inverted


def _add(parent: ET.Element, tag: str, **attributes: object) -> ET.Element:
    return ET.SubElement(parent, tag, {key: str(value) for key, value in attributes.items()})


def _numbers(values: list[float]) -> str:
    return ", ".join(f"{value:g}" for value in values)


if __name__ == "__main__":
    sys.exit(exit_code(lambda: convert(Path(sys.argv[1]), Path(sys.argv[2]))))
