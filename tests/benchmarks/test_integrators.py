"""benchmarks/integrators.py: its figures on made-up images whose variances are known, and the script itself."""

import csv
import json
import runpy
import subprocess
import sys

import numpy as np
import pytest
from conftest import write_room

from nlt.paths import PROJECT
from nlt.scenes.lanes import is_jit

pytestmark = pytest.mark.slow

SCRIPT = PROJECT / "benchmarks/integrators.py"
CODE = runpy.run_path(str(SCRIPT))
SPP, SIZE, VIEWS, RENDERS = CODE["SPP"], 16, 3, 40


def made_up(spread, seed, shift=0.0):
    """Return images whose pixels have mean 1 and, for one sample, a variance of `spread` squared."""
    noise = np.random.default_rng(seed).normal(0, spread / np.sqrt(SPP), (VIEWS, RENDERS, 3, SIZE, SIZE))
    return 1 + shift + noise


def figures(images):
    times = {"path": [0.2, 0.1, 0.1], "bdpt": [0.4, 0.4, 3.0]}  # medians 0.1 and 0.4 seconds
    return CODE["figures"](images, times, 0.5, SIZE)


def test_figures():
    images = {"path": made_up(3.0, 0), "bdpt": made_up(1.0, 1)}
    row = figures(images)
    for integrator in images:
        assert np.isclose(row[f"{integrator}_variance"], SPP * images[integrator].var(1, ddof=1).mean(), rtol=1e-6)
    assert np.isclose(row["bdpt_s"], 0.4 / (SIZE**2 * SPP))
    # A ninth of the variance in four times the time.
    assert row["ratio_low"] < 9 / 4 < row["ratio_high"] and row["ratio_high"] - row["ratio_low"] < 0.3
    assert row["better"] == "bdpt" and row["p_agreement"] > 1e-3 and row["path_worst_pixel"] < 0.01
    assert figures({"path": made_up(1.0, 0), "bdpt": made_up(1.0, 1)})["better"] == "path"
    assert figures({"path": made_up(2.0, 2), "bdpt": made_up(1.0, 3)})["better"] == "undecided"
    assert figures({"path": made_up(1.0, 0), "bdpt": made_up(1.0, 1, shift=0.05)})["p_agreement"] < 1e-6


def test_a_firefly_shows():
    """If one pixel makes up the variance, the interval is wide, but the displayed variance hardly changes."""
    images = {"path": made_up(1.0, 0), "bdpt": made_up(1.0, 1)}
    images["path"][1, 7, :, 3, 4] += 300
    row = figures(images)
    assert row["path_worst_pixel"] > 0.9 and row["ratio_high"] > 10 * row["ratio_low"]
    assert row["better"] == "undecided" and row["ratio"] > 2 and row["display_ratio"] < 0.3


def run(*arguments):
    command = [sys.executable, str(SCRIPT), *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_script(tmp_path, variant):
    if not is_jit():
        pytest.skip("bdpt needs Mitsuba's llvm or cuda")
    room, out = write_room(tmp_path / "room"), tmp_path / "out"
    done = run(room, "--out", out, "--seconds", 1, "--resolution", 8, "--views", 1)
    assert done.returncode == 0, done.stderr
    (row,) = csv.DictReader((out / "table.csv").open())
    assert row["scene"] == "room" and float(row["p_agreement"]) > 1e-4 and float(row["ratio"]) > 0
    assert f"| {row['better']} |" in (out / "table.md").read_text() and "room: " in done.stdout
    manifest = json.loads((out / "manifest.json").read_text())
    assert manifest["resolution"] == 8 and manifest["scenes"] == [str(room)]
    assert (out / "integrators.png").stat().st_size > 1000
    mistaken = run("palace")
    assert mistaken.returncode and "palace" in mistaken.stderr and "Traceback" not in mistaken.stderr
