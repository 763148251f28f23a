"""The 3D-to-2D projection, Eq. (1): the mean of the features of all visible points that fall into a pixel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class SparseMap(NamedTuple):
    """A feature map (B, C, H, W) that is zero but where `rows` (M, C) are added up at their `pixels`.

    `pixels` (M,) int64: (image * H + row) * W + column.
    """

    rows: Tensor
    pixels: Tensor


def _transform(matrix: Tensor, vectors: Tensor) -> Tensor:
    """Matrices (B, 3, 3) times vectors (B, 3, N)."""
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
    """The pixel each point is seen in.

    `positions` (B, N, 3) in metres, world; `valid` (B, N) bool; `camera_matrix` (B, 3, 3) in pixels;
    `world_to_view` (B, 4, 4); `depth` (B, 1, H, W) in metres along z, 0 where nothing was hit; `normal`
    (B, 3, H, W), world.

    Returns (B, N) int64: row * W + column of floor(K T p), or H * W for a point that is not valid, not in
    front of the camera, outside the image, or occluded. A pixel occludes what lies behind the plane through
    the surface at its centre: at more than 1 + epsilon times the plane's depth there, the paper's tolerance.
    A point is occluded where at least half of the four nearest pixels, weighted bilinearly, occlude it.
    Planes, for depths alone would drop most points of a slanted surface; a vote, for between two pixels that
    see different surfaces no depth in between is either's.
    """
    height, width = depth.shape[-2:]
    view = _transform(world_to_view[:, :3, :3], positions.mT) + world_to_view[:, :3, 3:]
    homogeneous = _transform(camera_matrix, view)
    in_front = view[:, 2] > 0
    x, y = (homogeneous[:, :2] / torch.where(in_front, view[:, 2], 1)[:, None]).unbind(1)
    candidate = valid & in_front & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = torch.where(candidate, x, 0), torch.where(candidate, y, 0)

    # The plane of a pixel is n . (v - x) = 0 in view space, where v = K^-1 (K T p) and x = depth K^-1 centre.
    to_pixels = _transform(torch.linalg.inv_ex(camera_matrix)[0].mT, world_to_view[:, :3, :3])
    few = 4 * x.shape[1] < height * width  # then only the planes that are looked at
    if not few:
        column, row = (torch.arange(size, device=depth.device) for size in (width, height))
        everywhere = (column.repeat(height), row.repeat_interleave(width))
        planes = _tangent_planes(to_pixels, depth.flatten(2), normal.flatten(2), *everywhere).mT.flatten(0, 1)
    first = height * width * torch.arange(len(depth), device=depth.device)[:, None]
    unoccluded = torch.zeros_like(x)
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    for i, j in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        weight = (1 - (x - 0.5 - i).abs()) * (1 - (y - 0.5 - j).abs())
        column, row = i.long().clamp(0, width - 1), j.long().clamp(0, height - 1)
        at = row * width + column
        if few:
            plane = _tangent_planes(to_pixels, _at(depth, at), _at(normal, at), column, row)
        else:
            plane = planes[first + at].mT
        relative_depth = (plane * homogeneous).sum(1)
        unoccluded += weight * (relative_depth <= 1 + epsilon)
    return torch.where(candidate & (unoccluded > 0.5), y.long() * width + x.long(), height * width)


def _at(image: Tensor, pixels: Tensor) -> Tensor:
    """Of an image (B, C, H, W) its pixels (B, K), row * W + column: (B, C, K)."""
    return image.flatten(2).gather(2, pixels[:, None].expand(-1, image.shape[1], -1))


def _tangent_planes(to_pixels: Tensor, depth: Tensor, normal: Tensor, column: Tensor, row: Tensor) -> Tensor:
    """(B, 3, K): w of each of K pixels, such that w . K T p is p's depth over that of the pixel's plane on p's ray."""
    m = _transform(to_pixels, normal.to(depth.dtype))
    along = m[:, 0] * (column + 0.5) + m[:, 1] * (row + 0.5) + m[:, 2]
    return torch.where(depth > 0, m / (depth * along[:, None]), 0)  # no hit: infinitely far


def total(features: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Sum of features (B, N, C) by pixels (B, N), as from `visible_pixels`: (B, C, H, W)."""
    batch, _, channels = features.shape
    rows = height * width + 1  # the last collects the points that are dropped
    # bfloat16 would stop counting at 256
    features = features.to(torch.promote_types(features.dtype, torch.float32))
    index = (pixels + rows * torch.arange(batch, device=pixels.device)[:, None]).flatten()
    sums = features.new_zeros(batch * rows, channels).index_add_(0, index, features.flatten(0, 1))
    kept = sums.view(batch, rows, channels)[:, :-1]
    return kept.view(batch, height, width, channels).permute(0, 3, 1, 2)


def average(features: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Mean of features (B, N, C) by pixels (B, N), as from `visible_pixels`: (B, C, H, W), 0 where none."""
    count = total(torch.ones_like(features[..., :1], dtype=torch.float32), pixels, height, width)
    return total(features, pixels, height, width).div_(count.clamp(min=1))


def average_rows(rows: Tensor, pixels: Tensor, batch: int, height: int, width: int) -> Tensor:
    """Mean of rows (M, C) by pixels (M,), (image * height + row) * width + column: (batch, C, height, width)."""
    rows = rows.to(torch.promote_types(rows.dtype, torch.float32))  # as in `total`
    sums = rows.new_zeros(batch * height * width, rows.shape[1]).index_add_(0, pixels, rows)
    count = torch.bincount(pixels, minlength=len(sums)).clamp(min=1)
    return (sums / count[:, None]).view(batch, height, width, -1).permute(0, 3, 1, 2)


def average_sparsely(features: Tensor, pixels: Tensor, height: int, width: int) -> SparseMap:
    """As `average`: a row for each pixel in which a point is visible."""
    visible = pixels < height * width
    at = (pixels + height * width * torch.arange(len(pixels), device=pixels.device)[:, None])[visible]
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
    """Eq. (1): features (B, N, C) of points to a feature map (B, C, H, W), differentiable in the features.

    The other arguments are those of `visible_pixels`.
    """
    pixels = visible_pixels(positions, valid, camera_matrix, world_to_view, depth, normal, epsilon)
    return average(features, pixels, *depth.shape[-2:])
