"""What no reference is needed for: what must not change a prediction of any trained method, with random weights.

What the architecture cannot keep (the world's frame and handedness) is measured by `nlt stress`, suite "frame".
"""

from __future__ import annotations

import pytest
import torch
from synthetic import PHOTONS, POINTS, SCENES, synthetic_batch
from test_methods import CONFIGS, SIZE, build

from nlt.models.module import PROJECTION
from nlt.models.nlt import NeuralLightTransport
from nlt.models.projection import visible_pixels
from nlt.models.transport import PointEmbedding
from nlt.paths import find_config

EXTRA = 32  # points and photons that are added


@pytest.fixture(params=CONFIGS, ids=lambda path: path.stem)
def method(request):
    return build(request.param).eval()


def rows_of(batch, prefix, change):
    """The batch with every field of its points or photons changed alike."""
    return batch | {name: change(value) for name, value in batch.items() if name.startswith(prefix)}


def with_embedding(method, change):
    """What is learned of a point goes with it: (scenes, points, channels) changed in place."""
    for module in method.modules():
        if isinstance(module, PointEmbedding):
            table = change(module.table.weight.detach().view(SCENES, module.num_points, -1))
            module.num_points = table.shape[1]
            module.table = torch.nn.Embedding.from_pretrained(table.flatten(0, 1))
    return method


def features(method, batch):
    return method.features(batch, method.transport(batch))


@torch.no_grad()
def unchanged(method, before, after):
    """To rounding: sums have another order."""
    torch.testing.assert_close(after, before, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("prefix", "count"), [("point_", POINTS), ("photon_", PHOTONS)])
@torch.no_grad()
def test_order_of_points_and_photons(method, prefix, count):
    batch, order = synthetic_batch(), torch.randperm(count, generator=torch.Generator().manual_seed(1))
    expected = method(batch)
    if prefix == "point_":
        with_embedding(method, lambda table: table[:, order])
    unchanged(method, expected, method(rows_of(batch, prefix, lambda value: value[:, order])))


@pytest.mark.parametrize("prefix", ["point_", "photon_"])
@torch.no_grad()
def test_padding_with_what_is_not_there(method, prefix):
    """Invisible points anywhere, invalid photons anywhere: whatever they hold is not looked at."""
    batch, more = synthetic_batch(), synthetic_batch(seed=1)
    expected = method(batch)
    absent = {"point_": "point_visible", "photon_": "photon_valid"}[prefix]
    more[absent] = torch.zeros_like(more[absent])
    padded = batch | {
        name: torch.cat([batch[name], 100 * value[:, :EXTRA] if value.is_floating_point() else value[:, :EXTRA]], dim=1)
        for name, value in more.items()
        if name.startswith(prefix)
    }
    if prefix == "point_":
        with_embedding(method, lambda table: torch.cat([table, 100 * torch.randn(SCENES, EXTRA, table.shape[2])], 1))
    unchanged(method, expected, method(padded))


@torch.no_grad()
def test_a_removed_object_leaves_no_trace(method):
    """Points of an object that is not present are as good as deleted, in the projected features and the image."""
    batch, removed = synthetic_batch(), torch.arange(POINTS) % 3 == 0
    batch["point_visible"][:, removed] = False
    expected_features, expected = features(method, batch), method(batch)
    with_embedding(method, lambda table: table[:, ~removed])
    without = rows_of(batch, "point_", lambda value: value[:, ~removed])
    unchanged(method, expected_features, features(method, without))
    unchanged(method, expected, method(without))


@pytest.mark.parametrize("photons", [PHOTONS, 0])
@torch.no_grad()
def test_without_light(method, photons):
    """No emission, no photon that arrives or none at all, no traced radiance, nothing present: finite."""
    batch = rows_of(synthetic_batch(), "photon_", lambda value: torch.zeros_like(value[:, :photons]))
    for name in ("point_emission", "point_visible", "noisy_input"):
        batch[name] = torch.zeros_like(batch[name])
    assert method(batch).isfinite().all()


# --- the world's frame: in float64, in which no point changes its pixel by rounding ---


def double(batch):
    return {name: value.double() if value.is_floating_point() else value for name, value in batch.items()}


def moved(batch, rotation, translation):
    """Scene and camera under one rigid motion x -> R x + t: what the camera sees stays as it is."""
    inverse = torch.eye(4).double()
    inverse[:3, :3], inverse[:3, 3] = rotation.T, -rotation.T @ translation
    result = batch | {"world_to_view": batch["world_to_view"] @ inverse}
    for name in ("point_position", "photon_hit", "photon_origin"):
        result[name] = batch[name] @ rotation.T + translation
    result["photon_direction"] = batch["photon_direction"] @ rotation.T
    for name in ("normal", "view_direction"):
        result[name] = torch.einsum("ij,bjhw->bihw", rotation, batch[name])
    return result


def mirrored(batch):
    """The camera's image the other way round."""
    width = batch["depth"].shape[-1]
    flip = torch.tensor([[-1, 0, width], [0, 1, 0], [0, 0, 1]]).double()
    images = {name: value.flip(-1) for name, value in batch.items() if value.shape[-2:] == batch["depth"].shape[-2:]}
    return batch | images | {"camera_matrix": flip @ batch["camera_matrix"]}


def reads_positions(method):
    """It is fed with absolute positions or directions, so a prediction depends on the world's frame."""
    transports = isinstance(method, NeuralLightTransport) and "world_to_view" in method.inputs
    return transports or method.hparams.get("position", False)


ROTATION, _ = torch.linalg.qr(torch.randn(3, 3, generator=torch.Generator().manual_seed(3)).double())
ROTATION *= torch.linalg.det(ROTATION)
SHIFT = torch.tensor([5.0, -3.0, 11.0]).double()


@pytest.mark.parametrize(("positions", "valid"), [("point_position", "point_visible"), ("photon_hit", "photon_valid")])
def test_pixels_when_scene_and_camera_move_together(positions, valid):
    batch = double(synthetic_batch(size=13))
    pixels = lambda batch: visible_pixels(batch[positions], batch[valid], **{name: batch[name] for name in PROJECTION})
    expected = pixels(batch)
    seen = expected < 13 * 13
    assert seen.any(1).all() and not seen.all(1).any()
    assert torch.equal(pixels(moved(batch, ROTATION, SHIFT)), expected)
    row, column = expected // 13, expected % 13
    assert torch.equal(pixels(mirrored(batch)), torch.where(seen, row * 13 + 12 - column, expected))


@torch.no_grad()
def test_a_scene_elsewhere(method):
    """Scene and camera shifted together: the same image, unless the method is told where in the world a point is."""
    batch, method = double(synthetic_batch()), method.double()
    elsewhere = moved(batch, torch.eye(3).double(), SHIFT)
    if reads_positions(method):
        assert not torch.allclose(method(elsewhere), method(batch), rtol=1e-3)
    else:
        torch.testing.assert_close(method(elsewhere), method(batch))


@torch.no_grad()
def test_a_mirrored_camera(method):
    """What feeds the U-Net is mirrored, the U-Net itself need not be; which pixels are traced is not the camera's."""
    if "path_tracing" in method.stages:
        method.hparams.update(one_in=1, gap=0)
    batch, method = double(synthetic_batch(size=13)), method.double()
    torch.testing.assert_close(features(method, mirrored(batch)), features(method, batch).flip(-1))


@pytest.mark.parametrize("direct_light", [False, True])
@pytest.mark.parametrize("name", ["guided_1spp", "guided_1spp_relative"])
def test_colour_and_brightness_of_the_light(name, direct_light):
    """The image of a relative denoiser is as linear in each channel of the light as light transport is; no other's."""
    method = build(
        find_config("model", name), more={"output": "demodulated", "direct_light": direct_light} | SIZE
    ).eval()
    batch, light = synthetic_batch(), ("noisy", "emission", "direct")
    factor = torch.tensor([0.1, 3.0, 40.0])[:, None, None]
    brighter = batch | {field: batch[field] * factor for field in light}
    expected = method(batch) * factor
    assert torch.allclose(method(brighter), expected, rtol=1e-3, atol=1e-4) == (name == "guided_1spp_relative")
    black = method(batch | {field: torch.zeros_like(batch[field]) for field in light})
    assert black.isfinite().all()
