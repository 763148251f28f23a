"""The built-in scenes are closed, lit, well-formed and furnished, and what moves stays inside and off the rest."""

import shutil
from itertools import product
from pathlib import Path

import mitsuba as mi
import numpy as np
import pytest
import yaml
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from nlt.rendering.renderer import Renderer
from nlt.scenes import builtin
from nlt.scenes import description as description_module
from nlt.scenes.assembly import Scene
from nlt.scenes.builtin import BUILTINS, mitsuba_scene
from nlt.scenes.description import load_description
from nlt.scenes.state import sample_state, sample_view

ROOM = ("floor", "ceiling", "wall_left", "wall_right", "wall_back", "wall_front")
CONFIGS = Path(__file__).parents[2] / "configs" / "scenes"


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


def parts_of(shapes, keys):
    """(n, 2, 3) bounds of every connected part of these shapes, and the shape that each belongs to."""
    bounds, owners = [], []
    for key in keys:
        mesh = shapes[key].mesh
        _, same = np.unique(np.round(mesh.vertices, 6), axis=0, return_inverse=True)
        edges = same.ravel()[mesh.edges]
        _, label = connected_components(coo_matrix((np.ones(len(edges)), edges.T), shape=(same.max() + 1,) * 2), False)
        label = label[same.ravel()]
        for part in np.unique(label):
            points = mesh.vertices[label == part]
            bounds.append([points.min(0), points.max(0)])
            owners.append(key)
    return np.array(bounds), np.array(owners)


def overlap(some, others):
    """(n, m): how deep boxes (n, 2, 3) and (m, 2, 3) reach into each other; negative: the gap between them."""
    low = np.maximum(some[:, None, 0], others[None, :, 0])
    return (np.minimum(some[:, None, 1], others[None, :, 1]) - low).min(2)


def piece(key):
    return key.rpartition("_")[0] or key


def kinds(bsdf):
    """Every plugin type in a Mitsuba dict."""
    return {bsdf["type"]}.union(*(kinds(value) for value in bsdf.values() if isinstance(value, dict)))


def test_inventory(built):
    description, shapes, _ = built
    assert len(shapes) < 80 and sum(len(shape.mesh.faces) for shape in shapes.values()) < 60_000
    assert sum(shape.emitter is not None for shape in shapes.values()) <= 3
    if description["name"] != "egg":
        assert len({piece(key) for key in shapes if key not in ROOM}) >= 15
        assert len(description["objects"]) >= 5
        used = set().union(*(kinds(shape.bsdf) for shape in shapes.values()))
        assert used >= {"roughplastic", "roughconductor", "conductor", "dielectric", "bitmap"}


def test_objects_stay_inside(built):
    description, shapes, _ = built
    room = interior(shapes)
    assert np.array_equal(room.round(6), description["room"])
    camera = np.array([description["camera"]["min"], description["camera"]["max"]])
    assert (camera[0] > room[0]).all() and (camera[1] < room[1]).all() and (camera[0] < camera[1]).all()
    objects = description["objects"]
    moved = [key for entry in objects.values() for key in entry["shapes"]]
    assert len(moved) == len(set(moved)) and set(moved) <= set(shapes) - set(ROOM)
    for name, entry in objects.items():
        box = np.array(entry["box"], dtype=float)
        bounds = bounds_of(shapes, entry["shapes"])
        assert (box[0] <= 0).all() and (box[1] >= 0).all(), f"{name}: the place in the file is not allowed"
        assert np.ptp(box, 0).max() >= 0.05, f"{name} hardly moves"
        if bounds[0, 1] < room[0, 1] + 0.02:
            assert (box[:, 1] == 0).all(), f"{name} leaves the floor"
        swept = bounds + box
        assert (swept[0] >= room[0] - 1e-6).all() and (swept[1] <= room[1] + 1e-6).all(), f"{name} leaves: {swept}"
        assert overlap(swept[None], camera[None]) <= 0, f"{name} may hold the camera"


def test_nothing_runs_into_what_never_moves(built):
    """Bounds of connected parts against each other; one centimetre is a carpet's height, or a touch."""
    description, shapes, _ = built
    entries = description["objects"].values()
    static = sorted(set(shapes) - {key for entry in entries for key in entry["shapes"]} - set(ROOM))
    still, names = parts_of(shapes, static)
    camera = np.array([description["camera"]["min"], description["camera"]["max"]], float)
    light = description["moving_light"]
    half = np.array([light["size"][0] / 2, 0.005, light["size"][1] / 2])
    for what, where in (("camera", camera), ("moving light", np.add(light["box"], [-half, half]))):
        assert not (hit := names[overlap(where[None], still)[0] > 0]).size, f"{what} meets {hit}"
    for entry in entries:
        parts, keys = parts_of(shapes, entry["shapes"])
        meets = np.argwhere(overlap(parts + np.array(entry["box"]), still) > 0.01)
        assert not len(meets), {(keys[i], names[j]) for i, j in meets}


def test_nothing_floats(built):
    """Everything touches another piece or the shell; what moves is carried by what never moves, wherever it goes."""
    description, shapes, _ = built
    room = interior(shapes)
    parts, keys = parts_of(shapes, [key for key in shapes if key not in ROOM])
    pieces = np.array([piece(key) for key in keys])
    shell = lambda bounds: np.abs(bounds - room).min((1, 2)) < 0.012
    touch = overlap(parts, parts) > -0.012
    for name in np.unique(pieces):
        mine = pieces == name
        assert shell(parts[mine]).any() or touch[mine][:, ~mine].any(), f"{name} floats"
    owner = {key: name for name, entry in description["objects"].items() for key in entry["shapes"]}
    owners = np.array([owner.get(key, "") for key in keys])
    for name, entry in description["objects"].items():
        mine, rest = parts[owners == name], parts[owners == ""]
        for corner in product(*np.array(entry["box"], float).T):
            at = mine + np.array(corner)
            assert shell(at).any() or (overlap(at, rest) > -0.012).any(), f"{name} floats at {corner}"
        # What stands on it: its foot is at the height of a top, and inside that top's outline.
        others = owners != name
        foot, tops = parts[others], mine[:, 1]
        level = np.abs(foot[:, None, 0, 1] - tops[None, :, 1]) < 0.012
        within = ((foot.mean(1)[:, None] > mine[None, :, 0]) & (foot.mean(1)[:, None] < tops[None]))[..., [0, 2]].all(2)
        left = set(keys[others][(level & within).any(1)])
        assert not left, f"{left} stand on {name}, but do not move with it"


def test_moving_light_hangs_under_the_ceiling(built):
    description, shapes, _ = built
    light, room = description["moving_light"], interior(shapes)
    half = np.array([light["size"][0] / 2, 0, light["size"][1] / 2])
    low, high = np.array(light["box"])
    assert (low <= high).all() and (low - half > room[0]).all() and (high + half < room[1]).all()
    assert low[1] == high[1] > room[1, 1] - 0.15


@pytest.mark.parametrize("experiment", ["fixed_lights", "moving_lights"])
def test_well_exposed(built, experiment):
    """Random views of random states: the median pixel is neither dark nor burnt out, and no view is black."""
    description = load_description(built[0]["name"])
    scene = Scene(description, experiment)
    renderer, rng, views = Renderer(scene), np.random.default_rng(1), []
    for seed in range(8):
        scene.set_state(sample_state(description, experiment, rng))
        radiance = renderer.radiance(sample_view(description, 16, rng), 16, seed)
        assert np.isfinite(radiance).all()
        views.append(np.clip(radiance * description.exposure, 0, 1) ** (1 / 2.2))
    medians = np.median(np.reshape(views, (8, -1)), axis=1)
    assert 0.25 < np.median(medians) < 0.75 and medians.min() > 0.12 and medians.max() < 0.9, medians.round(2)


def test_digest_covers_every_file(tmp_path, monkeypatch):
    package = tmp_path / "builtin"
    shutil.copytree(Path(builtin.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))
    monkeypatch.setattr(description_module, "__file__", str(tmp_path / "description.py"))
    digests = [load_description("egg").digest]
    for file in sorted(package.rglob("*.*")):
        file.write_text(file.read_text() + "# changed\n")
        digests.append(load_description("egg").digest)
    assert len(digests) == len(set(digests)) > 4


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
