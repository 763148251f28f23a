"""benchmarks/speedrun.py: its finish lines, and two runs in a tiny room."""

import runpy
import sys

import pytest
from tiny import use_tiny_inception, write

from nlt.errors import UserError
from nlt.evaluation.results import read_rows
from nlt.paths import PROJECT

pytest_plugins = ["training_fixtures"]
pytestmark = pytest.mark.slow

LINES = {"fid": 60.0, "mssim": 0.8, "mse": 0.002}
SCRIPT = str(PROJECT / "benchmarks/speedrun.py")


@pytest.mark.parametrize(
    ("fid", "mssim", "mse", "lines"),
    [(59, 0.9, 0.001, "line 1, line 2, line 3"), (61, 0.9, 0.003, "line 2"), (61, 0.7, 0.003, "none")],
)
def test_lines(fid, mssim, mse, lines):
    assert runpy.run_path(SCRIPT)["passed"]({"fid": fid, "mssim": mssim, "mse": mse}, LINES) == lines


def test_the_table_names_the_fastest_of_each_line():
    known = {"date": "2026-01-01", "commit": "abcdef123", "method": "cnn", "render_min": 1.0, "train_min": 2.0}
    known |= {"fid": 50.0, "mssim": 0.5, "mse": 0.1}
    records = [
        {**known, "what": what, "minutes": minutes, "lines": lines}
        for what, minutes, lines in [("slow", 9.0, "line 1, line 2"), ("quick", 3.0, "line 1"), ("lost", 1.0, "none")]
    ]
    text = runpy.run_path(SCRIPT)["table"](records, LINES)
    assert "| 1 | FID below 60 | 3.0 | cnn: quick |" in text and "| 2 | MSSIM above 0.8 | 9.0 | cnn: slow |" in text
    assert "| 3 | MSE below 0.002 | – | not passed |" in text
    assert "| 2026-01-01 | abcdef1 | cnn | quick | 1.00 | 2.00 | 3.00 | 50.0 | 0.5000 | 0.10000 | line 1 |" in text


def test_three_runs(tiny, tmp_path, monkeypatch, one_thread):
    """The first sets the third line; the next has its own number of images; the last renders them while it trains."""
    monkeypatch.chdir(tmp_path)
    use_tiny_inception(monkeypatch)
    scale = write(tmp_path / "scale.yaml", {"model": {"init_args": {"width": 2}}, "trainer": {"max_steps": 2}})
    fixed = ["--data", str(tiny.data), "--scale", str(scale)]
    changes = {
        "the first": [],
        "fewer images": ["data.dataset.train=4"],
        "online": ["data.online=true", "data.workers=1"],
    }
    for what, settings in changes.items():
        more = ["--what", what, *(["--set", *settings] if settings else [])]
        monkeypatch.setattr(sys, "argv", ["speedrun.py", "cnn", *fixed, *more])
        runpy.run_path(SCRIPT)["main"]()
    first, second, online = rows = read_rows(tmp_path / "results/speedrun/records.csv")
    assert [(row["what"], row["settings"]) for row in rows[1:]] == [
        ("fewer images", "data.dataset.train=4"), ("online", "data.online=true data.workers=1"),
    ]  # fmt: skip
    assert online["mse"] != first["mse"], "online, the loader's order is that of the renderer"
    for row in rows:
        assert row["minutes"] == pytest.approx(row["render_min"] + row["train_min"]) and row["train_min"] > 0
    assert "line 3" not in first["lines"] and first["mse"] > 0 and first["mse"] != second["mse"]
    assert f"MSE below {first['mse'] / 2:.4g}" in (tmp_path / "results/speedrun/records.md").read_text()
    monkeypatch.setattr(sys, "argv", ["speedrun.py", "cnn", *fixed, "--what", "x", "--set", "data.dataset.test=2"])
    with pytest.raises(UserError, match="changes the test views"):
        runpy.run_path(SCRIPT)["main"]()
