"""8-bit integer convolutions for inference: twice as fast as bfloat16 on processors with VNNI."""

import math
from typing import NamedTuple

import torch
from torch import Tensor, nn

# Input channels and products per image from which 8-bit integers are faster (docs/performance.md).
LEAST_CHANNELS, _LEAST_PRODUCTS = 64, 1e8
_STEPS = 253  # steps of an input, at least; in bfloat16, 255 plus the half for rounding is 256, which wraps to 0
_LEAST = 1e-30  # lower bound on an image's maximum, by which its scale is divided
_BLOCK = 1 << 20  # values rounded at a time: few enough for the cache, enough for several threads


class PackedWeights(NamedTuple):
    """A convolution's weights, rounded to 127 steps of each output channel's largest and laid out for the processor."""

    weights: Tensor
    scales: Tensor
    zeros: Tensor
    bias: Tensor | None


def pack(conv: nn.Conv2d) -> PackedWeights:
    """Pack the weights of a convolution without groups and with zero padding."""
    weight = conv.weight.detach().float()
    scales = (weight.abs().amax((1, 2, 3)) / 127).clamp(min=torch.finfo(torch.float32).tiny)
    rounded = (weight / scales[:, None, None, None]).round().to(torch.int8)
    return PackedWeights(
        torch.ops.onednn.qconv_prepack(rounded, scales, 1.0, 0, *_geometry(conv), 1, None),
        scales,
        torch.zeros(len(scales), dtype=torch.int64),
        None if conv.bias is None else conv.bias.detach().float(),
    )


class Int8Conv2d(nn.Module):
    """A 3x3 convolution for inference on inputs that are not negative, in 8-bit integers where that is faster."""

    def __init__(self, conv: nn.Conv2d) -> None:
        super().__init__()
        self.packed = pack(conv)
        self.conv = conv

    def forward(self, x: Tensor) -> Tensor:
        """Return the convolution of x (B, C, H, W); in 8-bit integers, it is bfloat16."""
        enough = self.conv.weight.numel() * x[0, 0].numel() >= _LEAST_PRODUCTS
        return convolve(self.conv, x.to(torch.bfloat16), self.packed) if enough else self.conv(x)


def convolve(conv: nn.Conv2d, x: Tensor, packed: PackedWeights) -> Tensor:
    """Return conv(x) in bfloat16; x (B, C, H, W) is bfloat16 and not negative.

    Every image of x is rounded to 253 steps of its largest value, or one more.
    """
    weights, scales, zeros, bias = packed
    images = []
    for image in x.split(1):  # one scale per image, so that an image does not depend on its batch
        top = image.amax().float().clamp(min=_LEAST)
        steps = float((_STEPS / top).bfloat16())  # per unit of x, rounded to bfloat16 as `_rounded` will use it
        step = 1 / steps if steps > 0 else math.nan  # NaN if the image is not finite
        images.append(
            torch.ops.onednn.qconv2d_pointwise(
                _rounded(image, steps), step, 0, weights, scales, zeros, bias, *_geometry(conv), 1,
                1.0, 0, torch.bfloat16, "none", [], "",
            )
        )  # fmt: skip
    return images[0] if len(images) == 1 else torch.cat(images)


def _rounded(x: Tensor, steps: float) -> Tensor:
    """Return x * steps rounded to uint8, via int16: PyTorch does not vectorize the conversion of bfloat16 to bytes."""
    out = torch.empty_like(x, dtype=torch.uint8)
    rows = max(1, _BLOCK // (x.shape[1] * x.shape[3]))
    for source, target in zip(x.split(rows, 2), out.split(rows, 2), strict=True):
        target.copy_(torch.rsub(source, 0.5, alpha=-steps).to(torch.int16))
    return out


def _geometry(conv: nn.Conv2d) -> tuple[list[int], list[int], list[int]]:
    assert conv.groups == 1 and not isinstance(conv.padding, str)
    return list(conv.stride), list(conv.padding), list(conv.dilation)
