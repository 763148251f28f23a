"""Training and evaluation through the command line's parser, on a tiny dataset."""

from pathlib import Path

import lightning as L
import numpy as np
import OpenEXR
import pytest
import torch
import yaml
from PIL import Image
from safetensors.numpy import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tiny import DATASET, copy_dataset, use_tiny_inception, write
from torch.utils.data import DataLoader, default_collate

from nlt.baselines.cnn import CNN
from nlt.cli import main
from nlt.data.dataset import LightTransportDataset
from nlt.data.spec import DatasetSpec
from nlt.data.store import points_name, read_points, write_shard
from nlt.metrics.quantities import METRICS
from nlt.models.module import PROJECTION, RenderingModule
from nlt.models.projection import visible_pixels
from nlt.training import run_lightning

pytest_plugins = ["training_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


def content(tensors):
    """All tensors within, as bytes."""
    if isinstance(tensors, torch.Tensor):
        return tensors.numpy().tobytes()
    if isinstance(tensors, dict):
        return {key: content(value) for key, value in tensors.items()}
    return [content(value) for value in tensors] if isinstance(tensors, list | tuple) else tensors


@pytest.mark.parametrize(
    ("method", "limit", "legs", "validated"),
    [
        ("nlt_photons", "max_steps", (4, 8, 10), 1),
        ("denoising_1_4", "max_steps", (4, 6), 1),
        ("cnn", "max_epochs", (1, 2), 1),
        ("cnn", "max_steps", (4, 8, 10), 2),
    ],
)
def test_resuming_is_exact(tiny, method, limit, legs, validated):
    """In one go or killed after an epoch, validated or not, and again: parameters and optimiser the same to the bit."""

    def run(length, *more):
        limits = {"max_steps": -1, "max_epochs": -1, "check_val_every_n_epoch": validated, limit: length}
        trainer = run_lightning(
            tiny.command("fit", method, *(f"--trainer.{name}={value}" for name, value in limits.items()), *more)
        ).trainer
        path = trainer.checkpoint_callback.best_model_path
        checkpoint = torch.load(path, weights_only=True)
        return path, content([checkpoint[key] for key in ("state_dict", "optimizer_states", "lr_schedulers", "epoch")])

    _, through = run(legs[-1])
    path, state = run(legs[0])
    for length in legs[1:]:
        assert state != through
        torch.manual_seed(123)
        path, state = run(length, f"--ckpt_path={path}", "--seed_everything=99")
    assert state == through


@pytest.mark.parametrize("precision", ["32-true", "bf16-mixed"])
@pytest.mark.parametrize("algorithm", ["norm", "value"])
def test_gradients_are_clipped(tiny, precision, algorithm):
    """By Adam's first moment after a step, which is a tenth of the gradient."""
    options = {"max_steps": 1, "precision": precision, "gradient_clip_val": 1e-4, "gradient_clip_algorithm": algorithm}
    trainer = run_lightning(
        tiny.command("fit", "cnn", *(f"--trainer.{name}={value}" for name, value in options.items()))
    ).trainer
    moments = [10 * state["exp_avg"] for state in trainer.optimizers[0].state.values()]
    if algorithm == "norm":
        assert sum(moment.square().sum() for moment in moments).sqrt().item() == pytest.approx(1e-4, rel=1e-3)
    else:
        assert max(moment.abs().max() for moment in moments).item() == pytest.approx(1e-4, rel=1e-3)


def test_seed(tiny):
    def losses(seed):
        trainer = run_lightning(tiny.command("fit", "cnn", f"--seed_everything={seed}")).trainer
        return trainer.callback_metrics["train/loss"].item()

    assert losses(0) == losses(0) != losses(1)


def test_share_of_seen_photons_is_logged(tiny):
    """One step whose batch is the whole training set: photons in view over all that arrived."""
    options = ("--trainer.max_steps=1", f"--data.batch_size={DATASET['train']}")
    trainer = run_lightning(tiny.command("fit", "nlt_photons", *options)).trainer
    split = trainer.datamodule.split("train")
    batch = split.__getitems__(range(len(split)))
    view = {name: batch[name] for name in PROJECTION}
    seen = visible_pixels(batch["photon_hit"], batch["photon_valid"], **view) < DATASET["resolution"] ** 2
    assert 0 < seen.sum() < batch["photon_valid"].sum()
    expected = seen.sum() / batch["photon_valid"].sum()
    assert trainer.callback_metrics["train/photons_seen"].item() == pytest.approx(expected.item())


def test_two_processes(tiny, tmp_path):
    """Each epoch's samples are dealt out without overlap; an odd number is validated as by one process."""
    recorder = {"class_path": "tiny.Recorder", "init_args": {"directory": str(tmp_path)}}
    two = {"max_epochs": 2, "devices": 2, "strategy": "ddp_spawn", "callbacks": [recorder]}
    config = write(tmp_path / "two.yaml", {"trainer": two})
    trainer = run_lightning(tiny.command("fit", "cnn", f"--config={config}")).trainer
    assert DATASET["val"] % 2 == 1
    for epoch in range(2):
        ranks = [sorted((tmp_path / f"{epoch}-{rank}").read_text().split()) for rank in range(2)]
        assert len(ranks[0]) == len(ranks[1]) == DATASET["train"] // 2
        assert sorted(ranks[0] + ranks[1]) == [str(index) for index in range(DATASET["train"])]
    path = trainer.checkpoint_callback.best_model_path
    one = run_lightning(tiny.command("validate", "cnn", f"--ckpt_path={path}")).trainer.callback_metrics
    names = [f"val/{name}" for name in ("mse", "mssim", "unbiased_mse", "reference_noise")]
    for name in names:
        assert trainer.callback_metrics[name].item() == pytest.approx(one[name].item(), rel=1e-6), name


def test_sample_that_is_not_finite(tiny, tmp_path, capfd):
    """A NaN with a valid CRC: training stops, and says in which samples to look."""
    directory, config = copy_dataset(tiny, tmp_path)
    shard = directory / "train/000-0000004.safetensors"
    arrays = {name: array.copy() for name, array in load_file(shard).items() if not name.startswith("crc:")}
    arrays["noisy"][2, 1, 5, 5] = np.nan
    write_shard(shard, [{name: array[k] for name, array in arrays.items()} for k in range(4)])
    capfd.readouterr()
    assert main(tiny.command("fit", "cnn", f"--config={config}", f"--trainer.default_root_dir={tmp_path}")) == 2
    error = capfd.readouterr().err
    assert error.startswith("nlt: error: train/loss is nan at step ") and error.count("\n") == 1
    samples = error.partition("samples [")[2].partition("]")[0].split(", ")
    assert len(samples) == 2 and str(4 + 2) in samples


def test_embeddings_of_other_points_are_refused(tiny, checkpoint, tmp_path, capfd):
    """The points in another order: a CNN does not mind, embeddings would be of others."""
    trainer = run_lightning(tiny.command("fit", "nlt", "--trainer.max_steps=1")).trainer
    path = trainer.checkpoint_callback.best_model_path
    directory, config = copy_dataset(tiny, tmp_path)
    points = read_points(directory / points_name(0))
    write_shard(directory / points_name(0), [{**points, "position": points["position"][::-1].copy()}])
    elsewhere = [f"--config={config}", f"--trainer.default_root_dir={tmp_path}"]
    for command in ("validate", "fit"):
        assert main(tiny.command(command, "cnn", *elsewhere, f"--ckpt_path={checkpoint}")) == 0
        capfd.readouterr()
        assert main(tiny.command(command, "nlt", *elsewhere, f"--ckpt_path={path}")) == 2
        error = capfd.readouterr().err
        assert "its points differ from those of the checkpoint's embeddings" in error and str(directory) in error


def test_training_starts_from_weights(tiny, checkpoint, tmp_path):
    """With a learning rate of zero, the weights remain the checkpoint's, although the seed is another."""
    options = [f"--start_from={checkpoint}", "--model.init_args.learning_rate=0", "--seed_everything=7"]
    trainer = run_lightning(tiny.command("fit", "cnn", *options)).trainer
    assert trainer.global_step == 4
    weights = torch.load(checkpoint, weights_only=True)["state_dict"]
    assert content(dict(trainer.model.state_dict())) == content(weights)
    # A resumed run has its own weights, not those that it started from.
    last, other = trainer.checkpoint_callback.best_model_path, run_lightning(tiny.command("fit", "cnn")).trainer
    other_checkpoint = other.checkpoint_callback.best_model_path
    again = [f"--start_from={other_checkpoint}", f"--ckpt_path={last}", "--model.init_args.learning_rate=0"]
    trainer = run_lightning(tiny.command("fit", "cnn", *again)).trainer
    assert content(dict(trainer.model.state_dict())) == content(weights)


@pytest.mark.parametrize(
    ("method", "options", "message"),
    [
        ("nlt", [], "the method learns its training scenes (embeddings or a field)"),
        ("denoising_1_1", [], "checkpoint is of CNN, not SparseDenoising"),
        ("cnn", ["--model.init_args.width=4"], "checkpoint has width=2, this model width=4"),
    ],
)
def test_training_cannot_start_from_other_weights(tiny, checkpoint, capfd, method, options, message):
    assert main(tiny.command("fit", method, f"--start_from={checkpoint}", *options)) == 2
    error = capfd.readouterr().err
    assert error.count("\n") == 1 and str(checkpoint) in error and message in error


def test_mixed_precision(tiny, tmp_path, monkeypatch):
    """Where the device has bfloat16, layers use it; the weights and Adam's state do not."""
    seen = {}

    def step(self, batch, index):
        loss = training_step(self, batch, index)
        seen["training"] = torch.is_autocast_enabled("cpu"), self(batch).dtype, loss.dtype
        return loss

    training_step = CNN.training_step
    monkeypatch.setattr(CNN, "training_step", step)
    for has in (True, False):
        monkeypatch.setattr(torch.cpu, "get_capabilities", lambda has=has: {"avx512_bf16": has, "avx512_f": True})
        trainer = run_lightning(tiny.command("fit", "cnn", f"--trainer.default_root_dir={tmp_path}")).trainer
        assert seen == {"training": (has, torch.float32, torch.float32)}
        checkpoint = torch.load(trainer.checkpoint_callback.best_model_path, weights_only=True)
        state = checkpoint["optimizer_states"][0]["state"].values()
        tensors = [*checkpoint["state_dict"].values(), *(moments["exp_avg"] for moments in state)]
        assert {tensor.dtype for tensor in tensors} == {torch.float32}


def test_events(tiny, trained):
    events = EventAccumulator(str(trained)).Reload()
    values = {tag: [event.value for event in events.Scalars(tag)] for tag in events.Tags()["scalars"]}
    assert len(values["train/loss"]) == 4 and np.isfinite(values["train/loss"]).all()
    assert values["lr-Adam"] == pytest.approx([5e-4])
    for name in ("mse", "mssim", "unbiased_mse", "reference_noise"):
        assert np.isfinite(values[f"val/{name}"]).all(), name
    (image,) = events.Images("val/images")
    assert (image.width, image.height) == (4 * 16, 3 * 16)
    assert yaml.safe_load((trained / "config.yaml").read_text())["model"]["init_args"]["width"] == 2


def test_checkpoint_is_read_without_pickle(checkpoint):
    saved = torch.load(checkpoint, weights_only=True)
    assert saved["method"] == "nlt.baselines.cnn.CNN" and saved["global_step"] == 4


def test_evaluation_commands(tiny, checkpoint, tmp_path, monkeypatch, capsys):
    use_tiny_inception(monkeypatch)
    place = [f"--ckpt_path={checkpoint}", f"--trainer.default_root_dir={tmp_path}"]
    assert main(tiny.command("validate", "cnn", *place)) == 0
    assert "val/unbiased_mse" in capsys.readouterr().out
    logged = run_lightning(tiny.command("test", "cnn", *place)).trainer.callback_metrics
    assert set(logged) == {f"test/{name}" for name in METRICS}
    assert all(value.isfinite() for value in logged.values())

    capsys.readouterr()
    assert main(tiny.command("predict", "cnn", *place, "--trainer.precision=32-true")) == 0
    printed = capsys.readouterr().out.split()[-1]
    images = sorted((tmp_path / printed).iterdir())
    assert [image.name for image in images] == ["0000000.png", "0000001.png", "0000002.png"]
    dataset = LightTransportDataset(tiny.dataset, DatasetSpec(**DATASET), "test")
    batch = default_collate([dataset[2]])
    with torch.no_grad():
        radiance = RenderingModule.load_from_checkpoint(checkpoint).eval()(batch)[0].permute(1, 2, 0).double().numpy()
    exposed = np.clip(radiance * batch["exposure"].item(), 0, 1)
    srgb = np.where(exposed <= 0.0031308, 12.92 * exposed, 1.055 * exposed ** (1 / 2.4) - 0.055)
    assert np.abs(np.asarray(Image.open(images[2])) - 255 * srgb).max() <= 0.51

    place[1] = f"--trainer.default_root_dir={tmp_path / 'layers'}"
    assert main(tiny.command("predict", "cnn", *place, "--trainer.precision=32-true", "--exr")) == 0
    folder = Path(capsys.readouterr().out.split()[-1])
    assert (folder / images[2].name).read_bytes() == images[2].read_bytes()
    with OpenEXR.File(str(folder / "0000002.exr"), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    reference = (batch["reference_a"] + batch["reference_b"])[0] / 2
    np.testing.assert_allclose(found["G"], radiance[..., 1], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(found["Reference.B"], reference[2], rtol=1e-6)
    for name, field, channel in (
        ("Depth.Z", "depth", 0),
        ("Denoising Normal.Y", "normal", 1),
        ("Emit.R", "emission", 0),
    ):
        np.testing.assert_array_equal(found[name], batch[field][0, channel])


def test_an_easy_task_is_learnt(tiny, tmp_path):
    """Four samples whose image is half the albedo."""
    dataset = LightTransportDataset(tiny.dataset, DatasetSpec(**DATASET), "train")
    batch = default_collate([dataset[k] for k in range(4)])
    batch["noisy"] = batch["albedo"] / 2 + 0.1
    torch.manual_seed(0)
    method = CNN(width=8, loss="relative_mse", learning_rate=5e-3)

    def loss():
        with torch.no_grad():
            return method.loss(method(batch), batch["noisy"], batch["exposure"]).item()

    first = loss()
    quiet = {"logger": False, "enable_checkpointing": False, "enable_progress_bar": False}
    trainer = L.Trainer(accelerator="cpu", max_steps=60, enable_model_summary=False, default_root_dir=tmp_path, **quiet)
    trainer.fit(method, DataLoader([batch] * 60, batch_size=None))
    assert loss() < first / 2
