"""Which fast paths a device gets: decided here alone, recorded in results, each to be switched off."""

from __future__ import annotations

from dataclasses import dataclass

import torch


def default_device() -> torch.device:
    """CUDA where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def fast_bfloat16(device: torch.device) -> bool:
    """Whether the device multiplies bfloat16 itself; emulated, it is slower than float32."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and any("bf16" in name and has for name, has in torch.cpu.get_capabilities().items())


@dataclass(frozen=True)
class Policy:
    """How methods are computed. Without arguments: float32, as written.

    `bfloat16`: convolutions and linear layers by autocast. Its exponent is float32's, so no loss is scaled; weights,
    Adam's state, positions, projection, loss and metrics stay float32.
    """

    bfloat16: bool = False

    @classmethod
    def for_device(cls, device: torch.device) -> Policy:
        """All that the device has."""
        return cls(bfloat16=fast_bfloat16(device))
