"""Photons agree with Mitsuba's irradiancemeter, direct light with a sum in float64, the G-buffer with Mitsuba's AOVs,
and `noisy` with the reference.
"""

import mitsuba as mi
import numpy as np
import pytest
import trimesh
from conftest import LIGHT, PLACES, plain_scene, write_room
from scipy import ndimage, stats

from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.paths import scenes_root
from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.lanes import is_jit
from nlt.scenes.state import sample_state, sample_view

pytestmark = pytest.mark.slow

# ---- photons --------------------------------------------------------------------------------------------

SKY = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32) ** 4 * 20
# Patches: centre, half width, normal, way to another patch. The second lies next to the crate, partly in its shadow.
WALL = ([1, 0.7, 0.1], 0.4, [-1, 0, 0], [0, -0.3, 0])
FLOOR = ([0, 0, 0.2], 0.2, [0, 1, 0], [-0.3, 0, 0])


def irradiancemeter(folder, patch, depth):
    """Return 8 estimates (8, 3) of a patch's irradiance by Mitsuba, a millimetre in front of its surface."""
    centre, half, normal, _ = (np.array(part, float) for part in patch)
    place = mi.ScalarTransform4f().look_at(centre + 1e-3 * normal, centre + normal, [0, 0.1, 1]).scale(float(half))
    film = {"type": "hdrfilm", "width": 1, "height": 1, "rfilter": {"type": "box"}, "pixel_format": "rgb"}
    meter = mi.load_dict({"type": "rectangle", "to_world": place, "meter": {"type": "irradiancemeter", "film": film}})
    plain = mi.load_file(str(folder / "scene.xml"), optimize=False)
    # The meter is no part of the scene and shadows nothing.
    integrator = mi.load_dict({"type": "path", "max_depth": depth})
    render = lambda seed: mi.render(
        plain, sensor=meter.sensor(), integrator=integrator, spp=1 << 14, seed=mi.UInt32(seed)
    )
    return np.stack([np.array(render(seed))[0, 0] for seed in range(8)]).astype(float)


def compatible(ours, theirs):
    """Return the Bonferroni-corrected p-value of Welch's test on each colour."""
    return 3 * stats.ttest_ind(ours, theirs, equal_var=False).pvalue.min()


@pytest.mark.parametrize("case", ["area light", "environment", "both"])
def test_irradiance(tmp_path, case):
    """Photons give a patch of a wall, or of the floor next to the crate, its direct irradiance."""
    file = write_room(tmp_path, is_open=case != "area light", light=case != "environment")
    if case != "area light":
        mi.Bitmap(SKY).write(str(tmp_path / "sky.exr"))
        source = tmp_path / "scene.xml"
        sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter></scene>'
        source.write_text(source.read_text().replace("</scene>", sky))
    patch = WALL if case == "area light" else FLOOR
    centre, half, normal, aside = (np.array(part, float) for part in patch)
    renderer = Renderer(Scene(load_description(str(file)), "fixed_lights"))
    ours, shifted = [], []
    for seed in range(40):
        photons = renderer.photons(4000, seed)
        arrives = photons["photon_valid"] & (photons["photon_direction"] @ normal < 0)  # not from below the floor
        for estimates, at in ((ours, centre), (shifted, centre + aside)):
            off = photons["photon_hit"].astype(float) - at
            inside = arrives & (np.abs(off) < np.where(normal, 1e-3, half)).all(1)
            estimates.append(photons["photon_flux"][inside].sum(0, dtype=float) / (2 * half) ** 2)
    direct = irradiancemeter(tmp_path, patch, 1)
    assert compatible(np.array(ours), direct) > 1e-3
    assert compatible(np.array(shifted), direct) < 1e-6, "the test cannot tell a patch from its neighbour"
    if patch is WALL:  # with one bounce from the other walls
        assert compatible(np.array(ours), irradiancemeter(tmp_path, patch, 2)) < 1e-6, "nor direct from indirect"


# ---- direct light ---------------------------------------------------------------------------------------


def passes_crate(start, end):
    """Return whether the segments (n, 3) miss the crate of `write_room`, by its three slabs."""
    low, high = np.array([-0.6, 0, 0.05]) - start, np.array([-0.2, 0.5, 0.35]) - start
    with np.errstate(divide="ignore", invalid="ignore"):
        near, far = np.sort([low / (end - start), high / (end - start)], axis=0)
    return (near.max(1) > far.min(1)) | (near.max(1) > 1) | (far.min(1) < 0)


def lit_by_lamp(place, normal):
    """Return the light that white reflects, per radiance (n,), and the lamp's share in sight (n,), by 256 parts."""
    (width, depth), y, parts = LIGHT["size"], LIGHT["height"], (np.arange(16) + 0.5) / 16 - 0.5
    total, seen = np.zeros(len(place)), np.zeros(len(place))
    for x in width * parts:
        for z in depth * parts:
            away = np.array([x, y, z]) - place
            distance = np.linalg.norm(away, axis=1)
            cosines = (away * normal).sum(1).clip(0) * away[:, 1] / distance**2
            free = passes_crate(place + 1e-4 * normal, place + away)
            total += free * cosines / distance**2 * width * depth / (np.pi * len(parts) ** 2)
            seen += free / len(parts) ** 2
    return total, seen


def surface(camera, buffer):
    """Return the places (H W, 3) and normals (H W, 3) of a G-buffer, row by row."""
    directions, depth = camera.view_directions().reshape(3, -1).T, buffer["depth"].reshape(-1, 1).astype(float)
    place = camera.position + directions * (depth / (directions @ camera.rotation[:, 2:]))
    return place, buffer["normal"].reshape(3, -1).T.astype(float)


def test_direct_light(tmp_path):
    """Sixteen shadow rays, from eight places in a pixel, agree with 256 from each of 9: the mean weighted by albedo.

    Within 1 % where all reach the whole lamp, and exactly in the dark; at edges it is closer than what 256 say of the
    pixel's centre.
    """
    description, side = load_description(str(write_room(tmp_path))), 3
    source = tmp_path / "scene.xml"
    before, crate = source.read_text().split('id="crate"')
    source.write_text(before + 'id="crate"' + crate.replace("0.7, 0.6, 0.5", "0.1, 0.2, 0.9", 1))
    renderer = Renderer(Scene(description, "fixed_lights"))
    view = np.array([-0.9, 1.2, -0.6]), np.array([-0.6, 0, 0.2]), np.array([0, 1.0, 0]), 60
    camera, fine = Camera.look_at(*view, 72, 72), Camera.look_at(*view, 72 * side, 72 * side)
    lit = renderer.gbuffer(camera, direct=True)
    direct = lit["direct"]
    assert np.array_equal(renderer.gbuffer(camera, direct=True)["direct"], direct), "it has no noise"
    np.testing.assert_allclose(renderer.gbuffer(camera)["albedo"], lit["albedo"], atol=1e-6)
    rows = lambda image: image.reshape(len(image), -1).T.astype(float)
    buffer = renderer.gbuffer(fine)
    place, normal = surface(fine, buffer)
    albedo, (total, seen) = rows(buffer["albedo"]), lit_by_lamp(place, normal)
    exact = total[:, None] * LIGHT["radiance"]
    parted = lambda values: values.reshape(72, side, 72, side, -1).swapaxes(1, 2).reshape(72**2, side**2, -1)
    ours, theirs, centre = rows(direct), parted(albedo * exact).mean(1) / parted(albedo).mean(1), parted(exact)[:, 4]
    seen, is_flat = parted(seen)[..., 0], (np.ptp(parted(np.hstack([normal, albedo])), axis=1) < 1e-3).all(1)
    inside = lambda mask: ndimage.binary_erosion(mask.reshape(72, 72)).ravel()  # our places are not theirs
    whole, shadow = inside(is_flat & (seen == 1).all(1)), inside(is_flat & (seen == 0).all(1))
    penumbra = is_flat & (seen.mean(1) > 0) & (seen < 1).any(1)
    assert whole.sum() > 400 and shadow.sum() > 20 and penumbra.sum() > 20 and (~is_flat).sum() > 100
    np.testing.assert_allclose(ours[whole], theirs[whole], rtol=0.05)
    assert np.median(np.abs(ours[whole] / theirs[whole] - 1)) < 0.01
    assert not ours[shadow].any()
    unhindered = theirs[penumbra] / seen[penumbra].mean(1, keepdims=True)
    assert (np.abs(ours[penumbra] - theirs[penumbra]) < 0.17 * unhindered).all()
    error = lambda values: np.sqrt(((values - theirs)[~is_flat] ** 2).mean())
    assert error(ours) < 0.4 * error(centre)


def test_direct_light_next_to_the_lamp(tmp_path, monkeypatch):
    """A surface reflects no more radiance than a lamp emits, however close the lamp's points are."""
    monkeypatch.setitem(LIGHT, "height", 0.03)
    description = load_description(str(write_room(tmp_path)))
    below = Camera.look_at(np.array([0.9, 0.02, 0.0]), np.array([0, 0, 0.0]), np.array([0, 1.0, 0]), 10, 64, 64)
    direct = Renderer(Scene(description, "fixed_lights")).gbuffer(below, direct=True)["direct"]
    share = direct / np.reshape(LIGHT["radiance"], (3, 1, 1))
    assert 0.5 < share.max() < 1.2


def coated_floor(tmp_path, coated, sky=""):
    """Coat a room's floor and return a camera, the G-buffers before and after, and the direct light that Mitsuba sees.

    The last one, (3, 48, 48), is what the coated room reflects of its lamp on Mitsuba's paths of that length.
    """
    description = load_description(str(write_room(tmp_path, is_open=True)))
    source = tmp_path / "scene.xml"
    camera = Camera.look_at(np.array([0.9, 0.8, -0.6]), np.array([0.1, 0, 0.0]), np.array([0, 1.0, 0]), 60, 48, 48)
    plain = Renderer(Scene(description, "fixed_lights")).gbuffer(camera, direct=True)
    diffuse = '"diffuse"><rgb name="reflectance" value="0.7, 0.6, 0.5"/>'
    source.write_text(source.read_text().replace(diffuse, coated, 1).replace("</scene>", f"{sky}</scene>"))
    buffers = Renderer(Scene(description, "fixed_lights")).gbuffer(camera, direct=True)
    scene = mi.load_file(str(source), optimize=False)
    render = lambda depth: mi.render(
        scene, sensor=sensor_of(camera), integrator=mi.load_dict({"type": "path", "max_depth": depth}), spp=2048
    )
    return camera, plain, buffers, np.moveaxis(np.array(render(2) - render(1))[..., :3], 2, 0)


def test_direct_light_under_a_coat(tmp_path):
    """Plastic reflects less than its albedo says: as much as Mitsuba's paths of that length, but for its highlight."""
    coated = '"plastic"><boolean name="nonlinear" value="true"/><rgb name="diffuse_reflectance" value="0.7, 0.6, 0.5"/>'
    camera, plain, buffers, expected = coated_floor(tmp_path, coated)
    ours = buffers["seen_albedo"] * buffers["direct"]

    (x, y, z), (width, depth) = camera.position, LIGHT["size"]
    dx, dy, dz = camera.view_directions().astype(float)
    down = -(y + LIGHT["height"]) / np.where(dy < 0, dy, np.nan)  # to the lamp's mirror image in the floor
    is_highlight = (np.abs(x + down * dx) < width / 2 + 0.1) & (np.abs(z + down * dz) < depth / 2 + 0.1)
    is_floor = (buffers["normal"][1] > 0.99) & (buffers["depth"][0] > 0) & (buffers["emission"] == 0).all(0)
    is_floor &= np.abs(surface(camera, buffers)[0][:, 1].reshape(48, 48)) < 1e-3
    lit = ndimage.binary_erosion(is_floor & ~is_highlight & (expected > 0.01).all(0))
    assert lit.sum() > 400
    np.testing.assert_allclose(buffers["albedo"], plain["albedo"], atol=1e-6)
    ours, expected, as_plain = ours[:, lit], expected[:, lit], (plain["albedo"] * plain["direct"])[:, lit]
    np.testing.assert_allclose(ours.mean(1), expected.mean(1), rtol=0.02)
    assert np.median(np.abs(ours / expected - 1)) < 0.02
    assert (ours < 0.8 * as_plain).all(), "a plain surface would be far brighter"
    # Fresnel's law for an index of 1.49, and 0.5918 of the light inside is reflected back.
    cosine, inside = -dy[lit], np.sqrt(1 - (1 - dy[lit] ** 2) / 1.49**2)
    ratios = (cosine - 1.49 * inside) / (cosine + 1.49 * inside), (1.49 * cosine - inside) / (1.49 * cosine + inside)
    passed = (1 - np.mean(np.square(ratios), axis=0)) * (1 - (0.49 / 2.49) ** 2) / 1.49**2
    base = np.array([[0.7], [0.6], [0.5]])
    np.testing.assert_allclose(buffers["seen_albedo"][:, lit], base * passed / (1 - 0.5918 * base), rtol=0.02)


def lit_floor(tmp_path, coated, sky=""):
    """Return a coated floor's radiance (3, n) in ours, in Mitsuba's paths of that length, and without any highlight."""
    camera, plain, buffers, expected = coated_floor(tmp_path, coated, sky)
    is_floor = (np.abs(surface(camera, buffers)[0][:, 1].reshape(48, 48)) < 1e-3) & (buffers["depth"][0] > 0)
    floor = ndimage.binary_erosion(is_floor & (expected > 0.001).all(0))
    ours, base = (buffers["seen_albedo"] * light for light in (buffers["direct"], plain["direct"]))
    assert floor.sum() > 400 and (expected > 2 * base)[:, floor].mean() > 0.02, "there is a highlight"
    return ours[:, floor], expected[:, floor], base[:, floor]


@pytest.mark.parametrize("alpha", [0.3, 0.2, 0.1, 0.01, 0])
def test_highlights_of_a_coat(tmp_path, alpha):
    """A lamp's highlight on plastic, however rough, is that of Mitsuba's paths of that length."""
    base = '<rgb name="diffuse_reflectance" value="0.1"/>'
    coated = f'"roughplastic"><float name="alpha" value="{alpha}"/>{base}' if alpha else f'"plastic">{base}'
    ours, expected, _ = lit_floor(tmp_path, coated)
    np.testing.assert_allclose(ours.mean(1), expected.mean(1), rtol=0.02)
    assert np.median(np.abs(ours / expected - 1)) < 0.02


@pytest.mark.parametrize("roughness", [0.45, 0.1])
def test_highlights_of_principled(tmp_path, roughness):
    """Its lobes cannot be sampled one by one: a broad highlight is Mitsuba's, a sharp one is held down."""
    values = {"roughness": roughness, "specular": 0.5}
    floats = "".join(f'<float name="{name}" value="{value}"/>' for name, value in values.items())
    ours, expected, base = lit_floor(tmp_path, f'"principled"><rgb name="base_color" value="0.1"/>{floats}')
    if roughness == 0.45:
        np.testing.assert_allclose(ours.mean(1), expected.mean(1), rtol=0.03)
        assert np.median(np.abs(ours / expected - 1)) < 0.03
    else:
        assert (base.mean(1) < ours.mean(1)).all() and (ours.mean(1) < expected.mean(1)).all()
        assert ours.max() < expected.max() / 2


def test_a_coat_reflects_the_sky(tmp_path):
    """It reflects sky and lamp as Mitsuba's paths of that length do."""
    sky = '<emitter type="constant"><rgb name="radiance" value="0.2, 0.3, 0.4"/></emitter>'
    coated = '"plastic"><rgb name="diffuse_reflectance" value="0.02"/>'
    ours, expected, _ = lit_floor(tmp_path, coated, sky)
    np.testing.assert_allclose(ours.mean(1), expected.mean(1), rtol=0.05)


def test_direct_light_of_the_sky(tmp_path):
    """A white floor under a sky of one colour reflects nearly that colour, and nothing in the dark."""
    source = tmp_path / "scene.xml"
    for radiance in ("0.2, 0.3, 0.4", "0, 0, 0"):
        description = load_description(str(write_room(tmp_path, is_open=True, light=False)))
        sky = f'<emitter type="constant"><rgb name="radiance" value="{radiance}"/></emitter></scene>'
        source.write_text(source.read_text().replace("</scene>", sky))
        camera = Camera.look_at(np.array([0.6, 1.0, -0.6]), np.array([0.6, 0, -0.5]), np.array([0, 1.0, 0]), 20, 8, 8)
        direct = Renderer(Scene(description, "fixed_lights")).gbuffer(camera, direct=True)["direct"]
        expected = np.broadcast_to(np.float32(radiance.split(", "))[:, None, None], direct.shape)
        np.testing.assert_allclose(direct, expected, rtol=0.3)


def test_direct_light_of_a_bulb(tmp_path):
    """A mesh of a sphere lights the floor within 40 % of a sphere, although half faces away: radiance (r / d)^2 cos."""
    description = load_description(str(write_room(tmp_path, is_open=True)))
    bulb = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    bulb.apply_translation([0, 1.5, 0]).export(tmp_path / "lamp.ply")
    camera = Camera.look_at(np.array([0.6, 1.0, -0.5]), np.array([0.5, 0, -0.6]), np.array([0, 1.0, 0]), 30, 8, 8)
    renderer = Renderer(Scene(description, "fixed_lights"))
    buffer = renderer.gbuffer(camera, direct=True)
    depth, directions = buffer["depth"].reshape(-1, 1), camera.view_directions().reshape(3, -1).T
    place = camera.position + directions * (depth / (directions @ camera.rotation[:, 2:]))
    distance = np.linalg.norm(place - [0, 1.5, 0], axis=1)
    expected = np.outer(LIGHT["radiance"], 0.1**2 * 1.5 / distance**3)
    np.testing.assert_allclose(buffer["direct"].reshape(3, -1), expected, rtol=0.4)


PANE = """<shape type="rectangle"><transform name="to_world">
    <lookat origin="{x}, 1, 0" target="-9, 1, 0" up="0, 1, 0"/></transform>{bsdf}</shape></scene>"""
MIRROR = '<bsdf type="conductor"><rgb name="specular_reflectance" value="0.5, 0.4, 0.3"/></bsdf>'
GLASS = '<bsdf type="thindielectric"/>'


@pytest.mark.parametrize("case", ["mirror", "glass"])
def test_direct_light_by_way_of(tmp_path, case):
    """A mirror shows what a camera behind it would see, times its reflectance; a pane what is there without it."""
    free = Renderer(Scene(load_description(str(write_room(tmp_path / "free", is_open=True))), "fixed_lights"))
    description = load_description(str(write_room(tmp_path, is_open=True)))
    source, place = tmp_path / "scene.xml", {"mirror": (1.0, MIRROR), "glass": (-0.8, GLASS)}[case]
    source.write_text(source.read_text().replace("</scene>", PANE.format(x=place[0], bsdf=place[1])))
    behind = Renderer(Scene(description, "fixed_lights"))
    up, target, view = np.array([0, 1.0, 0]), np.array([1.0, 0.9, -0.3]), (60, 96, 192)
    camera = Camera.look_at(np.array([-0.9, 0.6, -0.7]), target, up, *view)
    there, columns = camera, slice(None)
    if case == "mirror":
        there, columns = Camera.look_at(np.array([2.9, 0.6, -0.7]), target, up, *view), slice(None, None, -1)
    ours, theirs = behind.gbuffer(camera, direct=True), free.gbuffer(there, direct=True)
    tint = np.array([[0.5], [0.4], [0.3]]) if case == "mirror" else np.ones((3, 1))
    pane = (ours["albedo"] == 0).all(0)  # elsewhere the crate stands before it
    is_lamp = (theirs["emission"] == np.array(LIGHT["radiance"])[:, None, None]).all(0)
    inside = ndimage.binary_erosion  # because a pixel and its mirror image have other places at edges
    lamp = inside(pane & is_lamp[:, columns])
    albedo = np.array([[0.7], [0.6], [0.5]])
    is_surface = np.isclose(theirs["albedo"], albedo[:, None]).all(0) & (theirs["emission"] == 0).all(0)
    diffuse = inside(pane & is_surface[:, columns])
    assert lamp.sum() > 3 and diffuse.sum() > 100 and np.allclose(theirs["seen_albedo"], theirs["albedo"], atol=1e-6)
    image = theirs["direct"][:, :, columns]
    agrees = np.isclose(ours["direct"], image, rtol=1e-2, atol=1e-4).all(0)
    _, seen = lit_by_lamp(*surface(there, theirs))
    whole_or_dark = np.isin(seen, (0, 1)).reshape(pane.shape)[:, columns]
    assert agrees[diffuse & inside(whole_or_dark)].mean() > 0.99
    one_ray = image.max() / 8
    assert np.isclose(ours["direct"], image, rtol=1e-2, atol=one_ray).all(0)[diffuse].mean() > 0.99
    expected = (tint * albedo).repeat(diffuse.sum(), 1)
    np.testing.assert_allclose(ours["seen_albedo"][:, diffuse], expected, rtol=1e-2)
    np.testing.assert_allclose(ours["seen_albedo"][:, lamp], tint.repeat(lamp.sum(), 1), rtol=1e-2)
    np.testing.assert_allclose(ours["direct"][:, lamp], np.array([LIGHT["radiance"]]).T.repeat(lamp.sum(), 1))


def test_direct_light_by_way_of_rough_metal(tmp_path):
    """Rough metal shows as much light of lit surfaces as Mitsuba's paths of that length, and no lamp."""
    description = load_description(str(write_room(tmp_path, is_open=True)))
    source, bsdf = tmp_path / "scene.xml", MIRROR.replace("conductor", "roughconductor")
    bsdf = bsdf.replace("</bsdf>", '<float name="alpha" value="0.2"/></bsdf>')
    source.write_text(source.read_text().replace("</scene>", PANE.format(x=1.0, bsdf=bsdf)))
    up, target = np.array([0, 1.0, 0]), np.array([1.0, 0.9, -0.3])
    camera = Camera.look_at(np.array([-0.9, 0.6, -0.7]), target, up, 60, 96, 96)
    buffers = Renderer(Scene(description, "fixed_lights")).gbuffer(camera, direct=True)
    pane = (buffers["albedo"] == 0).all(0) & (buffers["depth"][0] > 0)
    ours = buffers["seen_albedo"] * buffers["direct"]
    plain = mi.load_file(str(source), optimize=False)

    def by_paths(depth):
        integrator = mi.load_dict({"type": "path", "max_depth": depth, "rr_depth": 100})
        return np.array(mi.render(plain, sensor=sensor_of(camera, 1), integrator=integrator, spp=1024))[..., :3]

    lamp_in_metal, surface_in_metal = by_paths(2) - by_paths(1), by_paths(3) - by_paths(2)
    for rows, sees_lamp in ((slice(48, 72), True), (slice(72, 96), False)):
        inside = pane[rows]
        expected, lamp = (image[rows][inside].mean(0) for image in (surface_in_metal, lamp_in_metal))
        assert inside.mean() > 0.5 and (lamp > 0.5 * expected).all() == sees_lamp
        np.testing.assert_allclose(ours[:, rows][:, inside].mean(1), expected, rtol=0.2)


@pytest.mark.parametrize("panes", [2, 3])
def test_at_most_two_panes_are_looked_through(tmp_path, panes):
    """A lamp by way of more surfaces would be a dot as bright as the lamp, which almost no path sees."""
    description = load_description(str(write_room(tmp_path, is_open=True)))
    source = tmp_path / "scene.xml"
    glass = "".join(PANE.format(x=-0.8 + 0.05 * k, bsdf=GLASS).replace("</scene>", "") for k in range(panes))
    source.write_text(source.read_text().replace("</scene>", glass + "</scene>"))
    up, target = np.array([0, 1.0, 0]), np.array([1.0, 0.9, -0.3])
    camera = Camera.look_at(np.array([-0.9, 0.6, -0.7]), target, up, 60, 96, 192)
    buffers = Renderer(Scene(description, "fixed_lights")).gbuffer(camera, direct=True)
    behind = (buffers["albedo"] == 0).all(0)
    assert behind.mean() > 0.5
    assert buffers["seen_albedo"][:, behind].any() == (panes == 2)


# ---- G-buffer -------------------------------------------------------------------------------------------


def sensor_of(camera, units=1.0, **more):
    """Return Mitsuba's sensor for a camera."""
    to_world = np.linalg.inv(camera.world_to_view.astype(float)) @ np.diag([-1.0, -1, 1, 1])
    to_world[:3, 3] *= units
    return mi.load_dict({
        "type": "perspective", "fov": camera.fov, "near_clip": 1e-3, "to_world": mi.ScalarTransform4f(to_world),
        "film": {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"}},
        **more,
    })  # fmt: skip


def aovs(plain, camera, units):
    """Return Mitsuba's AOVs, each (..., H, W): depth along the axis in metres and normal at the pixel centres; albedo.

    The albedo is the mean of eight rays in each pixel, for which the sensor is shifted.
    """
    integrator = mi.load_dict({"type": "aov", "aovs": "p:position,n:sh_normal,a:albedo"})

    def split(x=0.5, y=0.5):
        shift = {"principal_point_offset_x": (0.5 - x) / camera.width}
        shift["principal_point_offset_y"] = (0.5 - y) / camera.height
        sampler = {"type": "stratified", "sample_count": 1, "jitter": False}
        image = np.array(
            mi.render(plain, sensor=sensor_of(camera, units, sampler=sampler, **shift), integrator=integrator, spp=1)
        )
        return np.split(np.moveaxis(image, 2, 0)[-9:].astype(float), 3)

    position, normal, _ = split()
    albedo = np.mean([split(*place)[2] for place in PLACES], axis=0)
    depth = np.einsum("i,ihw->hw", camera.rotation[:, 2], position / units - camera.position[:, None, None])
    return np.where(normal.any(0), depth, 0), normal, albedo


def meets_mask(plain, camera, units):
    """Return (H, W) bool: whether the first surface at the pixel's centre is a mask, where Mitsuba's AOVs stop."""
    flag = mi.BSDFFlags

    def of_mask(ray):
        hit = plain.ray_intersect(ray)
        if not is_jit() and not hit.is_valid():
            return False
        flags = hit.bsdf().flags()
        return mi.has_flag(flags, flag.Null) & mi.has_flag(flags, flag.DiffuseReflection)

    origin, directions = (camera.position * units).tolist(), camera.directions(camera.centres()).astype(np.float32)
    if is_jit():
        masks = np.array(of_mask(mi.Ray3f(mi.Point3f(origin), mi.Vector3f(directions.T))))
    else:
        masks = np.array([of_mask(mi.Ray3f(origin, d)) for d in directions.tolist()])
    return masks.reshape(camera.height, camera.width)


def check_gbuffer(renderer, plain, camera):
    units = renderer.scene.description.units_per_metre
    depth, normal, albedo = aovs(plain, camera, units)
    buffer, masks = renderer.gbuffer(camera), meets_mask(plain, camera, units)
    assert masks.mean() < 0.1 and (buffer["depth"][0, masks] > depth[masks] - 1e-3).all()
    for ours, theirs in ((buffer["depth"], depth), (buffer["normal"], normal), (buffer["albedo"], albedo)):
        ours[:, masks] = theirs[..., masks]
    # A ray that grazes an edge may fall on either side of it.
    assert (np.abs(buffer["depth"][0] - depth) < 1e-3 * (1 + depth)).mean() > 0.995
    assert (np.abs(buffer["normal"] - normal).max(0) < 1e-2).mean() > 0.99
    specular = (buffer["albedo"] == 0).all(0)  # which Mitsuba gives whatever value the BSDF has there
    assert (np.abs(buffer["albedo"] - albedo.clip(0, 1)).max(0)[~specular] < 1e-2).mean() > 0.97
    assert specular.mean() < 0.5 and depth.std() > 0.1 and normal.std() > 0.1
    flipped = np.abs(buffer["depth"][0, :, ::-1] - depth) < 1e-3 * (1 + depth)
    assert flipped.mean() < 0.5, "the test cannot tell left from right"


@pytest.mark.parametrize("seed", [0, 1])
def test_gbuffer_is_the_aov_integrators(demo, seed):
    state = sample_state(demo, "fixed_lights", np.random.default_rng(seed))
    renderer = Renderer(Scene(demo, "fixed_lights"))
    renderer.scene.set_state(state)
    camera = sample_view(demo, 48, np.random.default_rng(10 + seed))
    check_gbuffer(renderer, plain_scene(demo, "fixed_lights", state), camera)


@pytest.mark.skipif(not (scenes_root() / "living-room").is_dir(), reason=f"the living-room is not in {scenes_root()}")
def test_gbuffer_of_the_living_room():
    description = load_description("real/living-room")
    plain = mi.load_file(str(description.path), optimize=False)
    camera = sample_view(description, 64, np.random.default_rng(1))
    check_gbuffer(Renderer(Scene(description, "fixed_lights")), plain, camera)


def check_emission(renderer, plain, camera):
    """Emission is what the path tracer sees before any bounce, up to the precision of 4 x 4 rays at edges."""
    spp, least = 1024, 1e-6
    integrator = mi.load_dict({"type": "path", "max_depth": 1})
    image = mi.render(plain, sensor=sensor_of(camera), integrator=integrator, spp=spp)
    expected = np.moveaxis(np.array(image), 2, 0)[:3].astype(float)
    ours = renderer.gbuffer(camera)["emission"].astype(float)
    around = lambda f: np.stack([f(channel, 3) for channel in expected])
    high, low = around(ndimage.maximum_filter), around(ndimage.minimum_filter)
    inside = high - low < 1e-3 * high + least
    assert np.allclose(ours[inside], expected[inside], rtol=1e-3, atol=least)
    assert (np.abs(ours - expected) <= 0.25 * (high - low) + 1e-3 * high + least).all()
    assert ours.sum() == pytest.approx(expected.sum(), rel=0.01)
    lit = expected.any(0)
    assert 0.02 < lit.mean() < 0.98 and (~inside & (expected > 0)).sum() > 20
    assert np.abs(ours[:, :, ::-1] - expected).max() > 0.25 * high.max(), "the test cannot tell left from right"


@pytest.mark.parametrize("experiment", ["fixed_lights", "moving_lights"])
def test_emission_is_the_path_tracers_without_bounces(demo, experiment):
    state = sample_state(demo, experiment, np.random.default_rng(1))
    renderer = Renderer(Scene(demo, experiment))
    renderer.scene.set_state(state)
    lamp = np.array([0, demo.light.box[0, 1], 0]) if experiment == "fixed_lights" else demo.light.centre
    if experiment == "moving_lights":
        lamp = lamp + state.translation[-1]
    eye = np.array([1.2, 1.0, 1.2])
    camera = Camera.look_at(eye, lamp + np.array([0.3, 0, 0.1]), demo.up, 70, 40, 32)
    check_emission(renderer, plain_scene(demo, experiment, state), camera)
    below = Camera.look_at(eye, eye + np.array([0.1, -1, 0.2]), demo.up, 70, 8, 8)
    assert not renderer.gbuffer(below)["emission"].any()
    views = [sample_view(demo, 10, np.random.default_rng(k)) for k in range(8)]
    culled = [renderer.gbuffer(view)["emission"] for view in views]
    renderer._gbuffer._may_see_lamp = lambda camera: np.ones(camera.width * camera.height, bool)
    assert np.array_equal(culled, [renderer.gbuffer(view)["emission"] for view in views])
    assert np.any(culled)


@pytest.mark.parametrize("sky", ["envmap", "constant"])
def test_emission_of_the_environment(tmp_path, sky):
    """Emission holds the sky and a lamp that faces down, seen from below and then from above."""
    file = write_room(tmp_path, is_open=True)
    mi.Bitmap(np.repeat(np.repeat(SKY, 8, 0), 8, 1) + 0.1).write(str(tmp_path / "sky.exr"))
    value = {
        "envmap": '<string name="filename" value="sky.exr"/>',
        "constant": '<rgb name="radiance" value="3, 2, 1"/>',
    }
    source = tmp_path / "scene.xml"
    source.write_text(source.read_text().replace("</scene>", f'<emitter type="{sky}">{value[sky]}</emitter></scene>'))
    renderer = Renderer(Scene(load_description(str(file)), "fixed_lights"))
    plain = mi.load_file(str(source), optimize=False)
    for eye, target in (([0.8, 0.9, -1.6], [0, 1.2, 0]), ([0.8, 2.6, -1.6], [0, 0.6, 0])):
        camera = Camera.look_at(np.array(eye), np.array(target), np.array([0, 1.0, 0]), 80, 40, 32)
        check_emission(renderer, plain, camera)


# ---- the images of samples ------------------------------------------------------------------------------


def test_noisy_images_have_the_references_expectation():
    """Over many samples, the residuals of all pixels have mean 0 and are uncorrelated."""
    spec = DatasetSpec(["living_room"], resolution=8, val=120, num_points=1, num_photons=1, reference_spp=16)
    render = SampleRenderer(spec, 0)
    samples = [render.sample("val", k) for k in range(spec.val)]
    images = {
        n: np.stack([s[n] for s in samples]).astype(float) for n in ("noisy", "noisy_input", "target", "reference_a")
    }
    half = np.stack([s["reference_b"] for s in samples])
    residuals = {name: image - half for name, image in images.items()}
    for name, residual in residuals.items():
        p = stats.ttest_1samp(residual, 0).pvalue
        assert np.nanmin(p) * p.size > 1e-3, name
    dark = stats.ttest_1samp(np.minimum(images["noisy"], half.mean((0, 2, 3))[:, None, None]) - half, 0).pvalue
    assert np.nanmin(dark) * dark.size < 1e-4, "the test cannot tell clamped images"
    spread = {name: np.median(np.abs(residual)) for name, residual in residuals.items()}
    assert spread["noisy"] > 1.3 * spread["noisy_input"] > 1.3**2 * spread["target"], "1, 4 and 16 spp"
    assert spread["target"] == pytest.approx(spread["reference_a"], rel=0.1), "both 16 spp"
    for read in ("noisy", "noisy_input"):
        for target in {"noisy", "noisy_input", "target"} - {read}:
            own = images[read] - images["reference_a"], images[target] - half
            correlation = stats.spearmanr(*(r.ravel() for r in own)).statistic
            assert abs(correlation) < 5 / np.sqrt(own[0].size / 3), (read, target)
