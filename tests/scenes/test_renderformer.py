"""RenderFormer's scenes arrive with their geometry, materials and lights."""

import json
import runpy
import xml.etree.ElementTree as ET

import mitsuba as mi
import numpy as np
import pytest
import trimesh

from nlt.errors import UserError
from nlt.paths import PROJECT
from nlt.scenes import importer
from nlt.scenes.assembly import read_shape

convert = runpy.run_path(str(PROJECT / "scripts/renderformer.py"))["convert"]


def part(mesh, specular=0.0, emissive=0.0, seed=None, **transform):
    """An object as RenderFormer's JSON has it."""
    placed = {"translation": [0, 0, 0], "rotation": [0, 0, 0], "scale": [1, 1, 1], "normalize": False, **transform}
    material = {"diffuse": [0.1, 0.3, 0.8], "specular": [specular] * 3, "roughness": 0.3, "emissive": [emissive] * 3}
    material |= {"smooth_shading": False, "rand_tri_diffuse_seed": seed}
    return {"mesh_path": mesh, "transform": placed, "material": material}


def converted(folder, **objects):
    trimesh.creation.box((1, 2, 3)).export(folder / "box.obj")
    trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], process=False).export(folder / "tri.obj")
    camera = {"position": [1, -1, 0.9], "look_at": [0, 0, 0], "up": [0, 0, 1], "fov": 37.5}
    (folder / "room.json").write_text(json.dumps({"objects": objects, "cameras": [camera]}))
    convert(folder / "room.json", folder / "out")
    return importer.read(folder / "out/scene.xml")


def test_objects_are_where_renderformer_puts_them(tmp_path):
    """Rotated about x, y and z, then scaled, then moved, in float64 by hand; or shrunk into a sphere of radius 1/2."""
    turned = part("box.obj", rotation=[90, 0, 90], scale=[1, 2, 3], translation=[5, 6, 7])
    imported = converted(tmp_path, turned=turned, shrunk=part("box.obj", normalize=True), lamp=part("tri.obj", 0, 5.0))
    shapes = {mesh.id(): read_shape(mesh) for mesh in imported.scene.shapes()}
    extent = lambda name: np.ptp(shapes[name].vertices, axis=0)
    # (x, y, z) to (x, -z, y) to (z, x, y): the box's 1, 2 and 3 lie along y, z and x.
    np.testing.assert_allclose(extent("turned"), [3 * 1, 1 * 2, 2 * 3], atol=1e-5)
    np.testing.assert_allclose(shapes["turned"].vertices.mean(0), [5, 6, 7], atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(shapes["shrunk"].vertices, axis=1), 0.5, atol=1e-5)
    assert imported.up == "z"
    np.testing.assert_allclose(imported.camera[:3, 3], [1, -1, 0.9], atol=1e-6)


@pytest.mark.parametrize("height", [-2.0, 2.0])
def test_lights_face_the_scene(tmp_path, height):
    """RenderFormer's emit on both sides, Mitsuba's on one."""
    imported = converted(tmp_path, box=part("box.obj"), lamp=part("tri.obj", 0, 5.0, translation=[0, 0, height]))
    (lamp,) = (read_shape(mesh) for mesh in imported.scene.shapes() if mesh.is_emitter())
    assert lamp.id == "lamp" and np.sign(lamp.face_normals[0, 2]) == -np.sign(height)


def test_specular_reflectance(tmp_path):
    """At normal incidence, by Mitsuba's own Fresnel equations."""
    converted(tmp_path, box=part("box.obj"), glossy=part("box.obj", specular=0.2))
    (eta,) = ET.parse(tmp_path / "out/scene.xml").findall(".//float[@name='eta']")
    np.testing.assert_allclose(mi.fresnel(1.0, float(eta.get("value")))[0], 0.2, rtol=1e-5)


def test_random_colours_are_refused(tmp_path):
    with pytest.raises(UserError, match=r"room.json: objects.box.material.rand_tri_diffuse_seed: .*set it to null"):
        converted(tmp_path, box=part("box.obj", seed=3))
