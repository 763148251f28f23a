"""Opacity masks: whatever traces a ray passes through their transparent parts, and thin glass still stops it."""

import mitsuba as mi
import numpy as np
import pytest
from conftest import LIGHT, write_room
from scipy import ndimage

from nlt.rendering.renderer import Renderer
from nlt.scenes.assembly import Scene
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.pointcloud import sample_points

pytestmark = pytest.mark.slow

HEIGHT, COLOUR = 1.5, [0.1, 0.2, 0.3]
DIFFUSE = f"""<bsdf type="twosided"><bsdf type="diffuse">
    <rgb name="reflectance" value="{", ".join(map(str, COLOUR))}"/></bsdf></bsdf>"""
MASK = f"""<bsdf type="mask"><texture type="bitmap" name="opacity"><string name="filename" value="opacity.exr"/>
    <boolean name="raw" value="true"/><string name="filter_type" value="nearest"/></texture>{DIFFUSE}</bsdf>"""


def renderer_of(folder, bsdf, layers=1, **more):
    """A renderer of the room with sheets of a material between floor and lamp, as wide as the room, 1 cm apart."""
    file = write_room(folder, objects={}, **more)
    mi.Bitmap(np.float32([[[0], [1]]])).write(str(folder / "opacity.exr"))
    sheets = ""
    for k in range(layers):
        corners = [f"v {x} {HEIGHT + k / 100} {z}" for x, z in ((-1, -1), (-1, 1), (1, 1), (1, -1))]
        lines = [*corners, "vt 0 0", "vt 0 1", "vt 1 1", "vt 1 0", "f 1/1 2/2 3/3", "f 1/1 3/3 4/4"]
        (folder / f"sheet_{k}.obj").write_text("\n".join(lines))
        sheets += f'<shape type="obj" id="sheet_{k}"><string name="filename" value="sheet_{k}.obj"/>{bsdf}</shape>'
    source = folder / "scene.xml"
    source.write_text(source.read_text().replace("</scene>", f"{sheets}</scene>"))
    return Renderer(Scene(load_description(str(file)), "fixed_lights"))


@pytest.fixture(scope="module")
def masked(tmp_path_factory, variant):
    """The sheet is transparent where x < 0."""
    return renderer_of(tmp_path_factory.mktemp("masked"), MASK)


@pytest.fixture(scope="module")
def glass(tmp_path_factory, variant):
    return renderer_of(tmp_path_factory.mktemp("glass"), '<bsdf type="thindielectric"/>')


def look_up(renderer):
    """Buffers of a camera that looks straight up at the sheet; where its rays meet the sheet's plane (H, W)."""
    position = np.array([0.01, 0.8, 0.02])
    camera = Camera.look_at(position, position + np.array([0, 1.0, 0]), np.array([0, 0, 1.0]), 60, 24, 20)
    x = position[0] + (HEIGHT - position[1]) * camera.view_directions()[0] / camera.view_directions()[1]
    return renderer.gbuffer(camera) | {"transmits": renderer.transmits(camera)}, x


@pytest.mark.parametrize("layers", [1, 3])
def test_gbuffer(tmp_path, masked, layers):
    """Lamp and ceiling where the sheet is transparent, the sheet elsewhere."""
    renderer = masked if layers == 1 else renderer_of(tmp_path, MASK, layers)
    assert renderer.scene.masks
    buffer, x = look_up(renderer)
    opaque, clear = x > 0, x < 0
    assert np.allclose(buffer["depth"][0, opaque], HEIGHT - 0.8, atol=1e-4)
    assert np.allclose(buffer["albedo"][:, opaque].T, COLOUR, atol=1e-5)
    assert np.allclose(buffer["normal"][:, opaque].T, [0, 1, 0], atol=1e-5)
    assert not buffer["emission"][:, opaque].any() and not buffer["transmits"].any()
    lamp = clear & (buffer["emission"] == np.float32(LIGHT["radiance"])[:, None, None]).all(0)
    ceiling = clear & ~buffer["emission"].any(0)
    assert lamp.sum() > 20 and ceiling.sum() > 20
    assert np.allclose(buffer["depth"][0, lamp], LIGHT["height"] - 0.8, atol=1e-3)
    assert np.allclose(buffer["depth"][0, ceiling], 2 - 0.8, atol=1e-3)
    inside = ndimage.binary_erosion(ceiling, np.ones((3, 3)))  # at its edges, the albedo is that of two surfaces
    assert np.allclose(buffer["albedo"][:, inside].T, [0.7, 0.6, 0.5], atol=1e-5) and inside.sum() > 10
    assert np.allclose(buffer["normal"][:, ceiling].T, [0, -1, 0], atol=1e-5)


def test_direct_light(tmp_path, masked):
    """Shadow rays pass the sheet's transparent half as if nothing were there; the other half stops them."""
    free = renderer_of(tmp_path, MASK, layers=0)
    for side in (-1, 1):  # the walls before and behind which the sheet is transparent, and opaque
        camera = Camera.look_at(np.array([0, 1.0, 0]), np.array([side, 1.0, 0]), np.array([0, 1.0, 0]), 60, 24, 20)
        x, y, z = camera.view_directions()
        height, aside = 1 + y / np.abs(x), z / np.abs(x)
        wall = (np.abs(aside) < 0.99) & (height > 0.5) & (height < HEIGHT)  # whose rays to the lamp stay on its side
        ours, unhindered = (renderer.gbuffer(camera, direct=True)["direct"][:, wall] for renderer in (masked, free))
        assert wall.sum() > 100 and unhindered.all()
        np.testing.assert_allclose(ours, unhindered if side < 0 else 0, rtol=1e-4)


def photons_at_sheet(renderer):
    """The height of each photon's hit; where its ray crosses the sheet's plane, for those that do so in the room."""
    photons = {name: values.astype(float) for name, values in renderer.photons(4000, 0).items()}
    origin, direction = photons["photon_origin"], photons["photon_direction"]
    at = origin + direction * ((HEIGHT - origin[:, 1]) / direction[:, 1])[:, None]
    inside = (np.abs(at[:, [0, 2]]) < 0.99).all(1) & (np.abs(at[:, 0]) > 0.01)
    assert inside.sum() > 1000
    return photons["photon_hit"][inside, 1], at[inside, 0], photons


def test_photons(masked):
    height, x, photons = photons_at_sheet(masked)
    assert np.allclose(height[x > 0], HEIGHT, atol=1e-4) and (height[x < 0] < HEIGHT - 1e-3).all()
    away = photons["photon_hit"] - photons["photon_origin"]
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert np.abs(away - photons["photon_direction"]).max() < 1e-3, "passing a mask bends no ray"


def test_thin_glass_is_a_surface(glass):
    assert not glass.scene.masks
    buffer, _ = look_up(glass)
    assert np.allclose(buffer["depth"], HEIGHT - 0.8, atol=1e-4) and buffer["transmits"].all()
    assert not buffer["emission"].any() and not buffer["albedo"].any()
    height, _, _ = photons_at_sheet(glass)
    assert np.allclose(height, HEIGHT, atol=1e-4)


def test_points(masked, glass):
    """On the opaque half of the sheet only; above it, where the eyes below look through the transparent half."""
    for renderer in (masked, glass):
        points = sample_points(renderer.scene, 4000, 0)
        names = np.array(list(renderer.scene.shapes))[points["shape"]]
        x, y, _ = points["position"].T
        sheet = names == "sheet_0"
        if renderer is glass:
            assert (y < HEIGHT + 1e-4).all() and (x[sheet] < 0).any()
            continue
        assert sheet.sum() > 100 and (x[sheet] > 0).all()
        assert np.allclose(points["albedo"][sheet], COLOUR, atol=1e-5)
        above = y > HEIGHT + 0.01
        # All eyes are at x > 0.3, so what they see through the other half lies further that way.
        assert above.sum() > 100 and (x[above] < 0).all()
