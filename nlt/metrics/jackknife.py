"""The Fréchet distance and the kernel distance of two sets of images, and their jackknife values."""

import numpy as np
import torch
from torch import Tensor
from torchmetrics.image.kid import poly_mmd

_SUBSET, _SUBSETS = 1000, 100
GROUPS = 64  # maximum, because each group costs a singular value decomposition


def groups(count: int) -> np.ndarray:
    """Return the jackknife group of each image, (count,); up to 64 images, each has its own group."""
    return np.arange(count) % GROUPS


def standard_error(without: np.ndarray) -> float:
    """Return the jackknife standard error of a statistic from its values (G,), each without one of G equal groups."""
    return float(np.sqrt((len(without) - 1) * np.var(without)))


def frechet_distance(prediction: Tensor, reference: Tensor) -> Tensor:
    """Return the Fréchet distance of Gaussians fitted to features (N, C) and (M, C), a float64 scalar.

    FID, Heusel et al. 2017: |m1 - m2|² + Tr C1 + Tr C2 - 2 Tr (C1 C2)^(1/2). With the centred features X and Y, the
    nonzero eigenvalues of C1 C2 are the squared singular values of X Yᵀ / √((N - 1)(M - 1)), so the last trace is the
    nuclear norm of that matrix, whose size depends on N and M instead of C. (torchmetrics' FID has the same value, but
    takes seconds for C = 2048.) The result is NaN if N or M is less than 2. A small N biases it upwards, so only values
    with equal N and references are comparable.
    """
    sets = [features.double() for features in (prediction, reference)]
    degrees = [len(features) - 1 for features in sets]
    if min(degrees) < 1:
        return torch.full((), torch.nan, dtype=torch.float64, device=prediction.device)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)  # with several threads, LAPACK is many times slower on busy cores
    try:
        means = [features.mean(0) for features in sets]
        centred = [features - mean for features, mean in zip(sets, means, strict=True)]
        # With X = QR, R gives the same trace and singular values as X, and is smaller if N > C.
        x, y = (torch.linalg.qr(c, mode="r").R if len(c) > c.shape[1] else c for c in centred)
        root = torch.linalg.svdvals(x @ y.mT).sum() / (degrees[0] * degrees[1]) ** 0.5
    finally:
        torch.set_num_threads(threads)
    traces = x.square().sum() / degrees[0] + y.square().sum() / degrees[1]
    return (means[0] - means[1]).square().sum() + traces - 2 * root


def kernel_distance(prediction: Tensor, reference: Tensor) -> Tensor:
    """Return the squared maximum mean discrepancy of features (N, C) and (N, C) with a cubic kernel, a scalar.

    KID, Binkowski et al. 2018. It is unbiased, so values with different N are comparable. Up to 1000 samples are
    compared at once; with more, 100 random subsets of 1000 are averaged. The result is NaN if N is less than 2.
    """
    count = len(reference)
    if count < 2:
        return torch.full((), torch.nan, dtype=prediction.dtype, device=prediction.device)
    if count <= _SUBSET:
        return poly_mmd(reference, prediction)
    generator = torch.Generator().manual_seed(0)
    drawn = lambda features: features[torch.randperm(count, generator=generator)[:_SUBSET]]
    return torch.stack([poly_mmd(drawn(reference), drawn(prediction)) for _ in range(_SUBSETS)]).mean()


def fid_and_kid_without(prediction: Tensor, reference: Tensor) -> dict[str, np.ndarray]:
    """Return FID and KID of pooled features (N, C) without each image's group, (N,) each; NaN below three images."""
    group = groups(len(prediction))
    values: dict[str, list[float]] = {"fid_without": [], "kid_without": []}
    for k in range(min(GROUPS, len(group))):
        kept = torch.from_numpy(group != k).to(prediction.device)
        f, r = prediction[kept].double(), reference[kept].double()
        values["fid_without"].append(float(frechet_distance(f, r)))
        values["kid_without"].append(float(poly_mmd(r, f)) if len(f) > 1 else np.nan)
    return {key: np.array(by_group)[group] for key, by_group in values.items()}
