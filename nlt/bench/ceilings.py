"""The machine's ceilings: large matrix products and convolutions, memory copies, and Mitsuba's bare calls."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import torch
import torch.nn.functional as F

from nlt.bench.bare import Bare
from nlt.data.render import SampleRenderer

_DTYPES = {"float32": torch.float32, "bfloat16": torch.bfloat16}
_ENOUGH = 0.05  # seconds of a call above which overheads are negligible
_LARGEST = {"matmul": 8192, "convolution": 64}
_COPIED = 1 << 28  # bytes


def computing(device: torch.device, seconds: float) -> dict[str, float]:
    """Return operations and bytes (read and written) per second, the best of calls repeated for `seconds` / 6 each.

    The convolution has 3x3 taps, 128 input and 128 output channels, and images of 128x128; the faster layout counts.
    """
    share = seconds / 6
    ceilings: dict[str, float] = {}
    for name, dtype in _DTYPES.items():
        ceilings[f"matmul_{name}"] = _peak_rate("matmul", partial(_matmul, device, dtype), device, share)
        ceilings[f"convolution_{name}"] = max(
            _peak_rate("convolution", partial(_convolution, device, dtype, layout), device, share / 2)
            for layout in (torch.contiguous_format, torch.channels_last)
        )
    source = torch.zeros(_COPIED // 4, device=device)
    target = torch.empty_like(source)
    ceilings["copy"] = 2 * _COPIED / best(lambda: target.copy_(source), device, share)
    return ceilings


def rendering(render: SampleRenderer, seconds: float) -> dict[str, float]:
    """Return the seconds of a bare `mi.render` at 1 spp, one of the G-buffer, and the photons, at the spec's size."""
    bare = Bare(render, frozen=True)
    camera = render.place("train", 0)
    bare.sample(render.scene.state, camera, "train", 0)
    cpu = torch.device("cpu")  # results are copied to numpy, so there is nothing to wait for
    calls: dict[str, Callable[[], object]] = {
        "path_tracing": lambda: bare.render(bare.path, 1, 0),
        "gbuffer": lambda: bare.render(bare.aov, 1, 0),
        "photons": lambda: bare.photons(0),
    }
    return {name: best(call, cpu, seconds / len(calls)) for name, call in calls.items()}


def repeat(seconds: float, least: int, most: float = math.inf) -> Iterator[int]:
    """Yield 0, 1, 2, ... until `seconds` are over, but `least` to `most` times."""
    begin, k = time.perf_counter(), 0
    while k < least or (k < most and time.perf_counter() - begin < seconds):
        yield k
        k += 1


def best(call: Callable[[], object], device: torch.device, seconds: float) -> float:
    """Return the least seconds of a call, repeated for `seconds` and at least once, after a warm-up call."""
    times = []
    for _ in repeat(seconds, least=2):
        start = time.perf_counter()
        call()
        if device.type == "cuda":
            torch.cuda.synchronize(device)
        times.append(time.perf_counter() - start)
    return min(times[1:])


def _peak_rate(
    kind: str, make: Callable[[int], tuple[Callable[[], object], float]], device: torch.device, seconds: float
) -> float:
    """Return the operations per second at the first size whose calls take long enough."""
    size = {"matmul": 512, "convolution": 1}[kind]
    while True:
        call, operations = make(size)
        if size >= _LARGEST[kind] or best(call, device, 0) > _ENOUGH:
            return operations / best(call, device, seconds)
        size *= 2


@torch.inference_mode()
def _matmul(device: torch.device, dtype: torch.dtype, size: int) -> tuple[Callable[[], object], float]:
    a = torch.ones(size, size, device=device, dtype=dtype)
    return lambda: a @ a, 2.0 * size**3


@torch.inference_mode()
def _convolution(
    device: torch.device, dtype: torch.dtype, layout: torch.memory_format, batch: int
) -> tuple[Callable[[], object], float]:
    channels, side = 128, 128
    image = torch.ones(batch, channels, side, side, device=device, dtype=dtype).to(memory_format=layout)
    kernel = torch.ones(channels, channels, 3, 3, device=device, dtype=dtype).to(memory_format=layout)
    operations = 2.0 * np.prod(kernel.shape) * batch * side**2
    return lambda: F.conv2d(image, kernel, padding=1), float(operations)
