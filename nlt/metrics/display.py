"""The one display transform: from linear radiance to the sRGB values that are shown and compared."""

from __future__ import annotations

import torch
from torch import Tensor


def expose(radiance: Tensor, exposure: Tensor | float) -> Tensor:
    """Radiance (B, 3, H, W) times the exposure, (B,) or scalar: linear, unclamped."""
    exposure = torch.as_tensor(exposure, dtype=radiance.dtype, device=radiance.device)
    return radiance * exposure.reshape(-1, 1, 1, 1)


def display(radiance: Tensor, exposure: Tensor | float) -> Tensor:
    """Linear radiance (B, 3, H, W), W·sr⁻¹·m⁻², as sRGB (IEC 61966-2-1) in [0, 1], of the same shape.

    `exposure`, (B,) or scalar, belongs to the scene. It is never computed from a prediction: a prediction's
    error in brightness has to show. NaN stays NaN.
    """
    linear = expose(radiance, exposure).clamp(0, 1)
    # The second clamp keeps the gradient of the branch that `where` drops finite at 0.
    power = 1.055 * linear.clamp(min=0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, power)
