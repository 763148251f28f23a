"""The machine's ceilings: large matrix products and convolutions, memory copies, and Mitsuba's bare calls."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from functools import partial

import torch
import torch.nn.functional as F
from costs.bare import Bare
from torch.utils.benchmark import Timer

from nlt.data.render import SampleRenderer

_ENOUGH = 0.05  # seconds of a call above which overheads are negligible
MATRICES = (512, 1024, 2048, 4096, 8192)  # side
BATCHES = (1, 2, 4, 8, 16, 32, 64)  # images of a convolution
_CHANNELS = _SIDE = 128  # of a convolution
_COPIED = 1 << 28  # bytes


def computing(device: torch.device, seconds: float) -> dict[str, float]:
    """Return operations and bytes (read and written) per second, the best of calls repeated for `seconds` / 6 each.

    The convolution has 3x3 taps, 128 input and 128 output channels, and images of 128x128; the faster layout counts.
    """
    share = seconds / 6
    ceilings: dict[str, float] = {}
    for name, dtype in (("float32", torch.float32), ("bfloat16", torch.bfloat16)):
        ceilings[f"matmul_{name}"] = _peak_rate(partial(_matmul, device, dtype), MATRICES, share)
        ceilings[f"convolution_{name}"] = max(
            _peak_rate(partial(_convolution, device, dtype, layout), BATCHES, share / 2)
            for layout in (torch.contiguous_format, torch.channels_last)
        )
    source = torch.randn(_COPIED // 4, device=device)
    target = torch.empty_like(source)
    ceilings["copy"] = 2 * _COPIED / best(lambda: target.copy_(source), share)
    return ceilings


def rendering(render: SampleRenderer, seconds: float) -> dict[str, float]:
    """Return the seconds of a bare `mi.render` at 1 spp, one of the G-buffer, and the photons, at the spec's size."""
    bare = Bare(render, frozen=True)
    camera = render.place("train", 0)
    bare.sample(render.scene.state, camera, "train", 0)
    calls: dict[str, Callable[[], object]] = {
        "path_tracing": lambda: bare.render(bare.path, 1, 0),
        "gbuffer": lambda: bare.render(bare.aov, 1, 0),
        "photons": lambda: bare.photons(0),
    }
    return {name: best(call, seconds / len(calls)) for name, call in calls.items()}


def timer(call: Callable[[], object]) -> Timer:
    """Return PyTorch's timer of a call, which waits for CUDA, with all threads instead of one."""
    return Timer("call()", globals={"call": call}, num_threads=torch.get_num_threads())


def best(call: Callable[[], object], seconds: float) -> float:
    """Return the least seconds of a call, repeated for `seconds` after a warm-up; short calls are timed in blocks."""
    return min(timer(call).blocked_autorange(min_run_time=seconds).times)


def _peak_rate(
    make: Callable[[int], tuple[Callable[[], object], float]], sizes: Iterable[int], seconds: float
) -> float:
    """Return the operations per second at the first size whose calls take long enough, or else at the last."""
    for size in sizes:
        call, operations = make(size)
        if timer(call).timeit(1).median > _ENOUGH:
            break
    return operations / best(call, seconds)


def _matmul(device: torch.device, dtype: torch.dtype, size: int) -> tuple[Callable[[], object], float]:
    a = torch.randn(size, size, device=device, dtype=dtype)
    return lambda: a @ a, 2.0 * size**3


def _convolution(
    device: torch.device, dtype: torch.dtype, layout: torch.memory_format, batch: int
) -> tuple[Callable[[], object], float]:
    image = torch.randn(batch, _CHANNELS, _SIDE, _SIDE, device=device, dtype=dtype).to(memory_format=layout)
    kernel = torch.randn(_CHANNELS, _CHANNELS, 3, 3, device=device, dtype=dtype).to(memory_format=layout)
    operations = 2.0 * math.prod(kernel.shape) * batch * _SIDE**2
    return lambda: F.conv2d(image, kernel, padding=1), operations
