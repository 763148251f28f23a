"""The Image Synthesis Layer: a U-Net of convolutional ResNet blocks."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class ConvBlock(nn.Module):
    """Pre-activation ResNet block of two 3x3 convolutions: (B, in, H, W) -> (B, out, H, W)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_0 = nn.Conv2d(in_channels, out_channels, 3, padding=1)
        self.conv_1 = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        self.shortcut = (
            nn.Identity() if in_channels == out_channels else nn.Conv2d(in_channels, out_channels, 1, bias=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.conv_1(F.relu(self.conv_0(F.relu(x))))


class UNet(nn.Module):
    """Supplementary, "Image Synthesis Layer": (B, in_channels, H, W) -> (B, out_channels, H, W), any H, W.

    The supplementary's figure reduces the resolution in three steps and the main text names four blocks:
    `depth` counts the steps. Features start at `width` and double at each. The output is not bounded.
    """

    def __init__(self, in_channels: int, width: int = 64, depth: int = 3, out_channels: int = 3) -> None:
        super().__init__()
        widths = [width * 2**level for level in range(depth + 1)]
        self.conv_in = nn.Conv2d(in_channels, width, 3, padding=1)
        self.down = nn.ModuleList(ConvBlock(widths[max(i - 1, 0)], widths[i]) for i in range(depth + 1))
        self.up = nn.ModuleList(ConvBlock(widths[i + 1] + widths[i], widths[i]) for i in reversed(range(depth)))
        self.conv_out = nn.Conv2d(width, out_channels, 3, padding=1)

    def forward(self, x: Tensor) -> Tensor:
        x = self.down[0](self.conv_in(x))
        skips = []
        for block in self.down[1:]:
            skips.append(x)
            x = block(F.max_pool2d(x, 2, ceil_mode=True))  # ceil: a side of 1 stays 1
        for block, skip in zip(self.up, reversed(skips), strict=True):
            x = F.interpolate(x, size=skip.shape[-2:], mode="bilinear", align_corners=False)
            x = block(torch.cat([x, skip], dim=1))
        return self.conv_out(F.relu(x))
