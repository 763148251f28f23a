"""Rendering agrees with plain Mitsuba scenes, float64 geometry and analytic light, by statistical tests."""

import os
import re
import subprocess
import sys

import mitsuba as mi
import numpy as np
import pytest
import torch
import trimesh
from conftest import LIGHT, PLACES, demo_meshes, first_hit, plain_scene, write_room, write_yaml
from scipy import ndimage, stats

from nlt.baselines.cnn import CNN
from nlt.data.sample import DIRECT
from nlt.errors import UserError
from nlt.rendering import photons as photons_module
from nlt.rendering import renderer as renderer_module
from nlt.rendering import variant as variant_module
from nlt.rendering.renderer import Renderer
from nlt.scenes import builtin
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import MOVING_LIGHT, load_description
from nlt.scenes.lanes import is_jit
from nlt.scenes.state import SceneState, rest_state, sample_state, sample_view

pytestmark = pytest.mark.slow

# What mi.render's moments are in.
XYZ = np.array([[0.412453, 0.357580, 0.180423], [0.212671, 0.715160, 0.072169], [0.019334, 0.119193, 0.950227]])
GLASS = ("dielectric", "thindielectric", "roughdielectric")
ALPHA = 1e-4  # of each test, after Bonferroni's correction


def moments(plain, camera, spp, seed):
    """Return the mean and the variance of a path in XYZ, (3, H, W), by Mitsuba alone in a plain scene."""
    to_world = np.linalg.inv(camera.world_to_view.astype(float)) @ np.diag([-1.0, -1, 1, 1])
    film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}}
    to_world = mi.ScalarTransform4f(to_world)
    sensor = mi.load_dict({
        "type": "perspective", "fov": camera.fov, "near_clip": 1e-3, "to_world": to_world, "film": film,
    })  # fmt: skip
    integrator = mi.load_dict({"type": "moment", "path": {"type": "path", "max_depth": -1}})
    image = np.moveaxis(np.array(mi.render(plain, sensor=sensor, integrator=integrator, spp=spp, seed=seed)), 2, 0)
    mean, square = image[3:6].astype(float), image[6:9].astype(float)
    return mean, np.maximum(square - mean**2, 0) * spp / (spp - 1)


def samples_of(renderer, camera, spp, seeds, pixels=None):
    """Return our renderer's images in XYZ, (seeds, 3, H, W) or (seeds, 3, n)."""
    images = np.stack([renderer.radiance(camera, spp, seed, pixels) for seed in seeds]).astype(float)
    return np.einsum("xc,nc...->nx...", XYZ, images)


def p_value(samples, mean, variance):
    """Return the p-value of the samples' mean being `mean` (known with `variance`), in the worst entry and the sum."""
    count = len(samples)
    ours, theirs = samples.var(0, ddof=1) / count, variance
    error = samples.mean(0) - mean
    spread = np.sqrt(ours + theirs + 1e-10 * mean**2)  # a pixel full of light has no noise, only rounding
    each = 2 * stats.t.sf(np.abs(error) / spread, count - 1)
    total = samples.reshape(count, -1).sum(1)
    z = (total.mean() - mean.sum()) / np.sqrt(total.var(ddof=1) / count + theirs.sum())
    return min(1.0, each.min() * (each.size + 1), 2 * stats.t.sf(abs(z), count - 1) * (each.size + 1))


def away(experiment, demo):
    """Return a state with the objects at the ends of their boxes and without sofa, lamp and picture."""
    movables = demo.movables(experiment)
    present = np.array([m.name not in ("sofa", "lamp", "picture") for m in movables])
    translation = np.stack([m.box[k % 2] for k, m in enumerate(movables)]) * present[:, None]
    return SceneState(translation.astype(np.float32), present)


# ---- radiance -------------------------------------------------------------------------------------------


def check_states(renderer, demo, experiment):
    """Each of several states, resolutions and spp in turn agrees with a scene that is built for it alone."""
    rng = np.random.default_rng(0)
    other = sample_state(demo, experiment, np.random.default_rng(11))
    cases = [(rest_state(demo, experiment), 12, 4), (away(experiment, demo), 16, 2), (other, 16, 3)]
    previous = None
    for k, (state, resolution, spp) in enumerate(cases):
        camera = sample_view(demo, resolution, rng)
        renderer.scene.set_state(state)
        ours = samples_of(renderer, camera, spp, range(100 * k, 100 * k + 80))
        mean, variance = moments(plain_scene(demo, experiment, state), camera, 512, k)
        assert p_value(ours, mean, variance / 512) > ALPHA, f"state {k}"
        if k == 1:
            mean, variance = moments(plain_scene(demo, experiment, previous), camera, 512, k)
            assert p_value(ours, mean, variance / 512) < 1e-6, f"the test cannot tell state {k} from the last one"
        previous = state


def test_states_with_the_moving_light(renderer, demo):
    check_states(renderer, demo, "moving_lights")


def test_states_with_own_lights(demo):
    check_states(Renderer(Scene(demo, "fixed_lights")), demo, "fixed_lights")


def test_two_scenes_at_once(renderer, demo):
    """Moving one scene's objects does not change another scene, and each keeps its own kernels."""
    second = Renderer(Scene(demo, "moving_lights"))
    camera = sample_view(demo, 12, np.random.default_rng(2))
    states = [rest_state(demo, "moving_lights"), away("moving_lights", demo)]
    references = [moments(plain_scene(demo, "moving_lights", s), camera, 512, 5) for s in states]
    for r, state in zip((renderer, second), states, strict=True):
        r.scene.set_state(state)
    for k, r in enumerate((renderer, second, renderer)):
        mean, variance = references[k % 2]
        assert p_value(samples_of(r, camera, 4, range(50)), mean, variance / 512) > ALPHA


def test_loaded_emitter_that_moves(tmp_path):
    """When the light of an XML scene is moved or removed, its photons and their power follow."""
    box = [[-0.5, -0.5, 0], [0.5, 0, 0]]
    file = write_room(tmp_path, objects={"lamp": {"shapes": ["lamp"], "box": box}})
    scene = Scene(load_description(str(file)), "fixed_lights")
    renderer = Renderer(scene)
    scene.set_state(SceneState(np.array([[0.4, -0.3, 0]], np.float32), np.array([True])))
    photons = renderer.photons(500, 0)
    half = LIGHT["size"][0] / 2
    assert np.allclose(photons["photon_origin"][:, 1], LIGHT["height"] - 0.3, atol=1e-3)
    assert stats.kstest(photons["photon_origin"][:, 0], stats.uniform(0.4 - half, 2 * half).cdf).pvalue > 1e-3
    power = np.pi * np.prod(LIGHT["size"]) * np.array(LIGHT["radiance"])
    assert np.allclose(photons["photon_flux"].sum(0, dtype=float), power, rtol=1e-4)
    scene.set_state(SceneState(np.zeros((1, 3), np.float32), np.array([False])))
    assert renderer.photons(500, 0)["photon_flux"].sum() < 1e-9 * power.sum()


@pytest.mark.parametrize("movable", ["window", "bulb"])
def test_emitter_that_moves(tmp_path, movable):
    """Photons follow an emitting object that is moved, removed and put back."""
    shapes = {"window": ["window_panel"], "bulb": ["ceiling_lamp_panel", "ceiling_lamp_frame"]}[movable]
    objects = {movable: {"shapes": shapes, "box": [[-0.3, -0.3, 0], [0.3, 0, 0.3]]}}
    description = load_description(str(write_yaml(tmp_path / "scene.yaml", objects=objects)))
    renderer = Renderer(Scene(description, "fixed_lights"))
    camera = sample_view(description, 12, np.random.default_rng(3))
    areas = {"window_panel": (1.5 * 1.2, (3.8, 4.5, 5.5)), "ceiling_lamp_panel": (1.0, (5.8, 5.0, 4.1))}
    references = []
    # Removed first: what is learnt of the emitters' power then must not be kept. Often, for moved meshes whose
    # memory Dr.Jit does not own were read after it was freed, every now and then.
    for k, (offset, present) in enumerate([((0, 0, 0), False), ((-0.2, -0.3, 0.2), True)] * 3):
        state = SceneState(np.array([offset], np.float32), np.array([present]))
        renderer.scene.set_state(state)
        if k < 2:
            mean, variance = moments(plain_scene(description, "fixed_lights", state), camera, 512, k)
            references.append((mean, variance / 512))
        assert p_value(samples_of(renderer, camera, 4, range(40)), *references[k % 2]) > ALPHA
        photons = renderer.photons(1000, k)
        lit = [v for name, v in areas.items() if present or name not in shapes]
        power = sum(np.pi * area * np.array(radiance) for area, radiance in lit)
        assert np.allclose(photons["photon_flux"].sum(0, dtype=float), power, rtol=2e-2)
        if present:
            flux = photons["photon_flux"].mean(1)
            assert flux.max() < 1.5 * flux.min(), "photons carry about equal power"


def test_textured_light(tmp_path):
    """A light with a texture of one colour gives the images and photons of the plain light."""
    plain = write_room(tmp_path / "plain")
    file = write_room(tmp_path / "textured")
    colour = np.broadcast_to(np.float32(LIGHT["radiance"]), (4, 4, 3))
    mi.Bitmap(np.ascontiguousarray(colour)).write(str(file.with_name("light.exr")))
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * LIGHT["size"] / 2
    lines = [f"v {x} {LIGHT['height']} {z}" for x, z in corners] + ["vt 0 0", "vt 1 0", "vt 1 1", "vt 0 1"]
    file.with_name("lamp.obj").write_text("\n".join([*lines, "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]))
    xml = file.with_name("scene.xml")
    text = xml.read_text().replace('type="ply" id="lamp"', 'type="obj" id="lamp"').replace("lamp.ply", "lamp.obj")
    text = re.sub('<rgb name="radiance" value="[^"]*"/>', '<texture type="bitmap" name="radiance">'
                  '<string name="filename" value="light.exr"/></texture>', text)  # fmt: skip
    xml.write_text(text)

    def rendered(file):
        description = load_description(str(file))
        renderer = Renderer(Scene(description, "fixed_lights"))
        camera = sample_view(description, 8, np.random.default_rng(1))
        return samples_of(renderer, camera, 64, range(8)), renderer.photons(2000, 0)["photon_flux"].sum(0)

    (samples, flux), (expected, same) = map(rendered, (plain, file))
    assert p_value(samples, expected.mean(0), expected.var(0, ddof=1) / len(expected)) > ALPHA
    np.testing.assert_allclose(flux, same, rtol=1e-3)


def test_sparse_pixels(renderer, demo, monkeypatch):
    """Requested pixels come in the requested order and have the full image's expectation."""
    state = away("moving_lights", demo)
    renderer.scene.set_state(state)
    camera = sample_view(demo, 16, np.random.default_rng(4))
    pixels = np.random.default_rng(0).permutation(256)[:40]
    mean, variance = moments(plain_scene(demo, "moving_lights", state), camera, 1024, 1)
    mean, variance = (a.reshape(3, -1)[:, pixels] for a in (mean, variance / 1024))
    ours = samples_of(renderer, camera, 4, range(64), pixels)
    assert ours.shape[1:] == (3, 40)
    assert p_value(ours, mean, variance) > ALPHA
    assert p_value(ours[:, :, ::-1], mean, variance) < 1e-6, "the test cannot tell the pixels apart"

    traced = []
    launch = renderer_module.launch

    def spy(kernel, lanes, **fixed):
        traced.append(next(iter(lanes.values()))[1])
        return launch(kernel, lanes, **fixed)

    monkeypatch.setattr(renderer_module, "launch", spy)
    renderer.radiance(camera, 2, 0, pixels)
    corners = np.concatenate(traced)
    wanted = np.repeat(np.stack([pixels % 16, pixels // 16], 1), 2, axis=0)
    assert np.array_equal(corners, wanted), "two rays for every pixel asked for, and none else"
    # In batches, when there are too many to hold at once.
    monkeypatch.setattr(renderer_module, "_MAX_LANES", 100)
    traced.clear()
    batched = samples_of(renderer, camera, 5, range(50), pixels)
    assert max(map(len, traced)) <= 100 and sum(map(len, traced)) == 50 * 5 * 40
    assert p_value(batched, mean, variance) > ALPHA


def test_window_of_an_image(renderer, demo):
    """Radiance, G-buffer and direct light of a window are those of its pixels in the whole image."""
    state = away("moving_lights", demo)
    renderer.scene.set_state(state)
    camera = sample_view(demo, 24, np.random.default_rng(4))
    window = camera.window(11, 3, 8)
    inside = (slice(None), slice(3, 11), slice(11, 19))
    mean, variance = moments(plain_scene(demo, "moving_lights", state), camera, 1024, 1)
    ours = samples_of(renderer, window, 16, range(64))
    assert p_value(ours, mean[inside], variance[inside] / 1024) > ALPHA
    beside = (slice(None), slice(3, 11), slice(9, 17))
    assert p_value(ours, mean[beside], variance[beside] / 1024) < 1e-6, "the test cannot tell windows apart"
    whole, part = renderer.gbuffer(camera, direct=True), renderer.gbuffer(window, direct=True)
    for name, values in part.items():
        border = int(name == "albedo")  # a window does not know whether the albedo differs beyond its border
        seen = np.s_[:, border : 8 - border, border : 8 - border]
        bound = 1e-3 if name in DIRECT else 1e-4  # shadow rays may just miss or hit
        np.testing.assert_allclose(values[seen], whole[name][inside][seen], rtol=bound, atol=bound, err_msg=name)
    np.testing.assert_allclose(window.view_directions(), camera.view_directions()[inside], atol=1e-6)


def test_one_spp_is_unbiased(renderer, demo):
    """The mean of many images of 1 spp is the image of many spp, because nothing is clamped."""
    state = rest_state(demo, "moving_lights")
    renderer.scene.set_state(state)
    camera = sample_view(demo, 12, np.random.default_rng(5))
    spp = 4096
    mean, variance = moments(plain_scene(demo, "moving_lights", state), camera, spp, 3)
    ours = samples_of(renderer, camera, 1, range(500))
    assert p_value(ours, mean, variance / spp) > ALPHA
    assert p_value(np.minimum(ours, 2 * mean), mean, variance / spp) < 1e-6, "the test cannot tell clamped images"


def test_seeds(renderer, demo):
    renderer.scene.set_state(rest_state(demo, "moving_lights"))
    camera = sample_view(demo, 12, np.random.default_rng(6))
    pixels = np.arange(5, 60, 3)
    for draw in (
        lambda seed: renderer.radiance(camera, 2, seed),
        lambda seed: renderer.radiance(camera, 2, seed, pixels),
        lambda seed: np.concatenate([a.astype(float).ravel() for a in renderer.photons(64, seed).values()]),
    ):
        first, other, again = draw(1), draw(2), draw(1)
        assert first.tobytes() == again.tobytes() and (first != other).mean() > 0.5


def test_seeds_are_independent(renderer, demo):
    """The residuals of neighbouring seeds, pixels and samples are uncorrelated."""
    renderer.scene.set_state(rest_state(demo, "moving_lights"))
    camera = sample_view(demo, 12, np.random.default_rng(6))
    images = samples_of(renderer, camera, 1, range(400)).reshape(400, 3, -1)[:, 1]
    ranks = stats.rankdata(images, axis=0) - 200.5  # fireflies would rule a plain correlation
    ranks = ranks[:, ranks.std(0) > 0]
    scale = ranks.std() ** 2
    between_seeds = (ranks[1:] * ranks[:-1]).mean() / scale
    between_pixels = (ranks[:, 1:] * ranks[:, :-1]).mean() / scale
    assert max(abs(between_seeds), abs(between_pixels)) < 5 / np.sqrt(ranks.size)


# ---- G-buffer -------------------------------------------------------------------------------------------


def constant_albedo(shape) -> list[float]:
    """Return the albedo of a shape of the built-in rooms; NaN if it has a texture."""
    if shape.bsdf["type"] in ("dielectric", "conductor", "roughconductor"):
        return [0, 0, 0]
    colour = shape.bsdf.get("bsdf", {}).get("reflectance", {})
    return colour["value"] if colour.get("type") == "rgb" else [np.nan] * 3


@pytest.mark.parametrize("experiment", ["fixed_lights", "moving_lights"])
def test_gbuffer(experiment, demo):
    """Depth, normals and constant albedos agree with float64 ray-triangle intersections in two states."""
    renderer = Renderer(Scene(demo, experiment))
    for k, state in enumerate((rest_state(demo, experiment), away(experiment, demo))):
        renderer.scene.set_state(state)
        camera = sample_view(demo, (12, 16)[k], np.random.default_rng(40 + k))
        meshes = demo_meshes(demo, experiment, state)
        triangles = np.concatenate([v[shape.mesh.faces] for shape, v in meshes.values()])
        owner = np.concatenate([[i] * len(shape.mesh.faces) for i, (shape, _) in enumerate(meshes.values())])
        first = np.searchsorted(owner, np.arange(len(meshes)))
        pixels = camera.centres()
        # Pixel (i, j) by hand: K and T, not camera.directions.
        view = np.linalg.solve(camera.matrix.astype(float), np.append(pixels, np.ones((len(pixels), 1)), 1).T).T
        rotation = camera.world_to_view[:3, :3].astype(float)
        z, hit, weights = first_hit(triangles, np.tile(camera.position, (len(pixels), 1)), view @ rotation)
        buffer = {name: a.reshape(len(a), -1).T for name, a in renderer.gbuffer(camera).items()}
        transmits = renderer.transmits(camera).ravel()
        light = (buffer["depth"][:, 0] < z - 1e-3) & (np.abs(buffer["albedo"]) < 1e-6).all(1)
        if experiment == "moving_lights":  # whose rectangle is no mesh
            z[light] = buffer["depth"][light, 0]
        same = np.abs(buffer["depth"][:, 0] - z) < 1e-4
        assert same.mean() > 0.98, "depth along the camera's axis"  # the rest grazes an edge
        assert np.abs(np.linalg.norm(buffer["normal"], axis=1) - 1).max() < 1e-5

        checked = 0
        for i, (name, (shape, vertices)) in enumerate(meshes.items()):
            mine = same & ~light & (owner[hit] == i)
            if not mine.any():
                continue
            face = shape.mesh.faces[hit[mine] - first[i]]
            if shape.smooth:
                normal = np.einsum("nk,nkd->nd", weights[mine], shape.mesh.vertex_normals[face])
            else:
                a, b, c = (vertices[face[:, j]] for j in range(3))
                normal = np.cross(b - a, c - a)
            normal /= np.linalg.norm(normal, axis=1, keepdims=True)
            assert np.abs(buffer["normal"][mine] - normal).max() < 2e-3, name
            assert (transmits[mine] == (shape.bsdf["type"] in GLASS)).all(), name
            checked += 1
        assert checked > 2
        # The albedo is the mean of eight rays, or the centre's where it is that of its neighbours.
        constant = np.array([constant_albedo(shape) for shape, _ in meshes.values()])
        albedos = []
        for place in [(0.5, 0.5), *PLACES]:
            places = np.append(pixels + np.array(place) - 0.5, np.ones((len(pixels), 1)), 1)
            rays = np.linalg.solve(camera.matrix.astype(float), places.T).T @ rotation
            _, seen, _ = first_hit(triangles, np.tile(camera.position, (len(pixels), 1)), rays)
            albedos.append(constant[owner[seen]])
        centre, *albedos = albedos
        near_light = ndimage.binary_dilation(light.reshape(camera.height, -1), np.ones((3, 3))).ravel()
        known = np.isfinite(albedos).all((0, 2)) & ~near_light
        at_edge = known & (np.ptp(albedos, axis=0) > 0.1).any(1)
        image = np.pad(centre.reshape(camera.height, -1, 3), ((1, 1), (1, 1), (0, 0)), constant_values=np.nan)
        around = [
            image[1 + y :, 1 + x :][: camera.height, : camera.width] for x, y in ((-1, 0), (1, 0), (0, -1), (0, 1))
        ]
        is_same = (np.abs(np.array(around).reshape(4, *centre.shape) - centre) <= 0.02).all((0, 2))[:, None]
        agrees = np.abs(buffer["albedo"] - np.where(is_same, centre, np.mean(albedos, 0))).max(1) < 1e-3
        assert agrees[known].mean() > 0.97 and known.sum() > 50
        assert agrees[at_edge].mean() > 0.8 and at_edge.sum() > 2, "edges are mixtures"
        assert buffer["albedo"].min() >= 0 and buffer["albedo"].max() <= 1
        # Depth is not distance: seen obliquely, the two differ.
        assert (np.linalg.norm(view, axis=1) * z - z).max() > 0.1


def test_glass_transmits():
    """A pixel transmits exactly where its ray first hits the glass egg, by float64 intersections."""
    renderer, shapes = Renderer(Scene(load_description("egg"), "static")), builtin.egg().values()
    (glass,) = (shape.mesh.vertices for shape in shapes if shape.bsdf["type"] in GLASS)
    camera = Camera.look_at(glass.max(0) + np.array([0.5, 0.1, 0.5]), glass.mean(0), np.array([0, 1.0, 0]), 30, 16, 12)
    triangles = np.concatenate([shape.mesh.vertices[shape.mesh.faces] for shape in shapes])
    of_glass = np.concatenate([[shape.bsdf["type"] in GLASS] * len(shape.mesh.faces) for shape in shapes])
    _, hit, _ = first_hit(triangles, np.tile(camera.position, (192, 1)), camera.directions(camera.centres()))
    transmits = renderer.transmits(camera).ravel()
    assert 0.1 < of_glass[hit].mean() < 0.9
    assert (transmits != of_glass[hit]).sum() <= 2  # rays that graze the egg


def test_misses(tmp_path):
    """Pixels that look past a floor and a crate are zero, and the crate's depth is known."""
    description = load_description(str(write_room(tmp_path, is_open=True)))
    scene = Scene(description, "fixed_lights")
    renderer = Renderer(scene)
    scene.set_state(rest_state(description, "fixed_lights"))
    position = np.array([0.5, 1.0, -0.6])
    camera = Camera.look_at(position, position + np.array([-0.6, -0.4, 0.6]), description.up, 70.0, 16, 16)
    buffer = renderer.gbuffer(camera)
    direction = camera.view_directions().astype(float)
    t = -camera.position[1] / np.where(direction[1] < 0, direction[1], np.nan)
    floor = camera.position[:, None, None] + t * direction
    sky = ~((np.abs(floor[0]) < 1) & (np.abs(floor[2]) < 1))
    on_floor = ~sky & (buffer["normal"][1] > 0.99) & (buffer["depth"][0] > 0)
    z = (camera.rotation[:, 2] @ (floor - camera.position[:, None, None]).reshape(3, -1)).reshape(sky.shape)
    assert on_floor.sum() > 20
    crate = on_floor & (np.abs(buffer["depth"][0] - z) > 1e-3)
    assert (buffer["depth"][0][crate] < z[crate]).all() and crate.sum() < on_floor.sum() / 2
    miss = buffer["depth"][0] == 0
    assert miss.sum() > 20 and (miss <= sky).all(), "what misses looks past the floor"
    assert all((buffer[name][:, miss] == 0).all() for name in ("depth", "normal", "emission"))
    among_misses = ndimage.binary_erosion(miss, np.ones((3, 3)))  # beside them, a pixel covers a part of the floor
    assert (buffer["albedo"][:, among_misses] == 0).all() and among_misses.sum() > 5


# ---- photons --------------------------------------------------------------------------------------------


def floor_irradiance(patch, size, centre, radiance, height):
    """Return the mean irradiance of a floor patch (2, 2) from a rectangle that faces down, by quadrature."""
    mid = lambda low, high, n: low + (np.arange(n) + 0.5) * (high - low) / n
    axes = lambda low, high: [mid(low[k], high[k], 30) for k in (0, 1)]
    grid = lambda low, high: np.stack(np.meshgrid(*axes(low, high)), -1).reshape(-1, 2)
    at, light = grid(*patch), grid(np.array(centre) - np.array(size) / 2, np.array(centre) + np.array(size) / 2)
    square = ((at[:, None] - light[None]) ** 2).sum(-1) + height**2
    return (height**2 / square**2).mean() * size[0] * size[1] * np.array(radiance)


@pytest.fixture(scope="module")
def open_room(tmp_path_factory):
    """Return a renderer of a lamp above a bare floor, and the power that arrives there by quadrature."""
    description = load_description(str(write_room(tmp_path_factory.mktemp("open"), is_open=True)))
    scene = Scene(description, "fixed_lights")
    scene.set_state(SceneState(np.zeros((1, 3), np.float32), np.array([False])))  # without the crate
    floor = np.array([[-1, -1], [1, 1]])
    return Renderer(scene), 4 * floor_irradiance(floor, LIGHT["size"], (0, 0), LIGHT["radiance"], LIGHT["height"])


def test_photons_in_an_open_room(open_room):
    """Photons that miss are dropped; hits and irradiance on the floor agree with closed forms and quadrature."""
    renderer, power = open_room
    count = 20_000
    photons = renderer.photons(count, 1)
    origin, direction, hit = (photons[f"photon_{n}"].astype(float) for n in ("origin", "direction", "hit"))
    assert photons["photon_valid"].all()
    assert np.allclose(photons["photon_flux"].sum(0, dtype=float), power, rtol=0.03)
    assert np.ptp(photons["photon_flux"], axis=0).max() < 1e-6 * photons["photon_flux"].max()
    assert np.abs(np.linalg.norm(direction, axis=1) - 1).max() < 1e-5
    expected = origin + direction * (-origin[:, 1] / direction[:, 1])[:, None]
    assert (np.abs(expected[:, [0, 2]]) < 1 + 1e-5).all() and np.abs(hit - expected).max() < 1e-3

    patch = np.array([[-0.3, 0.1], [0.5, 0.8]])
    inside = (hit[:, [0, 2]] > patch[0]).all(1) & (hit[:, [0, 2]] < patch[1]).all(1)
    irradiance = floor_irradiance(patch, LIGHT["size"], (0, 0), LIGHT["radiance"], LIGHT["height"])
    share = irradiance * np.prod(patch[1] - patch[0]) / power  # of the photons that fall into the patch
    assert np.ptp(share) < 1e-9
    assert stats.binomtest(int(inside.sum()), count, share[0]).pvalue > 1e-3


def test_photon_flux_is_unbiased(open_room, monkeypatch):
    """The flux is unbiased for few photons and at the limit of casts, and naive counting is biased."""
    renderer, power = open_room
    share = power[0] / (np.pi * np.prod(LIGHT["size"]) * LIGHT["radiance"][0])
    assert 0.1 < share < 0.4
    for most in (1024, 3):
        monkeypatch.setattr(photons_module, "_MOST_CASTS", most)
        draws = [renderer.photons(4, seed) for seed in range(400)]
        sums = np.array([draw["photon_flux"][:, 0].sum(dtype=float) for draw in draws])
        assert stats.ttest_1samp(sums, power[0]).pvalue > 1e-3
        complete = np.array([draw["photon_valid"].all() for draw in draws])
        assert complete.all() if most > 3 else 0.1 < complete.mean() < 0.9
        assert all((draw[name][~draw["photon_valid"]] == 0).all() for draw in draws for name in draw)
        if most > 3:
            naive = sums * 4 / 3  # n / N, but for N - 1 in the place of N
            assert stats.ttest_1samp(naive, power[0]).pvalue < 1e-6, "the test cannot tell biased ones"


def test_photons_of_the_sky(tmp_path):
    """Photons of a constant sky arrive through the opening of a room without a ceiling, and none hits its outside."""
    sky, opening = np.array([3.0, 2.0, 1.0]), 4.0
    file = write_room(tmp_path, room=[[-1, 0, -1], [1, 2, 1]])
    walls = trimesh.load(tmp_path / "room.ply", process=False)
    walls.update_faces(walls.triangles_center[:, 1] < 2 - 1e-6)
    walls.export(tmp_path / "room.ply")
    emitter = '<emitter type="constant"><rgb name="radiance" value="3, 2, 1"/></emitter>'
    source = tmp_path / "scene.xml"
    source.write_text(source.read_text().replace("</scene>", f"{emitter}</scene>"))
    photons = Renderer(Scene(load_description(str(file)), "fixed_lights")).photons(20_000, 0)
    lamp = np.pi * np.prod(LIGHT["size"]) * np.array(LIGHT["radiance"])  # all of which arrives
    arriving = np.pi * sky * opening + lamp
    assert photons["photon_valid"].all()
    assert np.allclose(photons["photon_flux"].sum(0, dtype=float), arriving, rtol=0.03)
    from_lamp = np.abs(photons["photon_origin"]).max(1) < 2
    assert from_lamp.mean() == pytest.approx(lamp.mean() / arriving.mean(), rel=0.05), "by the power that arrives"
    origin, direction, hit = (photons[f"photon_{n}"][~from_lamp].astype(float) for n in ("origin", "direction", "hit"))
    entry = origin + direction * ((2 - origin[:, 1]) / direction[:, 1])[:, None]
    assert (np.abs(entry[:, [0, 2]]) < 1 + 1e-4).all() and (direction[:, 1] < 0).all()
    assert stats.kstest(direction[:, 1] ** 2, stats.uniform.cdf).pvalue > 1e-3, "Lambert's law at the opening"
    assert (np.abs(hit[:, [0, 2]]) < 1 + 1e-4).all() and (hit[:, 1] > -1e-4).all()


def test_no_photon_arrives(tmp_path):
    """Casting ends with invalid photons if the lamp's light never crosses the room."""
    file = write_room(tmp_path, room=[[10, 0, 10], [11, 2, 11]])
    photons = Renderer(Scene(load_description(str(file)), "fixed_lights")).photons(5, 0)
    assert not photons["photon_valid"].any() and all((values == 0).all() for values in photons.values())


def test_photons_of_two_emitters(demo):
    """Photons come from emitters in proportion to power, and hit as float64 ray-triangle intersections do."""
    scene = Scene(demo, "fixed_lights")
    state = sample_state(demo, "fixed_lights", np.random.default_rng(2))
    scene.set_state(state)
    photons = Renderer(scene).photons(3000, 4)
    window = np.pi * 1.5 * 1.2 * np.array([3.8, 4.5, 5.5])
    lamp = np.pi * np.array([5.8, 5.0, 4.1])
    assert np.allclose(photons["photon_flux"].sum(0, dtype=float), window + lamp, rtol=3e-3)
    from_lamp = photons["photon_origin"][:, 1] > 2.5  # under the ceiling, above the window
    share = lamp.mean() / (window + lamp).mean()
    assert abs(from_lamp.sum() - 3000 * share) < 3, "systematic: not even binomial noise"
    colours = photons["photon_flux"] / photons["photon_flux"].sum(1, keepdims=True)
    assert np.allclose(colours[from_lamp], lamp / lamp.sum(), atol=1e-5)
    assert np.allclose(colours[~from_lamp], window / window.sum(), atol=1e-5)

    some = np.random.default_rng(0).permutation(3000)[:150]
    meshes = demo_meshes(demo, "fixed_lights", state)
    triangles = np.concatenate([v[shape.mesh.faces] for shape, v in meshes.values()])
    origin, direction = (photons[f"photon_{n}"][some].astype(float) for n in ("origin", "direction"))
    t, _, _ = first_hit(triangles, origin, direction)
    off = np.linalg.norm(origin + t[:, None] * direction - photons["photon_hit"][some], axis=1)
    assert (off < 1e-3).mean() > 0.98 and photons["photon_valid"].all(), "the room is closed"


def test_photons_of_the_moved_light(renderer, demo):
    state = rest_state(demo, "moving_lights")
    state.translation[-1] = [0.9, 0, -0.7]
    renderer.scene.set_state(state)
    photons = renderer.photons(2000, 0)
    centre, half = demo.light.box.mean(0) + state.translation[-1], demo.light.size / 2
    off = photons["photon_origin"] - centre
    assert stats.kstest(off[:, 0], stats.uniform(-half[0], 2 * half[0]).cdf).pvalue > 1e-3
    assert stats.kstest(off[:, 2], stats.uniform(-half[1], 2 * half[1]).cdf).pvalue > 1e-3
    assert np.abs(off[:, 1]).max() < 1e-3 and (photons["photon_direction"][:, 1] < 0).all()
    # A Lambertian emitter: the squared cosine is uniform.
    assert stats.kstest(photons["photon_direction"][:, 1].astype(float) ** 2, stats.uniform.cdf).pvalue > 1e-3
    power = np.pi * demo.light.size.prod() * demo.light.radiance
    assert np.allclose(photons["photon_flux"].sum(0, dtype=float), power, rtol=1e-4)
    assert demo.movables("moving_lights")[-1].name == MOVING_LIGHT


# ---- the lemma ------------------------------------------------------------------------------------------


def gradients(network, predict, targets):
    """Return the gradients (n, parameters) of the mean squared error of `predict` against each target."""

    def loss(parameters, target):
        return ((predict(parameters) - target) ** 2).mean()

    each = torch.func.vmap(torch.func.grad(loss), (None, 0))(dict(network.named_parameters()), targets)
    return torch.cat([g.flatten(1) for g in each.values()], 1).detach().numpy()


@pytest.mark.parametrize("output", ["radiance", "demodulated"])
def test_lemma(renderer, demo, output):
    """Eq. 3: noisy targets give the gradient of the noise-free image in expectation; clamped ones do not."""
    renderer.scene.set_state(away("moving_lights", demo))
    camera = sample_view(demo, 16, np.random.default_rng(9))
    buffers = {name: torch.from_numpy(image[None].astype(float)) for name, image in renderer.gbuffer(camera).items()}
    inputs = torch.cat([buffers[name] for name in ("depth", "normal", "albedo")], 1)
    torch.manual_seed(0)
    method, channels = CNN(width=1, output=output), 6 if output == "demodulated" else 3
    network = torch.nn.Sequential(torch.nn.Conv2d(7, 4, 1), torch.nn.Tanh(), torch.nn.Conv2d(4, channels, 1)).double()
    batch = {**buffers, "exposure": torch.ones(1, dtype=torch.float64)}
    predict = lambda parameters: method.to_radiance(batch, torch.func.functional_call(network, parameters, inputs))
    images = lambda spp, seeds: torch.from_numpy(
        np.stack([renderer.radiance(camera, spp, seed) for seed in seeds])[:, None].astype(float)
    )
    noisy = images(1, range(500))
    exact = gradients(network, predict, images(64, range(1000, 1040)))

    def worst(targets):
        p = stats.ttest_ind(gradients(network, predict, targets), exact, equal_var=False).pvalue
        return p.min() * len(p)

    assert worst(noisy) > 1e-3
    assert worst(noisy.clamp(0, 1)) < 1e-9


# ---- the variant ----------------------------------------------------------------------------------------


@pytest.fixture
def probing(monkeypatch):
    """Make choose_variant behave as in a new process; yield what was probed and what works."""
    monkeypatch.delenv("NLT_VARIANT", raising=False)
    monkeypatch.delenv("DRJIT_LIBLLVM_PATH", raising=False)
    probed = []
    monkeypatch.setattr(variant_module, "_llvm_libraries", lambda: ["/new.so", "/old.so"])
    ok: set = set()
    monkeypatch.setattr(variant_module, "_works", lambda *pair: probed.append(pair) or pair in ok)
    yield probed, ok
    # choose_variant records its choice there, and monkeypatch restores only what was there before.
    for name in ("NLT_VARIANT", "DRJIT_LIBLLVM_PATH"):
        os.environ.pop(name, None)


def test_variant_order(probing):
    probed, ok = probing
    choose = variant_module.choose_variant.__wrapped__
    order = [("cuda_ad_rgb", None), ("llvm_ad_rgb", "/new.so"), ("llvm_ad_rgb", "/old.so")]
    fallback = choose()
    assert probed == order and fallback.name == "scalar_rgb"
    assert "cuda_ad_rgb" in fallback.reason and "llvm_ad_rgb" in fallback.reason
    assert os.environ["NLT_VARIANT"] == "scalar_rgb"  # worker processes need not probe

    del os.environ["NLT_VARIANT"]
    probed.clear()
    ok.add(order[2])
    chosen = choose()
    assert probed == order and chosen.name == "llvm_ad_rgb" and "/old.so" in chosen.reason
    assert os.environ["NLT_VARIANT"] == "llvm_ad_rgb" and os.environ["DRJIT_LIBLLVM_PATH"] == "/old.so"

    del os.environ["NLT_VARIANT"]
    probed.clear()
    ok.add(order[0])
    assert choose().name == "cuda_ad_rgb" and probed == order[:1]


def test_variant_set_by_hand(probing, monkeypatch):
    monkeypatch.setenv("NLT_VARIANT", "scalar_rgb")
    chosen = variant_module.choose_variant.__wrapped__()
    assert chosen.name == "scalar_rgb" and "NLT_VARIANT" in chosen.reason and not probing[0]


def test_variant_unknown(probing, monkeypatch):
    monkeypatch.setenv("NLT_VARIANT", "palace_rgb")
    with pytest.raises(UserError, match=r"NLT_VARIANT.*scalar_rgb.*palace_rgb"):
        variant_module.choose_variant.__wrapped__()


def test_probe():
    """The variant that runs here passes the probe, and a broken LLVM only kills the probe."""
    assert not is_jit() or variant_module._works(mi.variant(), None)
    assert not variant_module._works("llvm_ad_rgb", "/dev/null")


IN_SCALAR = """
import numpy as np, sys; from nlt.rendering.variant import use_variant; use_variant()
from nlt.rendering.renderer import Renderer; from nlt.scenes.assembly import Scene
from nlt.scenes.description import load_description; from nlt.scenes.state import rest_state, sample_view
d = load_description('living_room'); r = Renderer(Scene(d, 'moving_lights'))
r.scene.set_state(rest_state(d, 'moving_lights'))
c = sample_view(d, 20, np.random.default_rng({view})).window(*{corner}, 12)
"""


def in_scalar(images, *shape, **camera):
    """An expression's float32 values (*shape, 12, 12), of renderer `r` and camera `c` in the scalar variant."""
    code = IN_SCALAR.format(**camera) + f"np.save(sys.stdout.buffer, np.stack({images}).astype(np.float32))"
    environment = dict(os.environ, NLT_VARIANT="scalar_rgb")
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, check=True)
    return np.frombuffer(done.stdout[-int(np.prod(shape)) * 144 * 4 :], np.float32).reshape(*shape, 12, 12)


def test_scalar_agrees(renderer, demo):
    """The scalar variant has the same expectation as the variant that runs here, also in a window of an image."""
    images = in_scalar("[r.radiance(c, 8, s) for s in range(40)]", 40, 3, view=7, corner=(7, 1))
    scalar = np.einsum("xc,nchw->nxhw", XYZ, images)
    renderer.scene.set_state(rest_state(demo, "moving_lights"))
    window = sample_view(demo, 20, np.random.default_rng(7)).window(7, 1, 12)
    ours = samples_of(renderer, window, 8, range(50, 90))
    assert p_value(ours, scalar.mean(0), scalar.var(0, ddof=1) / 40) > ALPHA


def test_scalar_gbuffer_agrees(renderer, demo):
    """Both variants trace the same rays, mirrors and shadow rays included, but for rounding at edges."""
    names, at = ("albedo", "direct", "seen_albedo", "normal", "emission"), {"view": 3, "corner": (0, 0)}
    scalar = in_scalar(f"[r.gbuffer(c, True)[name] for name in {names}]", len(names), 3, **at)
    renderer.scene.set_state(rest_state(demo, "moving_lights"))
    window = sample_view(demo, 20, np.random.default_rng(at["view"])).window(*at["corner"], 12)
    ours = renderer.gbuffer(window, direct=True)
    black, mirrored = ours["seen_albedo"] == 0, ours["seen_albedo"] > ours["albedo"] + 0.01
    assert black.any() and mirrored.any(), "the window shows neither a black surface nor a mirror"
    for name, theirs in zip(names, scalar, strict=True):
        assert (np.abs(ours[name] - theirs) < 1e-3 * (1 + np.abs(theirs))).mean() > 0.95, name
