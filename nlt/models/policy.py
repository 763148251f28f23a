"""The fast paths of each device: chosen only here, recorded in results, switched off by `--precision 32`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlt.models import int8

# Below this, dense maps are faster: measured at 64x64 to 1024x1024, widths 8 to 64 (docs/performance.md).
_PIXELS_PER_POINT = 1
_sparse: ContextVar[bool] = ContextVar("sparse", default=False)
# Input channels and products per image from which 8-bit integers are faster (docs/performance.md).
_LEAST_CHANNELS, _LEAST_PRODUCTS = 64, 1e8
_packed: ContextVar[dict[nn.Module, int8.PackedWeights] | None] = ContextVar("packed", default=None)


def default_device() -> torch.device:
    """Return the CUDA device if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def fast_bfloat16(device: torch.device) -> bool:
    """Return whether the device multiplies bfloat16 natively; emulated bfloat16 is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and any("bf16" in name and has for name, has in torch.cpu.get_capabilities().items())


def fast_int8(device: torch.device) -> bool:
    """Return whether the device multiplies 8-bit integers natively, through oneDNN."""
    return device.type == "cpu" and any("vnni" in name and has for name, has in torch.cpu.get_capabilities().items())


def convolve(conv: nn.Conv2d, x: Tensor, relu: bool = False) -> Tensor:
    """Return conv(x), followed by a ReLU if `relu`; x (B, C, H, W) is not negative. See `Policy.int8`."""
    packed, products = _packed.get(), conv.weight.numel() * x[0, 0].numel()
    enough = conv.in_channels >= _LEAST_CHANNELS and products >= _LEAST_PRODUCTS
    if packed is not None and enough and not torch.is_grad_enabled():
        return int8.convolve(conv, x.to(torch.bfloat16), packed, relu)
    y = conv(x)
    return F.relu(y, inplace=True) if relu else y


def project_sparsely(points: int, pixels: int) -> bool:
    """Return whether a cloud is projected as a sparse map, by its number of points and the pixels; see `Policy`."""
    return _sparse.get() and not torch.is_grad_enabled() and pixels >= _PIXELS_PER_POINT * points


@dataclass(frozen=True)
class Policy:
    """The precision and fast paths with which methods are trained, timed and evaluated. The default is float32.

    `bfloat16`: convolutions and linear layers run under autocast. bfloat16 has the exponent of float32, so no loss is
    scaled; weights, Adam's state, positions, projection, loss and metrics stay float32.

    `sparse`: with many pixels per point, projected features stay a list of rows, which the first convolution adds up;
    never while gradients are recorded. Without it, as in an exported program, they become maps. Not tested on a GPU.

    `int8`: the large 3x3 convolutions of the U-Net's blocks run in 8-bit integers, the layers around them in bfloat16;
    never while gradients are recorded, nor in an exported program.

    The convolutions' layout is channels_last either way; `nlt.models.plain` uses none of this. torch.compile and CUDA
    graphs are not used: they were not tested on a GPU, and a machine without one may have no compiler.
    """

    bfloat16: bool = False
    sparse: bool = False
    int8: bool = False

    @classmethod
    def for_device(cls, device: torch.device, precision: str = "auto") -> Policy:
        """Return the policy of a device; `precision` is auto (the fastest that the device supports), 32 or bf16."""
        bfloat16 = precision == "bf16" or (precision == "auto" and fast_bfloat16(device))
        integers = precision == "auto" and bfloat16 and fast_int8(device)
        return cls(bfloat16, sparse=precision != "32" and device.type == "cpu", int8=integers)

    @property
    def precision(self) -> str:
        """The precision by the name that Lightning's trainer uses."""
        return "bf16-mixed" if self.bfloat16 else "32-true"

    @contextmanager
    def applied(self, device: torch.device) -> Iterator[None]:
        """Apply the policy in a context; use one context for many frames, because it caches the converted weights."""
        before, packed = _sparse.set(self.sparse), _packed.set({} if self.int8 else None)
        try:
            with torch.autocast(device.type, torch.bfloat16, enabled=self.bfloat16):
                yield
        finally:
            _sparse.reset(before)
            _packed.reset(packed)
