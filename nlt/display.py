"""The display transform from linear radiance to the sRGB values that are shown and compared."""

import numpy as np
import torch
from torch import Tensor


def expose(radiance: Tensor, exposure: Tensor | float) -> Tensor:
    """Return radiance (B, 3, H, W) times the exposure, (B,), (B, 3) or scalar; the result is linear and unclamped."""
    exposure = torch.as_tensor(exposure, dtype=radiance.dtype, device=radiance.device)
    return radiance * exposure.reshape(*exposure.shape, *[1] * (4 - exposure.ndim))


def display(radiance: Tensor, exposure: Tensor | float) -> Tensor:
    """Convert linear radiance (B, 3, H, W), W·sr⁻¹·m⁻², to sRGB (IEC 61966-2-1) in [0, 1], of the same shape.

    `exposure`, (B,) or scalar, belongs to the scene. It is never computed from a prediction, because errors
    in brightness must remain visible. NaN stays NaN.
    """
    linear = expose(radiance, exposure).clamp(0, 1)
    # The second clamp keeps the gradient finite at 0 in the branch that `where` discards.
    power = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, power)


def display_bytes(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Convert linear radiance (3, H, W) to sRGB (H, W, 3) uint8."""
    srgb = display(torch.from_numpy(radiance)[None], exposure)[0].permute(1, 2, 0)
    return (srgb.numpy() * 255).round().astype(np.uint8)
