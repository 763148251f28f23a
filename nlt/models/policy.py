"""Which fast paths a device gets: decided here alone, recorded in results, to be switched off by `--precision 32`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlt.models import int8

# At fewer, maps cost less: measured at 64x64 to 1024x1024, widths 8 to 64 (docs/performance.md).
_PIXELS_PER_POINT = 1
_sparse: ContextVar[bool] = ContextVar("sparse", default=False)
# Of each image, from which on 8 bits are faster (docs/performance.md): input channels, and products.
_LEAST_CHANNELS, _LEAST_PRODUCTS = 64, 1e8
_packed: ContextVar[dict[nn.Module, int8.PackedWeights] | None] = ContextVar("packed", default=None)


def default_device() -> torch.device:
    """CUDA where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def fast_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 itself; emulated, it is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and any("bf16" in name and has for name, has in torch.cpu.get_capabilities().items())


def fast_int8(device: torch.device) -> bool:
    """Whether the device multiplies 8-bit integers itself, by way of oneDNN."""
    return device.type == "cpu" and any("vnni" in name and has for name, has in torch.cpu.get_capabilities().items())


def convolve(conv: nn.Conv2d, x: Tensor, relu: bool = False) -> Tensor:
    """conv(x), of which with `relu` the positive part: of an x (B, C, H, W) that is not negative; see `Policy.int8`."""
    packed, products = _packed.get(), conv.weight.numel() * x[0, 0].numel()
    enough = conv.in_channels >= _LEAST_CHANNELS and products >= _LEAST_PRODUCTS
    if packed is not None and enough and not torch.is_grad_enabled():
        return int8.convolve(conv, x.to(torch.bfloat16), packed, relu)
    y = conv(x)
    return F.relu(y, inplace=True) if relu else y


def project_sparsely(points: int, pixels: int) -> bool:
    """Whether a cloud of so many points is projected to so many pixels as a sparse map; see `Policy`."""
    return _sparse.get() and not torch.is_grad_enabled() and pixels >= _PIXELS_PER_POINT * points


@dataclass(frozen=True)
class Policy:
    """How methods are trained, timed and judged. Without arguments: float32.

    `bfloat16`: convolutions and linear layers by autocast. Its exponent is float32's, so no loss is scaled; weights,
    Adam's state, positions, projection, loss and metrics stay float32.

    `sparse`: where pixels are many, projected features stay a list of rows, which the first convolution adds up; never
    while gradients are wanted. Without it, as in an exported program, they become maps. Not tried on a GPU.

    `int8`: the large 3x3 convolutions of the U-Net's blocks in 8-bit integers, what is around them in bfloat16; never
    while gradients are wanted, nor in an exported program.

    The convolutions' layout is channels_last either way, and `nlt.models.plain` the path without any of it. Neither
    torch.compile nor CUDA graphs: they were not tried on a GPU, and a CPU need not have a compiler.
    """

    bfloat16: bool = False
    sparse: bool = False
    int8: bool = False

    @classmethod
    def for_device(cls, device: torch.device, precision: str = "auto") -> Policy:
        """`precision`: auto for what the device has, 32, or bf16."""
        bfloat16 = precision == "bf16" or (precision == "auto" and fast_bfloat16(device))
        integers = precision == "auto" and bfloat16 and fast_int8(device)
        return cls(bfloat16, sparse=precision != "32" and device.type == "cpu", int8=integers)

    @property
    def precision(self) -> str:
        """As Lightning's trainer calls it."""
        return "bf16-mixed" if self.bfloat16 else "32-true"

    @contextmanager
    def applied(self, device: torch.device) -> Iterator[None]:
        """What is computed within goes by the policy; stay in it for many frames, for it keeps the weights it cast."""
        before, packed = _sparse.set(self.sparse), _packed.set({} if self.int8 else None)
        try:
            with torch.autocast(device.type, torch.bfloat16, enabled=self.bfloat16):
                yield
        finally:
            _sparse.reset(before)
            _packed.reset(packed)
