"""A random batch with every field of the sample format, as the DataModule would collate it."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn.functional import normalize

from nlt.data.sample import BATCH_FIELDS, FIELDS, MATERIALS

SCENES, POINTS, PHOTONS = 2, 96, 64


def synthetic_batch(batch_size: int = 2, size: int = 16, seed: int = 0) -> dict[str, Tensor]:
    """Shapes from FIELDS and BATCH_FIELDS; a camera at the origin looks along z at points in front of it."""
    g = torch.Generator().manual_seed(seed)
    sizes = {"H": size, "W": size, "P": PHOTONS, "N": POINTS, "M": 2}
    batch: dict[str, Tensor] = {}
    for name, field in {**FIELDS, **BATCH_FIELDS}.items():
        shape = (batch_size, *field.resolve(sizes))
        if field.dtype == "bool":
            batch[name] = torch.rand(shape, generator=g) < 0.8
        elif field.dtype == "int64":
            batch[name] = torch.randint(SCENES, shape, generator=g)
        else:
            batch[name] = torch.rand(shape, generator=g)
    batch["scene"] = torch.arange(batch_size) % SCENES
    batch["index"] = torch.arange(batch_size)
    batch["point_material"] = torch.randint(len(MATERIALS), (batch_size, POINTS), generator=g)
    batch["exposure"] += 0.5
    for name in ("normal", "view_direction"):
        batch[name] = normalize(batch[name] - 0.5, dim=1)
    batch["photon_direction"] = normalize(batch["photon_direction"] - 0.5, dim=-1)
    for name in ("point_position", "photon_hit"):
        batch[name] = (batch[name] - 0.5) * 2 + torch.tensor([0.0, 0.0, 3.0])
    batch["depth"] = 4 * batch["depth"].round() + 2.5 * batch["depth"]  # some nearer than the points
    focal = 1.2 * size
    camera = torch.tensor([[focal, 0, size / 2], [0, focal, size / 2], [0, 0, 1]])
    batch["camera_matrix"] = camera.expand(batch_size, 3, 3).clone()
    batch["world_to_view"] = torch.eye(4).expand(batch_size, 4, 4).clone()
    return batch
