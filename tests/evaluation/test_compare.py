"""`nlt compare` over every method there is: its files, its numbers, and what it does when run again."""

import csv
import itertools
import json
import os
import re
import shutil
import statistics
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.linalg
import torch
from made_results import make_results, papers_numbers
from PIL import Image
from safetensors.numpy import load_file
from skimage.metrics import structural_similarity
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import DATASET, SCALE, use_tiny_inception, write
from torch.utils.data import default_collate

from nlt import paths
from nlt.baselines.cnn import CNN
from nlt.cli import main
from nlt.config import merge
from nlt.data import engines
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.spec import DatasetSpec
from nlt.data.store import points_name
from nlt.evaluation import clock, compare, comparison, progress, provenance
from nlt.evaluation.frames import Frames
from nlt.evaluation.judge import Evaluation
from nlt.evaluation.paper import published
from nlt.evaluation.provenance import origin
from nlt.evaluation.results import load, write_images, write_rows
from nlt.evaluation.trainings import Training, newest_checkpoint, train
from nlt.metrics.quantities import METRICS
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, accelerate
from nlt.models.unet import UNet
from nlt.paths import CONFIGS, PROJECT
from nlt.report import plots
from nlt.report.dashboard import write_logs
from nlt.report.draw import draw
from nlt.report.figures import curves, draw_learning_curves
from nlt.report.gallery import Shown, draw_samples, worst_pixels

pytest_plugins = ["training_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

CPU = torch.device("cpu")
ACCURACY = ("mse", "unbiased_mse", "reference_noise", "mssim", "fid", "feature_l1")
STAGES = ("gbuffer", "photons", "path_tracing", "transport", "projection", "synthesis", "denoise")
UNTRAINED = (
    "path_tracing_1",
    "path_tracing_4",
    "path_tracing_16",
    "oidn_1",
    "oidn_2",
    "oidn_4",
    "oidn_1_balanced",
    "oidn_2_balanced",
    "oidn_4_balanced",
    "oidn_1_fast",
    "oidn_2_fast",
    "oidn_4_fast",
    "oidn_1_mirrors",
)
STEPS = 6  # 4 to an epoch
# Methods that nothing in the package knows of.
EXTRA = """
import os
import signal
from pathlib import Path

from nlt.baselines.cnn import CNN
from nlt.models.nlt import NeuralLightTransport

class Diverges(CNN):
    def features(self, batch, transported=None):
        return super().features(batch) * float("nan")

class Fails(CNN):
    def training_step(self, batch, batch_idx):
        raise RuntimeError("out of\\nluck")

class Killed(CNN):
    def training_step(self, batch, batch_idx):
        os.kill(os.getpid(), signal.SIGKILL)

class KilledOnce(NeuralLightTransport):
    # In the second epoch, while a checkpoint is being written.
    def training_step(self, batch, batch_idx):
        if self.global_step == 5 and not Path("killed").exists():
            (kept,) = Path(self.trainer.log_dir).glob("checkpoints/*.ckpt")
            assert "step=4" in kept.name
            truncated = kept.with_name("epoch=7-step=99.ckpt")
            truncated.write_bytes(kept.read_bytes()[:-1000])
            os.utime(truncated, (2**31, 2**31))
            Path("killed").touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return super().training_step(batch, batch_idx)

class Extra(CNN):
    stages = ("photons", "gbuffer")
"""


class World(SimpleNamespace):
    """Its own directory, configs and methods; `compare` runs there and returns the table's rows by method."""

    def compare(self, *more, out="again"):
        with pytest.MonkeyPatch.context() as patch:
            if not self.draws:
                patch.setattr("nlt.cli._draw", lambda *_: None)
            assert main(["compare", "--config", str(self.config), f"--out={out}", *more]) == 0
        with (self.folder / out / "table.csv").open(newline="") as file:
            *rows, floor = csv.DictReader(file)
        assert floor["method"] == "reference (its halves)"
        return {row["method"]: row for row in rows}

    def runs(self, out="out"):
        """The rows of runs.csv by method."""
        with (self.folder / out / "runs.csv").open(newline="") as file:
            return {row["method"]: row for row in csv.DictReader(file)}

    def run(self, method):
        """The newest directory of a method's training."""
        found = self.folder.glob(f"runs/*/{method}-" + "[0-9a-f]" * 8)
        return max(found, key=lambda path: path.stat().st_mtime)

    def outcome(self, method):
        return json.loads((self.run(method) / "done.json").read_text())

    def checkpoint(self, method):
        (path,) = self.run(method).glob("checkpoints/*.ckpt")
        return path


@pytest.fixture(scope="module")
def world(tiny, tmp_path_factory, one_thread):
    """A first comparison of all methods; `frames`: what the clock measured, in order."""
    folder = tmp_path_factory.mktemp("world")
    shutil.copytree(CONFIGS, folder / "configs")
    write(folder / "extra_method.py", EXTRA)
    write(folder / "configs/model/extra.yaml", {"model": {"class_path": "extra_method.Extra"}})
    scale = merge(SCALE, {"trainer": {"max_steps": STEPS, "max_epochs": -1, "enable_progress_bar": False}})
    content = {"table": "table2", "data": str(tiny.data), "scale": str(write(folder / "scale.yaml", scale)), "seed": 3}
    frames = []
    original = clock.Clock._frame

    def spy(self, module, index):
        frames.append(original(self, module, index))
        return frames[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        patch.syspath_prepend(folder)
        patch.setattr(paths, "CONFIGS", folder / "configs")
        patch.setattr(engines, "available_cpus", lambda: 1)  # and so many threads in a training's process
        patch.setattr(clock, "WARM_UP", 1)
        patch.setattr(clock, "FRAMES", 3)
        patch.setattr(clock.Clock, "_frame", spy)
        config = write(folder / "tiny.yaml", content)
        patch.setattr(sys, "argv", ["nlt", "compare", "--config", str(config), "--out=out"])
        use_tiny_inception(patch)
        made = World(folder=folder, config=config, frames=frames, tiny=tiny, draws=True)
        made.rows = made.compare(out="out")
        made.measured = list(frames)
        made.draws = False  # only the pictures of the first are looked at
        yield made


@pytest.fixture
def trainings(monkeypatch):
    """The trainings that are begun."""
    begun = []
    original = engines.Local.run
    monkeypatch.setattr(engines.Local, "run", lambda self, *jobs: (begun.extend(jobs[1]), original(self, *jobs))[1])
    return begun


@pytest.fixture
def more_methods(world):
    """Adds methods of EXTRA, in lower case, for a test."""
    added = []

    def add(*names):
        for name in names:
            content = {"model": {"class_path": f"extra_method.{name}"}}
            added.append(write(world.folder / f"configs/model/{name.lower()}.yaml", content))

    yield add
    for path in added:
        path.unlink()


def methods():
    return set(comparison.all_methods())


def test_table(world):
    """One row for every config, the added method's included; the paper's columns come first."""
    assert set(world.rows) == methods() | {"extra"}
    with (world.folder / "out/table.csv").open() as file:
        header = file.readline().strip().split(",")
    assert header[:4] == ["method", "status", "n_test", "seeds"]
    means = [name for name in header[4:] if name.rpartition("_")[2] not in ("std", "low", "high")]
    assert means[:5] == ["time_per_frame_s", "mse", "mssim", "fid", "feature_l1"]
    runs = world.runs()
    for name, row in world.rows.items():
        assert (row["status"], row["n_test"], row["seeds"]) == ("ok", "3", "1")
        assert all(np.isfinite(float(row[key])) for key in ACCURACY)
        assert runs[name]["seed"] == "3" and runs[name]["steps"] == ("" if name in UNTRAINED else str(STEPS))


def test_time_is_the_sum_of_the_stages_medians(world):
    """Over the frames after the warm-up, of exactly the stages that the method declares."""
    for k, (name, row) in enumerate(world.rows.items()):
        stages = {stage for stage in STAGES if row[f"{stage}_s"]}
        if name in UNTRAINED:
            assert stages == {"path_tracing", *({"gbuffer", "denoise"} if "oidn" in name else ())}
        else:
            module = RenderingModule.load_from_checkpoint(world.checkpoint(name))
            assert stages == {*module.stages, "transport", "projection", "synthesis"}, name
        frames = world.measured[4 * k + 1 : 4 * k + 4]
        medians = {stage: statistics.median(frame[stage] for frame in frames) for stage in stages}
        for stage, seconds in medians.items():
            assert float(row[f"{stage}_s"]) == pytest.approx(seconds)
        assert float(row["time_per_frame_s"]) == pytest.approx(sum(medians.values()))
        of_camera = [seconds for stage, seconds in medians.items() if stage not in ("photons", "transport")]
        assert float(row["moving_camera_s"]) == pytest.approx(sum(of_camera))
    assert "photons" in RenderingModule.load_from_checkpoint(world.checkpoint("extra")).stages


def test_metrics_are_those_of_the_predictions(world):
    module = RenderingModule.load_from_checkpoint(world.checkpoint("nlt_photons"))
    module = accelerate(module, Policy.for_device(CPU), CPU)
    dataset = LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test")
    mse, mssim = [], []
    for k in range(3):
        batch = default_collate([dataset[k]])
        with torch.no_grad():
            prediction = module(batch)
        pair = [shown(x, batch) for x in (prediction, (batch["reference_a"] + batch["reference_b"]) / 2)]
        mse.append(np.mean((pair[0] - pair[1]) ** 2))
        f, r = (np.pad(x, ((3, 3), (3, 3), (0, 0)), mode="reflect") for x in pair)
        options = {"win_size": 7, "data_range": 1.0, "channel_axis": -1, "use_sample_covariance": False}
        mssim.append(structural_similarity(f, r, **options))
    row = world.rows["nlt_photons"]
    assert float(row["mse"]) == pytest.approx(np.mean(mse), rel=1e-5)
    assert float(row["mssim"]) == pytest.approx(np.mean(mssim), abs=1e-5)


def test_floor_is_one_half_judged_by_the_other(world):
    """By numpy, scikit-image and scipy; in the manifest and as the tables' last row."""
    dataset = LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test", ())
    a, b = [], []
    for k in range(3):
        batch = default_collate([dataset[k]])
        a.append(shown(batch["reference_a"], batch))
        b.append(shown(batch["reference_b"], batch))
    padded = [[np.pad(x, ((3, 3), (3, 3), (0, 0)), mode="reflect") for x in half] for half in (a, b)]
    options = {"win_size": 7, "data_range": 1.0, "channel_axis": -1, "use_sample_covariance": False}
    # The features of `tiny_inception`: means of quarters.
    pooled = [np.stack([x.reshape(2, 8, 2, 8, 3).mean((1, 3)).transpose(2, 0, 1).ravel() for x in h]) for h in (a, b)]
    covariance = [np.cov(half.T) for half in pooled]
    root = scipy.linalg.sqrtm(covariance[0] @ covariance[1]).real
    fid = np.sum((pooled[0].mean(0) - pooled[1].mean(0)) ** 2) + np.trace(sum(covariance) - 2 * root)
    expected = {
        "mse": np.mean([np.mean((x - y) ** 2) for x, y in zip(a, b, strict=True)]),
        "psnr": np.mean([-10 * np.log10(np.mean((x - y) ** 2)) for x, y in zip(a, b, strict=True)]),
        "mssim": np.mean([structural_similarity(x, y, **options) for x, y in zip(*padded, strict=True)]),
        "feature_l1": np.mean(np.abs(pooled[0] - pooled[1])),
        "fid": fid,
    }
    record = json.loads((world.folder / "out/manifest.json").read_text())
    for key, value in expected.items():
        assert record["floor"][key] == pytest.approx(value, rel=1e-4), key
    assert set(record["floor"]) == set(METRICS) - {"unbiased_mse", "reference_noise"}
    assert record["references"] == {"living_room": {"spp": 2, "measured_mse": pytest.approx(expected["mse"])}}
    with (world.folder / "out/table.csv").open(newline="") as file:
        *_, last = csv.DictReader(file)
    assert float(last["mse"]) == record["floor"]["mse"] and not last["time_per_frame_s"] and not last["unbiased_mse"]
    lines = (world.folder / "out/table.md").read_text().partition("\n## ")[0].splitlines()
    assert f"| reference (its halves) | – | {expected['mse']:.5f} | " in [x for x in lines if x[:1] == "|"][-1]


def shown(image, batch):
    """(H, W, 3): exposed, clamped, sRGB."""
    x = np.clip(image[0].permute(1, 2, 0).double().numpy() * batch["exposure"].item(), 0, 1)
    return np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)


def test_the_papers_figures_stand_beside_ours(world):
    lines = (world.folder / "out/table.md").read_text().partition("\n## ")[0].splitlines()
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in lines if line.startswith("| ")]
    accuracy = {name: cells for name, *cells in rows}
    theirs = {
        "CNN only": [0.019, 0.01, 0.827, 33.7, 0.199],
        "Ours (w/ photons)": [0.0468, 0.0014, 0.887, 25.1, 0.172],
        "Denoising (1/4)": [0.3801, 0.0002, 0.923, 17.6, 0.143],
    }
    for name, figures in theirs.items():
        assert [float(cell.split(" / ")[1]) for cell in accuracy[name]] == figures
    ours = float(accuracy["CNN only"][1].split(" / ")[0].removesuffix(" ≈"))
    assert ours == pytest.approx(float(world.rows["cnn"]["mse"]), abs=1e-5)
    assert "/" not in "".join(accuracy["extra"])


def test_pictures(world, tmp_path):
    """Of each view the noisy image, every method's and the reference, in lines of at most seven; nothing is black."""
    dataset = LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test", ())

    def check(file, count, views):
        image = np.asarray(Image.open(file).convert("RGB")) / 255
        side, lines = 192, -(-count // 7)
        columns = -(-count // lines)
        assert abs(image.shape[1] - side * columns) < 10
        bottoms = np.linspace(0, image.shape[0], len(views) * lines + 1)[1:]  # of the lines

        def tile(row, number):
            """The middle of a picture, without its borders."""
            line, column = divmod(number, columns)
            y, x = int(bottoms[row * lines + line] - side / 2), int((column + 0.5) * image.shape[1] / columns)
            half = int(0.3 * side)
            return image[y - half : y + half, x - half : x + half]

        for i, view in enumerate(views):
            batch = default_collate([dataset[view]])
            for j in range(count):
                assert 0.02 < tile(i, j).mean() < 0.98 and tile(i, j).std() > 0.005, (i, j)
            for j, target in ((0, batch["noisy"]), (count - 1, (batch["reference_a"] + batch["reference_b"]) / 2)):
                expected = shown(target, batch)[3:13, 3:13]
                assert np.abs(tile(i, j).mean((0, 1)) - expected.mean((0, 1))).max() < 0.06, (i, j)

    check(world.folder / "out/samples.webp", len(world.rows) + 2, [0])  # so many lines that one view is drawn
    images = Shown.load(load(world.folder / "out"))
    few = dict(itertools.islice(images.methods.items(), 8))
    draw_samples(replace(images, results=replace(images.results, directory=tmp_path), methods=few))
    check(tmp_path / "samples.webp", len(few) + 2, [0, 1, 2])
    rows = np.asarray(Image.open(world.folder / "out/qualitative.webp").convert("RGB")) / 255
    assert rows.shape[1] == pytest.approx(110 * 3 * 3, abs=10)  # image, inset and error of each view
    assert rows.shape[0] == pytest.approx(110 * (len(world.rows) + 2), abs=50)
    for view in range(3):
        batch = default_collate([dataset[view]])
        expected = shown((batch["reference_a"] + batch["reference_b"]) / 2, batch)[3:13, 3:13]
        tile = rows[-90:-22, 330 * view + 22 : 330 * view + 90]  # in the last row
        assert np.abs(tile.mean((0, 1)) - expected.mean((0, 1))).max() < 0.06, view
    curves = np.asarray(Image.open(world.folder / "out/speed_accuracy.png").convert("RGB"))
    assert curves.shape[1] > curves.shape[0] > 300 and curves.std() > 5


def test_manifest(world):
    record = json.loads((world.folder / "out/manifest.json").read_text())
    assert record["command"] == f"nlt compare --config {world.config} --out=out"
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=PROJECT, capture_output=True, text=True, check=False)
    assert record["commit"] is None if commit.returncode else re.fullmatch("[0-9a-f]{40}", record["commit"])
    assert set(record["configs"]) == set(world.rows) == set(record["methods"])
    assert record["configs"]["denoising_1_4"]["model"]["init_args"] == {"one_in": 4, "gbuffer": False, "width": 2}
    assert (record["seeds"], record["n_test"]) == ([3], 3)
    assert record["versions"]["torch"] == torch.__version__
    assert record["wall_time_s"] > 0 and record["device"]
    assert record["integrators"] == {"living_room": "path"}


# ---- run again ------------------------------------------------------------------------------------------


def test_trainings_are_forked_from_a_process_without_mitsuba():
    """Importing Dr.Jit initialises CUDA, and then PyTorch cannot use CUDA in a forked process."""
    program = "import sys, nlt.evaluation.trainings; print({'drjit', 'mitsuba'} & sys.modules.keys())"
    assert subprocess.check_output([sys.executable, "-c", program], text=True) == "set()\n"


def test_nothing_is_trained_twice(world, trainings):
    again = world.compare("--methods", "cnn", "nlt_photons", "denoising_1_4")
    assert trainings == []
    for name, row in again.items():
        assert {key: row[key] for key in ACCURACY} == {key: world.rows[name][key] for key in ACCURACY}


def test_a_second_device_adds_its_times(world, trainings, monkeypatch):
    """Nothing is trained for it; the first one's times stay."""
    shutil.copytree(world.folder / "out", world.folder / "devices", ignore=shutil.ignore_patterns("*.png", "*.svg"))
    here, other = compare.surroundings, not Policy.for_device(CPU).bfloat16
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": other})
    monkeypatch.setattr(compare, "surroundings", lambda *given: here(*given) | {"device": "GPU, made up"})
    second = world.compare("--methods", "cnn", "path_tracing_1", out="devices")
    assert trainings == []
    results = load(world.folder / "devices")
    assert results.devices == ["GPU, made up", here(torch.device("cpu"))["device"]]
    first = results.on(results.devices[1])
    for name in second:
        for key in ("time_per_frame_s", "path_tracing_s", "synthesis_s"):
            assert results.mean(name, key) == pytest.approx(float(second[name][key] or "nan"), nan_ok=True)
            assert first.mean(name, key) == pytest.approx(float(world.rows[name][key] or "nan"), nan_ok=True)
    assert len(results.timings) == 2 + len(world.rows)
    assert "Time per frame by device" in (world.folder / "devices/table.md").read_text()


def test_a_package_that_is_not_installed_has_no_version(monkeypatch):
    """A comparison without OIDN's rows may run where OIDN is not installed."""
    monkeypatch.setattr(provenance, "_PACKAGES", ("torch", "no-such-package"))
    assert provenance.surroundings(CPU)["versions"] == {"torch": torch.__version__, "no-such-package": None}


def test_one_methods_config_retrains_this_method(world, trainings):
    file = world.folder / "configs/model/feature_projection.yaml"
    before = file.read_text()
    file.write_text(before + "  init_args:\n    learning_rate: 0.01\n")
    try:
        rows = world.compare("--methods", "cnn", "feature_projection")
        assert len(trainings) == 1 and '"learning_rate": 0.01' in trainings[0].config
        assert rows["feature_projection"]["mse"] != world.rows["feature_projection"]["mse"]
        assert rows["cnn"]["mse"] == world.rows["cnn"]["mse"]
    finally:
        file.write_text(before)
    rows = world.compare("--methods", "feature_projection")
    assert len(trainings) == 1 and rows["feature_projection"]["mse"] == world.rows["feature_projection"]["mse"]


def test_precision(world, trainings, monkeypatch):
    """What the device has, unless switched off: of the training, of the images that are judged, in the manifest."""
    first = Policy.for_device(CPU).bfloat16
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: {"avx512_bf16": True})
    seen = []

    def convolution(self, *features):
        seen.append(torch.is_autocast_enabled("cpu"))
        return forward(self, *features)

    forward = UNet.forward
    monkeypatch.setattr(UNet, "forward", convolution)
    for options, bfloat16 in (((), True), (("--precision", "32"), False)):
        del seen[:]
        world.compare("--methods", "cnn", *options, out=f"precision{bfloat16}")
        assert set(seen) == {bfloat16} and len(seen) > 4
        manifest = json.loads((world.folder / f"precision{bfloat16}/manifest.json").read_text())
        assert manifest["policy"] == {"bfloat16": bfloat16, "sparse": bfloat16, "int8": False}
    assert "precision: 32-true" in (world.run("cnn") / "config.yaml").read_text()
    assert len(trainings) == first  # if the first comparison's is not in float32
    if trainings:
        shutil.rmtree(world.run("cnn"))  # others look for the newest


def test_a_killed_training_goes_on(world, more_methods):
    """In the same comparison, from its last whole checkpoint: what comes out is as if nothing had been."""
    more_methods("KilledOnce")
    row = world.compare("--methods", "killedonce")["killedonce"]
    assert (world.folder / "killed").exists() and world.outcome("killedonce")["resumed"]
    assert row["status"] == "ok" and row["mse"] == world.rows["nlt"]["mse"]
    assert same_weights(world.run("killedonce"), world.run("nlt"))


def same_weights(run, other):
    weights = [torch.load(newest_checkpoint(path), weights_only=True)["state_dict"] for path in (run, other)]
    return all(torch.equal(weights[0].pop(name), value) for name, value in weights[1].items()) and not weights[0]


def test_a_lost_mark_costs_no_step(world, trainings):
    """Killed between the last checkpoint and done.json: the training is found finished."""
    (world.run("cnn") / "done.json").unlink()
    row = world.compare("--methods", "cnn")["cnn"]
    assert len(trainings) == 1 and world.outcome("cnn")["resumed"]
    assert row["mse"] == world.rows["cnn"]["mse"]


# ---- rows that fail, seeds, sizes -----------------------------------------------------------------------


def test_rows_that_diverge_or_fail_are_shown(world, trainings, more_methods, capfd):
    """The others go on; what diverged is not trained again, what died is, once, and when the command is given again."""
    more_methods("Diverges", "Fails", "Killed")
    methods = ("cnn", "diverges", "fails", "killed")
    rows = world.compare("--workers=2", "--methods", *methods, out="bad")
    assert [rows[name]["status"] for name in methods] == ["ok", "1 of 1 diverged", "1 of 1 failed", "1 of 1 failed"]
    messages = {name: row["message"] for name, row in world.runs("bad").items()}
    assert "train/loss is nan at step 0" in messages["diverges"]
    assert messages["fails"] == "RuntimeError: out of luck" and messages["killed"] == "exit code -9"
    assert (world.run("fails") / "log.txt").read_text().count("Traceback") == 2
    printed = capfd.readouterr().out
    assert "killed, seed 3    failed    exit code -9" in printed and "trainings: 1 diverged, 2 failed" in printed
    assert rows["fails"]["mse"] == rows["diverges"]["mse"] == "" and float(rows["cnn"]["mse"]) > 0
    table = (world.folder / "bad/table.md").read_text()
    assert "| diverges [1 of 1 diverged] | – |" in table
    assert [job.method for job in trainings] == ["diverges", "fails", "killed"]
    world.compare("--methods", "diverges", out="bad")
    assert len(trainings) == 3


@pytest.mark.parametrize(
    ("cores", "workers", "trainings", "threads"),
    [(2, None, 3, [1, 1]), (2, 8, 3, [1, 1]), (2, 1, 3, [2]), (2, None, 1, [2]), (6, None, 2, [3, 3])],
)
def test_trainings_never_have_more_threads_than_cores(tmp_path, monkeypatch, cores, workers, trainings, threads):
    """`threads` are those of the trainings that run at once."""
    started = []

    class Process:
        def __init__(self, work, job, threads, counter, preload):
            started.append(threads)

    def interrupt(engine, running):
        raise KeyboardInterrupt

    monkeypatch.setattr(engines, "available_cpus", lambda: cores)
    monkeypatch.setattr(engines, "Process", Process)
    monkeypatch.setattr(engines.Local, "_wait", interrupt)
    monkeypatch.setattr(engines.Local, "_cancel", lambda *_: None)
    jobs = [Training("cnn", seed, tmp_path / str(seed), "{}") for seed in range(trainings)]
    with pytest.raises(KeyboardInterrupt):
        train(jobs, "local", workers, {})
    assert started == threads


@pytest.fixture
def elsewhere(world):
    """A variant that trains in another room, which is larger and has other objects."""
    dataset = {"scenes": ["bedroom"], "train": 4, "val": 1, "test": 0, "num_points": 32}
    file = write(world.folder / "configs/variant/elsewhere.yaml", {"data": {"dataset": dataset}})
    yield file
    file.unlink()


def test_a_method_trained_in_another_room(world, elsewhere):
    """It is judged in the compared room; the other room's dataset is rendered for its training."""
    rows = world.compare("--methods", "cnn", "cnn@elsewhere", out="unseen")
    here, there = (world.runs("unseen")[name]["run"] for name in ("cnn", "cnn@elsewhere"))
    assert Path(here).parent.name == world.tiny.dataset.name and Path(there).parent.name.startswith("moving_lights-bed")
    (dataset,) = Path(world.tiny.dataset).parent.glob("moving_lights-bedroom-*")
    manifest = json.loads((dataset / "manifest.json").read_text())
    assert (manifest["spec"]["scenes"], manifest["spec"]["test"]) == (["bedroom"], 0)
    assert len(list((dataset / "train").iterdir())) == 1
    assert rows["cnn@elsewhere"]["mse"] != rows["cnn"]["mse"]


def test_no_embeddings_of_another_room(world, elsewhere, capfd, trainings):
    arguments = ["compare", "--config", str(world.config), "--methods", "cnn", "nlt@elsewhere", "--out=refused"]
    assert main(arguments) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "elsewhere.yaml: data.dataset" in error and "photons_only" in error
    assert trainings == []


def test_embeddings_from_more_images_of_the_same_room(world):
    """A variant with more images has the comparison's points, so its embeddings belong to the compared room, too."""
    file = write(world.folder / "configs/variant/more_images.yaml", {"data": {"dataset": {"train": 12}}})
    rows = world.compare("--methods", "nlt", "nlt@more_images", out="more_images")
    file.unlink()
    runs = world.runs("more_images")
    datasets = [world.tiny.dataset.parent / Path(runs[name]["run"]).parent.name for name in ("nlt", "nlt@more_images")]
    here, more = (load_file(dataset / points_name(0))["position"] for dataset in datasets)
    assert datasets[0] != datasets[1] and rows["nlt@more_images"]["mse"] != rows["nlt"]["mse"]
    np.testing.assert_array_equal(here, more)


@pytest.fixture
def fine_tuned(world, elsewhere):
    """A variant that starts from the weights of the other room; its learning rate of zero keeps them."""
    content = {"start_from": "elsewhere", "model": {"init_args": {"learning_rate": 0.0}}}
    file = write(world.folder / "configs/variant/fine_tuned.yaml", content)
    yield file
    file.unlink()


def test_a_method_that_starts_from_another_room(world, fine_tuned, trainings):
    rows = world.compare(
        "--methods", "photons_only@fine_tuned", "photons_only", "photons_only@elsewhere", out="started"
    )
    assert trainings[-1].method == "photons_only@fine_tuned" and trainings[-1].start.method == "photons_only@elsewhere"
    assert (
        rows["photons_only@fine_tuned"]["mse"] == rows["photons_only@elsewhere"]["mse"] != rows["photons_only"]["mse"]
    )
    trained_in = Path(world.runs("started")["photons_only@fine_tuned"]["run"]).parent.name
    assert trained_in == world.tiny.dataset.name


def test_a_start_is_in_the_comparison(world, fine_tuned, capfd, trainings):
    assert main(["compare", "--config", str(world.config), "--methods", "cnn", "cnn@fine_tuned", "--out=refused"]) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and "fine_tuned.yaml: start_from: cnn@elsewhere" in error
    assert trainings == []


def test_a_start_that_fails(world, fine_tuned, more_methods):
    """The training that starts from it fails with its reason."""
    more_methods("Diverges", "Killed")
    rows = world.compare(
        "--methods", *(f"{m}@{v}" for m in ("diverges", "killed") for v in ("elsewhere", "fine_tuned"))
    )
    runs = world.runs("again")
    assert set(rows) == set(runs)
    for method, status in (("diverges", "diverged"), ("killed", "failed")):
        run = runs[f"{method}@fine_tuned"]
        assert run["status"] == status and run["message"].startswith(f"{method}@elsewhere, seed 3: ")


@pytest.mark.parametrize("section", ["model", "trainer", "data"])
def test_a_mistake_in_the_last_config(world, trainings, capfd, section):
    """Is found before the first training."""
    content = merge({"model": {"class_path": "extra_method.Extra"}}, {section: {"init_args": {"no_such": 1}}})
    file = write(world.folder / "configs/model/wrong.yaml", content)
    try:
        arguments = ["compare", "--config", str(world.config), "--seeds=9", "--methods", "cnn", "wrong"]
        assert main(arguments) == 2
    finally:
        file.unlink()
    error = capfd.readouterr().err
    assert error.startswith("nlt: error: ") and error.count("\n") == 1
    assert str(file) in error and ("no_such" if section == "model" else "init_args") in error
    assert trainings == []


@pytest.fixture
def one_core():
    """For processes elsewhere, too: with other numbers of threads, sums are rounded otherwise."""
    cores = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(cores)})
    yield
    os.sched_setaffinity(0, cores)


def test_on_a_dask_cluster(world, tmp_path, one_core):
    """In a process of a worker elsewhere: the same bytes as here."""
    distributed = pytest.importorskip("distributed")
    with distributed.LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        assert trained_elsewhere(world, tmp_path, cluster.scheduler_address)


def test_on_slurm(world, tmp_path, monkeypatch, one_core):
    """By submitit's own stand-in for it."""
    pytest.importorskip("submitit")
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
    monkeypatch.setattr("submitit.Job._results_timeout_s", 0)  # for file systems that are late
    assert trained_elsewhere(world, tmp_path, "slurm-local")


def trained_elsewhere(world, folder, scheduler):
    found = comparison.Comparison.load(str(world.config), None, None, ["cnn"])
    job = Training.of(found, "cnn", 3, folder)
    assert train([job], scheduler, 1, {}) == {}
    return job.outcome["threads"] == 1 and same_weights(job.run, world.run("cnn"))


def test_progress_of_trainings(tmp_path, capsys, monkeypatch):
    """What is new, a line each; a row's end, and in between all that are in training when it is time again."""
    monkeypatch.setattr(progress, "_READ", 0)
    names = {tmp_path / name: f"{name}, seed 0" for name in ("cnn", "nlt")}
    write_bytes(tmp_path / "nlt" / progress.PROGRESS, b"of an earlier comparison")
    table = progress.ProgressTable(names)

    def shown(died=(), **training):
        for name, content in training.items():
            write_bytes(
                tmp_path / name / (progress.DONE if "done" in content else progress.PROGRESS),
                json.dumps(content).encode(),
            )
        table.show(dict(died))
        return capsys.readouterr().out

    assert shown().splitlines()[:2] == ["  cnn, seed 0  waiting", "  nlt, seed 0  waiting"]
    step = {"state": "training", "steps": 100, "loss": 0.25, "eta_s": 75}
    out = shown(cnn={**step, "step": 25}, nlt={**step, "step": 50})
    assert "  cnn, seed 0  training  step     25 of 100     loss 0.25      ETA 01:15" in out and "2 training\n" in out
    assert shown(cnn={**step, "step": 30}) == ""
    monkeypatch.setattr(progress, "_PRINT", 0)
    assert "step     75 of 100" in shown(cnn={**step, "step": 75})
    # Half of the way that is to go was made here: as long again.
    assert re.search(r"^(\S+) trainings: 2 training, ETA \1$", shown(cnn={**step, "step": 100}), re.MULTILINE)
    assert "  cnn, seed 0  done" in shown(cnn={"done": True})
    assert "  nlt, seed 0  failed    exit code -9" in shown({tmp_path / "nlt": "exit code -9"})
    begun = progress._Row(progress._TRAINING, steps=100)  # before its first step
    assert str(begun).split() == ["training", "step", "0", "of", "100", "loss", "?", "ETA", "?"]


@pytest.mark.parametrize(
    ("scale", "data", "name"),
    [
        (None, None, "demo"),
        ("demo", "data/demo.yaml", "demo"),
        ("small", None, "demo_small"),
        ("small", "real_egg", "demo_small_real_egg"),
        (None, "demo_fixed_lights", "demo_fixed_lights"),
        ("there/large.yaml", None, "demo_large"),
    ],
)
def test_results_of_another_scale_have_a_name_of_their_own(scale, data, name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_bytes(tmp_path / "there/large.yaml", (paths.CONFIGS / "scale/demo.yaml").read_bytes())
    assert comparison.Comparison.load("demo", scale, data, None).name == name


def test_what_is_judged_is_kept(world, monkeypatch):
    """At the same commit, evaluations are kept, so that a killed comparison resumes; times are measured again."""
    for kept in world.folder.glob("runs/**/judged.npz"):
        kept.unlink()
    judged, original = [], Evaluation.evaluate
    monkeypatch.setattr(Evaluation, "evaluate", lambda self, method: (judged.append(method), original(self, method))[1])

    def judge(commit, changes=False):
        judged.clear()
        monkeypatch.setattr(compare, "origin", lambda: {**origin(), "commit": commit, "uncommitted_changes": changes})
        world.compare("--methods", "path_tracing_1", out="kept")
        files = [world.folder / "kept" / name for name in ("views.csv", "images/path_tracing_1.npz")]
        return len(judged), [file.read_bytes() for file in files], world.runs("kept")["path_tracing_1"]

    first, again = judge("one"), judge("one")
    assert (first[0], again[0]) == (1, 0) and first[1] == again[1]
    assert first[2]["path_tracing_s"] != again[2]["path_tracing_s"]
    assert judge("one", changes=True)[0] == 1
    file = world.folder / "configs/model/path_tracing_1.yaml"
    before = file.read_text()
    try:  # the same name and commit, but a config that no commit has
        file.write_text(before.replace("spp: 1", "spp: 2"))
        assert judge("one")[0] == 1
    finally:
        file.write_text(before)


def test_history(world, more_methods):
    """The validation metrics along each training, as they were logged; also of one that was killed."""
    with (world.folder / "out/history.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert {row["method"] for row in rows} == set(world.rows) - set(UNTRAINED)
    more_methods("KilledOnce")
    (world.folder / "killed").unlink(missing_ok=True)
    for run in world.folder.glob("runs/*/killedonce-*"):
        shutil.rmtree(run)
    world.compare("--methods", "killedonce", "cnn", out="history")
    with (world.folder / "history/history.csv").open(newline="") as file:
        again = list(csv.DictReader(file))
    for method, found in (("nlt", rows), ("killedonce", again), ("cnn", again)):
        mine = [row for row in found if row["method"] == method]
        assert [(row["step"], row["images_seen"], row["seed"]) for row in mine] == [("4", "8", "3")]
        logs = [EventAccumulator(str(path)).Reload() for path in world.run(method).glob("events.out.tfevents.*")]
        for key in ("loss", "mse", "mssim"):
            logged = [
                event.value
                for log in logs
                if f"val/{key}" in log.Tags()["scalars"]
                for event in log.Scalars(f"val/{key}")
            ]
            assert [float(row[key]) for row in mine] == pytest.approx(logged)
        assert 0 < float(mine[0]["train_s"]) < world.outcome(method)["train_s"]


def test_training_images(world, trainings, capfd):
    """Trainings on fewer images take as many steps; the full training's row is listed with them."""
    world.compare("--methods", "cnn", "path_tracing_1", "--train-images", "3", "8", out="fewer")
    assert [(job.method, job.train_images) for job in trainings] == [("cnn", 3)]
    rows = load(world.folder / "fewer").rows("training_images.csv")
    assert [(row["method"], row["train_images"], row["status"]) for row in rows] == [("cnn", 8, "ok"), ("cnn", 3, "ok")]
    assert rows[0]["mse"] == float(world.rows["cnn"]["mse"]) != rows[1]["mse"] > 0
    assert trainings[0].outcome["steps"] == STEPS
    assert (world.folder / "fewer/table.csv").read_text().count("\ncnn,") == 1
    assert main(["compare", "--config", str(world.config), "--methods", "cnn", "--train-images", "9"]) == 2
    assert "--train-images: 9 is more than data.dataset.train; give at most 8" in capfd.readouterr().err


def test_curves_of_denoising(tmp_path):
    """Guided denoising and OIDN's faster modes are not joined with the rows that share their class."""
    names = ["denoising_1_1", "denoising_1_4", "guided_1_1", "guided_1_4", "oidn_1", "oidn_1_fast", "oidn_4"]
    names += ["oidn_1_balanced", "oidn_4_balanced"]
    found = curves(make_results(tmp_path, {name: {"time_per_frame_s": 1.0} for name in names}, None))
    assert found == {
        "Denoising (pixels traced)": ["denoising_1_4", "denoising_1_1"],
        "Guided denoising (pixels traced)": ["guided_1_4", "guided_1_1"],
        "OIDN (spp)": ["oidn_1", "oidn_4"],
        "OIDN balanced (spp)": ["oidn_1_balanced", "oidn_4_balanced"],
    }


def test_learning_curves(tmp_path, monkeypatch):
    """A line per method through the means over seeds, a band where there are several; nothing of what diverged."""
    results = make_results(tmp_path, papers_numbers("table2"), "table2", seeds=2)
    drawn = []
    monkeypatch.setattr(plots, "save", lambda figure, *_: drawn.append(figure))
    draw_learning_curves(results)
    assert not drawn
    rows = [
        {"method": method, "seed": seed, "images_seen": 100 * k, "mse": 1 / (k + seed), "loss": 3.0}
        for method, seeds in (("denoising_1_4", (0,)), ("nlt", (0, 1)))
        for seed in seeds
        for k in (1, 2, 4)
    ]
    write_rows(tmp_path / "history.csv", rows)
    lost = {"method": "nlt", "seed": 0, "train_images": 100, "status": "diverged"}
    good = {"method": "nlt", "seed": 0, "train_images": 400, "status": "ok", "mse": 0.25, "fid": 20.0}
    write_rows(tmp_path / "training_images.csv", [lost, good])
    draw_learning_curves(results)
    assert len(drawn.pop().axes) == 1  # of an earlier table: this one was not asked for it
    results.manifest["train_images"] = [100]
    draw_learning_curves(results)
    first, unused, few, fid = drawn[0].axes
    lines = {line.get_label(): line.get_xydata().T.tolist() for line in first.lines}
    assert lines == {
        "Denoising (1/4)": [[100, 200, 400], [1, 1 / 2, 1 / 4]],
        "Ours (w/o photons)": [[100, 200, 400], pytest.approx([3 / 4, 5 / 12, 9 / 40])],
    }
    assert len(first.collections) == 1 and not unused.axison
    assert [line.get_xydata().tolist() for axis in (few, fid) for line in axis.lines] == [[[400, 0.25]], [[400, 20]]]
    assert [text.get_text() for text in drawn[0].legends[0].get_texts()] == list(lines)


def test_seeds(world, trainings):
    rows = world.compare("--seeds=2", "--methods", "cnn", "path_tracing_1", out="seeds")
    assert len(trainings) == 1  # seed 3 was there
    with (world.folder / "seeds/runs.csv").open(newline="") as file:
        runs = list(csv.DictReader(file))
    assert [(run["method"], run["seed"]) for run in runs] == [("cnn", "3"), ("cnn", "4"), ("path_tracing_1", "3")]
    values = [float(run["mse"]) for run in runs[:2]]
    assert values[0] == float(world.rows["cnn"]["mse"]) != values[1]
    assert float(rows["cnn"]["mse"]) == pytest.approx(statistics.mean(values))
    assert float(rows["cnn"]["mse_std"]) == pytest.approx(statistics.stdev(values))
    assert rows["path_tracing_1"]["mse_std"] == ""
    cell = f"{statistics.mean(values):.5f} ± {statistics.stdev(values):.5f} / 0.01 "
    assert cell in (world.folder / "seeds/table.md").read_text().replace(" ≈", "")


def test_stored_images_and_metrics_are_of_the_same_predictions(world):
    """For every method: the metrics of each view, recomputed from images/*.npz."""
    results = load(world.folder / "out")
    reference = results.images("reference")
    target = [shown_radiance(r, e) for r, e in zip(reference["radiance"], reference["exposure"], strict=True)]
    for method in world.rows:
        images = results.images(method)["radiance"]
        mse = [
            np.mean((shown_radiance(f, e) - t) ** 2)
            for f, e, t in zip(images, reference["exposure"], target, strict=True)
        ]
        np.testing.assert_allclose(mse, results.per_view(method, "mse"), rtol=0.01)
        assert results.mean(method, "mse") == pytest.approx(results.per_view(method, "mse").mean())
    dataset = LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test", ())
    noisy = results.images("noisy")["radiance"]
    np.testing.assert_allclose(noisy[1], dataset[1]["noisy"], rtol=1e-3, atol=1e-3)


def shown_radiance(radiance, exposure):
    return shown(torch.from_numpy(radiance[None].astype(np.float32)), {"exposure": torch.tensor(exposure)})


def test_traced_pixels_are_no_stored_ones(world):
    """Deterministic; less noisy with more samples; not the teaching target, not the reference's."""
    dataset = LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test")
    frames = Frames(dataset)
    images = {spp: frames.traced(1, spp) for spp in (1, 2, 32)}
    frames.place(2)
    frames.traced.cache_clear()
    assert all(torch.equal(image, frames.traced(1, spp)) for spp, image in images.items())
    for name in ("noisy", "reference_a", "reference_b"):
        assert not any(torch.equal(dataset[1][name], image) for image in images.values())
    error = {spp: (image - frames.traced(1, 64)).square().mean() for spp, image in images.items()}
    assert error[32] < error[1] / 4


def test_sizes(world):
    """Parameters, FLOPs and memory agree with a count by hand for a small network."""

    class OneConvolution(CNN):
        def synthesize(self, batch, features):
            return self.unet.conv_in(features)[:, :3]

    frames = Frames(LightTransportDataset(world.tiny.dataset, DatasetSpec(**DATASET), "test"))
    module = OneConvolution(width=5)
    size = clock.Clock(frames, torch.device("cpu"), policy=Policy()).size(module)
    assert size["parameters"] == sum(p.numel() for p in module.parameters())
    pixels, channels = 16 * 16, 10
    assert size["flops"] == 2 * 9 * channels * 5 * pixels
    # The maps in the convolution's layout and their concatenation; inputs and parameters besides.
    inputs = 4 * (pixels * channels + 1) + 2 * 8
    assert size["peak_memory_bytes"] == 4 * size["parameters"] + inputs + 4 * pixels * (channels + channels)
    assert set(clock.Clock(frames, torch.device("cpu")).size(comparison.build_if_untrained("oidn_1"))) == {"parameters"}


def test_dashboard(world):
    """Each training has its curves, image grids and final metrics; Lightning's hyperparameters are off."""
    logs = write_logs(load("out"))
    assert {path.parent.relative_to(logs).as_posix() for path in logs.glob("**/seed_3")} == set(world.rows)
    # A link for each time that the training was begun or went on.
    links = [path for path in (logs / "cnn/seed_3").iterdir() if path.is_symlink()]
    tags = [EventAccumulator(str(link)).Reload().Tags() for link in links]
    scalars, images = ({tag for run in tags for tag in run[kind]} for kind in ("scalars", "images"))
    assert {"train/loss", "val/loss", "val/mse"} <= scalars and images == {"val/images"}
    assert "hp_metric" not in scalars and not any(run["histograms"] for run in tags)
    assert not any(path.is_symlink() for path in (logs / "oidn_1/seed_3").iterdir())


# ---- drawn from results ---------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """Results with the paper's numbers, three seeds, one method that diverged and one without FID."""
    rows = papers_numbers("table2")
    del rows["cnn"]["fid"]
    directory = tmp_path_factory.mktemp("made")
    results = make_results(directory, rows, "table2", seeds=3, over_seeds=0.02, over_views=0.1, images=True)
    bad = {"method": "lost", "seed": 0, "status": "diverged", "message": "train/loss is nan"}
    write_rows(directory / "runs.csv", [*results.runs, bad])
    draw(directory)
    return load(directory)


def test_tables_carry_the_same_numbers(made):
    """CSV against Markdown against LaTeX, cell by cell."""
    markdown = (made.directory / "table.md").read_text()
    first = [line.strip("| ").split(" | ") for line in markdown.partition("\n## ")[0].splitlines() if line[:1] == "|"]
    latex = (made.directory / "table.tex").read_text().partition("\\bottomrule")[0].partition("\\midrule")[2]
    tex = [line.removesuffix(r" \\").split(" & ") for line in latex.strip().splitlines()]
    with (made.directory / "table.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(first) - 2 == len(tex) == 15
    for row, cells, tex_cells in zip(rows, first[2:], tex, strict=True):
        assert [cell.replace("±", r"$\pm$").replace("–", "--") for cell in cells[1:]] == tex_cells[1:]
        for key, cell in zip(("time_per_frame_s", "mse", "mssim", "fid", "feature_l1"), cells[1:], strict=True):
            mean, _, std = cell.partition(" / ")[0].partition(" ± ")
            if not row[key]:
                assert mean == "–"
                continue
            digits = len(mean.partition(".")[2])
            assert mean == f"{float(row[key]):.{digits}f}" and std == f"{float(row[f'{key}_std']):.{digits}f}"
    assert [row["method"] for row in rows if not row["fid"]] == ["cnn", "lost"]
    assert rows[-1]["status"] == "1 of 1 diverged" and first[-1][0] == "lost [1 of 1 diverged]"


def test_interval_is_of_the_views(made):
    values = made.per_view("nlt", "mse")
    low, high = made.interval("nlt", "mse")
    error = values.std(ddof=1) / len(values) ** 0.5
    assert low < values.mean() < high and (high - low) / (2 * 1.96 * error) == pytest.approx(1, abs=0.15)
    assert np.isnan(made.interval("nlt", "fid")).all()


def test_drawing_again_changes_no_byte(made, tmp_path):
    """Elsewhere, too, without anything but the directory."""
    files = {path.name: path.read_bytes() for path in made.directory.iterdir() if path.is_file()}
    assert {
        "table.csv",
        "table.md",
        "table.tex",
        "claims.md",
        "claims.json",
        "speed_accuracy.svg",
        "failures.md",
        "report.html",
    } <= set(files)
    copy = shutil.copytree(made.directory, tmp_path / "copy")
    for name in set(files) - {"runs.csv", "views.csv", "manifest.json"}:
        (copy / name).unlink()
    assert main(["report", str(copy)]) == 0
    assert {path.name: path.read_bytes() for path in copy.iterdir() if path.is_file()} == files


def test_without_images_the_rest_is_drawn(made, tmp_path):
    copy = shutil.copytree(
        made.directory, tmp_path / "copy", ignore=shutil.ignore_patterns("images", "*.png", "*.webp")
    )
    assert main(["report", str(copy)]) == 0
    assert (copy / "speed_accuracy.png").exists() and not (copy / "samples.webp").exists()


@pytest.mark.parametrize(("file", "content"), [("manifest.json", None), ("runs.csv", None), ("manifest.json", "{")])
def test_results_that_cannot_be_read(made, tmp_path, capfd, file, content):
    copy = shutil.copytree(made.directory, tmp_path / "copy", ignore=shutil.ignore_patterns("images"))
    (copy / file).unlink() if content is None else write(copy / file, content)
    capfd.readouterr()
    assert main(["report", str(copy)]) == 2
    error = capfd.readouterr().err
    assert error.startswith(f"nlt: error: {copy / file}: ") and error.count("\n") == 1


def test_causes_of_failures(tmp_path):
    """A made-up room of two walls: a mirror, a thing near the camera, a shadow's edge, and a view without a light."""
    albedo = np.full((2, 3, 40, 40), 0.5)
    depth = np.full((2, 1, 40, 40), 4.0)
    light = np.full((2, 3, 40, 40), 0.4)
    albedo[:, :, 2:8, 2:8] = 0  # mirror
    albedo[:, :, 12:14, 2:8] = 0  # glass
    transmits = np.zeros((2, 40, 40), bool)
    transmits[:, 12:14, 2:8] = True
    depth[:, :, 30:38, 2:8] = 1.0  # near
    light[:, :, :, 20:] = 0.1  # shadow
    make_results(tmp_path, {"cnn": {"mse": 0.1}}, "table2", images=True)
    view = np.arange(2)
    write_images(tmp_path, "reference", radiance=light, exposure=np.ones(2, np.float32), view=view)
    write_images(tmp_path, "noisy", radiance=light)
    normal = np.zeros_like(albedo)
    buffers = {"albedo": albedo, "normal": normal, "depth": depth, "transmits": transmits}
    write_images(tmp_path, "gbuffer", **buffers, light_in_view=np.array([True, False]))
    wrong = light.copy()
    wrong[0, :, 3:7, 3:7] += 0.3  # in the mirror of the first view
    wrong[1, :, 10:28, 30:38] += 0.3  # anywhere in the second
    write_images(tmp_path, "cnn", radiance=wrong)
    images = Shown.load(load(tmp_path))
    causes = images.causes
    assert np.array_equal(causes["mirror"], (albedo == 0).any(1) & ~transmits)
    assert np.array_equal(causes["glass"], transmits)
    assert np.array_equal(causes["near camera"], depth[:, 0] == 1)
    edge = causes["shadow edge"]
    assert edge[:, 10:28, 19:21].all() and not edge[:, :, :17].any() and not edge[:, :, 23:].any()
    assert causes["light not in view"][1].all() and not causes["light not in view"][0].any()
    assert not causes["none of these"][1].any() and causes["none of these"][0, 15, 30]
    worst = worst_pixels(images, "cnn")
    assert np.array_equal(worst, (wrong != light).any(1)) and worst.sum() == 16 + 144
    draw(tmp_path)
    with (tmp_path / "failures.csv").open(newline="") as file:
        share = {row["cause"]: float(row["share_of_worst"]) for row in csv.DictReader(file)}
    assert share["mirror"] == pytest.approx(0.1) and share["light not in view"] == pytest.approx(0.9)
    assert (
        "| CNN only | 10.0% (16) | 0.0% (0) | 0.0% (0) | 0.0% (0) | 90.0% (144) | 0.0% (0) |"
        in (tmp_path / "failures.md").read_text()
    )


@pytest.mark.parametrize("name", paths.config_names("compare"))
def test_every_comparison_names_what_there_is(name):
    """Its data, scale and methods; a table of the paper has all of the paper's methods."""
    found = comparison.Comparison.load(name, None, None, None, seeds=3)
    assert found.spec.test and found.seeds == [0, 1, 2]
    assert all(found.configs[method]["model"]["class_path"] for method in found.methods)
    if found.table:
        assert {m for m in paths.config_names("model") if published(found.table, m)} <= set(found.methods)
    trained = [method for method in found.methods if comparison.build_if_untrained(method) is None]
    assert len(found.rows) == 3 * len(trained) + len(found.methods) - len(trained)
