"""Stress changes that need no rendering: fewer inputs, or another coordinate frame of the world."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from nlt.data.sample import BATCH_FIELDS, FIELDS
from nlt.models.method import Batch

_IMAGES = tuple(name for name, field in (FIELDS | BATCH_FIELDS).items() if field.shape[1:] == ("H", "W"))


def _points(batch: Batch, share: float) -> Batch:
    """Keep the first points, which are in random order, and mark the others as not visible."""
    count = batch["point_visible"].shape[1]
    first = torch.arange(count, device=batch["point_visible"].device) < max(1, round(share * count))
    return batch | {"point_visible": batch["point_visible"] & first}


def _photons(batch: Batch, share: float) -> Batch:
    """Keep photons at equal strides in their list, which is sorted by emitter; the total power stays the same."""
    total = batch["photon_flux"].shape[1]
    count = round(share * total)
    chosen = ((torch.arange(count, device=batch["photon_flux"].device) + 0.5) * (total / max(count, 1))).long()
    fewer = {name: value[:, chosen] for name, value in batch.items() if name.startswith("photon_")}
    return batch | fewer | {"photon_flux": fewer["photon_flux"] * (total / max(count, 1))}


def _spp(batch: Batch, spp: float) -> Batch:
    """Give input pixels `spp` samples on average; the pixels with one sample more are random."""
    less, more = int(np.floor(spp)), int(np.ceil(spp))
    image = batch["noisy_input"]
    chosen = torch.rand(image.shape[-2:], generator=torch.Generator().manual_seed(0)).to(image.device) < spp - less
    return batch | {"noisy_input": torch.where(chosen, batch[f"input_{more}"], batch[f"input_{less}"])}


def _moved(batch: Batch, rotation: Tensor, translation: Tensor) -> Batch:
    """Apply the rigid motion x -> R x + t to scene and camera, which leaves the image the same."""
    back = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    back[:3, :3], back[:3, 3] = rotation.T, -rotation.T @ translation
    changed = {"world_to_view": batch["world_to_view"].to(back.dtype) @ back}
    for name in ("point_position", "photon_hit", "photon_origin"):
        changed[name] = batch[name].to(back.dtype) @ rotation.T + translation
    changed["photon_direction"] = batch["photon_direction"].to(back.dtype) @ rotation.T
    for name in ("normal", "view_direction"):
        changed[name] = torch.einsum("ij,bjhw->bihw", rotation, batch[name].to(back.dtype))
    return batch | {name: value.to(batch[name].dtype) for name, value in changed.items()}


def _shifted(batch: Batch, metres: float, up: Tensor, middle: Tensor) -> Batch:
    level = (up == 0).to(up.dtype)
    return _moved(batch, torch.diag(torch.ones_like(up)), metres * level / level.norm())


def _turned(batch: Batch, degrees: float, up: Tensor, middle: Tensor) -> Batch:
    """Turn about the vertical through the middle of the camera's box (Rodrigues' formula)."""
    angle = torch.tensor(np.radians(degrees), device=up.device)
    cross = torch.linalg.cross(torch.diag(torch.ones_like(up)), up.expand(3, 3), dim=1)
    rotation = torch.eye(3, dtype=up.dtype, device=up.device) + angle.sin() * cross + (1 - angle.cos()) * cross @ cross
    return _moved(batch, rotation, middle - rotation @ middle)


def _mirrored(batch: Batch, _: float, up: Tensor, middle: Tensor) -> Batch:
    """Mirror every image, and the camera's matrix so that points fall on the pixels where they are visible."""
    width = batch["depth"].shape[-1]
    flip = torch.tensor([[-1.0, 0, width], [0, 1, 0], [0, 0, 1]], device=batch["depth"].device)
    images = {name: value.flip(-1) for name, value in batch.items() if name in _IMAGES or "traced_" in name}
    return batch | images | {"camera_matrix": flip @ batch["camera_matrix"]}


FRAME: dict[str, Callable[[Batch, float, Tensor, Tensor], Batch]] = {
    "shifted": _shifted, "turned": _turned, "mirrored": _mirrored,
}  # fmt: skip
BUDGET: dict[str, Callable[[Batch, float], Batch]] = {
    "points": _points, "photons": _photons, "pixels": lambda batch, _: batch, "spp": _spp,
}  # fmt: skip
