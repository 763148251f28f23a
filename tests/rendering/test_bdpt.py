"""The bidirectional integrator agrees with Mitsuba's path tracer and with a furnace, by statistical tests."""

from types import SimpleNamespace

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from conftest import write_yaml
from scipy import stats
from test_rendering import away

from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.errors import UserError
from nlt.rendering import renderer as renderer_module
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.lanes import is_jit
from nlt.scenes.state import rest_state, sample_view

pytestmark = pytest.mark.slow

ALPHA = 1e-4  # of each test, after Bonferroni's correction
SIZE, BLOCK, SEEDS, SPP = 16, 4, 20, 48
_ALIVE: list = []  # scenes: one freed while a kernel is recorded ends the process


@pytest.fixture(autouse=True)
def arrays(variant):
    if not is_jit():
        pytest.skip("bdpt needs Mitsuba's llvm or cuda")


def rgb(*value):
    return {"type": "rgb", "value": list(value)}


def diffuse(*colour):
    return {"type": "twosided", "one": {"type": "diffuse", "reflectance": rgb(*colour)}}


def area(*radiance):
    return {"type": "area", "radiance": rgb(*radiance)}


def mesh(shape, bsdf, emitter=None, smooth=False):
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(bsdf)
    if emitter:
        properties["mesh_emitter"] = mi.load_dict(emitter)
    result = mi.Mesh("mesh", len(shape.vertices), len(shape.faces), props=properties, has_vertex_normals=smooth)
    values = mi.traverse(result)
    values["vertex_positions"] = np.array(shape.vertices, np.float32).ravel()
    values["faces"] = np.array(shape.faces, np.uint32).ravel()
    if smooth:
        values["vertex_normals"] = np.array(shape.vertex_normals, np.float32).ravel()
    values.update()
    return result


def box(*size, at=(0, 0, 0)):
    shape = trimesh.creation.box(size)
    shape.apply_translation(at)
    return shape


def lamp(x, y, z, half, *radiance):
    """Return a lamp that faces down."""
    place = mi.ScalarTransform4f().translate([x, y, z]).rotate([1, 0, 0], 90).scale(half)
    return {"type": "rectangle", "to_world": place, "bsdf": diffuse(0.3, 0.3, 0.3), "emitter": area(*radiance)}


def room():
    """Return a closed diffuse room with a crate whose shading normals are far from its faces' normals."""
    walls, crate = mesh(box(2, 2, 2), diffuse(0.7, 0.6, 0.5)), box(0.9, 1, 0.9, at=(-0.3, -0.5, -0.3))
    crate = mesh(crate, diffuse(0.3, 0.5, 0.8), smooth=True)
    return {"walls": walls, "crate": crate, "lamp": lamp(0.2, 0.98, 0, 0.3, 5, 4, 3)}


def materials():
    """Return coarse, smoothly shaded balls of every material under a lamp that is large enough for `path`."""
    kinds = {
        "glass": {"type": "dielectric"},
        "frosted": {"type": "roughdielectric", "alpha": 0.3},
        "coated": {"type": "roughplastic", "diffuse_reflectance": rgb(0.2, 0.5, 0.7), "alpha": 0.2},
        "plastic": {"type": "plastic", "diffuse_reflectance": rgb(0.7, 0.5, 0.2)},
        "brushed": {"type": "twosided", "one": {"type": "roughconductor", "material": "Cu", "alpha": 0.2}},
        "mirror": {"type": "conductor"},
        "mask": {"type": "mask", "opacity": 0.6, "one": diffuse(0.6, 0.3, 0.3)},
        "thin": {"type": "thindielectric"},
    }
    parts = {"walls": mesh(box(2, 2, 2), diffuse(0.7, 0.6, 0.5)), "lamp": lamp(0, 0.98, 0, 0.6, 3, 2.5, 2)}
    for k, (name, bsdf) in enumerate(kinds.items()):
        ball = trimesh.creation.icosphere(subdivisions=1, radius=0.28)
        ball.apply_translation([0.62 * (k % 3 - 1), 0.6 * (k // 3 - 1), -0.5 + 0.2 * (k % 2)])
        parts[name] = mesh(ball, bsdf, smooth=name != "thin")
    return parts


def chamber():
    """Return a room that is lit only through a doorway, by a lamp in the next room."""
    white = diffuse(0.7, 0.7, 0.7)
    return {"walls": mesh(box(4, 2, 2), white), "lamp": lamp(-1.4, 0.9, 0.2, 0.3, 30, 27, 25),
            "wall": mesh(box(0.05, 2, 1.4, at=(-0.9, 0, -0.3)), white),
            "above": mesh(box(0.05, 0.4, 0.6, at=(-0.9, 0.8, 0.7)), white)}  # fmt: skip


def lantern():
    """Return a lamp in a coarse globe of frosted glass, where shading normals break the symmetry."""
    globe = trimesh.creation.icosphere(subdivisions=1, radius=0.5)
    globe.apply_translation([-0.2, 0.1, -0.4])
    frosted = mesh(globe, {"type": "roughdielectric", "alpha": 0.5}, smooth=True)
    walls = mesh(box(2, 2, 2), diffuse(0.6, 0.5, 0.4))
    return {"walls": walls, "globe": frosted, "lamp": lamp(-0.2, 0.2, -0.4, 0.2, 9, 8, 7)}


def sky():
    """Return the balls between a wall and a floor under an environment map."""
    spots = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32) ** 4 * 4
    parts = materials()
    parts["walls"] = mesh(box(0.2, 2, 2, at=(-1.1, 0, 0)), diffuse(0.7, 0.6, 0.5))
    parts["floor"] = mesh(box(3, 0.2, 3, at=(0, -1.1, 0)), diffuse(0.5, 0.5, 0.5))
    return {**parts, "sky": {"type": "envmap", "bitmap": mi.Bitmap(spots)}}


def points():
    """Return a room with emitters that no path can hit."""
    aim = mi.ScalarTransform4f().look_at(origin=[-0.6, 0.8, 0.6], target=[0, -1, 0], up=[0, 0, 1])
    parts = room() | {"walls": mesh(box(2, 0.2, 2, at=(0, -1.1, 0)), diffuse(0.7, 0.6, 0.5))}
    return parts | {
        "point": {"type": "point", "position": [0.5, 0.5, 0.5], "intensity": rgb(1, 0.2, 0.2)},
        "spot": {"type": "spot", "to_world": aim, "intensity": rgb(0.2, 2, 0.2)},
        "sun": {"type": "directional", "direction": [0.3, -1, -0.2], "irradiance": rgb(0.2, 0.2, 1)},
    }


def furnace():
    """Return a closed box that emits 1 and reflects half everywhere."""
    walls = box(2, 2, 2)
    walls.invert()
    return {"walls": mesh(walls, {"type": "diffuse", "reflectance": rgb(0.5, 0.5, 0.5)}, area(1, 1, 1))}


def renderer_of(parts, integrator):
    _ALIVE.append(mi.load_dict({"type": "scene", **parts}))
    description = SimpleNamespace(units_per_metre=1.0, room=None, integrator=integrator)
    return Renderer(SimpleNamespace(mi_scene=_ALIVE[-1], description=description), integrator)


VIEW = Camera.look_at(np.array([0.3, 0.1, 0.9]), np.array([-0.2, -0.3, -1]), np.array([0, 1, 0]), 80, SIZE, SIZE)


def images(renderer, first_seed, camera=VIEW):
    """Return the mean radiance of blocks of pixels, (SEEDS, values)."""
    seeds = range(first_seed, first_seed + SEEDS)
    stack = np.stack([renderer.radiance(camera, SPP, seed) for seed in seeds]).astype(float)
    return stack.reshape(SEEDS, 3, SIZE // BLOCK, BLOCK, SIZE // BLOCK, BLOCK).mean((3, 5)).reshape(SEEDS, -1)


def agreement(ours, theirs):
    """Return the Bonferroni-corrected p-value of Welch's test on the worst block or the mean."""
    ours, theirs = (np.concatenate([a, a.mean(1, keepdims=True)], 1) for a in (ours, theirs))
    black = (ours == 0).all(0) & (theirs == 0).all(0)
    return stats.ttest_ind(ours[:, ~black], theirs[:, ~black], equal_var=False).pvalue.min() * (~black).sum()


@pytest.mark.parametrize("parts", [room, materials, lantern, chamber, sky, points])
def test_agrees_with_path(parts):
    theirs = images(renderer_of(parts(), "path"), 0)
    ours = images(renderer_of(parts(), "bdpt"), 1000)
    assert agreement(ours, theirs) > ALPHA
    assert agreement(1.15 * ours, theirs) < ALPHA, "the test cannot tell 15 % more light"
    assert parts is not chamber or ours.var(0).mean() < theirs.var(0).mean() / 2, "what it is for"


def test_agrees_without_connections_to_the_camera(monkeypatch):
    """`bdpt` agrees with `path` also as a plain integrator without splats, and with shorter light subpaths."""
    monkeypatch.setattr(renderer_module, "_bidirectional", lambda image, **more: renderer_module._radiance(**more))
    ours = renderer_of(materials(), "bdpt")
    ours.integrator = mi.load_dict({"type": "bdpt", "light_vertices": 3})
    assert agreement(images(ours, 0), images(renderer_of(materials(), "path"), 1000)) > ALPHA


def test_furnace(monkeypatch):
    """Radiance is 1 / (1 - 1/2) everywhere only if the weights add up to one for paths of every length."""
    from nlt.rendering import bdpt

    def p(renderer):
        values = images(renderer, 0)
        return stats.ttest_1samp(values, 2).pvalue.min() * values.shape[1]

    assert p(renderer_of(furnace(), "bdpt")) > ALPHA
    wrong = lambda vertex, density, back, ratio: density * vertex.inverse * (vertex.smooth + 0.8 * back * ratio)
    monkeypatch.setattr(bdpt, "_others", wrong)
    assert p(renderer_of(furnace(), "bdpt")) < 1e-6, "the test cannot tell wrong weights"


def test_states_and_pixels(renderer, demo):
    """One frozen kernel renders moved instances in several states, and then only some of the pixels."""
    ours = Renderer(renderer.scene, "bdpt")
    camera = sample_view(demo, SIZE, np.random.default_rng(1))
    renderer.scene.set_state(rest_state(demo, "moving_lights"))
    before = images(ours, 0, camera)
    renderer.scene.set_state(away("moving_lights", demo))
    after, theirs = images(ours, 0, camera), images(renderer, 100, camera)
    assert agreement(after, theirs) > ALPHA and agreement(before, theirs) < ALPHA
    pixels = np.random.default_rng(0).permutation(SIZE**2)[:30]
    some, wanted = (
        np.stack([r.radiance(camera, 2 * SPP, seed, pixels).astype(float) for seed in range(first, first + SEEDS)])
        for r, first in ((ours, 0), (renderer, 100))
    )
    flat = lambda values: values.reshape(SEEDS, -1)
    assert agreement(flat(some), flat(wanted)) > ALPHA
    assert agreement(flat(some), flat(wanted[:, :, ::-1])) < ALPHA, "the test cannot tell the pixels apart"
    assert ours.radiance(camera, 2 * SPP, 0, pixels).tobytes() == some[0].astype(np.float32).tobytes()


def test_choosing(tmp_path, monkeypatch, caplog):
    """The dataset overrules the scene; where only `path` can run, only the scene's choice gives way."""
    scene = str(write_yaml(tmp_path / "scene.yaml", integrator="bdpt"))
    chosen = lambda **more: SampleRenderer(DatasetSpec([scene], "fixed_lights", **more), 0).renderer.integrator_name
    assert (chosen(), chosen(integrator="path"), chosen(integrator="bdpt")) == ("bdpt", "path", "bdpt")
    with pytest.raises(UserError, match=r"data\.dataset\.integrator: must be one of scene, path, bdpt, is 'photons'"):
        DatasetSpec([scene], integrator="photons")
    described = Scene(load_description(scene), "fixed_lights")
    monkeypatch.setattr(renderer_module, "is_jit", lambda: False)
    assert Renderer(described).integrator_name == "path" and "bdpt needs" in caplog.text
    with pytest.raises(UserError, match="integrator: bdpt needs Mitsuba's llvm or cuda"):
        Renderer(described, "bdpt")
