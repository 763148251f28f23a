"""Scenes shared by the tests, and what renders and traces them independently of nlt.scenes and nlt.rendering."""

from __future__ import annotations

import os
import shutil

import mitsuba as mi
import numpy as np
import pytest
import trimesh
import yaml
from generated import spec_of

from nlt.rendering.variant import use_variant
from nlt.scenes.builtin import living_room
from nlt.scenes.description import MOVING_LIGHT, load_description

LIGHT = {"size": (0.6, 0.4), "radiance": (7.0, 5.0, 3.0), "height": 1.9}


@pytest.fixture(scope="session", autouse=True)
def variant():
    """The variant that this machine or NLT_VARIANT chooses."""
    return use_variant()


@pytest.fixture(scope="session", autouse=True)
def cache(tmp_path_factory):
    """A cache of the session's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("NLT_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def refused(capfd):
    """Runs a command that is to fail: exit code 2, and nothing on stderr but one line with these words."""

    from nlt.cli import main

    def run(arguments, *words):
        capfd.readouterr()
        assert main([str(argument) for argument in arguments]) == 2
        error = capfd.readouterr().err
        assert error.startswith("nlt: error: ") and error.endswith("\n") and error.count("\n") == 1, error
        assert "Traceback" not in error
        for word in words:
            assert str(word) in error
        return error

    return run


@pytest.fixture(scope="session")
def dataset(tmp_path_factory, variant):
    """The directory of a small generated dataset: `generated.spec_of()`."""
    from nlt.data.generate import generate

    return generate(spec_of(), tmp_path_factory.mktemp("data"), workers=1)


@pytest.fixture(scope="session")
def demo(variant):
    return load_description("living_room")


@pytest.fixture(scope="session")
def scene(demo):
    """The demo room with the moving light. Set its state before use: other tests have moved it."""
    from nlt.scenes.assembly import Scene

    return Scene(demo, "moving_lights")


@pytest.fixture(scope="session")
def renderer(scene):
    from nlt.rendering.renderer import Renderer

    return Renderer(scene)


def write_yaml(path, **content):
    """A scene.yaml; by default over the demo room."""
    content = {
        "source": "builtin:living_room",
        "camera": {"min": [-1.8, 1.0, -1.7], "max": [2.2, 1.6, 1.75]},
        **content,
    }
    path.write_text(yaml.safe_dump(content))
    return path


# Where the albedo of a pixel is sampled, from its corner: (k + 0.5) / 8 and the same with the bits of k reversed.
PLACES = (np.stack([np.arange(8), [0, 4, 2, 6, 1, 5, 3, 7]], 1) + 0.5) / 8


def write_room(folder, scale=1.0, is_open=False, light=True, **more):
    """A white box of 2 x 2 x 2 m with a crate and a light under its ceiling, its XML `scale` times as large.

    Returns its scene.yaml, written in the same enlarged units. `is_open`: only the floor of the box.
    """
    folder.mkdir(parents=True, exist_ok=True)
    room = trimesh.creation.box((2, 2, 2))
    room.apply_translation([0, 1, 0])
    room.invert()
    if is_open:
        room.update_faces(room.triangles_center[:, 1] < 1e-6)
    crate = trimesh.creation.box((0.4, 0.5, 0.3))
    crate.apply_translation([-0.4, 0.25, 0.2])
    (w, d), y = LIGHT["size"], LIGHT["height"]
    corners = np.array([[-w, y, -d], [w, y, -d], [w, y, d], [-w, y, d]]) * [0.5, 1, 0.5]
    meshes = {"room": room, "crate": crate, "lamp": trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], process=False)}
    shapes = ""
    for name, mesh in meshes.items():
        mesh = mesh.copy()
        mesh.apply_scale(scale)
        mesh.export(folder / f"{name}.ply")
        radiance = ", ".join(map(str, LIGHT["radiance"]))
        emitter = f'<emitter type="area"><rgb name="radiance" value="{radiance}"/></emitter>'
        shapes += f"""<shape type="ply" id="{name}"><string name="filename" value="{name}.ply"/>
            <boolean name="face_normals" value="true"/>
            <bsdf type="twosided"><bsdf type="diffuse"><rgb name="reflectance" value="0.7, 0.6, 0.5"/></bsdf></bsdf>
            {emitter if name == "lamp" and light else ""}</shape>"""
    (folder / "scene.xml").write_text(f'<scene version="3.0.0">{shapes}</scene>')
    content = {
        "name": "room",
        "source": "scene.xml",
        "units_per_metre": scale,
        "camera": {"min": [0.3 * scale, 0.8 * scale, -0.8 * scale], "max": [0.8 * scale, 1.2 * scale, -0.3 * scale]},
        "objects": {"crate": {"shapes": ["crate"], "box": [[0, 0, 0], [0.6 * scale, 0, 0]]}},
        "moving_light": {
            "size": [0.3 * scale, 0.8 * scale],
            "radiance": [5, 4, 3],
            "box": [[-0.5 * scale, 1.8 * scale, -0.4 * scale], [0.7 * scale, 1.8 * scale, 0.2 * scale]],
        },
        **more,
    }
    return write_yaml(folder / "scene.yaml", **content)


def offsets(description, experiment, state):
    """Shape -> its translation, None where removed; only shapes that can move."""
    return {
        shape: np.asarray(t, float) if present else None
        for movable, t, present in zip(description.movables(experiment), state.translation, state.present, strict=True)
        for shape in movable.shapes
    }


def demo_meshes(description, experiment, state):
    """The demo room in a state as {shape: (BuiltinShape, vertices)}; without the moving light."""
    moved = offsets(description, experiment, state)
    shapes = {key: shape for key, shape in living_room().items() if moved.get(key, 0) is not None}
    return {key: (shape, shape.mesh.vertices + moved.get(key, 0)) for key, shape in shapes.items()}


def plain_scene(description, experiment, state):
    """The demo room in a state, built afresh by Mitsuba from moved meshes: no instances, updates or kernels of ours."""
    bsdfs: dict = {}
    parts: dict = {"type": "scene"}
    for key, (shape, vertices) in demo_meshes(description, experiment, state).items():
        if id(shape.bsdf) not in bsdfs:
            bsdfs[id(shape.bsdf)] = mi.load_dict(shape.bsdf)
        props = mi.Properties()
        props["mesh_bsdf"] = bsdfs[id(shape.bsdf)]
        if shape.emitter is not None and experiment != "moving_lights":
            props["mesh_emitter"] = mi.load_dict(shape.emitter)
        uv = shape.uv is not None
        size = (len(vertices), len(shape.mesh.faces))
        mesh = mi.Mesh(key, *size, props=props, has_vertex_normals=shape.smooth, has_vertex_texcoords=uv)
        values = mi.traverse(mesh)
        values["vertex_positions"] = vertices.ravel().astype(np.float32)
        values["faces"] = shape.mesh.faces.ravel().astype(np.uint32)
        if uv:
            values["vertex_texcoords"] = shape.uv.ravel().astype(np.float32)
        if shape.smooth:
            values["vertex_normals"] = shape.mesh.vertex_normals.ravel().astype(np.float32)
        values.update()
        parts[key] = mesh
    if experiment == "moving_lights":
        light = description.light
        centre = light.box.mean(0) + offsets(description, experiment, state)[MOVING_LIGHT]
        half = [light.size[0] / 2, light.size[1] / 2, 1]
        parts["light"] = {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate(centre.tolist()).rotate([1, 0, 0], 90).scale(half),
            "black": {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}},
            "emitter": {"type": "area", "radiance": {"type": "rgb", "value": light.radiance.tolist()}},
        }
    return mi.load_dict(parts)


def first_hit(triangles, origins, directions):
    """Möller-Trumbore in float64, every ray against every triangle (F, 3, 3).

    Returns distances (n,), inf where a ray meets nothing; the triangles met (n,); their barycentric weights (n, 3).
    """
    a, e1, e2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    results = []
    for o, d in zip(origins.astype(float), directions.astype(float), strict=True):
        p = np.cross(d, e2)
        with np.errstate(divide="ignore", invalid="ignore"):
            inverse = 1 / (e1 * p).sum(1)
            u = ((o - a) * p).sum(1) * inverse
            q = np.cross(o - a, e1)
            v = (q @ d) * inverse
            t = (e2 * q).sum(1) * inverse
            t[~((u >= 0) & (v >= 0) & (u + v <= 1) & (t > 1e-6))] = np.inf
        k = int(t.argmin())
        results.append((t[k], k, (1 - u[k] - v[k], u[k], v[k])))
    t, which, weights = zip(*results, strict=True)
    return np.array(t), np.array(which), np.array(weights)


@pytest.fixture(scope="module")
def browser():
    """Headless chromium."""
    from playwright.sync_api import sync_playwright  # here, because few tests need it

    path = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if path is None:
        pytest.fail("no chromium: run scripts/system-packages.sh chromium, or apt-get install chromium")
    with sync_playwright() as playwright:
        arguments = ["--no-sandbox"] if os.geteuid() == 0 else []
        browser = playwright.chromium.launch(executable_path=path, args=arguments)
        yield browser
        browser.close()


def pytest_collection_modifyitems(items):
    """Mark the tests that open a page in chromium."""
    for item in items:
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)
