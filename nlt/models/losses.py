"""Training losses against a noisy target; each is unbiased in the sense of the paper's Lemma 1."""

from torch import Tensor

from nlt.display import expose


def mse(prediction: Tensor, target: Tensor, exposure: Tensor) -> Tensor:
    """Eq. (2): the mean squared error of linear radiance (B, 3, H, W), weighted by the squared exposure (B,).

    Neither image is clamped or tone-mapped: the expectation of a tone-mapped noisy image is not the tone-mapped
    noise-free image.
    """
    return expose(prediction - target, exposure).square().mean()


def relative_mse(prediction: Tensor, target: Tensor, exposure: Tensor) -> Tensor:
    """Return `mse` with each squared error divided by the squared predicted exposed radiance plus 0.01.

    This reduces the effect of fireflies (Lehtinen et al. 2018). The denominator is detached, so that the gradient is
    linear in the target and stays unbiased for a fixed weight.
    """
    weight = expose(prediction.detach(), exposure).square() + 0.01
    return (expose(prediction - target, exposure).square() / weight).mean()
