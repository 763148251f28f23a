"""Points are uniform on the surfaces and carry the attributes of the material they lie on."""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from conftest import demo_meshes, write_room, write_yaml
from scipy import stats
from scipy.spatial import Delaunay

from nlt.data.sample import POINT_FIELDS
from nlt.errors import UserError
from nlt.scenes.assembly import Scene, Shape
from nlt.scenes.builtin import living_room
from nlt.scenes.description import MATERIALS, MOVING_LIGHT, load_description
from nlt.scenes.pointcloud import material, sample_points
from nlt.scenes.state import rest_state

pytestmark = pytest.mark.slow

COUNT = 20_000


@pytest.fixture(scope="module")
def own_lights(demo):
    return Scene(demo, "fixed_lights")


@pytest.fixture(scope="module")
def points(own_lights):
    return sample_points(own_lights, COUNT, 7)


@pytest.fixture(scope="module")
def meshes(demo):
    """Shape index -> (name, BuiltinShape), in the order of the scene."""
    return list(living_room().items())


def test_fields(points):
    assert points.keys() == POINT_FIELDS.keys()
    for name, field in POINT_FIELDS.items():
        assert points[name].shape == field.resolve({"N": COUNT}) and points[name].dtype == field.dtype, name
        assert np.isfinite(points[name]).all(), name


def test_uniform_over_shapes_triangles_and_within(points, meshes):
    """On the movable objects, all of whose surface is kept."""
    observed = np.bincount(points["shape"], points["object"] >= 0, len(meshes))
    movable = np.isin(np.arange(len(meshes)), points["shape"][points["object"] >= 0])
    area = np.array([shape.mesh.area_faces.sum() for _, shape in meshes]) * movable
    assert stats.chisquare(observed[movable], (area * observed.sum() / area.sum())[movable]).pvalue > 1e-3

    tested = 0
    for k in np.flatnonzero(observed > 100):
        mesh = meshes[k][1].mesh
        position = points["position"][points["shape"] == k].astype(float)
        # Every triangle's barycentric weights of every point; a point's triangle is the one that holds it.
        corners = mesh.triangles
        if len(corners) > 200:
            continue
        pairs = np.broadcast_to(corners, (len(position), *corners.shape)).reshape(-1, 3, 3)
        repeated = np.repeat(position, len(corners), axis=0)
        weights = trimesh.triangles.points_to_barycentric(pairs, repeated).reshape(len(position), -1, 3)
        rebuilt = np.einsum("ntk,tkd->ntd", weights, corners)
        off = np.linalg.norm(rebuilt - position[:, None], axis=2) + 10 * np.clip(-weights, 0, None).max(2)
        owner = off.argmin(1)
        assert off[np.arange(len(owner)), owner].max() < 1e-4, f"{meshes[k][0]}: a point lies beside the mesh"
        expected = mesh.area_faces / mesh.area * len(position)
        if expected.min() >= 5:
            assert stats.chisquare(np.bincount(owner, minlength=len(expected)), expected).pvalue > 1e-4
        inside = weights[np.arange(len(owner)), owner]
        # Uniform in a triangle: each weight has the density 2 (1 - w).
        assert min(stats.kstest(inside[:, j], stats.beta(1, 2).cdf).pvalue for j in range(3)) > 1e-4
        tested += 1
    assert tested > 7


def test_points_on_smooth_shapes(points, meshes):
    index = [name for name, _ in meshes].index("ball_glass")
    position = points["position"][points["shape"] == index].astype(float)
    assert len(position) > 20
    radius = np.linalg.norm(position - meshes[index][1].mesh.bounds.mean(0), axis=1)
    assert (radius <= 0.2 + 1e-5).all() and (radius > 0.199).all()


def test_materials_albedo_emission(points, meshes):
    """Against the built-in room's own description of each shape."""
    constants = {"wall_right": (0.8, 0.72, 0.55), "chair_1_seat": (0.12, 0.24, 0.42), "ceiling": (0.8, 0.8, 0.78)}
    kinds = {"ball_glass": "glass", "lamp_stand": "glossy", "mirror_panel": "mirror", "vase_body": "coated"}
    kinds |= dict.fromkeys(["floor"], "coated") | dict.fromkeys(["rug", "table_top", *constants], "diffuse")
    names = np.array([name for name, _ in meshes])
    kinds = {n: k for n, k in kinds.items() if n in names}
    for name, kind in kinds.items():
        mine = points["shape"] == names.tolist().index(name)
        assert mine.sum() > 3 and (points["material"][mine] == MATERIALS.index(kind)).all(), name
        if kind in ("glass", "glossy", "mirror"):
            assert (points["albedo"][mine] == 0).all(), name
    albedos = [tuple(np.round(row, 4)) for row in points["albedo"]]
    seat = points["shape"] == names.tolist().index("chair_1_seat")
    assert {a for a, m in zip(albedos, seat, strict=True) if m} == {tuple(np.float32(constants["chair_1_seat"]))}
    assert points["albedo"].min() >= 0 and points["albedo"].max() <= 1

    radiance = {"window_panel": (3.8, 4.5, 5.5), "ceiling_lamp_panel": (5.8, 5.0, 4.1)}
    expected = np.array([radiance.get(names[k], (0, 0, 0)) for k in points["shape"]])
    assert np.allclose(points["emission"], expected, rtol=1e-5) and expected.any(1).sum() > 50


def test_objects(points, demo, meshes):
    owner = {shape: k for k, movable in enumerate(demo.objects) for shape in movable.shapes}
    assert np.array_equal(points["object"], [owner.get(meshes[k][0], -1) for k in points["shape"]])
    assert len(np.unique(points["object"])) > 8


def test_moving_light_is_the_only_emitter(scene, demo):
    points = sample_points(scene, COUNT, 7)
    lit = points["emission"].any(1)
    light = points["object"] == len(demo.objects)
    assert np.array_equal(lit, light) and light.sum() > 50
    assert np.allclose(points["emission"][lit], demo.light.radiance)
    assert (points["albedo"][lit] == 0).all() and list(scene.shapes).index(MOVING_LIGHT) == points["shape"][lit][0]
    half = np.array([demo.light.size[0], 0, demo.light.size[1]]) / 2
    assert (np.abs(points["position"][lit] - demo.light.box.mean(0)) <= half + 1e-5).all()
    meshes = demo_meshes(demo, "moving_lights", rest_state(demo, "moving_lights"))
    area = sum(meshes[name][0].mesh.area for movable in demo.objects for name in movable.shapes)
    share = demo.light.size.prod() / (area + demo.light.size.prod())
    assert stats.binomtest(int(lit.sum()), int((points["object"] >= 0).sum()), share).pvalue > 1e-3


def test_seeds(own_lights, points):
    again, other = (sample_points(own_lights, COUNT, seed) for seed in (7, 8))
    assert all(again[n].tobytes() == points[n].tobytes() for n in points)
    assert (other["position"] != points["position"]).any(1).mean() > 0.99


def add_box(folder, name, size, centre):
    """Another shape in the XML of `write_room`."""
    box = trimesh.creation.box(size)
    box.apply_translation(centre)
    box.export(folder / f"{name}.ply")
    source = folder / "scene.xml"
    shape = f"""<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>
        <bsdf type="twosided"><bsdf type="diffuse"/></bsdf></shape>"""
    source.write_text(source.read_text().replace("</scene>", f"{shape}</scene>"))
    return box


def test_only_what_may_be_seen(tmp_path):
    """In a closed room, uniform on walls, crate and lamp; nothing in a locked chest, nor outside."""
    room = [[-1, 0, -1], [1, 2, 1]]
    file = write_room(tmp_path, room=room, camera={"min": [-0.9, 0.4, -0.9], "max": [0.9, 1.8, 0.9]})
    add_box(tmp_path, "ground", (50, 0.1, 50), (0, -1, 0))
    add_box(tmp_path, "chest", (0.3, 0.3, 0.3), (0.4, 0.15, -0.5))
    add_box(tmp_path, "coins", (0.2, 0.2, 0.2), (0.4, 0.15, -0.5))
    add_box(tmp_path, "behind", (0.2, 0.5, 0.02), (-0.4, 0.25, 0.5))  # the movable crate
    scene = Scene(load_description(str(file)), "fixed_lights")
    before = scene.state
    points = sample_points(scene, COUNT, 3)
    assert scene.state is before
    names = np.array(list(scene.shapes))[points["shape"]]
    assert set(names) == {"room", "crate", "lamp", "chest", "behind"}
    # All of the crate, for it moves, and what stands behind it; of the chest, not what it stands on.
    area = {
        "room": 24 - 0.3**2 - 0.2 * 0.02,
        "crate": 2 * (0.4 * 0.5 + 0.4 * 0.3 + 0.5 * 0.3),
        "lamp": 0.24,
        "chest": 5 * 0.3**2,
    }
    area["behind"] = 2 * 0.5 * (0.2 + 0.02) + 0.2 * 0.02
    observed = [(names == name).sum() for name in area]
    expected = np.array(list(area.values())) * COUNT / sum(area.values())
    assert stats.chisquare(observed, expected).pvalue > 1e-3
    whole = sum(shape.face_areas.sum() for shape in scene.shapes.values())
    assert points["area_share"] == pytest.approx(sum(area.values()) / whole, rel=0.05)


def test_nothing_in_sight(tmp_path):
    file = write_room(tmp_path, room=[[-1, 0, -1], [1, 2, 1]])
    add_box(tmp_path, "universe", (5e4, 5e4, 5e4), (0, 0, 0))
    with pytest.raises(UserError, match=r"scene.yaml: camera: only .* of the scene's surface can be seen"):
        sample_points(Scene(load_description(str(file)), "fixed_lights"), 100, 0)


# ---- materials one by one -------------------------------------------------------------------------------

DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.2, 0.4, 0.9]}}


@pytest.mark.parametrize(
    ("bsdf", "kind", "albedo"),
    [
        (DIFFUSE, "diffuse", [0.2, 0.4, 0.9]),
        ({"type": "twosided", "bsdf": DIFFUSE}, "diffuse", [0.2, 0.4, 0.9]),
        ({"type": "mask", "opacity": 1.0, "bsdf": DIFFUSE}, "diffuse", [0.2, 0.4, 0.9]),
        ({"type": "bumpmap", "arbitrary": {"type": "checkerboard"}, "bsdf": DIFFUSE}, "diffuse", [0.2, 0.4, 0.9]),
        ({"type": "roughplastic", "diffuse_reflectance": DIFFUSE["reflectance"]}, "coated", None),
        ({"type": "plastic", "diffuse_reflectance": DIFFUSE["reflectance"]}, "coated", None),
        ({"type": "principled", "base_color": DIFFUSE["reflectance"]}, "coated", None),
        ({"type": "conductor", "material": "Au"}, "mirror", [0, 0, 0]),
        ({"type": "roughconductor", "material": "Al"}, "glossy", [0, 0, 0]),
        ({"type": "dielectric"}, "glass", [0, 0, 0]),
        ({"type": "roughdielectric"}, "glass", [0, 0, 0]),
        ({"type": "thindielectric"}, "glass", [0, 0, 0]),
        ({"type": "twosided", "bsdf": {"type": "roughconductor", "material": "Cu"}}, "glossy", [0, 0, 0]),
        ({"type": "mask", "opacity": 0.5, "bsdf": {"type": "conductor"}}, "mirror", [0, 0, 0]),
        ({"type": "null"}, "other", [0, 0, 0]),
    ],
    ids=lambda value: value["type"] if isinstance(value, dict) else None,
)
def test_material(bsdf, kind, albedo):
    values = _albedo_of(mi.load_dict(bsdf), np.array([[0.3, 0.3], [0.9, 0.1]]))
    assert material(mi.load_dict(bsdf)) == kind
    assert (values >= 0).all() and (values <= 1).all()
    if albedo is not None:
        assert np.allclose(values, albedo, atol=1e-6)
    else:
        # The colour under the coat: in the same order, and not far off.
        assert (np.diff(values, axis=1) > 0).all() and np.abs(values - [0.2, 0.4, 0.9]).max() < 0.2


def _albedo_of(bsdf, uv):
    """The albedo that sample_points gives a plane of that material at these texture coordinates."""
    from nlt.scenes.pointcloud import surface

    shape = Shape("plane", np.zeros((3, 3)), np.array([[0, 1, 2]]), None, bsdf, None)
    return surface(shape, uv)[0]


def test_texture(tmp_path):
    """Albedo of points on the floor, whose texture coordinates are known, against the bitmap read by hand."""
    pixels = np.random.default_rng(0).random((4, 4, 3)).astype(np.float32)
    bitmap = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "filter_type": "nearest", "raw": True}
    uv = np.random.default_rng(1).random((200, 2))
    values = _albedo_of(mi.load_dict({"type": "diffuse", "reflectance": bitmap}), uv)
    column, row = (uv * 4).astype(int).T
    assert np.allclose(values, pixels[row, column], atol=1e-6)


def test_texture_of_a_loaded_mesh(tmp_path):
    """End to end: a textured OBJ quad; position, not our own uv, says which texel a point shows."""
    file = write_room(tmp_path)
    pixels = (np.arange(12).reshape(2, 2, 3) * 20).astype(np.uint8)
    mi.Bitmap(pixels).write(str(tmp_path / "tiles.png"))
    # x, z in 0..1 at y = 0.5, facing up; u = x and v = z.
    (tmp_path / "quad.obj").write_text(
        "v 0 .5 0\nv 1 .5 0\nv 1 .5 1\nv 0 .5 1\nvt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nf 1/1 3/3 2/2\nf 1/1 4/4 3/3\n"
    )
    quad = """<shape type="obj" id="quad"><string name="filename" value="quad.obj"/><bsdf type="diffuse">
        <texture type="bitmap" name="reflectance"><string name="filename" value="tiles.png"/>
        <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture></bsdf></shape>"""
    source = tmp_path / "scene.xml"
    source.write_text(source.read_text().replace("</scene>", f"{quad}</scene>"))
    scene = Scene(load_description(str(file)), "fixed_lights")
    points = sample_points(scene, 3000, 0)
    mine = points["shape"] == list(scene.shapes).index("quad")
    x, _, z = points["position"][mine].T
    # Mitsuba flips v of OBJ files and of images alike: v = 0 is the last row of the file.
    rows = 1 - (z > 0.5)
    assert mine.sum() > 60
    assert np.allclose(points["albedo"][mine], pixels[rows, (x > 0.5).astype(int)] / 255, atol=1e-5)


def test_uniform_over_triangles_of_any_size(tmp_path):
    """Three walls of random triangles, seen whole from between them: chi-squared per wall and over all triangles."""
    rng = np.random.default_rng(0)
    corners = np.array([[0, 0], [0, 1], [1, 0], [1, 1]])
    sheets = {name: Delaunay(np.concatenate([corners, rng.random((30, 2))])) for name in ("floor", "left", "back")}
    # u, v in the unit square to the wall's own place and size.
    frames = {"floor": [[2, 0, 0], [0, 0, 2]], "left": [[0, 1, 0], [0, 0, 2]], "back": [[2, 0, 0], [0, 0.5, 0]]}
    shapes = ""
    for name, sheet in sheets.items():
        mesh = trimesh.Trimesh(sheet.points @ frames[name], sheet.simplices, process=False)
        mesh.export(tmp_path / f"{name}.ply")
        light = '<emitter type="area"><rgb name="radiance" value="1"/></emitter>' if name == "left" else ""
        shapes += f"""<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>
            <bsdf type="twosided"><bsdf type="diffuse"/></bsdf>{light}</shape>"""
    (tmp_path / "scene.xml").write_text(f'<scene version="3.0.0">{shapes}</scene>')
    views = {
        "camera": {"min": [0.3, 0.3, 0.3], "max": [0.6, 0.5, 0.6]},
        "look_at": {"min": [0, 0, 0], "max": [0.2, 0, 0.2]},
    }
    file = write_yaml(tmp_path / "scene.yaml", name="walls", source="scene.xml", **views)
    scene = Scene(load_description(str(file)), "fixed_lights")
    points = sample_points(scene, COUNT, 3)
    observed, expected = [], []
    for k, name in enumerate(scene.shapes):
        sheet, frame = sheets[name], np.array(frames[name], float)
        position = points["position"][points["shape"] == k].astype(float)
        triangle = sheet.find_simplex(position @ np.linalg.pinv(frame), tol=1e-6)
        observed.append(np.bincount(triangle, minlength=len(sheet.simplices)))
        a, b, c = np.moveaxis(sheet.points[sheet.simplices] @ frame, 1, 0)
        expected.append(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)
    total = sum(map(np.sum, expected))
    each, areas = np.concatenate(observed), np.concatenate(expected) * COUNT / total
    few = areas < 5  # together, as the chi-squared test wants
    together = lambda values: np.append(values[~few], values[few].sum()) if few.any() else values
    assert len(areas) > 100 and areas.max() > 10 * areas.min()
    assert stats.chisquare(together(each), together(areas)).pvalue > 1e-3
    per_shape = [part.sum() for part in observed], [part.sum() * COUNT / total for part in expected]
    assert stats.chisquare(*per_shape).pvalue > 1e-3
    assert stats.chisquare(per_shape[0]).pvalue < 1e-6, "the test cannot tell walls of different sizes"
