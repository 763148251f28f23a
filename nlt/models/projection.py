"""The 3D-to-2D projection, Eq. (1): the mean of the features of all visible points that fall into a pixel."""

from typing import NamedTuple

import torch
from torch import Tensor


class SparseMap(NamedTuple):
    """A feature map (B, C, H, W) that is zero except at `pixels`, where the `rows` (M, C) are added up.

    `pixels` (M,) int64: (image * H + row) * W + column.
    """

    rows: Tensor
    pixels: Tensor


def _transform(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Multiply vectors (B, 3, N) by matrices (B, 3, 3)."""
    # Not a matmul: that may run in bfloat16 or TF32, which moves points by whole pixels.
    x, y, z = (matrix[:, :, k, None] * vectors[:, None, k] for k in range(3))
    return x + y + z


def visible_pixels(
    positions: Tensor,
    valid: Tensor,
    camera_matrix: Tensor,
    world_to_view: Tensor,
    depth: Tensor,
    normal: Tensor,
    epsilon: float = 1e-3,
) -> Tensor:
    """Return the pixel in which each point is visible.

    Args:
        positions: (B, N, 3) in metres, world space.
        valid: (B, N) bool.
        camera_matrix: (B, 3, 3) in pixels.
        world_to_view: (B, 4, 4).
        depth: (B, 1, H, W) in metres along z, 0 where no surface is hit.
        normal: (B, 3, H, W), world space.
        epsilon: the paper's tolerance of the depth.

    Returns:
        (B, N) int64: row * W + column of floor(K T p), or H * W for a point that is not valid, not in front of the
        camera, outside the image, or occluded.

    A pixel occludes points behind the plane through the surface at its centre: at more than 1 + epsilon times the
    plane's depth on the point's ray. A point is occluded if at least half of the four nearest pixels, weighted
    bilinearly, occlude it. Depths without planes would drop most points of a slanted surface. The pixels vote because
    a depth interpolated between pixels of different surfaces belongs to neither.
    """
    height, width = depth.shape[-2:]
    view = _transform(world_to_view[:, :3, :3], positions.mT) + world_to_view[:, :3, 3:]
    homogeneous = _transform(camera_matrix, view)
    in_front = view[:, 2] > 0
    x, y = (homogeneous[:, :2] / torch.where(in_front, view[:, 2], 1)[:, None]).unbind(1)
    candidate = valid & in_front & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    image, point = candidate.nonzero(as_tuple=True)
    x, y, homogeneous = x[image, point], y[image, point], homogeneous[image, :, point]

    # The plane of a pixel is n . (v - x) = 0 in view space, where v = K^-1 (K T p) and x = depth K^-1 centre.
    to_pixels = _transform(torch.linalg.inv_ex(camera_matrix)[0].mT, world_to_view[:, :3, :3])
    few_points = 4 * positions.shape[1] < height * width  # then only their planes are computed
    if not few_points:
        column, row = (torch.arange(size, device=depth.device) for size in (width, height))
        everywhere = (column.repeat(height), row.repeat_interleave(width))
        planes = _tangent_planes(to_pixels, depth.flatten(2), normal.flatten(2), *everywhere).mT.flatten(0, 1)
    unoccluded = torch.zeros_like(x)
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    for i, j in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        weight = (1 - (x - 0.5 - i).abs()) * (1 - (y - 0.5 - j).abs())
        column, row = i.long().clamp(0, width - 1), j.long().clamp(0, height - 1)
        if few_points:
            depths, normals = depth[image, :, row, column, None], normal[image, :, row, column, None]
            plane = _tangent_planes(to_pixels[image], depths, normals, column[:, None], row[:, None])[..., 0]
        else:
            plane = planes[(image * height + row) * width + column]
        relative_depth = (plane * homogeneous).sum(1)
        unoccluded += weight * (relative_depth <= 1 + epsilon)
    pixels = torch.full_like(candidate, height * width, dtype=torch.int64)
    pixels[image, point] = torch.where(unoccluded > 0.5, y.long() * width + x.long(), height * width)
    return pixels


def _tangent_planes(to_pixels: Tensor, depth: Tensor, normal: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """Return w (B, 3, K) of K pixels: w . K T p is p's depth over that of the pixel's plane along p's ray.

    to_pixels (B, 3, 3), depth (B, 1, K), normal (B, 3, K); column and row (K,) or (B, K).
    """
    m = _transform(to_pixels, normal.to(depth.dtype))
    along = m[:, 0] * (column + 0.5) + m[:, 1] * (row + 0.5) + m[:, 2]
    return torch.where(depth > 0, m / (depth * along[:, None]), 0)  # no hit is infinitely far


def visible_rows(pixels: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """Return which points are visible, (B, N) bool, and their pixels (M,): (image * height + row) * width + column.

    `pixels` (B, N) are those of `visible_pixels`.
    """
    visible = pixels < height * width
    first = height * width * torch.arange(len(pixels), device=pixels.device)[:, None]
    return visible, (pixels + first)[visible]


def total(features: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Return the sum (B, C, H, W) of features (B, N, C) in each pixel; `pixels` (B, N) as from `visible_pixels`."""
    batch, _, channels = features.shape
    rows = height * width + 1  # the last one collects the points that are not visible
    # bfloat16 would stop counting at 256
    features = features.to(torch.promote_types(features.dtype, torch.float32))
    index = (pixels + rows * torch.arange(batch, device=pixels.device)[:, None]).flatten()
    sums = features.new_zeros(batch * rows, channels).index_add_(0, index, features.flatten(0, 1))
    kept = sums.view(batch, rows, channels)[:, :-1]
    return kept.view(batch, height, width, channels).permute(0, 3, 1, 2)


def average(features: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Return the mean (B, C, H, W) of features (B, N, C) in each pixel, 0 where there is none; see `total`."""
    count = total(torch.ones_like(features[..., :1], dtype=torch.float32), pixels, height, width)
    return total(features, pixels, height, width).div_(count.clamp(min=1))


def average_rows(rows: Tensor, pixels: Tensor, batch: int, height: int, width: int) -> Tensor:
    """Return the mean (batch, C, height, width) of rows (M, C) in each pixel.

    `pixels` (M,): (image * height + row) * width + column.
    """
    rows = rows.to(torch.promote_types(rows.dtype, torch.float32))  # as in `total`
    sums = rows.new_zeros(batch * height * width, rows.shape[1]).index_add_(0, pixels, rows)
    count = torch.bincount(pixels, minlength=len(sums)).clamp(min=1)
    return (sums / count[:, None]).view(batch, height, width, -1).permute(0, 3, 1, 2)


def average_sparsely(features: Tensor, pixels: Tensor, height: int, width: int) -> SparseMap:
    """Return the same means as `average`, with a row for each pixel in which a point is visible."""
    visible, at = visible_rows(pixels, height, width)
    seen, row, count = at.unique(return_inverse=True, return_counts=True)
    features = features[visible].to(torch.promote_types(features.dtype, torch.float32))  # as in `total`
    sums = features.new_zeros(len(seen), features.shape[1]).index_add_(0, row, features)
    return SparseMap(sums / count[:, None], seen)


def project(
    features: Tensor,
    positions: Tensor,
    valid: Tensor,
    camera_matrix: Tensor,
    world_to_view: Tensor,
    depth: Tensor,
    normal: Tensor,
    epsilon: float = 1e-3,
) -> Tensor:
    """Project features (B, N, C) of points to a map (B, C, H, W) by Eq. (1), differentiable in the features.

    The other arguments are those of `visible_pixels`.
    """
    pixels = visible_pixels(positions, valid, camera_matrix, world_to_view, depth, normal, epsilon)
    height, width = depth.shape[-2:]
    if not features.requires_grad:  # an exported program has no shapes that depend on the data
        return average(features, pixels, height, width)
    visible, at = visible_rows(pixels, height, width)
    return average_rows(features[visible], at, len(pixels), height, width)
