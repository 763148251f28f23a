"""Checks whether `nlt select` picks the model that a scene needs, in five scenes, and what each pick saves.

    python benchmarks/selection.py --minutes 6

Runs `nlt select` for a static scene, a room with fixed lights and three with a moving light, and writes summary.md and
summary.csv: each pick against always taking the full model and against picking by the number of parameters. A claim
that does not hold is printed as failing. A complete selection is not repeated.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from pathlib import Path
from typing import Any

from nlt.data.files import write_bytes
from nlt.evaluation.results import read_rows, write_rows
from nlt.select.output import summary

# In configs/select.
CASES = ("static_egg", "fixed_lights", "demo", "real_living_room", "real_dining_room")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, help="time of each selection (default: the config's)")
    parser.add_argument("--out", type=Path, default=Path("results/select"))
    options = parser.parse_args()
    confirmed: dict[str, list[dict[str, Any]]] = {}
    for case in CASES:
        directory = options.out / case
        if not (directory / "front.svg").exists():
            minutes = [f"--minutes={options.minutes}"] if options.minutes else []
            command = [sys.executable, "-m", "nlt.cli", "select", "--config", case, "--out", str(directory), *minutes]
            subprocess.run(command, check=True)  # own processes: Mitsuba's memory grows with every scene
        confirmed[case] = read_rows(directory / "confirmed.csv")
    write_rows(options.out / "summary.csv", [{"case": case, **row} for case, rows in confirmed.items() for row in rows])
    text = summary(confirmed)
    write_bytes(options.out / "summary.md", text.encode())
    print(text)


if __name__ == "__main__":
    main()
