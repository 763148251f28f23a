"""benchmarks/leaner.py on results with known means and seed noise, and the curves that sizes make."""

import math
import runpy

import numpy as np
import pytest
from made_results import make_results
from scipy import stats

from nlt.errors import UserError
from nlt.evaluation.results import load, write_manifest
from nlt.paths import PROJECT
from nlt.report.figures import curves, draw_speed_accuracy

pytestmark = pytest.mark.slow

MSE = {"tiny": 0.04, "small": 0.02, "medium": 0.01, "large": 0.01, "paper": 0.01}


@pytest.fixture
def results(tmp_path):
    """Return results with 2 % of noise: nlt_photons as in `MSE`, and cnn equal in all sizes."""
    rows = {}
    for k, (size, mse) in enumerate(MSE.items()):
        rows[f"nlt_photons@{size}"] = {"time_per_frame_s": 0.01 * 2**k, "mse": mse, "mssim": 0.8 - mse}
        rows[f"cnn@{size}"] = {"time_per_frame_s": 0.004 * 2**k, "mse": 0.1, "mssim": 0.7}
    made = make_results(tmp_path, rows, None, seeds=3, over_seeds=0.02)
    write_manifest(tmp_path, {**made.manifest, "scenes": ["room"], "dataset": "moving_lights-room-64-0"})
    return load(tmp_path)


def test_the_leanest(results):
    leaner = runpy.run_path(str(PROJECT / "benchmarks/leaner.py"))
    photons, cnn = leaner["groups"](results)
    assert photons == [f"nlt_photons@{size}" for size in MSE] and cnn == [f"cnn@{size}" for size in MSE]
    rows, noise = leaner["rank"](results, photons, "mse")
    assert [row.method for row in rows] == photons  # by time
    assert [row.enough for row in rows] == [False, False, True, True, True]
    assert rows[0].loss == pytest.approx(3, rel=0.1) and rows[0].value == pytest.approx(0.04, rel=0.04)
    logs = [np.log(results.values(method, "mse")) for method in photons]
    expected = stats.t.ppf(0.975, 10) * math.sqrt(2 / 3 * np.mean([v.var(ddof=1) for v in logs]))
    assert noise == pytest.approx(math.expm1(expected))
    text = leaner["judge"](results.directory)
    assert text == (results.directory / "leanest.md").read_text()
    assert "**MSE: Ours (w/ photons), medium (39.8 ms a frame).**" in text and "**MSE: CNN only" in text
    assert "| Ours (w/ photons), tiny | 0.0" in text and "of 3 seeds" in text


def test_one_seed_says_nothing_of_noise(tmp_path):
    made = make_results(tmp_path, {f"cnn@{k}": {"time_per_frame_s": 1.0, "mse": 0.1} for k in MSE}, None)
    with pytest.raises(UserError, match="2 seeds"):
        runpy.run_path(str(PROJECT / "benchmarks/leaner.py"))["rank"](made, made.methods, "mse")


def test_sizes_are_curves(results):
    """The sizes of a method make one curve, from the fastest on."""
    assert curves(results) == {
        "Ours (w/ photons), variants": [f"nlt_photons@{size}" for size in MSE],
        "CNN only, variants": [f"cnn@{size}" for size in MSE],
    }
    draw_speed_accuracy(results)
    assert (results.directory / "speed_accuracy.png").exists()
