"""Stress changes that need no rendering: fewer inputs, or another coordinate frame of the world."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from nlt.data.sample import BATCH_FIELDS, FIELDS
from nlt.models.method import Batch

_IMAGES = tuple(name for name, field in (FIELDS | BATCH_FIELDS).items() if field.shape[1:] == ("H", "W"))


def _points(batch: Batch, share: float, *_: np.ndarray) -> Batch:
    """Keep the first points, which are in random order, and mark the others as not visible."""
    count = batch["point_visible"].shape[1]
    first = torch.arange(count, device=batch["point_visible"].device) < max(1, round(share * count))
    return batch | {"point_visible": batch["point_visible"] & first}


def _photons(batch: Batch, share: float, *_: np.ndarray) -> Batch:
    """Keep photons at equal strides in their list, which is sorted by emitter; the total power stays the same."""
    total = batch["photon_flux"].shape[1]
    count = round(share * total)
    chosen = ((torch.arange(count, device=batch["photon_flux"].device) + 0.5) * (total / max(count, 1))).long()
    fewer = {name: value[:, chosen] for name, value in batch.items() if name.startswith("photon_")}
    return batch | fewer | {"photon_flux": fewer["photon_flux"] * (total / max(count, 1))}


def _spp(batch: Batch, spp: float, *_: np.ndarray) -> Batch:
    """Give input pixels `spp` samples on average; the pixels with one sample more are random."""
    less, more = int(np.floor(spp)), int(np.ceil(spp))
    image = batch["noisy_input"]
    chosen = torch.rand(image.shape[-2:], generator=torch.Generator().manual_seed(0)).to(image.device) < spp - less
    return batch | {"noisy_input": torch.where(chosen, batch[f"input_{more}"], batch[f"input_{less}"])}


def _moved(batch: Batch, rotation: np.ndarray, translation: np.ndarray) -> Batch:
    """Apply the rigid motion x -> R x + t to scene and camera, which leaves the image the same."""
    motion = np.eye(4)
    motion[:3, :3], motion[:3, 3] = rotation, translation
    forward, back = (torch.tensor(m, device=batch["depth"].device) for m in (motion, np.linalg.inv(motion)))
    turn, shift = forward[:3, :3], forward[:3, 3]
    changed = {"world_to_view": batch["world_to_view"].double() @ back}
    for name in ("point_position", "photon_hit", "photon_origin"):
        changed[name] = batch[name].double() @ turn.T + shift
    changed["photon_direction"] = batch["photon_direction"].double() @ turn.T
    for name in ("normal", "view_direction"):
        changed[name] = torch.einsum("ij,bjhw->bihw", turn, batch[name].double())
    return batch | {name: value.to(batch[name].dtype) for name, value in changed.items()}


def _shifted(batch: Batch, metres: float, up: np.ndarray, *_: np.ndarray) -> Batch:
    """Move along the diagonal of the two horizontal axes."""
    level = (up == 0) / np.linalg.norm(up == 0)
    return _moved(batch, np.eye(3), metres * level)


def _turned(batch: Batch, degrees: float, up: np.ndarray, middle: np.ndarray) -> Batch:
    """Turn about the vertical through the middle of the camera's box."""
    rotation = Rotation.from_rotvec(degrees * up, degrees=True).as_matrix()
    return _moved(batch, rotation, middle - rotation @ middle)


def _mirrored(batch: Batch, *_: Any) -> Batch:
    """Mirror every image, and the camera's matrix so that points fall on the pixels where they are visible."""
    width = batch["depth"].shape[-1]
    flip = torch.tensor([[-1.0, 0, width], [0, 1, 0], [0, 0, 1]], device=batch["depth"].device)
    images = {name: value.flip(-1) for name, value in batch.items() if name in _IMAGES or "traced_" in name}
    return batch | images | {"camera_matrix": flip @ batch["camera_matrix"]}


# Each takes the batch, the change's value, and the scene's up vector and the middle of its camera's box.
INPUTS: dict[str, Callable[..., Batch]] = {
    "points": _points, "photons": _photons, "pixels": lambda batch, *_: batch, "spp": _spp,
    "shifted": _shifted, "turned": _turned, "mirrored": _mirrored,
}  # fmt: skip
