"""Measures the frames per second of `nlt view` while the light moves: each picture that the page offers, at each size.

    OMP_WAIT_POLICY=passive python benchmarks/viewing.py               # the demo's models
    OMP_WAIT_POLICY=passive python benchmarks/viewing.py results/demo  # those of a comparison

It writes results/bench/viewing.json and viewing.md. OpenMP reads the policy once, at the start; `nlt view` sets it
itself. The pictures are drawn as the page draws them, without the browser. Methods take turns, so that other work on
the machine slows all of them.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from pathlib import Path

from nlt.data.files import write_bytes
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.policy import default_device
from nlt.paths import PROJECT
from nlt.report.table_writer import grid
from nlt.scenes.trajectory import TURNTABLE, cameras, states
from nlt.view.pictures import REFERENCE, Pictures

SIZES = (128, 256)
WARM_UP, TIMED, ROUNDS = 4, 10, 3


def main() -> None:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("source", nargs="?", help="a checkpoint or a results directory; default: the demo's models")
    parser.add_argument("--out", type=Path, default=PROJECT / "results/bench")
    options = parser.parse_args()
    pictures = Pictures(options.source, None)
    names = [name for name in pictures.names if name != REFERENCE]
    description, experiment = pictures.scene.description, pictures.scene.experiment
    moments = states(description, experiment, "0", TURNTABLE, WARM_UP + ROUNDS * TIMED)
    record = {**origin(), **surroundings(default_device()), "load_average": {"before": os.getloadavg()}}
    times: dict[tuple[str, int], list[float]] = {}
    stages: dict[tuple[str, int], dict[str, float]] = {}
    for turn in range(ROUNDS):
        for size in SIZES:
            (camera,) = cameras(description, TURNTABLE, 1, size, size)
            for name in names:
                warm_up = range(WARM_UP if turn == 0 else 1)
                timed = range(WARM_UP + turn * TIMED, WARM_UP + (turn + 1) * TIMED)
                for k in warm_up:
                    pictures.draw(name, moments[k], camera, 1)
                pictures.lap()
                for k in timed:
                    start = time.perf_counter()
                    pictures.draw(name, moments[k], camera, 1)
                    times.setdefault((name, size), []).append(time.perf_counter() - start)
                sums = stages.setdefault((name, size), {})
                for stage, seconds in pictures.lap().items():
                    sums[stage] = sums.get(stage, 0.0) + 1e3 * seconds / (ROUNDS * TIMED)
    record["load_average"]["after"] = os.getloadavg()
    record["rows"] = [
        {"picture": n, "size": s, "ms": 1e3 * statistics.median(t), "stages_ms": stages[n, s]}
        for (n, s), t in times.items()
    ]
    table = []
    for name in names:
        medians = [statistics.median(times[name, size]) for size in SIZES]
        table.append([name, *(f"{1 / second:.0f} ({1e3 * second:.0f} ms)" for second in medians)])
    before, after = (load[0] for load in record["load_average"].values())
    note = (
        f"Frames per second while the light moves, and the median of {ROUNDS * TIMED} frames; path tracing and Open "
        f"Image Denoise at 1 sample per pixel. {record['device']}; load average {before:.1f} before, {after:.1f} after."
        f" `{record['command']}`"
    )
    lines = ["# Frames per second of the viewer", "", *grid(["picture", *(f"{n}x{n}" for n in SIZES)], table), note, ""]
    write_bytes(options.out / "viewing.json", (json.dumps(record, indent=1) + "\n").encode())
    write_bytes(options.out / "viewing.md", "\n".join(lines).encode())
    print("\n".join(lines))


if __name__ == "__main__":
    main()
