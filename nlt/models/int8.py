"""Convolutions in 8-bit integers: twice as fast as in bfloat16 where the processor has VNNI; at inference only."""

from __future__ import annotations

import math
from collections.abc import MutableMapping
from typing import NamedTuple

import torch
from torch import Tensor, nn

_STEPS = 253  # of an input, at least: in bfloat16, 255 and the half that rounds would be 256, which is 0 as a byte
_LEAST = 1e-30  # largest value of an image
_BLOCK = 1 << 20  # values that are rounded at a time: few enough for the cache, enough for several threads


class PackedWeights(NamedTuple):
    """Of a convolution, rounded to 127 steps of each output channel's largest, and laid out for the processor."""

    weights: Tensor
    scales: Tensor
    zeros: Tensor
    bias: Tensor | None


def pack(conv: nn.Conv2d) -> PackedWeights:
    """The weights of a convolution of groups 1 and zeros around."""
    weight = conv.weight.detach().float()
    scales = (weight.abs().amax((1, 2, 3)) / 127).clamp(min=torch.finfo(torch.float32).tiny)
    rounded = (weight / scales[:, None, None, None]).round().to(torch.int8)
    return PackedWeights(
        torch.ops.onednn.qconv_prepack(rounded, scales, 1.0, 0, *_geometry(conv), 1, None),
        scales,
        torch.zeros(len(scales), dtype=torch.int64),
        None if conv.bias is None else conv.bias.detach().float(),
    )


def convolve(conv: nn.Conv2d, x: Tensor, packed: MutableMapping[nn.Module, PackedWeights], relu: bool) -> Tensor:
    """conv(x), of which with `relu` the positive part: x (B, C, H, W) bfloat16, not negative, to bfloat16.

    Every image of x is rounded to 253 steps of its largest value, or one more. `packed` keeps the weights.
    """
    if conv not in packed:
        packed[conv] = pack(conv)
    weights, scales, zeros, bias = packed[conv]
    images = []
    for image in x.split(1):  # each by its own scale, so that an image does not depend on its batch
        top = image.amax().float().clamp(min=_LEAST)
        steps = float((_STEPS / top).bfloat16())  # per unit, as the addition in bfloat16 will take them
        step = 1 / steps if steps > 0 else math.nan  # of what is not finite
        images.append(
            torch.ops.onednn.qconv2d_pointwise(
                _rounded(image, steps), step, 0, weights, scales, zeros, bias, *_geometry(conv), 1,
                1.0, 0, torch.bfloat16, "relu" if relu else "none", [], "",
            )
        )  # fmt: skip
    return images[0] if len(images) == 1 else torch.cat(images)


def _rounded(x: Tensor, steps: float) -> Tensor:
    """x * steps in uint8; by way of int16, for PyTorch converts bfloat16 to bytes one by one."""
    out = torch.empty_like(x, dtype=torch.uint8)
    rows = max(1, _BLOCK // (x.shape[1] * x.shape[3]))
    for source, target in zip(x.split(rows, 2), out.split(rows, 2), strict=True):
        target.copy_(torch.rsub(source, 0.5, alpha=-steps).to(torch.int16))
    return out


def _geometry(conv: nn.Conv2d) -> tuple[list[int], list[int], list[int]]:
    assert conv.groups == 1 and not isinstance(conv.padding, str)
    return list(conv.stride), list(conv.padding), list(conv.dilation)
