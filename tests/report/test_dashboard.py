"""`nlt report --dashboard`: what TensorBoard itself says it shows."""

import json
import os
import re
import signal
import subprocess
import sys
import time
import urllib.request
from functools import partial

import pytest
from made_results import ODD, make_troubled_results
from torch.utils.tensorboard import SummaryWriter

from nlt.cli import main
from nlt.evaluation.results import load
from nlt.metrics.quantities import QUANTITIES
from nlt.paths import PROJECT
from nlt.report.dashboard import write_logs


@pytest.fixture(scope="module")
def stored(tmp_path_factory):
    """Results, and a training's logs of one run, in the directory that runs.csv names."""
    folder = tmp_path_factory.mktemp("dashboard")
    with SummaryWriter(str(folder / "runs/cnn-0")) as writer:
        for step in range(5):
            writer.add_scalar("train/loss", 1 / (step + 1), step)
        writer.add_scalar("val/loss", 0.5, 4)
    directory = make_troubled_results(folder / "results").directory
    (directory / "speed_accuracy.png").write_bytes((PROJECT / "docs/sample.png").read_bytes())
    return directory


def test_tensorboard_shows_it(stored):
    """A run per method and seed with its training's curves; the layout; hyperparameters; the chart; no histograms."""
    environment = {**os.environ, "PYTHONPATH": str(PROJECT)}
    command = [sys.executable, "-c", "from nlt.cli import main; main()", "report", str(stored), "--dashboard=0"]
    heed = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)  # which the background jobs of a shell ignore
    server = subprocess.Popen(
        command, cwd=stored.parent, stdout=subprocess.PIPE, text=True, env=environment, preexec_fn=heed
    )
    try:
        url = re.match(r"(http://\S+?)/? shows", server.stdout.readline())[1]

        def get(path, body=None):
            data = None if body is None else json.dumps(body).encode()
            request = urllib.request.Request(f"{url}/data/{path}", data, {"Content-Type": "application/json"})
            return json.load(urllib.request.urlopen(request, timeout=30))

        runs = {f"{row['method']}/seed_{row['seed']}" for row in load(stored).runs} | {"comparison"}
        deadline = time.monotonic() + 60
        while set(get("runs")) != runs or "train/loss" not in get("plugin/scalars/tags").get("cnn/seed_0", {}):
            assert time.monotonic() < deadline, (get("runs"), get("plugin/scalars/tags"))
            time.sleep(0.2)
        losses = get("plugin/scalars/scalars?run=cnn/seed_0&tag=train/loss")
        assert [value for _, _, value in losses] == pytest.approx([1 / (step + 1) for step in range(5)])
        tags = get("plugin/scalars/tags")
        assert "final/mse" in tags["cnn/seed_0"] and "final/mse" not in tags.get("nlt/seed_1", {})
        charts = {chart["title"]: chart for category in get("plugin/custom_scalars/layout")["category"]
                  for chart in category["chart"]}  # fmt: skip
        shown = {tag for chart in charts.values() for tag in chart["multiline"]["tag"]}
        assert {"train/loss", "val/loss", "val/mse"} <= shown
        experiment = get("plugin/hparams/experiment", {})
        assert {info["name"] for info in experiment["hparamInfos"]} >= {"method", "seed"}
        names = {info["name"]["tag"]: info["displayName"] for info in experiment["metricInfos"]}
        assert names["final/mse"] == "MSE ↓" and f"final/{next(iter(QUANTITIES))}" in names
        images = get("plugin/images/tags")
        assert "speed_accuracy" in images["comparison"]
        assert not any(get("plugin/histograms/tags").values())
    finally:
        server.send_signal(signal.SIGINT)
        assert server.wait(timeout=30) == 0


def test_again(stored, monkeypatch):
    """Making it again replaces everything; the trainings' own logs stay."""
    monkeypatch.chdir(stored.parent)
    for _ in range(2):
        logs = write_logs(load(stored))
    assert len(list((logs / "cnn/seed_0").iterdir())) == 2
    assert len(list((stored.parent / "runs/cnn-0").iterdir())) == 1
    assert len(list(logs.glob("*/seed_*"))) == len(load(stored).runs)
    assert (logs / ODD / "seed_0").is_dir()


def test_no_results(tmp_path, capsys):
    assert main(["report", str(tmp_path), "--dashboard"]) == 2
    assert "nlt compare" in capsys.readouterr().err
