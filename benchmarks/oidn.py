"""Measures the time of Open Image Denoise in each of its modes, on random images, which do not change the times.

Usage: python benchmarks/oidn.py                              # writes results/bench/oidn.json and oidn.md
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path
from typing import get_args

import torch

from nlt.baselines.path_tracing import OpenImageDenoise, Quality
from nlt.data.files import write_bytes
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.policy import default_device
from nlt.paths import PROJECT
from nlt.report.table_writer import grid

SIZES = (16, 64, 128, 256)  # 16 shows the cost that does not grow with the pixels
WARM_UP, TIMED, ROUNDS = 3, 10, 4


def main() -> None:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, default=PROJECT / "results/bench")
    options = parser.parse_args()
    device = default_device()
    record = {**origin(), **surroundings(device), "load_average": {"before": os.getloadavg()}}
    times: dict[tuple[str, int], list[float]] = {}
    for _ in range(ROUNDS):  # interleaved, so that other work on the machine slows all modes alike
        for quality in get_args(Quality):
            for size in SIZES:
                times.setdefault((quality, size), []).extend(measure(quality, size, device))
    rows = [
        {"quality": q, "size": n, "ms": statistics.median(ms), "fastest_ms": min(ms)} for (q, n), ms in times.items()
    ]
    table = []  # a row per mode
    for quality in get_args(Quality):
        by_size = [times[quality, size] for size in SIZES]
        table.append([quality, *(f"{statistics.median(ms):.1f} ({min(ms):.1f})" for ms in by_size)])
    record["load_average"]["after"] = os.getloadavg()
    before, after = (load[0] for load in record["load_average"].values())
    note = (
        "Milliseconds of `denoise` alone: the median and, in brackets, the fastest. "
        f"{record['device']}; load average {before:.1f} before, {after:.1f} after. `python benchmarks/oidn.py`"
    )
    lines = ["# Open Image Denoise", "", *grid(["mode", *(f"{n}x{n}" for n in SIZES)], table), note, ""]
    text = "\n".join(lines)
    write_bytes(options.out / "oidn.json", (json.dumps({**record, "rows": rows}, indent=1) + "\n").encode())
    write_bytes(options.out / "oidn.md", text.encode())
    print(text)


def measure(quality: Quality, size: int, device: torch.device) -> list[float]:
    """Return the milliseconds of each timed image of size x size pixels."""
    traced, albedo, normal = torch.rand(3, 1, 3, size, size, device=device)
    batch = {"traced": traced, "albedo": albedo, "normal": normal, "exposure": torch.ones(1, device=device)}
    method, times = OpenImageDenoise(quality=quality), []
    for _ in range(WARM_UP + TIMED):
        start = time.perf_counter()
        method(batch).cpu()  # waits for the device
        times.append(1e3 * (time.perf_counter() - start))
    return times[WARM_UP:]


if __name__ == "__main__":
    main()
