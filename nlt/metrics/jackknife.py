"""The Fréchet distance of two sets of images, and how far FID and KID depend on which images are in them."""

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


def frechet_distance(prediction: Tensor, reference: Tensor) -> Tensor:
    """Of Gaussians fitted to features (N, C) and (M, C), in float64; NaN below two of either.

    Heusel et al. 2017: |m1 - m2|² + Tr C1 + Tr C2 - 2 Tr (C1 C2)^(1/2). The last trace is the nuclear norm of X Yᵀ, of
    the centred features X and Y, over the root of (N - 1)(M - 1): the nonzero eigenvalues of C1 C2 are the squares of
    its singular values. So the matrix is as large as the sets are, not as the features.
    """
    sets = [features.double() for features in (prediction, reference)]
    degrees = [len(features) - 1 for features in sets]
    if min(degrees) < 1:
        return torch.full((), torch.nan, dtype=torch.float64, device=prediction.device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # on busy cores LAPACK takes many times as long with several
    try:
        means = [features.mean(0) for features in sets]
        centred = [features - mean for features, mean in zip(sets, means, strict=True)]
        # X = QR has the products X Xᵀ and X Yᵀ up to rotations: of more features than channels, R will do.
        x, y = (torch.linalg.qr(c, mode="r").R if len(c) > c.shape[1] else c for c in centred)
        root = torch.linalg.svdvals(x @ y.mT).sum() / (degrees[0] * degrees[1]) ** 0.5
    finally:
        torch.set_num_threads(threads)
    traces = x.square().sum() / degrees[0] + y.square().sum() / degrees[1]
    return (means[0] - means[1]).square().sum() + traces - 2 * root


def fid_and_kid_without(prediction: Tensor, reference: Tensor) -> dict[str, np.ndarray]:
    """FID and KID of pooled features (N, C) without each image's group: (N,) each; NaN below three images."""
    group = groups(len(prediction))
    values: dict[str, list[float]] = {"fid_without": [], "kid_without": []}
    for k in range(min(GROUPS, len(group))):
        kept = torch.from_numpy(group != k).to(prediction.device)
        f, r = prediction[kept].double(), reference[kept].double()
        values["fid_without"].append(float(frechet_distance(f, r)))
        values["kid_without"].append(float(poly_mmd(r, f)) if len(f) > 1 else np.nan)
    return {key: np.array(each)[group] for key, each in values.items()}
