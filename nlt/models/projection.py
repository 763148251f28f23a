"""The 3D-to-2D projection, Eq. (1): the mean of the features of all visible points that fall into a pixel."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor


def _transform(matrix: Tensor, points: Tensor) -> Tensor:
    """Matrices (B, 3, 3) times points (B, N, 3)."""
    # Not a matmul: that may run in bfloat16 or TF32, which moves points by whole pixels.
    return (matrix[:, None] * points[:, :, None]).sum(-1)


def visible_pixels(
    positions: Tensor,
    valid: Tensor,
    camera_matrix: Tensor,
    world_to_view: Tensor,
    depth: Tensor,
    epsilon: float = 1e-3,
) -> Tensor:
    """The pixel each point is seen in.

    `positions` (B, N, 3) in metres, world; `valid` (B, N) bool; `camera_matrix` (B, 3, 3) in pixels;
    `world_to_view` (B, 4, 4); `depth` (B, 1, H, W) in metres along z, 0 where nothing was hit.

    Returns (B, N) int64: row * W + column of floor(K T p), or H * W for a point that is not valid, not in
    front of the camera, outside the image, or occluded. A point at depth z is occluded where
    z > (1 + epsilon) D: the paper's tolerance, relative to the depth D there. D is interpolated to where
    exactly the point falls, bilinearly in 1/D, which is linear in screen space on a plane: the nearest
    pixel's depth would drop most points of a surface seen at a grazing angle.
    """
    height, width = depth.shape[-2:]
    view = _transform(world_to_view[:, :3, :3], positions) + world_to_view[:, None, :3, 3]
    z = view[..., 2]
    in_front = z > 0
    xy = _transform(camera_matrix, view)[..., :2] / torch.where(in_front, z, 1)[..., None]
    x, y = xy.unbind(-1)
    inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)

    inverse_depth = torch.where(depth > 0, 1 / depth, 0)  # no hit: infinitely far
    size = xy.new_tensor([width, height])
    interpolated = F.grid_sample(
        inverse_depth, (2 * xy / size - 1)[:, None], padding_mode="border", align_corners=False
    )[:, 0, 0]
    occluded = z * interpolated > 1 + epsilon

    kept = valid & in_front & inside & ~occluded
    column, row = torch.where(kept[..., None], xy, 0).long().unbind(-1)
    return torch.where(kept, row * width + column, height * width)


def average(features: Tensor, pixels: Tensor, height: int, width: int) -> Tensor:
    """Mean of features (B, N, C) by pixels (B, N), as from `visible_pixels`: (B, C, H, W), 0 where none."""
    batch, _, channels = features.shape
    rows = height * width + 1  # the last collects the points that are dropped
    # bfloat16 would stop counting at 256
    features = features.to(torch.promote_types(features.dtype, torch.float32))
    index = (pixels + rows * torch.arange(batch, device=pixels.device)[:, None]).flatten()
    total = features.new_zeros(batch * rows, channels).index_add_(0, index, features.flatten(0, 1))
    count = features.new_zeros(batch * rows).index_add_(0, index, features.new_ones(index.shape))
    mean = (total / count.clamp(min=1)[:, None]).view(batch, rows, channels)[:, :-1]
    return mean.view(batch, height, width, channels).permute(0, 3, 1, 2)


def project(
    features: Tensor,
    positions: Tensor,
    valid: Tensor,
    camera_matrix: Tensor,
    world_to_view: Tensor,
    depth: Tensor,
    epsilon: float = 1e-3,
) -> Tensor:
    """Eq. (1): features (B, N, C) of points to a feature map (B, C, H, W), differentiable in the features.

    The other arguments are those of `visible_pixels`.
    """
    pixels = visible_pixels(positions, valid, camera_matrix, world_to_view, depth, epsilon)
    return average(features, pixels, *depth.shape[-2:])
