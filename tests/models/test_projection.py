"""The projection against a float64 loop over points, and its occlusion test on a plane."""

import math

import numpy as np
import pytest
import torch
from costs import plain

from nlt.models.projection import average_sparsely, project, visible_pixels

H, W = 12, 16


def camera(batch):
    """Off-centre intrinsics and random rotations, float64."""
    matrix = torch.tensor([[14.0, 0, 7.3], [0, 13.0, 6.1], [0, 0, 1]], dtype=torch.float64)
    view = torch.eye(4, dtype=torch.float64).repeat(batch, 1, 1)
    rotation = torch.linalg.qr(torch.randn(batch, 3, 3, dtype=torch.float64))[0]
    view[:, :3, :3] = rotation * torch.linalg.det(rotation).sign()[:, None, None]
    view[:, :3, 3] = torch.randn(batch, 3, dtype=torch.float64)
    return matrix.repeat(batch, 1, 1), view


def scene(batch=2, points=2000, channels=5):
    """Random points all around the camera, some not valid, and a depth map with sky, its normals random."""
    torch.manual_seed(0)
    matrix, view = camera(batch)
    depth = 1 + 3 * torch.rand(batch, 1, H, W, dtype=torch.float64)
    depth[torch.rand(depth.shape) < 0.2] = 0
    return (
        torch.randn(batch, points, channels, dtype=torch.float64),
        2 * torch.randn(batch, points, 3, dtype=torch.float64),
        torch.rand(batch, points) < 0.8,
        matrix,
        view,
        depth,
        torch.nn.functional.normalize(torch.randn(batch, 3, H, W, dtype=torch.float64), dim=1),
    )


def occluded_share(depth, normal, matrix, view, x, y, z, epsilon):
    """Return the bilinear weight of the four nearest pixels whose plane lies before z; the border is repeated."""
    i, j = math.floor(x - 0.5), math.floor(y - 0.5)
    total = 0.0
    for di, dj in ((0, 0), (1, 0), (0, 1), (1, 1)):
        weight = (1 - abs(x - 0.5 - i - di)) * (1 - abs(y - 0.5 - j - dj))
        column, row = min(max(i + di, 0), W - 1), min(max(j + dj, 0), H - 1)
        # The rays through the centre and through (x, y), both of depth 1; where the second meets the plane.
        centre, ray = (np.linalg.inv(matrix) @ [*at, 1] for at in ((column + 0.5, row + 0.5), (x, y)))
        n = view[:3, :3] @ normal[:, row, column]
        met = n @ (depth[row, column] * centre) / (n @ ray)
        total += weight * (depth[row, column] > 0 and met > 0 and z > (1 + epsilon) * met)
    return total


def brute_force(features, positions, valid, matrix, view, depth, normal, epsilon=1e-3):
    batch, points, channels = features.shape
    total, count = np.zeros((batch, channels, H, W)), np.zeros((batch, 1, H, W))
    for b in range(batch):
        for n in range(points):
            p = view[b, :3, :3] @ positions[b, n] + view[b, :3, 3]
            if not valid[b, n] or p[2] <= 0:
                continue
            x, y = ((matrix[b] @ p) / p[2])[:2]
            if not (0 <= x < W and 0 <= y < H):
                continue
            if occluded_share(depth[b, 0], normal[b], matrix[b], view[b], x, y, p[2], epsilon) >= 0.5:
                continue
            total[b, :, math.floor(y), math.floor(x)] += features[b, n]
            count[b, 0, math.floor(y), math.floor(x)] += 1
    return total / np.maximum(count, 1), count


@pytest.mark.parametrize("project", [project, plain.project], ids=["usual", "plain"])
def test_equals_the_loop_over_points(project):
    arguments = scene()
    expected, count = brute_force(*(a.numpy() for a in arguments))
    result = project(*arguments)
    assert result.dtype == torch.float64
    assert count.max() > 1 and (count == 0).any()
    np.testing.assert_allclose(result.numpy(), expected, rtol=0, atol=1e-12)
    assert (result.numpy()[np.broadcast_to(count == 0, expected.shape)] == 0).all()


def test_few_points_are_seen_where_they_are_among_many():
    """Their planes are found one by one, not for the whole image."""
    _, positions, valid, *view = scene()
    together = visible_pixels(positions, valid, *view)
    few = zip(positions.split(H * W // 5, dim=1), valid.split(H * W // 5, dim=1), strict=True)
    assert torch.equal(torch.cat([visible_pixels(*some, *view) for some in few], dim=1), together)
    assert (together < H * W).any()


def test_one_point_lands_in_the_floor_of_its_projection():
    eye = torch.eye(4, dtype=torch.float64)[None]
    matrix = torch.tensor([[[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]], dtype=torch.float64)
    positions = torch.tensor([[[0.3999, 0.2001, 1.0]]], dtype=torch.float64)  # x 3.999, y 2.001
    result = project(
        torch.ones(1, 1, 1).double(),
        positions,
        torch.ones(1, 1).bool(),
        matrix,
        eye,
        torch.zeros(1, 1, H, W).double(),
        torch.zeros(1, 3, H, W).double(),
    )
    assert result.nonzero().tolist() == [[0, 0, 2, 3]]


def test_gradient_in_the_features():
    features, *rest = scene(batch=1, points=120, channels=1)
    assert (project(features, *rest) != 0).any()
    assert torch.autograd.gradcheck(lambda f: project(f, *rest), features.requires_grad_())


def test_permuting_the_points_changes_nothing():
    features, positions, valid, *rest = scene()
    order = torch.randperm(features.shape[1])
    torch.testing.assert_close(
        project(features[:, order], positions[:, order], valid[:, order], *rest),
        project(features, positions, valid, *rest),
    )


def test_behind_and_at_the_camera():
    """Also on the camera's plane, where x/z does not exist: dropped, and no NaN, not even in the gradient."""
    features, _, _, matrix, _, depth, normal = scene(batch=1, points=4)
    view = torch.eye(4, dtype=torch.float64)[None]
    positions = torch.tensor([[[0.0, 0, -1], [0, 0, 0], [1, 1, 0], [0, 0, 1e-310]]], dtype=torch.float64)
    valid = torch.tensor([[True, True, True, False]])
    features.requires_grad_()
    result = project(features, positions, valid, matrix, view, depth, normal)
    result.sum().backward()
    assert (result == 0).all() and (features.grad == 0).all()


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_plane_at_a_grazing_angle(dtype):
    """A floor 1 m below the camera, seen to 20 m: all its points stay, all those 1 % behind go."""
    size, focal = 64, 40.0
    torch.manual_seed(0)
    centre = torch.arange(size, dtype=torch.float64) + 0.5
    slope = (centre - size / 2) / focal  # y/z of the pixel rows
    depth = torch.where(slope > 0, 1 / slope, 0).view(1, 1, size, 1).expand(1, 1, size, size)
    normal = torch.tensor([0.0, -1, 0], dtype=torch.float64).view(1, 3, 1, 1).expand(1, 3, size, size)
    # Up to the last row whose two neighbouring pixel centres both see the floor.
    z = 1 / torch.empty(5000, dtype=torch.float64).uniform_(0.5 / focal, 0.9 * slope[-1])
    x = torch.empty(5000, dtype=torch.float64).uniform_(-0.7, 0.7) * z
    positions = torch.stack([x, torch.ones_like(z), z], dim=-1)[None]
    matrix = torch.tensor([[[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]]])
    valid = torch.ones(1, len(z), dtype=torch.bool)

    def kept(points):
        arguments = (x.to(dtype) for x in (matrix, torch.eye(4)[None], depth, normal))
        return (visible_pixels(points.to(dtype), valid, *arguments) < size * size).double().mean()

    assert kept(positions) >= 0.999
    assert kept(positions * 1.01) == 0  # further along their own rays
    nearest = depth[0, 0, (positions[0, :, 1] / z * focal + size / 2).long(), 0]
    assert (z <= 1.001 * nearest).double().mean() < 0.7  # what the nearest pixel's depth would keep


def test_nothing_is_hit():
    """Depth 0 is infinitely far: nothing is occluded."""
    features, positions, valid, matrix, view, depth, normal = scene()
    everywhere = project(features, positions, valid, matrix, view, torch.zeros_like(depth), normal)
    far = project(
        features,
        positions,
        valid,
        matrix,
        view,
        torch.full_like(depth, 1e9),
        view[:, 2, :3, None, None].expand_as(normal),
    )
    torch.testing.assert_close(everywhere, far)
    assert (everywhere != 0).any()


def test_bfloat16_features_count_beyond_256():
    """A mean of equal features is that feature, however many there are."""
    eye = torch.eye(4)[None]
    scene = (
        torch.ones(1, 1000, 1, dtype=torch.bfloat16), torch.tensor([[[0.0, 0, 1]]]).expand(1, 1000, 3),
        torch.ones(1, 1000, dtype=torch.bool), torch.eye(3)[None], eye, torch.zeros(1, 1, H, W),
        torch.zeros(1, 3, H, W),
    )  # fmt: skip
    assert project(*scene)[0, 0, 0, 0] == 1
    sparse = average_sparsely(scene[0], visible_pixels(*scene[1:]), H, W)
    assert [part.tolist() for part in sparse] == [[[1.0]], [0]]
