"""The plain path: a method with its own weights in a straightforward implementation, to measure speed-ups against.

Eager, float32 throughout, contiguous NCHW, a single pass, nothing cached between frames. It is slow on purpose:
optimizations of the usual path do not belong here.
"""

from __future__ import annotations

import copy
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlt.models.clouds import CloudMethod
from nlt.models.module import RenderingModule
from nlt.models.unet import UNet


def plain(method: RenderingModule) -> RenderingModule:
    """Return a copy of a method that computes the same image, up to rounding, by the plain path."""
    twin = copy.deepcopy(method).float().to(memory_format=torch.contiguous_format)  # type: ignore[call-overload]
    twin.unet = PlainUNet(twin.unet)
    if isinstance(twin, CloudMethod):
        twin.projection = project
    return twin


class PlainUNet(nn.Module):
    """The U-Net as in the supplementary's figure, block by block: (B, C, H, W) to (B, 3 or 6, H, W)."""

    def __init__(self, net: UNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, x: Tensor, sparse: object = ()) -> Tensor:
        """Run the U-Net without TF32; there are no sparse maps."""
        net = self.net
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            levels = [_block(net.down[0], net.conv_in(x.contiguous()))]
            for block in net.down[1:]:
                levels.append(_block(block, F.max_pool2d(levels[-1], 2, ceil_mode=True)))
            x = levels.pop()
            for block in net.up:
                skip = levels.pop()
                upsampled = F.interpolate(x, skip.shape[-2:], mode="bilinear", align_corners=False)
                x = _block(block, torch.cat([upsampled, skip], dim=1))
            return net.conv_out(F.relu(x))


def _block(block: Any, x: Tensor) -> Tensor:
    return block.shortcut(x) + block.conv_1(F.relu(block.conv_0(F.relu(x))))


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
    """Project features by Eq. (1), with the arguments and the result of `nlt.models.projection.project`."""
    height, width = depth.shape[-2:]
    rotation, translation = world_to_view[:, :3, :3], world_to_view[:, None, :3, 3]
    view = positions @ rotation.mT + translation
    homogeneous = view @ camera_matrix.mT
    z = view[..., 2]
    in_front = z > 0
    x, y = (homogeneous[..., :2] / torch.where(in_front, z, 1)[..., None]).unbind(-1)
    seen = valid & in_front & (x >= 0) & (x < width) & (y >= 0) & (y < height)
    x, y = torch.where(seen, x, 0), torch.where(seen, y, 0)

    # The bilinear weight of those of the four nearest pixels whose plane lies in front of the point.
    to_ray = torch.linalg.inv(camera_matrix).mT
    ray = torch.stack([x, y, torch.ones_like(x)], -1) @ to_ray  # at depth 1
    occluded = torch.zeros_like(x)
    left, top = (x - 0.5).floor(), (y - 0.5).floor()
    for column, row in ((left, top), (left + 1, top), (left, top + 1), (left + 1, top + 1)):
        weight = (1 - (x - 0.5 - column).abs()) * (1 - (y - 0.5 - row).abs())
        column, row = column.clamp(0, width - 1), row.clamp(0, height - 1)
        centre = torch.stack([column + 0.5, row + 0.5, torch.ones_like(x)], -1) @ to_ray
        at = (row * width + column).long()
        surface = _gather(depth, at)
        n = _gather(normal.to(depth.dtype), at) @ rotation.mT
        plane_depth = (n * centre * surface).sum(-1) / (n * ray).sum(-1)  # along the point's ray
        occluded += weight * ((surface[..., 0] > 0) & (plane_depth > 0) & (z > (1 + epsilon) * plane_depth))
    seen = seen & (occluded < 0.5)

    pixel = (y.long() * width + x.long())[:, None]
    summand = torch.where(seen[..., None], features, 0).mT
    shape = (len(features), features.shape[-1], height * width)
    total = features.new_zeros(shape).scatter_add(2, pixel.expand_as(summand), summand)
    count = features.new_zeros(shape[0], 1, shape[2]).scatter_add(2, pixel, seen[:, None].to(features.dtype))
    return (total / count.clamp(min=1)).view(*shape[:2], height, width)


def _gather(image: Tensor, pixels: Tensor) -> Tensor:
    """Return the values (B, N, C) of an image (B, C, H, W) at flat pixel indices (B, N)."""
    return image.flatten(2).gather(2, pixels[:, None].expand(-1, image.shape[1], -1)).mT
