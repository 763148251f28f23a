"""Corrects a learned image by its noisy pixels, so that it is useful in scenes that it was not trained for.

Noisy pixels are unbiased, so their mean difference to an image is the image's error (the image is a control variate).
Noise hides the error of a pixel, but not that of an area.
"""

from collections.abc import Callable

import torch
import torch.nn.functional as F
from torch import Tensor

from nlt.display import expose
from nlt.models.method import Batch

_WINDOWS = (32, 16, 8)  # pixels; those of 4 leave mottles
_TRUST = 3.0  # a correction counts as far as its square is more than this times its variance
LEAST_ALBEDO = 0.05  # added to the albedo, which is 0 on mirrors
_DARK = 0.1  # exposed radiance below which the noise is about the same everywhere


def corrected(image: Tensor, noisy: Tensor, batch: Batch, albedo: Tensor, traced: Callable[[Tensor], Tensor]) -> Tensor:
    """Return an image (B, 3, H, W), in linear radiance, plus what its noisy pixels show that it lacks.

    Args:
        image: linear radiance.
        noisy: (B, 3, H, W), path-traced radiance.
        batch: with the `emission` and `exposure` of the view.
        albedo: (B, 3, H, W).
        traced: returns the path-traced pixels of any map (B, C, H, W).
    """
    exposure = batch["exposure"]
    reflected = expose(image - batch["emission"], exposure).mean(1, keepdim=True).clamp(min=0)
    # Lamps are known, and the pixels at their edges show a part of them.
    lamps = F.max_pool2d(batch["emission"].amax(1, keepdim=True), 3, 1, 1)
    seen = (expose(noisy - image, exposure), albedo, reflected, lamps == 0)
    missing = F.interpolate(correction(*map(traced, seen)), image.shape[2:], mode="bilinear")
    return image + expose((albedo + LEAST_ALBEDO) * missing, 1 / exposure)


def correction(residual: Tensor, albedo: Tensor, brightness: Tensor, valid: Tensor) -> Tensor:
    """Return the irradiance that an image lacks, by least squares in windows of 32, 16 and 8 pixels.

    In each window, a constant times the albedo explains the residual. Of this constant c with variance v, only
    c * max(0, 1 - 3 v / c²) is kept (James and Stein 1961), so where noise is all there is, nothing is added. Smaller
    windows explain what larger ones leave.

    Args:
        residual: (B, 3, H, W), noisy pixels minus the image, in exposed radiance.
        albedo: (B, 3, H, W).
        brightness: (B, 1, H, W), the image's exposed radiance, in proportion to which the noise grows.
        valid: (B, 1, H, W), False in pixels to leave out.

    Returns:
        (B, 3, H, W); times the albedo plus 0.05 it is what to add to the image.
    """
    albedo = albedo + LEAST_ALBEDO
    weight = valid / (brightness + _DARK) ** 2
    height, width = residual.shape[-2:]
    missing = torch.zeros_like(residual)
    for size in _WINDOWS:
        rest = residual - albedo * missing
        fitted, doubt = _fit(rest, albedo, weight, size)
        kept = fitted * (1 - _TRUST * doubt).clamp(min=0)
        missing = missing + F.interpolate(kept, size=(height, width), mode="bilinear", align_corners=False)
    return missing


def _fit(rest: Tensor, albedo: Tensor, weight: Tensor, size: int) -> tuple[Tensor, Tensor]:
    """Return the weighted least-squares factor c of each window, and its variance relative to c²."""
    height, width = rest.shape[-2:]
    total = lambda image: F.avg_pool2d(image, size, ceil_mode=True, divisor_override=1)
    share = weight * albedo.square()
    shares = total(share).clamp(min=1e-9)
    fitted = total(weight * albedo * rest) / shares
    spread = fitted.repeat_interleave(size, 2).repeat_interleave(size, 3)[..., :height, :width]
    error = weight * albedo * (rest - albedo * spread)
    # A pixel that alone decides c has no error; the less the others weigh, the less its error says.
    errors = total(error.square()) / (1 - total(share.square()) / shares.square()).clamp(min=1e-3)
    # A window without any bright outlier looks less noisy than it is; the windows around it know better.
    around = lambda image: F.avg_pool2d(image, 3, 1, 1, count_include_pad=False)
    variance = torch.maximum(errors, around(errors) / around(shares) * shares) / shares.square()
    return fitted, (variance / fitted.square().clamp(min=1e-12)).detach()
