"""Finds how small a model may be.

    python benchmarks/leaner.py --seeds 3
    python benchmarks/leaner.py --judge results/sizes

Runs `nlt compare` for five network sizes (results/sizes); a stopped run resumes. Then writes leanest.md there from the
stored results alone (`--judge` does only this, for any results): the cheapest method that is worse than the best by no
more than seed noise.
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import scipy.stats

from nlt.cli import exit_code
from nlt.cli import main as nlt
from nlt.data.files import write_bytes
from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import LEVEL, Results, load
from nlt.metrics.quantities import METRICS
from nlt.report.table_writer import grid

STUDIES = {  # directory of the results: arguments of nlt compare
    "results/sizes": "--config sizes",
}
KEYS = ("mse", "mssim")


@dataclass(frozen=True)
class Row:
    """A method compared with the best of its group; `loss` is the fraction by which its error is larger."""

    method: str
    value: float
    time: float
    parameters: int
    loss: float
    enough: bool


def rank(results: Results, methods: list[str], key: str) -> tuple[list[Row], float]:
    """Return the methods, the cheapest first, and the least loss that exceeds seed noise (Fisher's LSD).

    Errors (1 - MSSIM for MSSIM) are compared by their logarithms, whose variance over seeds is assumed equal for all
    methods and pooled. Test images are the same for all.
    """
    errors = {m: results.values(m, key) for m in methods}
    errors = {m: np.log(v if METRICS[key].direction == "lower" else 1 - v) for m, v in errors.items() if len(v)}
    freedom, seeds = sum(len(v) - 1 for v in errors.values()), min(len(v) for v in errors.values())
    if not freedom:
        raise UserError(f"{results.directory}: has one seed, so seed noise is unknown; compare with 2 seeds or more")
    variance = sum(((v - v.mean()) ** 2).sum() for v in errors.values()) / freedom
    noise = scipy.stats.t.ppf((1 + LEVEL) / 2, freedom) * math.sqrt(2 * variance / seeds)
    best = min(v.mean() for v in errors.values())
    rows = []
    for m, v in errors.items():
        sizes = (results.mean(m, "time_per_frame_s"), int(results.mean(m, "parameters")))
        behind = v.mean() - best
        rows.append(Row(m, results.mean(m, key), *sizes, math.expm1(behind), bool(behind <= noise)))
    return sorted(rows, key=lambda row: row.time), math.expm1(noise)


def groups(results: Results) -> list[list[str]]:
    """Group the sizes of each method; without sizes, or with photon counts only, all methods are one group."""
    sized: dict[str, list[str]] = {}
    for method in results.methods:
        name, _, size = method.partition("@")
        sized.setdefault(name if size and "_" not in size else "", []).append(method)
    return list(sized.values())


def judge(directory: Path) -> str:
    """Write leanest.md of a comparison's results and return its text."""
    results = load(directory)
    seeds = len(results.manifest["seeds"])
    scenes = f"{', '.join(results.manifest['scenes'])} ({results.manifest['dataset'].partition('-')[0]})"
    lines = [f"# The leanest method without a loss beyond seed noise: {scenes}", ""]
    for methods in groups(results):
        for key in KEYS:
            rows, noise = rank(results, methods, key)
            named = lambda row: f"{label(row.method)} ({1e3 * row.time:.1f} ms a frame)"
            leanest, best = next(row for row in rows if row.enough), min(rows, key=lambda row: row.loss)
            metric = METRICS[key]
            lines += [
                f"**{metric.label}: {named(leanest)}.** The best is {named(best)}. "
                f"A loss below {noise:.0%} may be the noise of {seeds} seeds.",
                "",
            ]
            table = [
                [label(row.method), f"{row.value:{metric.format}}", f"{row.loss:.0%}", "no" if row.enough else "yes",
                 f"{1e3 * row.time:.1f}", f"{row.parameters:,}"] for row in rows
            ]  # fmt: skip
            headings = ["method", metric.label, "loss", "beyond noise", "time per frame (ms)", "parameters"]
            lines += grid(headings, table)
    lines += ["Loss: the fraction by which the error (1 - MSSIM for MSSIM) exceeds the best. Means over seeds.",
              f"`python benchmarks/leaner.py --judge {directory}`"]  # fmt: skip
    text = "\n".join(lines) + "\n"
    write_bytes(directory / "leanest.md", text.encode())
    return text


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--workers", type=int, default=1, help="trainings in parallel")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES), help="studies to run")
    parser.add_argument("--judge", nargs="+", metavar="DIR", help="only judge these results")
    options = parser.parse_args()
    for directory in options.judge or options.only:
        if not options.judge:
            more = [f"--seeds={options.seeds}", f"--workers={options.workers}", f"--out={directory}"]
            sys.argv = ["nlt", "compare", *STUDIES[directory].split(), *more]  # the manifest records it
            if code := nlt(sys.argv[1:]):
                sys.exit(code)
        print(judge(Path(directory)), flush=True)


if __name__ == "__main__":
    sys.exit(exit_code(main))
