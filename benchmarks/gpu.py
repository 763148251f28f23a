"""Measures, on a CUDA device, what each fast path of the U-Net gains: time of a frame and of a training step.

    python benchmarks/gpu.py                 # writes results/bench/gpu/unet.json
    python benchmarks/gpu.py --compile       # also torch.compile, which takes a minute

The U-Net has width 64 and reads as many channels as that of `nlt_photons`. A frame has 256x256 pixels; a training step
has 32 windows of 64x64 pixels, forwards and backwards. All paths take turns, after a warm-up, on random numbers.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import torch
from costs.plain import PlainUNet

from nlt.data.files import write_bytes
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.unet import UNet

CHANNELS, WIDTH = 10 + 2 * 64, 64
FRAME, STEP = (1, 256), (32, 64)  # images, pixels of a side
Call = Callable[[], object]


def unet(dtype: torch.dtype, layout: torch.memory_format) -> UNet:
    """Return the U-Net on the GPU; all have the same weights."""
    torch.manual_seed(0)
    return UNet(CHANNELS, WIDTH).to("cuda", dtype, memory_format=layout)  # type: ignore[call-overload]


def image(size: tuple[int, int], dtype: torch.dtype, layout: torch.memory_format) -> torch.Tensor:
    """Return a random input of the U-Net (images, CHANNELS, side, side)."""
    torch.manual_seed(1)
    return torch.randn(size[0], CHANNELS, size[1], size[1], device="cuda").to(dtype, memory_format=layout)


def frames(compiled: bool) -> dict[str, Call]:
    """Return the paths of a frame."""
    paths: dict[str, Call] = {}
    for name, dtype, layout in (
        ("float32", torch.float32, torch.contiguous_format),
        ("TF32", torch.float32, torch.contiguous_format),
        ("bfloat16", torch.bfloat16, torch.contiguous_format),
        ("bfloat16, channels_last", torch.bfloat16, torch.channels_last),
    ):
        net, x = unet(dtype, layout).eval(), image(FRAME, dtype, layout)
        paths[name] = partial(PlainUNet(net) if name == "float32" else net, x)
    paths["the same as a CUDA graph"] = _graph(partial(net, x))
    if compiled:
        paths["the same through torch.compile"] = partial(torch.compile(net), x)
    return paths


def steps(compiled: bool) -> dict[str, Call]:
    """Return the paths of a training step without its optimiser."""
    paths: dict[str, Call] = {}
    for name, autocast, layout in (
        ("TF32", False, torch.contiguous_format),
        ("bfloat16 autocast", True, torch.contiguous_format),
        ("bfloat16 autocast, channels_last", True, torch.channels_last),
    ):
        paths[name] = partial(_step, unet(torch.float32, layout), image(STEP, torch.float32, layout), autocast)
    if compiled:
        net = torch.compile(unet(torch.float32, layout))
        paths["the same through torch.compile"] = partial(_step, net, image(STEP, torch.float32, layout), True)
    return paths


def _step(net: Any, x: torch.Tensor, autocast: bool) -> None:
    net.zero_grad()
    with torch.autocast("cuda", torch.bfloat16, enabled=autocast):
        y = net(x)
    y.float().square().mean().backward()


def _graph(call: Call) -> Call:
    graph = torch.cuda.CUDAGraph()
    for _ in range(3):
        call()
    torch.cuda.synchronize()
    with torch.cuda.graph(graph):
        call()
    return graph.replay


def times(paths: dict[str, Call], turns: int) -> dict[str, float]:
    """Return the median milliseconds of each path over the turns."""
    laps: dict[str, list[float]] = {name: [] for name in paths}
    for turn in range(3 + turns):
        for name, call in paths.items():
            torch.cuda.synchronize()
            start = time.perf_counter()
            call()
            torch.cuda.synchronize()
            if turn >= 3:
                laps[name].append(1000 * (time.perf_counter() - start))
    return {name: round(statistics.median(each), 3) for name, each in laps.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--turns", type=int, default=50, help="timed turns (default: 50)")
    parser.add_argument("--compile", action="store_true", help="also measure torch.compile")
    parser.add_argument("--out", type=Path, default=Path("results/bench/gpu/unet.json"))
    options = parser.parse_args()
    if not torch.cuda.is_available():
        parser.error("this machine has no CUDA device; benchmarks/bench.py measures a processor")
    report = {"manifest": origin() | surroundings(torch.device("cuda")), "turns": options.turns}
    torch.backends.cudnn.allow_tf32 = True
    with torch.inference_mode():
        report["frame_ms"] = times(frames(options.compile), options.turns)
    report["step_ms"] = times(steps(options.compile), options.turns)
    write_bytes(options.out, (json.dumps(report, indent=1) + "\n").encode())
    print(json.dumps({key: report[key] for key in ("frame_ms", "step_ms")}, indent=1))


if __name__ == "__main__":
    main()
