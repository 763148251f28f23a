"""Training losses against a noisy target; each is unbiased in the sense of the paper's Lemma 1."""

from __future__ import annotations

from torch import Tensor

from nlt.metrics.display import expose


def mse(prediction: Tensor, target: Tensor, exposure: Tensor) -> Tensor:
    """Eq. (2): mean squared error of linear radiance (B, 3, H, W), weighted by the exposure (B,) squared.

    Neither side is clamped or tone-mapped: the expectation of either of a noisy image is not that of the
    noise-free one.
    """
    return expose(prediction - target, exposure).square().mean()


def relative_mse(prediction: Tensor, target: Tensor, exposure: Tensor) -> Tensor:
    """`mse` with each squared error divided by the predicted exposed radiance squared plus 0.01.

    Tames fireflies (Lehtinen et al. 2018). The denominator is detached, so that the gradient is linear in
    the target and stays unbiased for a fixed weight.
    """
    weight = expose(prediction.detach(), exposure).square() + 0.01
    return (expose(prediction - target, exposure).square() / weight).mean()
