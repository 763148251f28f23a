"""Every method in configs/model: its contract with batch, trainer and checkpoint; and the sparse denoiser."""

from __future__ import annotations

import re
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import lightning as L
import pytest
import torch
from costs.plain import plain
from lightning.pytorch.loggers import TensorBoardLogger
from synthetic import PHOTONS, POINTS, SCENES, synthetic_batch
from torch.utils.data import DataLoader

from nlt.baselines.ablation import INPUTS, InputAblation
from nlt.baselines.cnn import CNN
from nlt.baselines.denoising import SparseDenoising, pixel_mask
from nlt.baselines.feature_projection import FeatureProjection
from nlt.baselines.guided import GuidedFourSamples, GuidedOneSample
from nlt.baselines.path_tracing import OpenImageDenoise
from nlt.cli import main
from nlt.config import read_configs
from nlt.display import expose
from nlt.errors import UserError
from nlt.evaluation.comparison import build_if_untrained
from nlt.models import factory, losses
from nlt.models.clouds import CloudMethod
from nlt.models.image_grid import ImageGrid
from nlt.models.module import GBUFFER, RenderingModule
from nlt.models.moving_camera import MovingCamera
from nlt.models.nlt import NeuralLightTransport
from nlt.models.policy import Policy, accelerate
from nlt.paths import config_names, find_config

pytest_plugins = ["training_fixtures"]

UNTRAINED = [name for name in config_names("model") if build_if_untrained(name)]
CONFIGS = [find_config("model", name) for name in config_names("model") if name not in UNTRAINED]
SIZE = {"width": 4, "num_scenes": SCENES, "num_points": POINTS}


def build(config: Path, scale: Path | None = None, more: dict[str, int] = SIZE) -> RenderingModule:
    torch.manual_seed(0)
    return factory.build(read_configs([path for path in (config, scale) if path]), config, **more)


@pytest.fixture(params=CONFIGS, ids=lambda path: path.stem)
def method(request: pytest.FixtureRequest) -> RenderingModule:
    return build(request.param)


def trainer(path: Path, **kwargs) -> L.Trainer:
    quiet = {"enable_progress_bar": False, "enable_model_summary": False, "logger": False}
    return L.Trainer(default_root_dir=path, accelerator="cpu", **(quiet | {"max_epochs": 1} | kwargs))


def loader(*batches: dict[str, torch.Tensor]) -> DataLoader:
    return DataLoader(list(batches), batch_size=None)


def test_the_plain_path_makes_the_same_image(method, one_thread):
    batch = {k: v.double() if v.is_floating_point() else v for k, v in synthetic_batch(size=24).items()}
    slow = plain(method).double().eval()
    with torch.no_grad():
        torch.testing.assert_close(slow(batch), method.double().eval()(batch), rtol=1e-9, atol=1e-12)
    assert type(slow.unet) is not type(method.unet)


def test_one_training_step_reaches_every_parameter(method):
    loss = method.training_step(synthetic_batch(), 0)
    loss.backward()
    assert loss.isfinite()
    for name, parameter in method.named_parameters():
        assert parameter.grad is not None and parameter.grad.isfinite().all(), name
        assert parameter.grad.any(), name


def test_output(method):
    batch = synthetic_batch(size=13)
    with torch.no_grad():
        features = method.eval().features(batch, method.transport(batch))
        prediction = method(batch)
    assert features.shape == (2, method.feature_channels, 13, 13)
    assert prediction.shape == (2, 3, 13, 13) and prediction.isfinite().all()
    assert prediction.is_contiguous()


def test_inputs_are_sufficient_and_necessary(method):
    batch = synthetic_batch()
    declared = {name: batch[name] for name in (*method.inputs, "exposure", "scene", "index")}
    method.eval()
    assert torch.equal(method(declared), method(batch))
    for name in method.inputs:
        with pytest.raises(KeyError, match=name):
            method({k: v for k, v in declared.items() if k != name})


def test_bfloat16_autocast(method):
    """A prediction in float32, near that of full precision: no position is rounded."""
    batch = synthetic_batch()
    method.eval()
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        mixed = method(batch)
    assert mixed.dtype == torch.float32
    torch.testing.assert_close(mixed, method(batch), rtol=0.05, atol=0.05)


def test_stages_are_those_of_the_inputs(method):
    photons = any(name.startswith("photon_") for name in method.inputs)
    stages = {
        "gbuffer": not {"depth", "normal"}.isdisjoint(method.inputs),
        "photons": photons,
        "path_tracing": method.pixel_fraction > 0,
    }
    assert method.stages == tuple(stage for stage, needed in stages.items() if needed)


@pytest.mark.parametrize(
    ("name", "stages"),
    {
        "cnn": ("gbuffer",),
        "feature_projection": ("gbuffer",),
        "nlt": ("gbuffer",),
        "nlt_photons": ("gbuffer", "photons"),
        "field": ("gbuffer", "photons"),
        "guided_1spp": ("gbuffer", "path_tracing"),
        "guided_1spp_field": ("gbuffer", "photons", "path_tracing"),
        "guided_4spp": ("gbuffer", "path_tracing"),
        "guided_1_64": ("gbuffer", "path_tracing"),
        "denoising_1_1": ("path_tracing",),
        "ablation_1": ("gbuffer",),
    }.items(),
)
def test_stages(name, stages):
    assert build(find_config("model", name)).stages == stages


DIRECT = [path for path in CONFIGS if not path.stem.startswith(("denoising", "ablation"))]


@pytest.mark.parametrize("config", DIRECT, ids=lambda path: path.stem)
def test_direct_light(config):
    """A switch of every method that reads the G-buffer: six more channels, no more stages."""
    batch, without = synthetic_batch(), build(config)
    method = build(config, find_config("variant", "direct")).eval()
    assert {*method.inputs} - {*without.inputs} == {"direct", "seen_albedo"}
    assert method.stages == without.stages and method.reads_direct_light > without.reads_direct_light
    assert method.feature_channels == without.feature_channels + 6
    with torch.no_grad():
        features = method.features(batch, method.transport(batch))
        assert features.shape[1] == method.feature_channels
        brighter = method.features(batch | {"direct": batch["direct"] + 1}, method.transport(batch))
    changed = (features != brighter).any(0).any(-1).any(-1)
    assert changed.sum() == 3
    expected = torch.log1p(expose(batch["direct"], method.exposure(batch)))
    torch.testing.assert_close(features[:, changed], expected)


@pytest.mark.parametrize("name", ["denoising_1_1", "ablation_1"])
def test_direct_light_without_a_gbuffer(name):
    with pytest.raises(UserError, match=r"model.init_args.direct_light: .* does not read the G-buffer"):
        build(find_config("model", name), find_config("variant", "direct"))


def test_doubled_exposure_of_halved_light(method):
    """Exposed radiance is all the network sees, so the prediction only halves."""
    batch = synthetic_batch()
    method.eval()
    expected = method(batch) / 2
    for name in ("noisy", "emission", "direct", "noisy_input", "point_emission", "photon_flux"):
        batch[name] = batch[name] / 2
    batch["exposure"] = batch["exposure"] * 2
    torch.testing.assert_close(method(batch), expected)


@pytest.mark.parametrize("name", ["nlt_photons", "photons_only"])
def test_splitting_the_photons(name):
    """Each photon as two of half the flux: the same light, the same prediction."""
    batch, method = synthetic_batch(), build(find_config("model", name)).eval()
    expected = method(batch)
    for name in method.inputs:
        if name.startswith("photon_"):
            batch[name] = torch.cat([batch[name]] * 2, dim=1)
    batch["photon_flux"] = batch["photon_flux"] / 2
    torch.testing.assert_close(method(batch), expected)


def test_the_papers_optimiser():
    """Sec. 3, Implementation Details: the defaults, with which scale `paper` trains."""
    (optimiser,), (schedule,) = CNN(width=1).configure_optimizers()
    assert type(optimiser) is torch.optim.Adam and optimiser.param_groups[0]["lr"] == 5e-4
    optimiser.step()
    schedule.step()  # after an epoch, as Lightning does by default
    assert optimiser.param_groups[0]["lr"] == pytest.approx(0.99 * 5e-4, rel=1e-12)
    assert CNN(width=1).loss is losses.mse


@pytest.mark.parametrize("number", range(1, 16))
def test_ablation_of_inputs(number):
    """Any combination: only what is chosen reaches the U-Net, and none of the rest is needed."""
    chosen = {name: bool(number >> k & 1) for k, name in enumerate(INPUTS)}
    method, batch = InputAblation(**chosen, embedding=5, **SIZE), synthetic_batch()
    features = method.features({name: batch[name] for name in (*method.inputs, "scene")})
    parts = dict(zip(INPUTS, (3, 5, 3, 3), strict=True))
    assert features.shape[1] == method.feature_channels == sum(parts[name] for name in INPUTS if chosen[name])
    if chosen["normal"] and chosen["ray_direction"]:
        torch.testing.assert_close(features[:, -6:], torch.cat([batch["normal"], batch["view_direction"]], dim=1))
    assert ("point_position" in method.inputs) == (chosen["position"] or chosen["point_features"])


def test_ablation_without_inputs():
    with pytest.raises(UserError, match=r"model\.init_args.*position.*ray_direction"):
        InputAblation(**SIZE)


def test_a_scale_without_class_path_is_merged(tmp_path):
    scale = tmp_path / "scale.yaml"
    scale.write_text("model:\n  init_args:\n    depth: 1\n")
    method = build(next(path for path in CONFIGS if path.stem == "nlt_photons"), scale)
    assert isinstance(method, NeuralLightTransport)
    assert method.hparams["depth"] == 1 and method.hparams["use_photons"]


@pytest.mark.parametrize("name", ["cnn", "nlt_photons", "photons_only"])
def test_sizes(name):
    """From tiny to the paper's, which are the defaults; each has more parameters than the one before."""
    files = {size: find_config("variant", size) for size in config_names("variant")}
    widths = {size: read_configs([file]).get("model", {}).get("init_args", {}) for size, file in files.items()}
    files = {size: file for size, file in files.items() if {"width", "photon_width"} <= widths[size].keys()}
    made = {size: build(find_config("model", name), file, {}) for size, file in files.items()}
    count = {size: sum(p.numel() for p in method.parameters()) for size, method in made.items()}
    assert sorted(count, key=lambda size: count[size]) == ["tiny", "small", "medium", "large", "paper"]
    paper = build(find_config("model", name), None, {})
    assert paper.hparams == made["paper"].hparams
    points, photons = (hasattr(paper, part) for part in ("pointnet", "photon_network"))
    assert (points, photons) == {"cnn": (False, False), "nlt_photons": (True, True)}.get(name, (False, True))


def test_width_of_the_points_is_even():
    with pytest.raises(UserError, match=r"model\.init_args\.point_width: must be even, is 7"):
        NeuralLightTransport(point_width=7, **SIZE)


# --- loss, trainer, checkpoints ---


def test_losses():
    exposure = torch.tensor([2.0, 0.5])
    prediction, target = torch.rand(2, 3, 4, 4, requires_grad=True), 10 * torch.rand(2, 3, 4, 4)
    scale = exposure.view(2, 1, 1, 1)
    squared = (scale * (prediction - target)) ** 2
    torch.testing.assert_close(losses.mse(prediction, target, exposure), squared.mean())
    relative = losses.relative_mse(prediction, target, exposure)
    weight = 1 / ((scale * prediction.detach()) ** 2 + 0.01)
    torch.testing.assert_close(relative, (weight * squared).mean())
    # Linear in the target, so that the noise averages out.
    (gradient,) = torch.autograd.grad(relative, prediction)
    expected = 2 * weight * scale**2 * (prediction - target) / target.numel()
    torch.testing.assert_close(gradient, expected)


def test_a_loss_that_is_not_finite_names_the_samples():
    batch = synthetic_batch()
    batch["noisy"][0, 0, 3, 3] = torch.nan
    with pytest.raises(UserError, match=r"nan at step 0.*scenes \[0, 1\], samples \[0, 1\]"):
        CNN(width=4).training_step(batch, 0)


def test_metrics_are_logged(tmp_path):
    batch, method = synthetic_batch(), CNN(width=4)
    run = trainer(tmp_path, logger=TensorBoardLogger(tmp_path), callbacks=[ImageGrid(images=3)])
    run.fit(method, loader(batch), loader(batch, batch))
    assert {"train/loss", "val/mse", "val/mssim"} <= run.callback_metrics.keys()
    with torch.no_grad():
        difference = method.eval()(batch) - batch["reference_a"], method(batch) - batch["reference_b"]
    expected = (difference[0] * difference[1] * batch["exposure"].view(-1, 1, 1, 1) ** 2).mean()
    torch.testing.assert_close(run.callback_metrics["val/unbiased_mse"].float(), expected)
    assert run.optimizers[0].param_groups[0]["lr"] == pytest.approx(5e-4 * 0.99)

    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(run.logger.log_dir).Reload()
    (image,) = events.Images("val/images")
    assert (image.width, image.height) == (4 * 16, 3 * 16)


def test_image_grid_where_validation_is_rare(tmp_path):
    """Validated at epochs 1, 3 and 5, drawn every 3 or more: at 1 and 5, none of them divisible by 3."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    batch = synthetic_batch()
    often = {"max_epochs": 6, "check_val_every_n_epoch": 2, "num_sanity_val_steps": 0}
    run = trainer(tmp_path, logger=TensorBoardLogger(tmp_path), callbacks=[ImageGrid(every_n_epochs=3)], **often)
    run.fit(CNN(width=4), loader(batch), loader(batch))
    events = EventAccumulator(run.logger.log_dir).Reload()
    per_epoch = run.global_step // 6
    assert [image.step for image in events.Images("val/images")] == [2 * per_epoch, 6 * per_epoch]


def test_image_grid_without_a_logger(tmp_path):
    run = trainer(tmp_path, callbacks=[ImageGrid()], num_sanity_val_steps=0)
    run.validate(CNN(width=4), loader(synthetic_batch()), verbose=False)


@pytest.fixture(scope="module")
def checkpoints(tmp_path_factory) -> dict[str, Path]:
    """By method, each after one step."""
    paths = {}
    for config in CONFIGS:
        path = tmp_path_factory.mktemp(config.stem)
        run = trainer(path, enable_checkpointing=False)
        run.fit(build(config), loader(synthetic_batch()))
        paths[config.stem] = path / "last.ckpt"
        run.save_checkpoint(paths[config.stem])
    return paths


def test_checkpoint_loads_with_weights_only(checkpoints):
    batch = synthetic_batch()
    for path in checkpoints.values():
        checkpoint = torch.load(path, weights_only=True)
        assert not any("metric" in key for key in checkpoint["state_dict"])
        restored = RenderingModule.load_from_checkpoint(path)
        assert restored.class_path() == checkpoint["method"]
        assert restored.eval()(batch).isfinite().all()


@pytest.mark.parametrize(
    ("wanted", "options", "saved", "message"),
    [
        (NeuralLightTransport, {}, "cnn", "checkpoint is of CNN, not NeuralLightTransport"),
        (CNN, {}, "nlt", "checkpoint is of NeuralLightTransport, not CNN"),
        (NeuralLightTransport, {}, "denoising_1_4", "checkpoint is of SparseDenoising, not Neural"),
        (CNN, {"width": 8}, "cnn", "checkpoint has width=4, this model width=8"),
        (CNN, {"depth": 2}, "cnn", "checkpoint has depth=3, this model depth=2"),
        (
            NeuralLightTransport,
            {"num_points": 7},
            "nlt",
            "checkpoint has num_points=96, this model num_points=7",
        ),
        (
            NeuralLightTransport,
            {"use_photons": True},
            "nlt",
            "checkpoint has use_photons=False, this model use_photons=True",
        ),
        (
            NeuralLightTransport,
            {"point_width": 8},
            "nlt",
            "checkpoint has point_width=64, this model point_width=8",
        ),
        (SparseDenoising, {"one_in": 16}, "denoising_1_4", "checkpoint has one_in=4, this model one_in=16"),
    ],
)
def test_checkpoint_of_another_method(tmp_path, checkpoints, wanted, options, saved, message):
    """One line, whether a trainer resumes or tests or the class loads."""
    size = SIZE if issubclass(wanted, CloudMethod) else {"width": SIZE["width"]}
    model, data = wanted(**{**size, **options}), loader(synthetic_batch())
    run = trainer(tmp_path, max_epochs=2)
    for load in (
        lambda: run.fit(model, data, ckpt_path=checkpoints[saved], weights_only=True),
        lambda: run.test(model, data, ckpt_path=checkpoints[saved], weights_only=True),
        lambda: wanted.load_from_checkpoint(checkpoints[saved], **options),
    ):
        with pytest.raises(UserError, match=message) as error:
            load()
        assert "\n" not in str(error.value)


def test_checkpoint_older_than_an_option():
    """The option had no effect in its training."""
    checkpoint = {}
    GuidedOneSample(**SIZE).on_save_checkpoint(checkpoint)
    del checkpoint["architecture"]["relative"], checkpoint["architecture"]["patch"]
    GuidedOneSample(**SIZE).on_load_checkpoint(checkpoint)
    with pytest.raises(UserError, match="checkpoint has relative=False, this model relative=True"):
        GuidedOneSample(relative=True, **SIZE).on_load_checkpoint(checkpoint)
    with pytest.raises(UserError, match="checkpoint has patch=1, this model patch=2"):
        GuidedOneSample(patch=2, **SIZE).on_load_checkpoint(checkpoint)


@pytest.mark.parametrize("config", ["nlt_photons", "denoising_1_4"])
def test_resuming_is_exact(tmp_path, config):
    """Two epochs in one go, or one, a checkpoint and another: the same weights to the bit."""
    path, data = (
        next(p for p in CONFIGS if p.stem == config),
        loader(synthetic_batch(), synthetic_batch(seed=1)),
    )
    through = build(path)
    trainer(tmp_path, max_epochs=2).fit(through, data)
    first = trainer(tmp_path, max_epochs=1)
    first.fit(build(path), data)
    first.save_checkpoint(tmp_path / "first.ckpt")
    torch.manual_seed(123)
    resumed = build(path)
    trainer(tmp_path, max_epochs=2).fit(resumed, data, ckpt_path=tmp_path / "first.ckpt", weights_only=True)
    for a, b in zip(through.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)


# --- inference ---


def test_a_moving_camera_reuses_the_state(method):
    """The image is the same to the bit; light transport is computed once per state."""
    moving, (here, there) = MovingCamera(method), (synthetic_batch(seed=seed) for seed in (0, 1))
    there |= {name: here[name] for name in method.state_inputs}
    calls, transport = [], method.transport
    method.transport = lambda state: calls.append(state) or transport(state)
    with torch.no_grad():
        for batch in (here, there, here):
            assert torch.equal(moving(batch), method.synthesize(batch, method.features(batch, transport(batch))))
        assert len(calls) == 1
        here["exposure"] *= 2  # in place
        expected = method.synthesize(here, method.features(here, transport(here)))
        assert torch.equal(moving(here), expected) and len(calls) == 2


def test_sparse_maps_make_the_same_image(method, one_thread):
    """Only where pixels are many, and only in the accelerated copy."""
    double = lambda batch: {k: v.double() if v.is_floating_point() else v for k, v in batch.items()}
    batch, small = (double(synthetic_batch(size=size)) for size in (24, 7))
    projects = isinstance(method, NeuralLightTransport | FeatureProjection) and "camera_matrix" in method.inputs
    method = method.double().eval()
    with torch.no_grad():
        expected = method(batch)
        fast = accelerate(method, Policy(sparse=True), torch.device("cpu"))
        features = lambda batch: fast.features(batch, fast.transport(batch))
        assert isinstance(features(batch), tuple) == projects
        torch.testing.assert_close(fast(batch), expected, rtol=1e-9, atol=1e-12)
        assert isinstance(features(small), torch.Tensor)
        assert torch.equal(method(batch), expected)


_ALONE = """
import sys, torch
for name in ("nlt", "lightning", "mitsuba"):
    sys.modules[name] = None  # importing it fails
for folder in sys.argv[1:]:
    batch, expected = torch.load(f"{folder}/frame.pt")
    torch.testing.assert_close(torch.export.load(f"{folder}/program.pt2").module()(batch), expected)
    print(folder)
"""


def test_exported_programs_run_alone(tmp_path, checkpoints):
    """Every method's, with PyTorch and nothing else: the same image."""
    folders = []
    for name, path in checkpoints.items():
        folders.append(tmp_path / name)
        folders[-1].mkdir()
        program = folders[-1] / "program.pt2"
        assert main(["export", str(path), "-o", str(program), "--resolution=16", f"--photons={PHOTONS}"]) == 0
        method, whole = RenderingModule.load_from_checkpoint(path).eval(), synthetic_batch(1)
        batch = {field: whole[field] for field in (*method.inputs, "exposure", "scene", "index")}
        with torch.no_grad():
            torch.save((batch, method(batch)), folders[-1] / "frame.pt")
    done = subprocess.run(
        [sys.executable, "-c", _ALONE, *map(str, folders)], capture_output=True, text=True, check=True
    )
    assert done.stdout.split() == [str(folder) for folder in folders]


# --- without training ---


@pytest.mark.parametrize("name", UNTRAINED)
def test_untrained(name):
    """Reads what it declares; its prediction follows the light."""
    method, batch = build_if_untrained(name), {**synthetic_batch(), "traced": 3 * torch.rand(2, 3, 16, 16)}
    declared = {key: batch[key] for key in (*method.inputs, "exposure", "scene", "index")}
    expected = method(declared)
    assert expected.shape == (2, 3, 16, 16) and expected.isfinite().all() and expected.is_contiguous()
    assert method.stages == (*(("gbuffer",) if "oidn" in name else ()), "path_tracing")
    assert method.reads_direct_light == ("mirrors" in name)
    assert method.spp == int(re.findall(r"\d+", name)[0]) and method.pixel_fraction == 1
    assert not list(method.parameters())
    scaled = {**declared, "traced": batch["traced"] / 2, "exposure": batch["exposure"] * 2}
    torch.testing.assert_close(method(scaled), expected / 2, rtol=1e-4, atol=1e-5)


def test_oidn_sees_what_a_mirror_shows():
    """A mirror has no albedo; its image of a checkerboard stays sharper with the checkerboard's albedo as a guide."""
    generator = torch.Generator().manual_seed(0)
    albedo = (0.3 + 0.5 * ((torch.arange(64)[:, None] // 4 + torch.arange(64) // 4) % 2)).expand(1, 3, 64, 64)
    batch = {
        "traced": albedo * torch.rand(1, 3, 64, 64, generator=generator) * 2, "albedo": torch.zeros(1, 3, 64, 64),
        "seen_albedo": albedo, "exposure": torch.tensor([0.5]), "normal": torch.ones(1, 3, 64, 64) / 3**0.5,
    }  # fmt: skip
    plain, mirrors = [
        (build_if_untrained(name)(batch) - albedo).square().mean() for name in ("oidn_1", "oidn_1_mirrors")
    ]
    assert mirrors < plain / 2


@pytest.mark.parametrize("name", ["oidn_1", "oidn_1_balanced", "oidn_1_fast", "oidn_1_mirrors"])
def test_oidn_removes_noise_and_keeps_edges_of_its_guides(name):
    """A checkerboard albedo under constant light, with noise: nearer to the truth than a twentieth of the noise."""
    generator = torch.Generator().manual_seed(0)
    albedo = (0.3 + 0.5 * ((torch.arange(64)[:, None] // 8 + torch.arange(64) // 8) % 2)).expand(1, 3, 64, 64)
    noise = torch.rand(1, 3, 64, 64, generator=generator) * 2
    batch = {
        "traced": albedo * noise, "albedo": albedo, "seen_albedo": albedo,
        "exposure": torch.tensor([0.5]),
        "normal": torch.tensor([0.0, 0, 1]).view(1, 3, 1, 1).expand(1, 3, 64, 64),
    }  # fmt: skip
    error = (build_if_untrained(name)(batch) - albedo).square().mean()
    assert error < (batch["traced"] - albedo).square().mean() / 20


def test_oidns_quality():
    """Three filters that make three different images; any other name is refused."""
    batch = {**synthetic_batch(), "traced": 3 * torch.rand(2, 3, 16, 16)}
    images = [OpenImageDenoise(quality=quality)(batch) for quality in ("fast", "balanced", "high")]
    assert min((a - b).abs().max() for a, b in combinations(images, 2)) > 0.01
    assert torch.equal(build_if_untrained("oidn_1")(batch), images[-1])
    with pytest.raises(UserError, match=r"^model\.init_args\.quality: must be one of fast, balanced, high, is 'best'$"):
        OpenImageDenoise(quality="best")


# --- the sparse denoiser ---


@pytest.mark.parametrize("one_in", [1, 4, 16, 32, 64, 1000])
def test_mask_has_exactly_the_number_of_pixels(one_in):
    mask = pixel_mask(torch.arange(20), 16, 15, one_in)
    assert mask.shape == (20, 1, 16, 15) and mask.dtype == torch.bool
    assert (mask.sum((1, 2, 3)) == round(16 * 15 / one_in)).all()


def test_mask_is_uniform():
    """Each pixel is chosen at its rate, and neighbours, and successive seeds, are independent."""
    n, p = 4000, 1 / 4
    mask = pixel_mask(torch.arange(n), 8, 8, 4)[:, 0].double()
    assert ((mask.mean(0) - p).abs() < 5 * (p * (1 - p) / n) ** 0.5).all()
    both = 16 * 15 / (64 * 63)  # without replacement
    assert abs((mask[:, :, 1:] * mask[:, :, :-1]).mean() - both) < 0.003
    assert abs((mask[1:] * mask[:-1]).mean() - p**2) < 0.003


@pytest.fixture
def step(monkeypatch: pytest.MonkeyPatch):
    """Sets the training step."""
    return lambda n: monkeypatch.setattr(SparseDenoising, "global_step", n)


def test_mask_is_fixed_in_evaluation_and_fresh_in_training(step):
    batch, method = synthetic_batch(4), SparseDenoising(one_in=4, width=4)
    other_seed = SparseDenoising(one_in=4, width=4, seed=1)

    def masks(model):
        step(0)
        first = model.mask(batch, 16, 16)
        assert torch.equal(first, model.mask(batch, 16, 16))
        step(1)
        return first, model.mask(batch, 16, 16)

    (a, b), (c, _) = masks(method.train()), masks(other_seed.train())
    d, e = masks(method.eval())
    assert torch.equal(d, e) and torch.equal(d, masks(other_seed.eval())[0])
    assert not torch.equal(a, b) and not torch.equal(a, c) and not torch.equal(a, d)
    assert not torch.equal(d[0], d[2])
    single = {name: value[2:3] for name, value in batch.items()}
    assert torch.equal(method.mask(single, 16, 16), d[2:3])  # wherever in a batch the sample is


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (SparseDenoising(one_in=4, width=4), "noisy_input"),
        (GuidedOneSample(gap=1, width=4), "noisy"),
        (GuidedOneSample(gap=1, rows_only=True, width=4), "noisy"),
        (GuidedOneSample(gap=2, width=4, relative=True), "noisy"),
        (GuidedFourSamples(gap=1, rows_only=True, width=4), "noisy_input"),
    ],
)
@torch.no_grad()
def test_pixels_not_traced_have_no_influence(method, name):
    batch, method = synthetic_batch(), method.eval()
    expected, mask = method(batch), method.mask(batch, 16, 16)
    assert mask.double().mean() == pytest.approx(method.pixel_fraction, rel=0.2)
    noise = batch[name]
    batch[name] = torch.where(mask, noise, torch.nan)
    assert torch.equal(method(batch), expected)
    batch[name] = torch.where(mask, noise + 1, noise)
    assert not torch.equal(method(batch), expected)


def test_a_traced_pixel_stands_for_those_around_it():
    batch, method = synthetic_batch(), GuidedOneSample(gap=3, width=4)
    reflected = method.gbuffer(batch)[:, 10:]
    assert reflected.shape[2:] == (16, 16)
    own = GuidedOneSample(width=4).gbuffer(batch)[:, 10:]
    blocks = own[..., 2::4, 2::4].repeat_interleave(4, 2).repeat_interleave(4, 3)
    assert torch.equal(reflected, blocks) and not torch.equal(reflected, own)


@pytest.mark.parametrize("one_in", [1, 4, 16, 32, 64])
def test_guides_of_denoising(one_in):
    """The paper's denoisers see noisy pixels and which they are; the guided ones see the G-buffer, too."""
    plain, guided = (build(find_config("model", f"{name}_1_{one_in}")) for name in ("denoising", "guided"))
    assert plain.inputs == ("noisy_input",) and plain.stages == ("path_tracing",)
    assert guided.inputs == (*GBUFFER, "noisy_input") and guided.stages == ("gbuffer", "path_tracing")
    assert plain.pixel_fraction == guided.pixel_fraction == 1 / one_in


def test_the_targets_noise_is_independent(method):
    """A method that reads a noisy image compares with another one; its own noise would teach it to copy."""
    batch = synthetic_batch()
    reads = "noisy" in method.inputs
    assert method.target not in method.fields and method.target in method.training_fields
    assert method.target == ("target" if isinstance(method, GuidedOneSample) else "noisy")
    method.eval()
    prediction, loss = method(batch), method.noisy_loss(method(batch), batch)
    changed = batch | {method.target: batch[method.target] + 1}
    assert torch.equal(method(changed), prediction)
    assert not torch.equal(method.noisy_loss(prediction, changed), loss)
    if reads:
        assert method.stages[-1] == "path_tracing"
        assert not torch.equal(method(batch | {"noisy": batch["noisy"] + 1}), prediction)


def test_only_what_is_not_in_the_paper_trains_towards_the_cleaner_target():
    assert build(find_config("model", "cnn")).target == "noisy"
    assert build(find_config("model", "cnn"), find_config("variant", "direct")).target == "target"


def test_denoising_sees_noisy_pixels_alone():
    method = SparseDenoising(width=4)
    assert method.inputs == ("noisy_input",) and method.stages == ("path_tracing",)
    batch = synthetic_batch()
    names = ("noisy_input", "exposure", "scene", "index")
    assert method({name: batch[name] for name in names}).shape == (2, 3, 16, 16)
    assert method.feature_channels == 4 and method.pixel_fraction == 1
