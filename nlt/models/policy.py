"""Which fast paths a device gets: decided here alone, recorded in results, to be switched off by `--precision 32`."""

from __future__ import annotations

from contextlib import AbstractContextManager
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
    """How methods are trained, timed and judged. Without arguments: float32.

    `bfloat16`: convolutions and linear layers by autocast. Its exponent is float32's, so no loss is scaled; weights,
    Adam's state, positions, projection, loss and metrics stay float32.

    The convolutions' layout is channels_last either way, and `nlt.models.plain` the path without any of it. Neither
    torch.compile nor CUDA graphs: they were not tried on a GPU, and a CPU need not have a compiler.
    """

    bfloat16: bool = False

    @classmethod
    def for_device(cls, device: torch.device, precision: str = "auto") -> Policy:
        """`precision`: auto for what the device has, 32, or bf16."""
        return cls(bfloat16=precision == "bf16" or (precision == "auto" and fast_bfloat16(device)))

    @property
    def precision(self) -> str:
        """As Lightning's trainer calls it."""
        return "bf16-mixed" if self.bfloat16 else "32-true"

    def applied(self, device: torch.device) -> AbstractContextManager[None]:
        """What is computed within goes by the policy; stay in it for many frames, for it keeps the weights it cast."""
        return torch.autocast(device.type, torch.bfloat16, enabled=self.bfloat16)
