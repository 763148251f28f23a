"""The fast paths of each device: chosen only here, recorded in results, switched off by `--precision 32`."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TypeVar

import torch
from torch import nn

from nlt.models.int8 import LEAST_CHANNELS, Int8Conv2d
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.models.unet import ConvBlock

AnyMethod = TypeVar("AnyMethod", bound=Method)


def default_device() -> torch.device:
    """Return the CUDA device if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def fast_bfloat16(device: torch.device) -> bool:
    """Return whether the device multiplies bfloat16 natively and faster than float32.

    Emulated bfloat16 is slower than float32, and so is that of Intel's processors without AMX (performance-log.csv).
    """
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    has = torch.cpu.get_capabilities()
    slow = "Intel" in str(has.get("cpu_name")) and not has.get("amx_bf16")
    return device.type == "cpu" and not slow and any("bf16" in name and has[name] for name in has)


def fast_int8(device: torch.device) -> bool:
    """Return whether the device multiplies 8-bit integers natively, through oneDNN."""
    return device.type == "cpu" and any("vnni" in name and has for name, has in torch.cpu.get_capabilities().items())


@dataclass(frozen=True)
class Policy:
    """The precision and fast paths with which methods are trained, timed and evaluated. The default is float32.

    `bfloat16`: convolutions and linear layers run under autocast. bfloat16 has the exponent of float32, so no loss is
    scaled; in training, weights and Adam's state stay float32, and so do positions, projection, loss and metrics.

    `sparse`: with many pixels per point, projected features stay a list of rows, which the first convolution adds up.
    Used on a CPU only.

    `int8`: the large 3x3 convolutions of the U-Net's blocks run in 8-bit integers, the layers around them in bfloat16.

    The convolutions' layout is channels_last either way. torch.compile is not used, because it is slower on a CPU, and
    a machine may have no compiler; neither are CUDA graphs, which would save half a millisecond of a frame.
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

    def autocast(self, device: torch.device) -> torch.autocast:
        """Return the context in which a training step runs."""
        return torch.autocast(device.type, torch.bfloat16, enabled=self.bfloat16)


def accelerate(method: AnyMethod, policy: Policy, device: torch.device) -> AnyMethod:
    """Return the method for inference on a device: a trained one as a copy that takes the policy's fast paths."""
    if not isinstance(method, RenderingModule):
        return method.to(device).eval()
    fast = copy.deepcopy(method).to(device).eval().requires_grad_(False)
    fast.sparse, fast.in_bfloat16 = policy.sparse, policy.bfloat16
    if policy.int8:
        for block in (part for part in fast.modules() if isinstance(part, ConvBlock)):
            for name in ("conv_0", "conv_1"):
                conv = getattr(block, name)
                if conv.in_channels >= LEAST_CHANNELS:
                    setattr(block, name, Int8Conv2d(conv))
    if policy.bfloat16:  # converted once here, instead of by autocast in every frame
        for part in fast.modules():
            if type(part) in (nn.Conv2d, nn.Linear):
                part.to(torch.bfloat16)
    return fast
