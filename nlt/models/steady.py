"""Steady pictures: each frame of a video is blended with the frames before it, moved along with the camera.

This is temporal anti-aliasing (Karis 2014; Yang et al. 2020) around any method. The paper renders frames one by one.
"""

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.models.method import Batch

_HISTORY = 0.8  # weight of the frames before
_SAME_DEPTH = 0.02  # relative difference up to which a depth is that of the same surface


class Steady:
    """Blends the radiance (1, 3, H, W) of consecutive frames; the first call returns its frame unchanged.

    A pixel's history is the last result at the place where the camera saw the pixel's surface before. It counts only
    where that surface was in view, by its depth: what an object uncovers begins anew, and so does a moved object. It is
    clamped to the least and greatest radiance of the new frame within 3x3 pixels, so that moving light does not trail.
    """

    fields = ("depth", "camera_matrix", "world_to_view")

    def __init__(self) -> None:
        self._last: tuple[Tensor, Batch] | None = None

    def __call__(self, radiance: Tensor, batch: Batch) -> Tensor:
        """Return the blended radiance; `batch` has the frame's `fields`."""
        now = {name: batch[name].clone() for name in self.fields}
        if self._last is not None and self._last[0].shape == radiance.shape:
            image, before = self._last
            places, depth = seen_before(now, before)
            history = F.grid_sample(image, places, padding_mode="border", align_corners=False)
            last_depth = F.grid_sample(before["depth"], places, mode="nearest", align_corners=False)
            same = (depth > 0) & ((last_depth - depth).abs() < _SAME_DEPTH * depth)
            edges = F.pad(radiance, (1, 1, 1, 1), mode="replicate")
            lowest, highest = -F.max_pool2d(-edges, 3, 1), F.max_pool2d(edges, 3, 1)
            history = torch.maximum(torch.minimum(history, highest), lowest)
            radiance = torch.where(same, torch.lerp(radiance, history, _HISTORY), radiance)
        self._last = radiance, now
        return radiance


def seen_before(now: Batch, before: Batch) -> tuple[Tensor, Tensor]:
    """Return where the camera `before` sees the surfaces that the camera `now` sees.

    Returns:
        (B, H, W, 2) image places, from -1 to 1 as `grid_sample` reads them, beyond the image if not in view; and the
        depth (B, 1, H, W) there, in metres, 0 where no surface is hit or it lies behind the camera.
    """
    depth = now["depth"].double()
    height, width = depth.shape[-2:]
    rows, columns = (torch.arange(size, device=depth.device) + 0.5 for size in (height, width))
    y, x = torch.meshgrid(rows.double(), columns.double(), indexing="ij")
    pixels = torch.stack([x, y, torch.ones_like(x)]).flatten(1)  # (3, H * W)
    to_world = torch.linalg.inv(now["world_to_view"].double())
    in_view = torch.linalg.inv(now["camera_matrix"].double()) @ pixels * depth.flatten(2)
    world = to_world[:, :3, :3] @ in_view + to_world[:, :3, 3:]
    to_view = before["world_to_view"].double()
    place = before["camera_matrix"].double() @ (to_view[:, :3, :3] @ world + to_view[:, :3, 3:])
    z = place[:, 2:]
    size = torch.tensor([width, height], device=depth.device).double()
    at = (2 * place[:, :2] / z.clamp(min=1e-6)).transpose(1, 2) / size - 1
    hit = (depth.flatten(2) > 0) & (z > 0)
    in_front = torch.where(hit, z, 0).view(-1, 1, height, width)
    return at.view(-1, height, width, 2).float(), in_front.to(now["depth"].dtype)
