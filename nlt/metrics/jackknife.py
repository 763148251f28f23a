"""How far a distance of two sets of images depends on which images are in them."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torchmetrics.image.kid import poly_mmd

GROUPS = 64  # at most: each costs a singular value decomposition


def groups(count: int) -> np.ndarray:
    """(count,) the jackknife group of each image: one of its own up to 64 images."""
    return np.arange(count) % GROUPS


def standard_error(without: np.ndarray) -> float:
    """Of a statistic, from its values without each group in turn (G,), the groups being of about one size."""
    return float(np.sqrt((len(without) - 1) * np.var(without)))


def fid_and_kid_without(prediction: Tensor, reference: Tensor) -> dict[str, np.ndarray]:
    """FID and KID of pooled features (N, C) without each image's group: (N,) each; NaN below three images."""
    group = groups(len(prediction))
    values: dict[str, list[float]] = {"fid_without": [], "kid_without": []}
    for k in range(min(GROUPS, len(group))):
        kept = torch.from_numpy(group != k).to(prediction.device)
        f, r = prediction[kept].double(), reference[kept].double()
        if len(f) < 2:
            values["fid_without"].append(np.nan)
            values["kid_without"].append(np.nan)
            continue
        x, y = f - f.mean(0), r - r.mean(0)
        # Tr (C1 C2)^(1/2) is the nuclear norm of X Yᵀ, of the centred features: N x N however many channels.
        cross = torch.linalg.svdvals(x @ y.T).sum()
        spread = (x.square().sum() + y.square().sum() - 2 * cross) / (len(f) - 1)
        values["fid_without"].append(float((f.mean(0) - r.mean(0)).square().sum() + spread))
        values["kid_without"].append(float(poly_mmd(r, f)))
    return {key: np.array(each)[group] for key, each in values.items()}
