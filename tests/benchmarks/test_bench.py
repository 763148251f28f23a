"""benchmarks/bench.py is complete, consistent and resumable, and the plain path is plain."""

import json
import re
from types import SimpleNamespace

import pytest
import torch
from bench import main, parser
from costs import ceilings
from costs import run as bench
from costs.plain import plain
from synthetic import POINTS, SCENES, synthetic_batch
from tiny import DATASET, SCALE, write

from nlt.config import merge
from nlt.data.dataset import LightTransportDataset
from nlt.data.spec import DatasetSpec
from nlt.evaluation import clock
from nlt.evaluation.comparison import build_if_untrained
from nlt.evaluation.frames import Frames
from nlt.metrics.quantities import NETWORK_STAGES, STAGES
from nlt.models.method import Method
from nlt.models.nlt import NeuralLightTransport

pytest_plugins = ["training_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]

GRID = {"resolution": (8,), "num_points": (32,), "num_photons": (32,), "width": (4,), "batch": (2,)}
METHODS = ("cnn", "nlt_photons", "oidn_1")
SIZE = {"width": 3, "depth": 2, "num_scenes": SCENES, "num_points": POINTS}


def test_the_plain_path_is_plain():
    """The plain path is float32 and contiguous for any method, and does not share its weights."""
    method = NeuralLightTransport(use_photons=True, **SIZE)
    slow = plain(method.to(memory_format=torch.channels_last)).eval()
    seen = []
    for module in slow.modules():
        if isinstance(module, torch.nn.Conv2d | torch.nn.Linear):
            module.register_forward_hook(
                lambda m, x, y: seen.append((x[0].is_contiguous(), m.weight.is_contiguous(), y.dtype))
            )
    with torch.no_grad():
        image = slow(synthetic_batch())
        for parameter in method.parameters():
            parameter.zero_()
        torch.testing.assert_close(slow(synthetic_batch()), image)
    assert set(seen) == {(True, True, torch.float32)} and image.abs().sum() > 0
    assert torch.get_float32_matmul_precision() == "highest"


class Recorder(Method):
    """Records the batches that its step is given."""

    inputs = ("traced", "depth")
    stages = ("gbuffer", "path_tracing")
    spp = 1

    def __init__(self):
        super().__init__()
        self.batches = []

    def steps(self):
        return {"denoise": lambda batch, _: self.batches.append(batch)}


class Samples(list):
    """Stands for a dataset of four scenes."""

    spec = SimpleNamespace(scenes=list("abcd"))


def test_the_warm_up_sees_every_scene(monkeypatch):
    """The first frame in a scene compiles kernels, so it must not be timed."""
    device, seen = torch.device("cpu"), []
    watch = clock.Clock(SimpleNamespace(dataset=Samples(range(4 * 16))), device)
    monkeypatch.setattr(watch, "_frame", lambda method, indices: seen.extend(indices) or {"synthesis": 0.0})
    watch.time_interleaved({"": torch.nn.Identity()})
    assert {index // 16 for index in seen[: clock.WARM_UP]} == {0, 1, 2, 3}
    assert len(set(seen)) == len(seen) == clock.WARM_UP + clock.FRAMES


def test_a_batch_of_frames(tiny, monkeypatch):
    """Every frame of a batch is rendered, and the methods take turns."""
    frames = Frames(LightTransportDataset(tiny.dataset, DatasetSpec(**DATASET), "test"))
    placed = []
    place = frames.place
    monkeypatch.setattr(frames, "place", lambda index: (placed.append(index), place(index))[1])
    monkeypatch.setattr(clock, "WARM_UP", 1)
    monkeypatch.setattr(clock, "FRAMES", 3)
    first, second = Recorder(), Recorder()
    timed = clock.Clock(frames, torch.device("cpu"), batch=2).time_interleaved({"a": first, "b": second})
    assert [len(timed[name]) for name in ("a", "b")] == [3, 3]
    assert set(timed["a"][0]) == {"gbuffer", "path_tracing", "denoise"}
    assert placed == [0, 1, 0, 1, 2, 0, 2, 0, 1, 2, 1, 2, 0, 1, 0, 1]
    assert all(batch["traced"].shape == (2, 3, 16, 16) for batch in first.batches)
    for batch in (first.batches[1], second.batches[1]):  # the same frames, the sample's own depth
        expected = torch.stack([frames.dataset[2]["depth"], frames.dataset[0]["depth"]])
        assert torch.equal(batch["depth"], expected)


@pytest.fixture(scope="module")
def arguments(tmp_path_factory):
    """Yield the arguments of a benchmark that takes seconds."""
    folder = tmp_path_factory.mktemp("bench")
    data = write(folder / "data.yaml", {"data": {"dataset": DATASET, "batch_size": 2, "workers": 0}})
    scale = write(folder / "scale.yaml", merge(SCALE, {"model": {"init_args": {"lr_schedule": "cosine"}}}))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench, "GRID", GRID)
        patch.setattr(bench, "_TRAINING_STEPS", 3)
        patch.setattr(clock, "WARM_UP", 1)
        patch.setattr(clock, "FRAMES", 3)
        patch.setattr(ceilings, "MATRICES", (64,))
        patch.setattr(ceilings, "BATCHES", (1,))
        patch.setattr(ceilings, "_SIDE", 8)
        patch.setattr(ceilings, "_COPIED", 1 << 20)
        yield ["--data", str(data), "--scale", str(scale), "--methods", *METHODS, "--seconds", "1"]


@pytest.fixture(scope="module")
def made(arguments, tmp_path_factory):
    """Return the directory of a benchmark that was killed once, and the names of all measurements."""
    out = tmp_path_factory.mktemp("out")
    command = [*arguments, "--growth", "--set", "num_points=48", "--device", "cpu", "--out", str(out)]
    measured, original = [], bench.Benchmark.measure

    def measure(self, part):
        measured.append(str(part))
        if str(part) == "frame nlt_photons" and measured.count(str(part)) == 1:
            raise KeyboardInterrupt
        return original(self, part)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(bench.Benchmark, "measure", measure)
        assert main(command) == 130
        assert main(command) == 0
    return out, measured


def test_goes_on_after_a_kill(made):
    out, measured = made
    assert measured.count("frame nlt_photons") == 2
    assert all(measured.count(key) == 1 for key in measured if key != "frame nlt_photons")
    assert not (out / ".bench").exists()


def test_everything_is_there_and_adds_up(made):
    content = json.loads((made[0] / "bench.json").read_text())
    rows = {tuple(row[k] for k in ("kind", "method", "factor", "value")): row for row in content["parts"]}
    settings = content["manifest"]["settings"]
    assert (settings["num_points"], settings["resolution"], settings["width"]) == (48, 16, 2)
    for method in METHODS:
        row = rows["frame", method, "", 0]
        assert row["timed_frames"] == 3
        stages = {stage for stage in STAGES if f"{stage}_s" in row}
        rendered = {"cnn": {"gbuffer"}, "nlt_photons": {"gbuffer", "photons"}, "oidn_1": {"gbuffer", "path_tracing"}}
        trained = not build_if_untrained(method)
        assert stages == rendered[method] | (set(NETWORK_STAGES) if trained else {"denoise"})
        for timed in (row, row["plain"]) if trained else (row,):
            assert timed["time_per_frame_s"] == pytest.approx(sum(timed[f"{stage}_s"] for stage in stages))
            assert all(0 < timed[f"{stage}_s"] <= timed[f"{stage}_p95_s"] for stage in stages)
        assert (("training", method, "", 0) in rows) == trained
        if trained:
            assert 0 < row["speedup"]["p5"] <= row["speedup"]["median"] <= row["speedup"]["p95"]
            assert row["flops"] == sum(row["step_flops"].values()) and row["precision"] in ("float32", "bfloat16")
            training = rows["training", method, "", 0]
            assert training["images_per_second"] * training["step_s"] == pytest.approx(2)
            assert 0 <= training["waiting_share"] < 1 and 1 <= training["timed_steps"] <= 40
    for factor, values in GRID.items():
        for value in {*values, settings[factor]}:
            assert rows["growth", "nlt_photons", factor, value]["time_per_frame_s"] > 0
    memory = lambda factor, value: rows["growth", "nlt_photons", factor, value]["peak_memory_bytes"]
    for factor, (value,) in GRID.items():
        assert (memory(factor, value) < memory(factor, settings[factor])) == (value < settings[factor])
    assert all(value > 0 for value in rows["ceilings", "", "", 0]["computing"].values())
    assert set(rows["ceilings", "", "", 0]["bare_s"]) == {"path_tracing", "gbuffer", "photons"}
    assert rows["loading", "", "", 0]["samples_per_second"] > 0
    generation = rows["generation", "", "", 0]
    whole = sum(generation["stages_s"].values())
    assert generation["evaluated_per_second"] == pytest.approx(1 / whole)
    assert generation["train_per_second"] == pytest.approx(1 / (whole - generation["stages_s"]["reference"]))


def test_the_table_says_what_the_json_says(made):
    out, _ = made
    text = (out / "bench.md").read_text()
    rows = json.loads((out / "bench.json").read_text())["parts"]
    (row,) = (row for row in rows if (row["kind"], row["method"]) == ("frame", "nlt_photons"))
    (line,) = re.findall(r"\| Ours \(w/ photons\) \|(.*frames.*|.*to.*)\|", text)
    for stage in ("gbuffer", "photons", *NETWORK_STAGES):
        assert f"{1e3 * row[f'{stage}_s']:.2f} ({1e3 * row[f'{stage}_p95_s']:.2f})" in line
    assert f"{row['speedup']['median']:.2f} (" in line
    for name in ("bench.png", "bench.svg", "growth.png", "growth.svg"):
        assert (out / name).stat().st_size > 5000


def test_what_would_take_too_long_is_skipped_and_said(arguments, tmp_path, monkeypatch):
    monkeypatch.setattr(bench, "GRID", {"width": (2, 4, 8)})
    more = ["--methods", "cnn", "--growth", "cnn", "--device", "cpu", "--out", str(tmp_path)]
    run = bench.Benchmark(parser().parse_args([*arguments, *more]))
    part = bench.Part("growth", "cnn", "width", 4)
    run.done = {bench.Part("growth", "cnn", "width", 2): {"time_per_frame_s": 0.3, "peak_memory_bytes": 8}}
    skipped = run.measure(part)["skipped"]
    assert "1.2 s" in skipped and "1 s" in skipped
    run.done[part] = {"skipped": skipped}
    assert run.measure(bench.Part("growth", "cnn", "width", 8)) == {"skipped": "width 4 was skipped"}
    run.done = {bench.Part("growth", "cnn", "width", 2): {"time_per_frame_s": 0.0, "peak_memory_bytes": 2**60}}
    assert "GiB" in run.measure(part)["skipped"]
    run.done[bench.Part("frame", "cnn")] = {"time_per_frame_s": 9.0, "synthesis_s": 9.0}
    assert "54 s" not in (why := run.measure(bench.Part("training", "cnn"))["skipped"]) and "108 s" in why


@pytest.mark.parametrize(
    ("more", "words"),
    [
        (["--methods", "gan"], ("--methods", "gan", "nlt_photons")),
        (["--growth", "gan"], ("--growth", "gan")),
        (["--set", "colour=3"], ("--set", "colour", "photons")),
        (["--set", "num_points=many"], ("--set", "num_points", "many")),
        (["--set", "resolution=4"], ("--set", "resolution", "8")),
        (["--set", "points"], ("--set", "KEY=VALUE")),
        (["--device", "tpu"], ("--device", "tpu")),
        (["--seconds", "0"], ("--seconds",)),
        (["--ckpt", "none.ckpt"], ("--ckpt", "one method")),
        (["--methods", "cnn", "--ckpt", "none.ckpt"], ("none.ckpt", "cannot be read")),
        (["--scale", "none"], ("none.yaml", "No such file")),
    ],
)
def test_mistakes(arguments, more, words, tmp_path, capfd):
    assert main([*arguments, "--out", str(tmp_path), *more]) == 2
    error = capfd.readouterr().err
    assert error.startswith("nlt: error: ") and error.count("\n") == 1, error
    assert all(word in error for word in words)
    assert not list(tmp_path.iterdir())


def test_another_methods_checkpoint(arguments, checkpoint, tmp_path, capfd):
    assert main([*arguments, "--methods", "nlt", "--ckpt", str(checkpoint), "--out", str(tmp_path)]) == 2
    assert "CNN" in capfd.readouterr().err


def test_a_checkpoint_gives_weights_and_size(arguments, checkpoint, tmp_path):
    more = ["--methods", "cnn", "--set", "width=7", "--ckpt", str(checkpoint), "--device", "cpu"]
    run = bench.Benchmark(parser().parse_args([*arguments, *more, "--out", str(tmp_path)]))
    saved = torch.load(checkpoint, weights_only=True)
    assert run.settings["width"] == saved["architecture"]["width"] == 2
    weights = run.method("cnn", run.settings).state_dict()
    assert all(torch.equal(weights[name], value) for name, value in saved["state_dict"].items())
