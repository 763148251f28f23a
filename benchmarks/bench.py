"""Measures the cost of a frame, a training step and a sample, against a plain path and the machine's ceilings.

    python benchmarks/bench.py                       # all methods; writes bench.json, bench.md and figures
    python benchmarks/bench.py --methods nlt_photons --growth --out results/bench/growth

After a kill, the same command at the same commit goes on where it was. docs/performance.md explains the results.
"""

import argparse
import sys
from collections.abc import Sequence

from nlt.arguments import Parser, pair, positive
from nlt.cli import exit_code
from nlt.waiting import wait_passively


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and return the exit code of `nlt.cli.exit_code`."""
    return exit_code(lambda: _run(argv))


def _run(argv: Sequence[str] | None) -> None:
    options = parser().parse_args(argv)
    wait_passively()
    from costs.run import Benchmark  # imports PyTorch, which reads the wait policy

    Benchmark(options).run()


def parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python benchmarks/bench.py", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--data", default="demo", help="config in configs/data, by name or path (default: demo)")
    parser.add_argument("--scale", default="demo", help="config in configs/scale, by name or path (default: demo)")
    parser.add_argument("--methods", nargs="+", help="configs in configs/model (default: all but the ablation's)")
    parser.add_argument(
        "--set", dest="changed", nargs="+", action="extend", type=pair, default=[], metavar="KEY=VALUE",
        help="override resolution, num_points, num_photons, width, depth, batch_size, workers or batch (frames)",
    )  # fmt: skip
    parser.add_argument(
        "--ckpt", dest="checkpoint", metavar="CKPT", help="checkpoint of the only method (default: random weights)"
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), help="cpu or cuda (default: cuda if available)")
    parser.add_argument("--seconds", type=positive, default=20, help="maximum seconds per measurement (default: 20)")
    parser.add_argument(
        "--growth", nargs="*", metavar="METHOD",
        help="also vary resolution, num_points, num_photons, width and batch (without METHOD: of nlt_photons)",
    )  # fmt: skip
    parser.add_argument("--out", default="results/bench", help="directory for the results (default: results/bench)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
