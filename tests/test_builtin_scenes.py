"""The built-in rooms are closed, lit, well-formed, and their descriptions keep the furniture inside."""

from itertools import product
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml

from nlt.scenes.builtin import BUILTINS, mitsuba_scene

ROOM = ("floor", "ceiling", "wall_left", "wall_right", "wall_back", "wall_front")
CONFIGS = Path(__file__).parents[1] / "configs" / "scenes"


@pytest.fixture(scope="module", params=sorted(BUILTINS))
def built(request):
    """(description, shapes, live scene) in scalar_rgb."""
    before = mi.variant()
    mi.set_variant("scalar_rgb")
    description = yaml.safe_load((CONFIGS / f"{request.param}.yaml").read_text())
    yield description, BUILTINS[request.param](), mitsuba_scene(request.param)
    if before is not None:
        mi.set_variant(before)


def interior(shapes):
    """(2, 3) bounds of the room: each of its six quads is flat along one axis."""
    limits = [[], [], []]
    for key in ROOM:
        bounds = shapes[key].mesh.bounds
        axis = np.argmin(bounds[1] - bounds[0])
        limits[axis].append(bounds[0, axis])
    return np.array([sorted(pair) for pair in limits]).T


def bounds_of(shapes, keys):
    bounds = np.stack([shapes[key].mesh.bounds for key in keys])
    return np.stack([bounds[:, 0].min(0), bounds[:, 1].max(0)])


def is_closed(mesh):
    """As often along an edge as back; unlike is_watertight this lets two boxes share an edge."""
    edges = mesh.edges.tolist()
    return sorted(edges) == sorted([b, a] for a, b in edges)


def test_meshes(built):
    _, shapes, scene = built
    assert [shape.id() for shape in scene.shapes()] == list(shapes)
    for key, shape in shapes.items():
        mesh = shape.mesh
        assert np.isfinite(mesh.vertices).all() and (mesh.area_faces > 0).all(), key
        assert shape.uv is None or shape.uv.shape == (len(mesh.vertices), 2), key
        merged = mesh.copy()
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        if is_closed(merged):
            bodies = merged.split(only_watertight=False)
            assert all(body.volume > 0 for body in bodies), f"{key} faces inward"
        else:
            assert shape.emitter is not None or key in ROOM, f"{key} is open"


def test_room_faces_inward(built):
    _, shapes, _ = built
    centre = interior(shapes).mean(0)
    for key in ROOM:
        mesh = shapes[key].mesh
        assert (np.einsum("ij,ij->i", mesh.face_normals, centre - mesh.triangles_center) > 0).all(), key


def test_flat_and_smooth_normals(built):
    """Flat shapes share no vertex across an edge; the live mesh of a smooth shape has unit normals."""
    _, shapes, scene = built
    for live, (key, shape) in zip(scene.shapes(), shapes.items(), strict=True):
        assert live.has_vertex_normals() == shape.smooth
        if shape.smooth:
            normals = np.reshape(mi.traverse(live)["vertex_normals"], (-1, 3))
            assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-3), key
        else:
            assert np.allclose(
                shape.mesh.vertex_normals[shape.mesh.faces], shape.mesh.face_normals[:, None], atol=1e-6
            ), key


def test_objects_stay_inside(built):
    description, shapes, _ = built
    room = interior(shapes)
    camera = np.array([description["camera"]["min"], description["camera"]["max"]])
    assert (camera[0] > room[0]).all() and (camera[1] < room[1]).all() and (camera[0] < camera[1]).all()
    objects = description["objects"]
    moved = [key for entry in objects.values() for key in entry["shapes"]]
    assert len(objects) >= 4 and len(moved) == len(set(moved)) and set(moved) <= set(shapes) - set(ROOM)
    for name, entry in objects.items():
        box = np.array(entry["box"], dtype=float)
        bounds = bounds_of(shapes, entry["shapes"])
        assert (box[0] <= 0).all() and (box[1] >= 0).all(), f"{name}: the place in the file is not allowed"
        if bounds[0, 1] < room[0, 1] + 0.02:
            assert (box[:, 1] == 0).all(), f"{name} leaves the floor"
        for corner in product(*box.T):
            at = bounds + corner
            assert (at[0] >= room[0] - 1e-6).all() and (at[1] <= room[1] + 1e-6).all(), f"{name} at {corner}"
        swept = bounds + box
        assert (swept[1] <= camera[0]).any() or (swept[0] >= camera[1]).any(), f"{name} may hold the camera"


def test_moving_light_stays_inside(built):
    description, shapes, _ = built
    light, room = description["moving_light"], interior(shapes)
    half = np.array([light["size"][0] / 2, 0, light["size"][1] / 2])
    low, high = np.array(light["box"])
    assert (low <= high).all() and (low - half > room[0]).all() and (high + half < room[1]).all()


def test_closed_and_lit(built):
    description, shapes, scene = built
    assert len(scene.emitters()) == sum(shape.emitter is not None for shape in shapes.values()) >= 1
    camera = np.array([description["camera"]["min"], description["camera"]["max"]])
    rng = np.random.default_rng(0)
    directions = rng.standard_normal((1000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for origin, direction in zip(rng.uniform(*camera, (1000, 3)), directions, strict=True):
        assert scene.ray_test(mi.Ray3f(origin.tolist(), direction.tolist())), "a ray leaves the room"

    centre = camera.mean(0)
    to_world = mi.ScalarTransform4f().look_at(camera[0].tolist(), centre.tolist(), [0, 1, 0])
    film = {"type": "hdrfilm", "width": 32, "height": 32, "rfilter": {"type": "box"}}
    sensor = mi.load_dict({"type": "perspective", "fov": description["fov"], "to_world": to_world, "film": film})
    image = np.array(mi.render(scene, sensor=sensor, integrator=mi.load_dict({"type": "path"}), spp=16))
    display = np.clip(image * description["exposure"], 0, 1) ** (1 / 2.2)
    assert np.isfinite(image).all() and 0.2 < display.mean() < 0.7
