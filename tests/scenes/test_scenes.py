"""Descriptions are read strictly; states, views and cameras follow the supplementary; units are metres."""

import weakref

import numpy as np
import pytest
import yaml
from conftest import LIGHT, write_room, write_yaml
from scipy import stats

from nlt.errors import UserError
from nlt.paths import CONFIGS
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.pointcloud import sample_points
from nlt.scenes.state import rest_state, sample_state, sample_view

BOX = [[0, 0, 0], [1, 0, 0]]


def refused(call, *fragments):
    """The call fails with one line that holds all fragments."""
    with pytest.raises(UserError) as caught:
        call()
    message = str(caught.value)
    assert "\n" not in message and all(str(f) in message for f in fragments), message


@pytest.mark.parametrize(
    ("content", "fragments"),
    [
        ({"lamps": 1}, ["lamps", "unknown key", "moving_light"]),
        ({"camera": {"min": [0, 0, 0], "max": [1, 1, 1], "fov": 3}}, ["camera.fov", "unknown key", "min, max"]),
        ({"objects": {"a": {"shapes": ["rug"], "box": BOX, "turn": 1}}}, ["objects.a.turn", "unknown key", "box"]),
        ({"objects": {"a": {"shapes": ["rug"], "box": BOX[::-1]}}}, ["objects.a.box", "empty"]),
        ({"objects": {"a": {"shapes": ["rug"], "box": [1, 2]}}}, ["objects.a.box.0", "must be a list, is 1"]),
        ({"objects": {"a": {"box": BOX}}}, ["objects.a.shapes", "missing"]),
        ({"objects": {"a": {"shapes": "rug", "box": BOX}}}, ["objects.a.shapes", "must be a list", "rug"]),
        ({"objects": ["rug"]}, ["objects", "mapping"]),
        ({"objects": {"moving_light": {"shapes": ["rug"], "box": BOX}}}, ["objects", "moving_light is reserved"]),
        ({"camera": None}, ["camera", "missing"]),
        ({"camera": {"min": [0, 0, 0]}}, ["camera.max"]),
        ({"camera": {"min": [0, 2, 0], "max": [1, 1, 1]}}, ["camera", "empty"]),
        ({"source": None}, ["source", "missing"]),
        ({"source": "nowhere/scene.xml"}, ["source", "nowhere/scene.xml", "NLT_SCENES"]),
        ({"objects": {"static": {"shapes": ["rug"], "box": BOX}}}, ["objects", "static is reserved"]),
        ({"up": "w"}, ["up", "x, y, z", "w"]),
        ({"fov": 180}, ["fov", "below 180"]),
        ({"units_per_metre": 0}, ["units_per_metre", "above 0"]),
        ({"exposure": "bright"}, ["exposure", "bright"]),
        ({"moving_light": {"size": [1, 0], "radiance": [1, 1, 1], "box": BOX}}, ["moving_light.size.1", "above 0"]),
        ({"moving_light": {"size": [1, 1], "radiance": [0, 0, 0], "box": BOX}}, ["moving_light.radiance"]),
    ],
)
def test_description_refused(tmp_path, content, fragments):
    file = write_yaml(tmp_path / "scene.yaml", **content)
    refused(lambda: load_description(str(file)), file, *fragments)


def test_description_unreadable(tmp_path):
    refused(lambda: load_description("no_such"), "no_such.yaml", "living_room")
    file = tmp_path / "scene.yaml"
    refused(lambda: load_description(str(file)), file)
    file.write_text("camera: [1\n")
    refused(lambda: load_description(str(file)), file, "YAML")
    file.write_text("- 1\n")
    refused(lambda: load_description(str(file)), file, "mapping")


@pytest.mark.parametrize(
    ("content", "experiment", "fragments"),
    [
        ({"objects": {"a": {"shapes": ["piano"], "box": BOX}}}, "fixed_lights", ["objects.a.shapes", "piano", "ball"]),
        (
            {"objects": {k: {"shapes": ["rug"], "box": BOX} for k in ("a", "b")}},
            "fixed_lights",
            ["objects.b.shapes", "rug", "belongs to a"],
        ),
        ({"source": "builtin:palace"}, "static", ["source", "palace", "living_room"]),
        ({}, "moving_lights", ["moving_light", "missing"]),
    ],
)
def test_scene_refused(tmp_path, content, experiment, fragments):
    file = write_yaml(tmp_path / "scene.yaml", **content)
    refused(lambda: Scene(load_description(str(file)), experiment), file, *fragments)


def test_source_refused(tmp_path):
    dark = load_description(str(write_room(tmp_path / "dark", light=False)))
    refused(lambda: Scene(dark, "fixed_lights"), dark.file, "source", "no emitters", "moving_lights")
    Scene(dark, "moving_lights")

    file = write_room(tmp_path / "strange")
    source = file.with_name("scene.xml")
    source.write_text("<scene version='3.0.0'><shape type='no_such'/></scene>")
    refused(lambda: Scene(load_description(str(file)), "static"), source, "no_such")


def test_flat_boxes_and_defaults(tmp_path):
    objects = {"a": {"shapes": ["rug"], "box": [[-1, 0, 2], [1, 0, 2]]}}
    description = load_description(str(write_yaml(tmp_path / "flat.yaml", objects=objects)))
    assert np.array_equal(description.objects[0].box, objects["a"]["box"]) and description.name == "flat"
    rng = np.random.default_rng(0)
    drawn = np.concatenate([sample_state(description, "fixed_lights", rng).translation for _ in range(20)])
    assert set(map(tuple, drawn[:, 1:].tolist())) == {(0, 2), (0, 0)}, "within the box, or removed"


# ---- states ---------------------------------------------------------------------------------------------


def test_states_follow_the_supplementary(demo):
    rng = np.random.default_rng(5)
    states = [sample_state(demo, "moving_lights", rng) for _ in range(1500)]
    translation, present = np.stack([s.translation for s in states]), np.stack([s.present for s in states])
    content = yaml.safe_load((CONFIGS / "scenes" / "living_room.yaml").read_text())
    light = np.array(content["moving_light"]["box"], float)
    boxes = [np.array(entry["box"], float) for entry in content["objects"].values()] + [light - light.mean(0)]

    tests = []
    for m, (low, high) in enumerate(boxes):
        there = present[:, m]
        assert (translation[~there, m] == 0).all()
        for axis in range(3):
            values = translation[there, m, axis]
            if low[axis] == high[axis]:
                assert np.allclose(values, low[axis])
            else:
                tests.append(stats.kstest(values, stats.uniform(low[axis], high[axis] - low[axis]).cdf).pvalue)
    for m in range(len(boxes) - 1):
        tests.append(stats.binomtest(int((~present[:, m]).sum()), len(states), 0.2).pvalue)
    # Removals are independent: pairs of objects are both gone as often as chance says.
    both = sum(int((~present[:, a] & ~present[:, a + 1]).sum()) for a in range(0, len(boxes) - 1, 2))
    tests.append(stats.binomtest(both, len(states) * ((len(boxes) - 1) // 2), 0.04).pvalue)
    assert min(tests) > 1e-3 / len(tests)
    assert present[:, -1].all(), "the light is never removed"


def test_static_has_nothing_to_move(demo):
    state = sample_state(demo, "static", np.random.default_rng(0))
    assert demo.movables("static") == () and state.translation.shape == (0, 3) and state.present.shape == (0,)
    assert len(demo.movables("fixed_lights")) == len(demo.objects) == len(demo.movables("moving_lights")) - 1


# ---- views ----------------------------------------------------------------------------------------------


def test_views_follow_the_supplementary(demo):
    rng = np.random.default_rng(6)
    views = [sample_view(demo, 16, rng) for _ in range(600)]
    box = yaml.safe_load((CONFIGS / "scenes" / "living_room.yaml").read_text())["camera"]
    low, high = np.array(box["min"]), np.array(box["max"])
    position = np.stack([v.position for v in views])
    p = [stats.kstest(position[:, k], stats.uniform(low[k], high[k] - low[k]).cdf).pvalue for k in range(3)]
    assert min(p) > 1e-3
    # The axis of view passes through the box half the size: slab test.
    axis = np.stack([v.world_to_view[2, :3] for v in views]).astype(float)
    centre, quarter = (low + high) / 2, (high - low) / 4
    t = np.sort(np.stack([(centre + s * (quarter + 1e-5) - position) / axis for s in (-1, 1)]), axis=0)
    assert (t[1].min(1) >= np.maximum(t[0].max(1), 0)).all()
    assert all(abs(v.fov - 70) < 1e-4 and np.allclose(v.rotation @ [1, 0, 0] @ demo.up, 0) for v in views)


def test_camera_by_hand():
    """At (1, 2, 3) looking along +x with y up: right is +z, down is -y."""
    camera = Camera.look_at(np.array([1.0, 2, 3]), np.array([5.0, 2, 3]), np.array([0.0, 1, 0]), 90.0, 16, 12)
    point = np.array([1 + 4, 2 + 1, 3 + 2, 1.0])  # 4 ahead, 1 up, 2 to the right
    view = camera.world_to_view.astype(float) @ point
    assert np.allclose(view, [2, -1, 4, 1])
    pixel = camera.matrix.astype(float) @ view[:3]
    # 90 degrees across 16 pixels: the focal length is 8 pixels.
    assert np.allclose(pixel[:2] / pixel[2], [8 + 8 * 2 / 4, 6 - 8 * 1 / 4])
    assert np.allclose(camera.position, [1, 2, 3]) and abs(camera.fov - 90) < 1e-5


def test_view_directions_pass_pixel_centres(demo):
    camera = sample_view(demo, 12, np.random.default_rng(8))
    directions = camera.view_directions()
    assert directions.shape == (3, 12, 12) and directions.dtype == np.float32
    assert np.abs(np.linalg.norm(directions, axis=0) - 1).max() < 1e-6
    matrix, world_to_view = camera.matrix.astype(float), camera.world_to_view.astype(float)
    for row, column in [(0, 0), (3, 11), (11, 0), (7, 5)]:
        point = np.append(camera.position + 3.7 * directions[:, row, column], 1)
        pixel = matrix @ (world_to_view @ point)[:3]
        assert np.allclose(pixel[:2] / pixel[2], [column + 0.5, row + 0.5], atol=1e-4)
    assert np.allclose(world_to_view[:3, :3] @ world_to_view[:3, :3].T, np.eye(3), atol=1e-6)


# ---- units ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("experiment", ["fixed_lights", "moving_lights"])
def test_units(tmp_path, experiment):
    """A scene in decimetres is the same scene."""
    results = []
    for scale in (1.0, 10.0):
        description = load_description(str(write_room(tmp_path / str(scale), scale)))
        scene = Scene(description, experiment)
        renderer = Renderer(scene)
        state = rest_state(description, experiment)
        state.translation[0] = [0.5, 0, 0]
        scene.set_state(state)
        camera = sample_view(description, 12, np.random.default_rng(1))
        results.append({
            "state": state.translation,
            "K": camera.matrix,
            "T": camera.world_to_view,
            **renderer.gbuffer(camera),
            **renderer.photons(200, 3),
            "radiance": renderer.radiance(camera, 64, 0),
            "points": sample_points(scene, 200, 0)["position"],
        })  # fmt: skip
    one, ten = results
    for name in one:
        if name == "radiance":
            # The paths' rounding differs, so that a few of them part ways.
            assert abs(one[name].mean() / ten[name].mean() - 1) < 0.05
        else:
            # A ray that grazes an edge may see the other side of it.
            off = np.abs(one[name].astype(float) - ten[name]) > 1e-4 * (1 + np.abs(one[name].astype(float)))
            assert off.mean() < 0.02, name
    size, radiance = (LIGHT["size"], LIGHT["radiance"]) if experiment == "fixed_lights" else ([0.3, 0.8], [5, 4, 3])
    power = np.pi * size[0] * size[1] * np.array(radiance)
    assert np.allclose(ten["photon_flux"].sum(0), power, rtol=1e-4)
    assert (np.abs(ten["points"]) <= 2.001).all() and 0.1 < np.median(ten["depth"]) < 3


def test_moving_light_is_as_wide_along_x_as_it_says(tmp_path):
    """size is along the two horizontal axes in order: photons leave all over the rectangle, and nowhere else."""
    description = load_description(str(write_room(tmp_path)))
    scene = Scene(description, "moving_lights")
    scene.set_state(rest_state(description, "moving_lights"))
    origin = Renderer(scene).photons(2000, 0)["photon_origin"]
    assert stats.kstest(origin[:, 0], stats.uniform(0.1 - 0.15, 0.3).cdf).pvalue > 1e-3
    assert stats.kstest(origin[:, 2], stats.uniform(-0.1 - 0.4, 0.8).cdf).pvalue > 1e-3
    assert np.allclose(origin[:, 1], 1.8, atol=1e-3)  # Mitsuba starts a ray a little off its surface
    points = sample_points(scene, 20_000, 0)
    on_light = points["position"][points["emission"].any(1)]
    assert np.allclose(on_light.min(0), [-0.05, 1.8, -0.5], atol=0.05)
    assert np.allclose(on_light.max(0), [0.25, 1.8, 0.3], atol=0.05)


def test_unused_scenes_are_freed(demo):
    """The next scene frees them, although cycles keep them alive."""
    renderer = Renderer(Scene(demo, "static"))
    renderer.itself = renderer
    scene = weakref.ref(renderer.scene)
    del renderer
    assert scene() is not None
    Scene(demo, "static")
    assert scene() is None
