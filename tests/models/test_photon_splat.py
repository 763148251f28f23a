"""The density estimate of irradiance: on a plane of known irradiance, against loops in float64, and without photons."""

import math

import numpy as np
import pytest
import torch
from scipy import stats
from synthetic import synthetic_batch

from nlt.baselines.photon_splat import PhotonSplat, seen_area

SIZE, FOCAL = 24, 20.0


def plane_batch(photons, sets=1):
    """A camera looks down at an endless floor, 1.5 m below it, of irradiance (1, 2, 3) W/m²; float64.

    The photons, in independent `sets`, fall on 8 x 8 m of it, in which every pixel lies.
    """
    rng = np.random.default_rng(0)
    tilt = math.radians(50)
    rotation = np.array([[1, 0, 0], [0, math.cos(tilt), -math.sin(tilt)], [0, math.sin(tilt), math.cos(tilt)]])
    matrix = np.array([[FOCAL, 0, SIZE / 2], [0, 1.2 * FOCAL, SIZE / 2], [0, 0, 1]])
    centre = np.stack(np.meshgrid(np.arange(SIZE) + 0.5, np.arange(SIZE) + 0.5), -1)
    rays = np.concatenate([centre, np.ones((SIZE, SIZE, 1))], -1) @ np.linalg.inv(matrix).T  # of depth 1, y down
    depth = 1.5 / (rays @ rotation)[..., 1]  # the camera is the origin, the floor at y = 1.5
    assert (depth > 0).all()
    view = np.eye(4)
    view[:3, :3] = rotation
    hit = rng.uniform([-4, 1.5, -0.5], [4, 1.5, 7.5], (sets, photons, 3))
    direction = np.moveaxis(rays / np.linalg.norm(rays, axis=-1, keepdims=True) @ rotation, -1, 0)
    normal = np.broadcast_to(np.array([0.0, -1, 0])[:, None, None], (3, SIZE, SIZE))
    arrays = {
        "depth": depth[None], "normal": normal, "view_direction": direction, "albedo": 0 * normal,
        "camera_matrix": matrix, "world_to_view": view,
        "photon_flux": np.tile([1.0, 2, 3], (photons, 1)) * 64 / photons, "photon_valid": np.ones(photons, bool),
    }  # fmt: skip
    batch = {name: torch.from_numpy(np.array(a)).expand(sets, *a.shape).clone() for name, a in arrays.items()}
    return batch | {"photon_hit": torch.from_numpy(hit)}


def footprints(batch):
    """(H, W): the area of each pixel's quadrilateral on the floor, from where its corners' rays meet it."""
    matrix, rotation = batch["camera_matrix"][0].numpy(), batch["world_to_view"][0, :3, :3].numpy()
    corner = np.stack(np.meshgrid(np.arange(SIZE + 1), np.arange(SIZE + 1)), -1)
    rays = np.concatenate([corner, np.ones((SIZE + 1, SIZE + 1, 1))], -1) @ np.linalg.inv(matrix).T @ rotation
    met = rays[..., [0, 2]] * (1.5 / rays[..., 1:2])
    p, q = met[1:, 1:] - met[:-1, :-1], met[1:, :-1] - met[:-1, 1:]  # its diagonals
    return np.abs(p[..., 0] * q[..., 1] - p[..., 1] * q[..., 0]) / 2


def irradiance(batch, footprint=0):
    return PhotonSplat(width=2, depth=1, footprint=footprint).irradiance(batch)


def test_area_that_a_pixel_sees():
    batch = plane_batch(1)
    expected = footprints(batch)
    assert expected.max() > 4 * expected.min()
    np.testing.assert_allclose(seen_area(batch)[0, 0].numpy(), expected, rtol=0.01)


def test_unbiased_on_a_plane():
    """Over independent sets of photons, its mean is the plane's irradiance, near and far."""
    near = np.arange(SIZE) > SIZE / 2
    estimate = irradiance(plane_batch(1000, 60))
    for rows in (near, ~near):
        means = estimate[:, :, rows].mean((2, 3)).numpy()
        assert stats.ttest_1samp(means[:, 0], 1.0).pvalue > 1e-3
        np.testing.assert_allclose(means, means[:, :1] * [1.0, 2, 3], rtol=1e-9)


def test_a_footprint_trades_noise_for_bias():
    batch = plane_batch(4000, 20)
    pixel, wider = irradiance(batch)[:, 0], irradiance(batch, 4)[:, 0]
    assert (wider > 0).all() and (pixel == 0).double().mean() > 0.05
    assert wider.std() < pixel.std() / 2
    assert 0 < wider.mean() - 1 < 0.2


@pytest.mark.parametrize("footprint", [0, 1, 4, 1000])
def test_equals_the_loop_over_photons(footprint):
    """The flux of the photons in a pixel's footprint, whatever they carry, over its area."""
    batch = plane_batch(500)
    batch["photon_flux"] = torch.rand(1, 500, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    batch["photon_valid"] = batch["photon_flux"][..., 0] < 0.7
    batch["depth"][..., 5, 7] = 0  # no hit
    area = footprints(batch)
    area[5, 7] = 0
    flux_in, count_in = np.zeros((3, SIZE, SIZE)), np.zeros((SIZE, SIZE))
    matrix, rotation = batch["camera_matrix"][0].numpy(), batch["world_to_view"][0, :3, :3].numpy()
    names = ("photon_hit", "photon_flux", "photon_valid")
    for hit, flux, valid in zip(*(batch[name][0].numpy() for name in names), strict=True):
        x, y, w = matrix @ rotation @ hit
        if valid and w > 0 and 0 <= x / w < SIZE and 0 <= y / w < SIZE and area[int(y / w), int(x / w)]:
            flux_in[:, int(y / w), int(x / w)] += flux
            count_in[int(y / w), int(x / w)] += 1
    assert (count_in > 0).sum() > 30
    expected = np.zeros((3, SIZE, SIZE))
    for row, column in np.argwhere(area > 0):
        for radius in (0, 1, 2, 4, 8):
            box = np.s_[..., max(row - radius, 0) : row + radius + 1, max(column - radius, 0) : column + radius + 1]
            if count_in[box].sum() >= footprint:
                break
        expected[:, row, column] = flux_in[box].sum((1, 2)) / area[box].sum()
    np.testing.assert_allclose(irradiance(batch, footprint)[0].numpy(), expected, rtol=0.01)


def test_no_photons_and_no_surface_are_zeros():
    batch = synthetic_batch()
    assert irradiance(batch, 4).any()
    for name in ("photon_valid", "depth"):
        none = {**batch, name: torch.zeros_like(batch[name])}
        assert (irradiance(none) == 0).all() and (irradiance(none, 4) == 0).all()
