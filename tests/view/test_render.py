"""Videos by a trained method: their frames are its predictions, none is made twice, and what is wrong is said."""

import hashlib
import json
from pathlib import Path
from types import SimpleNamespace

import av
import numpy as np
import OpenEXR
import pytest
import torch
import yaml
from generated import spec_of
from PIL import Image
from tiny import write

from nlt.baselines.cnn import CNN
from nlt.baselines.denoising import SparseDenoising
from nlt.baselines.guided import GuidedOneSample
from nlt.baselines.path_tracing import OpenImageDenoise
from nlt.cli import main
from nlt.data.dataset import LightTransportDataset
from nlt.data.render import SampleRenderer
from nlt.data.store import points_name, read_points, write_shard
from nlt.display import display, display_bytes
from nlt.evaluation.export import load_trained, save_trained
from nlt.models.nlt import NeuralLightTransport
from nlt.models.policy import Policy, accelerate
from nlt.models.steady import Steady
from nlt.rendering.renderer import Renderer
from nlt.scenes.state import rest_state, sample_state
from nlt.scenes.trajectory import cameras, follow, states, turn, write_camera, write_state
from nlt.view.drawing import (
    DEMO,
    DEMO_SCENE,
    UNTRAINED,
    ModelRenderer,
    load_models,
    open_models,
    with_scene,
)
from nlt.view.video import render, write_video

pytest_plugins = ["training_fixtures"]
pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("one_thread")]
CPU = torch.device("cpu")
SIZE = (16, 12)  # width, height


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for module in ("drawing", "video"):
        monkeypatch.setattr(f"nlt.view.{module}.default_device", lambda: CPU)


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    """Files of methods with random weights: `nlt` with embeddings of the living room's points, `photons` without."""
    folder = tmp_path_factory.mktemp("models")
    torch.manual_seed(0)
    size = {"width": 2, "depth": 1}
    methods = {
        "nlt": NeuralLightTransport(use_photons=True, num_points=200, **size),
        "photons": NeuralLightTransport(use_photons=True, use_points=False, **size),
    }
    files = {name: folder / f"{name}.safetensors" for name in methods}
    points = SampleRenderer(spec_of(), 0).points()
    for name, method in methods.items():
        save_trained(method, spec_of(test=3), [points], str(files[name]))
    return SimpleNamespace(**files)


def pixels(path):
    return np.asarray(Image.open(path))


@pytest.mark.parametrize(("light", "size"), [(None, SIZE), ("turntable", (20, 12))])  # fewer pixels than points, more
def test_frames_are_predictions(models, tmp_path, monkeypatch, light, size):
    """Left, what the method says of the same samples, stored and read as any; right, path tracing.

    Photons are cast and light is transported once for a state.
    """
    cast, transported = [], []
    photons, transport = Renderer.photons, NeuralLightTransport.transport
    monkeypatch.setattr(Renderer, "photons", lambda *a: cast.append(a) or photons(*a))
    monkeypatch.setattr(NeuralLightTransport, "transport", lambda *a: transported.append(a) or transport(*a))
    render({"": str(models.nlt)}, "living_room", "frames", "3", light, frames=3, resolution=size, spp=2)
    # 7 are timed, the last of them in the first frame's state.
    assert len(cast) == len(transported) == (1 if light is None else 7 + 2)

    method, spec, _ = load_trained(str(models.nlt))
    renderer = SampleRenderer(spec, 0)
    views = cameras(renderer.description, "turntable", 3, *size)
    moments = states(renderer.description, "moving_lights", "3", light, 3)
    samples, traced = [], []
    for k, (moment, view) in enumerate(zip(moments, views, strict=True)):
        renderer.scene.set_state(moment)
        samples.append(renderer.view(view, np.random.SeedSequence([0]), spec.fields("test")))
        (seed,) = np.random.SeedSequence([1, k]).generate_state(1)
        traced.append(torch.from_numpy(renderer.radiance(view, 2, int(seed))))
    write_shard(tmp_path / points_name(0), [renderer.points()])
    write_shard(tmp_path / spec.shard("test", 0, 0).name, samples)
    batch = LightTransportDataset(tmp_path, spec, "test").__getitems__([0, 1, 2])
    with torch.no_grad():
        fast = accelerate(method, Policy.for_device(CPU), CPU)
        predicted = torch.cat([fast({name: v[k : k + 1] for name, v in batch.items()}) for k in range(3)])
    exposure = renderer.description.exposure
    for k in range(3):
        expected = [255 * display(x[None], exposure)[0].permute(1, 2, 0) for x in (predicted[k], traced[k])]
        picture = pixels(tmp_path / "frames" / f"{k:05d}.png")
        assert (picture[:12] == np.concatenate([e.round().numpy() for e in expected], 1)).all()


@pytest.mark.parametrize(
    ("method", "name"),
    [
        (SparseDenoising(one_in=16, width=2, depth=1), "noisy_input"),
        (GuidedOneSample(gap=3, width=2, depth=1), "noisy"),
    ],
)
def test_traces_only_the_pixels_that_the_method_looks_at(method, name):
    model = ModelRenderer(method, spec_of(input_spp=64, noisy_spp=64), 0, CPU)
    description = model.render.description
    (moment,), (view,) = states(description, "moving_lights", "3", None, 1), cameras(description, "turntable", 1, *SIZE)
    batch = model.batch(moment, view)
    looked = method.mask(batch, SIZE[1], SIZE[0])[0, 0]
    given = batch[name][0]
    assert looked.sum() == 12 and (given[:, ~looked] == 0).all()
    whole = model.traced(moment, view, 1024, 0)[0]
    noise = model.render.radiance(view, 64, 1) - whole.numpy()  # of as many samples, at all pixels
    assert (given - whole)[:, looked].square().mean() < 20 * np.square(noise).mean()
    assert given[:, looked].mean() == pytest.approx(whole[:, looked].mean().item(), rel=0.3)


def test_steady_frames_are_blended_ones(models, tmp_path):
    """Steady frames are those of the method, blended in order; a lost frame is made again as it was."""
    ask = lambda: render(
        {"": str(models.nlt)}, "living_room", "steady", "3", frames=3, resolution=SIZE, spp=0, steady=True
    )
    ask()
    method, spec, _ = load_trained(str(models.nlt))
    model = ModelRenderer(accelerate(method, Policy.for_device(CPU), CPU), spec, 0, CPU)
    description, steady = model.render.description, Steady()
    (moment,) = states(description, "moving_lights", "3", None, 1)
    files = [tmp_path / "steady" / f"{k:05d}.png" for k in range(3)]
    with torch.no_grad():
        for k, view in enumerate(cameras(description, "turntable", 3, *SIZE)):
            alone = model.frame(moment, view, k)
            depth = torch.from_numpy(model.gbuffer(moment, view)["depth"])[None]
            blended = steady(alone, model.batch(moment, view) | {"depth": depth})
            expected = 255 * display(blended, description.exposure)[0].permute(1, 2, 0)
            assert (pixels(files[k])[: SIZE[1]] == expected.round().numpy()).all()
            assert (k == 0) == torch.equal(blended, alone)
    content = files[2].read_bytes()
    files[2].unlink()
    ask()
    assert files[2].read_bytes() == content


def test_noise_differs_from_frame_to_frame():
    model = ModelRenderer(GuidedOneSample(width=2, depth=1), spec_of(), 0, CPU)
    description = model.render.description
    (moment,), (view,) = states(description, "moving_lights", "3", None, 1), cameras(description, "turntable", 1, *SIZE)
    first, again, other = (model.batch(moment, view, number)["noisy"] for number in (0, 0, 1))
    assert torch.equal(first, again) and not torch.equal(first, other)


def test_traces_one_sample_for_the_method_that_reads_it():
    """The frame's noisy image is the dataset's, at the same samples per pixel and of the same seed."""
    model = ModelRenderer(GuidedOneSample(width=2, depth=1), spec_of(noisy_spp=2, input_spp=64), 0, CPU)
    description = model.render.description
    (moment,), (view,) = states(description, "moving_lights", "3", None, 1), cameras(description, "turntable", 1, *SIZE)
    batch = model.batch(moment, view)
    assert "noisy_input" not in batch and model.seconds["path_tracing"] > 0
    expected = model.render.radiance(view, 2, int(np.random.SeedSequence([0]).generate_state(1)[0]))
    np.testing.assert_array_equal(batch["noisy"][0], expected)
    assert model.spec.samples(model.method.fields) == 2 and model.spec.samples(("noisy_input",)) == 64


def test_without_embeddings_any_scene_will_do():
    method = NeuralLightTransport(use_points=False, use_photons=True, width=2, depth=1)
    assert with_scene(method, spec_of(), "bedroom", "a.ckpt")[0].scenes == ["bedroom"]


def test_goes_on_where_it_was_killed(models, tmp_path, capsys):
    """Frames that are there stay as they are; another command's are not mixed with them."""
    ask = lambda **more: render(
        {"": str(models.photons)}, "bedroom", "frames", frames=4, resolution=(8, 8), spp=1, **more
    )
    ask()
    folder = tmp_path / "frames"
    first = {path.name: path.read_bytes() for path in folder.iterdir()}
    assert sorted(first) == [*(f"{k:05d}.png" for k in range(4)), "render.json"]
    Image.new("RGB", (16, 28), "red").save(folder / "00001.png")  # it would be another if it were made again
    red = (folder / "00001.png").read_bytes()
    for name in ("00002.png", "00003.png"):
        (folder / name).unlink()
    (folder / ".00002.png.elsewhere.1.tmp").write_bytes(b"half")
    ask()
    assert {name: (folder / name).read_bytes() for name in first} == first | {"00001.png": red}
    (folder / ".00002.png.elsewhere.1.tmp").unlink()
    arguments = f"render {models.photons} bedroom -o frames --frames 4 --resolution 8 --spp 1 --state 1"
    assert main(arguments.split()) == 2
    assert "another command" in capsys.readouterr().err
    assert (folder / "00001.png").read_bytes() == red


def test_layers_of_frames(models, tmp_path, refused):
    """The PNG shows the EXR's radiance; a frame whose EXR is missing is made again, and no other."""
    ask = ["render", str(models.photons), "living_room", "--frames", "2", "--resolution", "24x16", "--spp", "2"]
    refused([*ask, "--exr", "-o", "video.mp4"], "--exr", "folder")
    assert main([*ask, "-o", "frames"]) == 0
    before = [pixels(tmp_path / f"frames/0000{k}.png") for k in range(2)]
    assert main([*ask, "-o", "frames", "--exr"]) == 0
    model = ModelRenderer(*load_trained(str(models.photons))[:2], 0, CPU)
    exposure = model.render.description.exposure
    for k, view in enumerate(cameras(model.render.description, "turntable", 2, 24, 16)):
        (moment,) = states(model.render.description, "moving_lights", "0", None, 1)
        with OpenEXR.File(str(tmp_path / f"frames/0000{k}.exr"), separate_channels=True) as file:
            found = {name: channel.pixels for name, channel in file.channels().items()}
        layer = lambda *names: np.stack([found[name] for name in names])  # noqa: B023
        sheet = [display_bytes(layer(*(f"{p}{c}" for c in "RGB")), exposure) for p in ("", "Noisy Image.")]
        assert (pixels(tmp_path / f"frames/0000{k}.png") == before[k]).all()
        assert (before[k][:16] == np.concatenate(sheet, 1)).all()
        model.render.scene.set_state(moment)
        buffers = model.render.renderer.gbuffer(view)
        np.testing.assert_array_equal(found["Depth.Z"], buffers["depth"][0])
        for name, channels in (("albedo", "RGB"), ("normal", "XYZ")):
            stored = layer(*(f"Denoising {name.capitalize()}.{c}" for c in channels))
            np.testing.assert_allclose(stored, buffers[name], atol=1e-3)
        np.testing.assert_array_equal(layer(*(f"Emit.{c}" for c in "RGB")), buffers["emission"])
    (tmp_path / "frames/00000.exr").unlink()
    kept = (tmp_path / "frames/00001.exr").stat().st_mtime_ns
    assert main([*ask, "-o", "frames", "--exr"]) == 0
    assert (tmp_path / "frames/00000.exr").exists() and (tmp_path / "frames/00001.exr").stat().st_mtime_ns == kept


def test_embeddings_keep_their_points(models, monkeypatch):
    """Points and embeddings in another order make the same image, so a machine that samples others does not matter."""
    method, spec, (points,) = load_trained(str(models.nlt))
    order = np.random.default_rng(0).permutation(spec.num_points)
    table = method.embedding.table.weight.data
    table.copy_(table[torch.from_numpy(order)])
    shuffled = {name: array[order] if array.ndim else array for name, array in points.items()}
    save_trained(method, spec, [shuffled], "shuffled.safetensors")
    monkeypatch.setattr(SampleRenderer, "points", lambda _: pytest.fail("sampled again"))
    images = []
    for file in (str(models.nlt), "shuffled.safetensors"):
        (model,) = open_models(load_models({"": file}, "living_room")).values()
        description = model.render.description
        (moment,) = states(description, "moving_lights", "3", None, 1)
        (view,) = cameras(description, "turntable", 1, *SIZE)
        with torch.no_grad():
            images.append(model.frame(moment, view))
    torch.testing.assert_close(*images, rtol=1e-3, atol=1e-4)


def test_without_noisy_input_nothing_is_traced(models, monkeypatch):
    traced = []
    monkeypatch.setattr(SampleRenderer, "radiance", lambda *arguments: traced.append(arguments))
    model = ModelRenderer(*load_trained(str(models.photons))[:2], 0, CPU)
    description = model.render.description
    (moment,), (view,) = states(description, "moving_lights", "3", None, 1), cameras(description, "turntable", 1, *SIZE)
    with torch.no_grad():
        model.frame(moment, view)
    assert not traced and {"gbuffer", "photons", "projection", "synthesis"} <= model.seconds.keys()


def test_direct_light_is_that_of_the_view(models):
    model = ModelRenderer(CNN(width=2, direct_light=True), load_trained(str(models.photons))[1], 0, CPU)
    description = model.render.description
    (moment,), (view,) = states(description, "moving_lights", "3", None, 1), cameras(description, "turntable", 1, *SIZE)
    direct = model.batch(moment, view)["direct"][0].numpy()
    np.testing.assert_array_equal(direct, model.render.renderer.gbuffer(view, direct=True)["direct"])
    assert direct.any() and "gbuffer" in model.seconds and model.frame(moment, view).isfinite().all()


def test_checkpoint_export_and_video(tiny, checkpoint, tmp_path, capsys):
    """A checkpoint and its export make the same frames; the mp4 shows them, the PNG is the first of them."""
    assert main(["export", str(checkpoint), "-o", "small.safetensors"]) == 0
    points, (own,) = read_points(tiny.dataset / points_name(0)), load_trained(str(checkpoint))[2]
    assert own.keys() == points.keys() and all(np.array_equal(own[name], points[name]) for name in points)
    assert load_trained("small.safetensors")[2] == [{}]  # it has no embeddings
    size = ["--frames", "3", "--resolution", "34x17", "--state", "2", "--spp", "1"]
    for model, output in ((checkpoint, "a"), ("small.safetensors", "b")):
        assert main(["render", str(model), "living_room", "-o", output, *size]) == 0
    names = [f"{k:05d}.png" for k in range(3)]
    left = [[pixels(tmp_path / folder / name)[:17, :34] for name in names] for folder in "ab"]
    assert (np.stack(left[0]) == np.stack(left[1])).all() and left[0][0].any()
    assert main(["render", str(checkpoint), "living_room", "-o", "x/v.mp4", "--fps", "5", *size]) == 0
    assert sorted(path.name for path in (tmp_path / "x").iterdir()) == ["v.json", "v.mp4", "v.png"]
    assert (pixels(tmp_path / "x/v.png")[:17] == pixels(tmp_path / "a/00000.png")[:17]).all()
    with av.open(str(tmp_path / "x/v.mp4")) as container:
        stream = container.streams.video[0]
        shown = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        codec, rate = stream.codec_context, stream.average_rate
    assert (codec.name, codec.pix_fmt, rate, len(shown)) == ("h264", "yuv420p", 5, 3)
    assert all(frame.shape == (38, 68, 3) for frame in shown)  # 17 + 20 of the caption, made even
    assert json.loads((tmp_path / "x/v.json").read_text())["spp"] == 1


def test_video_shows_its_frames(tmp_path):
    ramp = np.linspace(0, 255, 64)[None, :, None] * np.ones((48, 1, 3))
    images = [np.roll(ramp, 8 * k, axis=1).astype(np.uint8) for k in range(5)]
    write_video(tmp_path / "v.mp4", iter(images), 10)
    with av.open(str(tmp_path / "v.mp4")) as container:
        shown = [frame.to_ndarray(format="rgb24").astype(float) for frame in container.decode(video=0)]
    assert len(shown) == 5
    for k, frame in enumerate(shown):
        errors = [np.abs(frame - image).mean() for image in images]
        assert errors[k] < 5 and int(np.argmin(errors)) == k


def test_included_models():
    """They are small and say where they are from."""
    files = [Path(file) for file in DEMO.values()]
    assert sum(file.stat().st_size for file in files) <= 5e6
    for file in files:
        card = json.loads(file.with_suffix(".json").read_text())
        assert card["command"] and len(card["commit"]) == 40 and card["test"]["mse"] > 0 and card["minutes"] > 0
        assert card["sha256"] == hashlib.sha256(file.read_bytes()).hexdigest()


def test_demo(tmp_path):
    """The demo's models are nearer to the reference than 1 spp."""
    assert main(["render", "--demo", "--frames", "2", "--resolution", "32", "-o", "demo.mp4"]) == 0
    assert pixels(tmp_path / "demo.png").shape == (52, 96, 3) and (tmp_path / "demo.mp4").stat().st_size > 0
    assert list(json.loads((tmp_path / "demo.json").read_text())["model_ms"]) == list(DEMO)
    models = open_models(load_models(DEMO, DEMO_SCENE))
    first = next(iter(models.values()))
    description = first.render.description
    moments = states(description, "moving_lights", "5", "turntable", 4)
    errors = []
    for moment, view in zip(moments, cameras(description, "turntable", 4, 64, 64), strict=True):
        with torch.no_grad():
            images = [first.traced(moment, view, spp, 1) for spp in (64, 1)]
            images += [model.frame(moment, view) for model in models.values()]
        reference, *drawn = [display(image, 1.0) for image in images]
        errors.append([(image - reference).square().mean().item() for image in drawn])
    noisy, *ours = np.mean(errors, axis=0)
    assert max(ours) < 0.5 * noisy


def test_without_training(tmp_path):
    """Without a checkpoint, Open Image Denoise draws a scene as it is, by its own lights unless the light is moved."""
    command = ["render", "egg", "--frames", "1", "--resolution", "16"]
    variants = {"own": "", "turning": "--light turntable", "moving": "--lights moving", "moved": "--state 3"}
    for name, options in variants.items():
        assert main([*command, *options.split(), "--spp", "1", "-o", name]) == 0
    manifests = {name: json.loads(Path(name, "render.json").read_text()) for name in variants}
    assert {name: each["experiment"] for name, each in manifests.items()} == {
        "own": "fixed_lights", "turning": "moving_lights", "moving": "moving_lights", "moved": "fixed_lights"
    }  # fmt: skip
    assert all(list(each["model_ms"]) == [UNTRAINED] for each in manifests.values())
    assert len({pixels(tmp_path / name / "00000.png").tobytes() for name in variants}) == 4
    renderer = SampleRenderer(spec_of("egg", experiment="fixed_lights"), 0)
    description = renderer.description
    renderer.scene.set_state(rest_state(description, "fixed_lights"))
    (view,) = cameras(description, "turntable", 1, 16, 16)
    (seed,) = np.random.SeedSequence([1, 0]).generate_state(1)
    traced = renderer.radiance(view, 1, int(seed))
    guides = renderer.view(view, np.random.SeedSequence([0]), {"albedo", "normal"})
    batch = {name: torch.from_numpy(value)[None] for name, value in {**guides, "traced": traced}.items()}
    denoised = OpenImageDenoise(1, "fast")(batch | {"exposure": torch.tensor([description.exposure])})[0].numpy()
    expected = np.concatenate([display_bytes(image, description.exposure) for image in (denoised, traced)], axis=1)
    np.testing.assert_array_equal(pixels(tmp_path / "own/00000.png")[:16], expected)


# --- paths ---


def test_turn_stays_in_the_box():
    box = np.array([[-1.0, 2, -5], [3, 2.5, 1]])
    points = turn(box, np.array([0.0, 1, 0]), 16)
    assert (points >= box[0]).all() and (points <= box[1]).all() and (points[:, 1] == 2.25).all()
    radii = (points - box.mean(0)) / (0.9 * (box[1] - box[0]) / 2)
    np.testing.assert_allclose(np.hypot(radii[:, 0], radii[:, 2]), 1)
    steps = np.linalg.norm(np.diff(radii, axis=0, append=radii[:1]), axis=1)
    np.testing.assert_allclose(steps, 2 * np.sin(np.pi / 16))


def test_follow_passes_its_keys():
    keys = np.random.default_rng(0).normal(size=(5, 3))
    there = follow(keys, 41, closed=False)
    np.testing.assert_allclose(there[::10], keys)
    for k in range(4):  # never outside of the box of two neighbours
        part, ends = there[10 * k : 10 * k + 11], np.sort(keys[k : k + 2], axis=0)
        assert (part >= ends[0] - 1e-9).all() and (part <= ends[1] + 1e-9).all()
    around = follow(keys, 50, closed=True)
    np.testing.assert_allclose(around[::10], keys)
    np.testing.assert_allclose(follow(np.roll(keys, -2, 0), 50, closed=True), np.roll(around, -20, 0))
    assert (follow(keys[:1], 3, closed=True) == keys[0]).all()


def test_written_states_and_views_are_read_back(demo, tmp_path):
    """The very state, of random ones in each experiment and of the light; the camera to within rounding."""
    for experiment in ("static", "fixed_lights", "moving_lights"):
        for seed in range(5):
            moment = sample_state(demo, experiment, np.random.default_rng(seed))
            path = write(tmp_path / "s.yaml", write_state(demo, experiment, moment))
            assert states(demo, experiment, str(path), None, 1)[0].key == moment.key
    for view in cameras(demo, "turntable", 3, 30, 20):
        path = write(tmp_path / "c.yaml", write_camera(view))
        (again,) = cameras(demo, str(path), 1, 30, 20)
        np.testing.assert_allclose(again.matrix, view.matrix, rtol=1e-6)
        np.testing.assert_allclose(again.world_to_view, view.world_to_view, atol=1e-6)


def test_files_of_states_and_views(demo, tmp_path):
    """What a state file says is where things are; a JSON file is read as well as YAML."""
    names = [movable.name for movable in demo.movables("moving_lights")]
    content = {"objects": {"vase": "removed", "table": [0.1, 0, 0.2]}, "light": [[-1, 2.5, 0], [1, 2.5, 0.5]]}
    first, last = states(demo, "moving_lights", str(write(tmp_path / "s.yaml", content)), None, 2)
    assert not first.present[names.index("vase")] and first.present.sum() == len(names) - 1
    np.testing.assert_allclose(first.translation[names.index("table")], [0.1, 0, 0.2], atol=1e-7)
    for moment, position in ((first, [-1, 2.5, 0]), (last, [1, 2.5, 0.5])):
        np.testing.assert_allclose(moment.translation[-1] + demo.light.centre, position, atol=1e-6)
    (seeded,) = states(demo, "moving_lights", str(write(tmp_path / "n.yaml", {"seed": 7})), None, 1)
    assert seeded.key == states(demo, "moving_lights", "7", None, 1)[0].key
    views = {"fov": 50, "views": [{"position": [0, 1, 0], "target": [1, 1, 0]}]}
    (view,) = cameras(demo, str(write(tmp_path / "v.json", json.dumps(views))), 1, 20, 10)
    assert view.fov == pytest.approx(50) and (view.width, view.height) == (20, 10)
    np.testing.assert_allclose(view.position, [0, 1, 0], atol=1e-6)
    np.testing.assert_allclose(view.rotation[:, 2], [1, 0, 0], atol=1e-6)


# --- mistakes ---


def test_mistakes_are_one_line(models, tmp_path, refused):
    view = {"position": [0, 1, 0], "target": [1, 1, 0]}
    file = lambda name, content: str(write(tmp_path / name, content))
    tiny = ["--resolution", "8", "--frames", "1"]
    plain = ["render", models.photons, "living_room", *tiny]
    refused(["render", "nowhere.ckpt", "living_room"], "nowhere.ckpt", "cannot be read")
    refused(["render", "nowhere.safetensors", "living_room"], "nowhere.safetensors", "cannot be read")
    broken = tmp_path / "broken.safetensors"
    broken.write_bytes(models.photons.read_bytes()[:-9])
    refused(["render", broken, "living_room"], broken, "damaged")
    refused(["render", models.photons, "palace"], "palace", "known scenes")
    refused(["render", models.nlt, "bedroom"], "bedroom", "embeddings", "living_room")
    method, *_ = load_trained(str(models.nlt))
    save_trained(method, spec_of(num_points=300), [], "more.safetensors")
    refused(["render", "more.safetensors", "living_room"], "200 points", "300")
    save_trained(method, spec_of(), [], "without.safetensors")
    refused(["render", "without.safetensors", "living_room"], "without.safetensors", "not the points", "train again")
    refused(["render", models.photons], "CKPT and SCENE")
    refused(["render", "palace"], "palace", "known scenes")
    refused(["render", models.nlt, "living_room", "--lights", "own"], "--lights", "embeddings", "moving_lights")
    refused(["render", "--demo", models.photons, "living_room"], "CKPT and SCENE")
    refused([*plain, "-o", "video.avi"], "video.avi")
    refused([*plain, "--spp", "many"], "--spp")
    refused([*plain, "--camera-path", "nowhere.yaml"], "nowhere.yaml", "No such file")
    for content, words in (
        ({}, ["views", "missing"]),
        ({"views": [view, {"position": [0, 0, 0]}]}, ["views.1.target", "missing"]),
        ({"views": [{**view, "up": 1}]}, ["views.0.up", "unknown"]),
        ({"views": [{**view, "target": [0, 1]}]}, ["views.0.target.2", "too short"]),
        ({"views": [{**view, "target": view["position"]}]}, ["frame 0"]),
        ({"views": [view], "fov": 200}, ["fov", "below 180"]),
        ({"views": [view], "closed": "no"}, ["closed", "true or false"]),
        ("views: [", ["not valid YAML"]),
    ):
        path = file("path.yaml", content if isinstance(content, str) else yaml.safe_dump(content))
        refused([*plain, "--camera-path", path], "path.yaml", *words)
    for state, words in (
        ({"objects": {"piano": "removed"}}, ["objects.piano", "unknown"]),
        ({"objects": {"vase": "gone"}}, ["objects.vase"]),
        ({"light": [0, 1, 2]}, ["light"]),
        ({"seed": -1}, ["seed"]),
    ):
        refused([*plain, "--state", file("state.yaml", state)], "state.yaml", *words)
    fixed = tmp_path / "fixed.safetensors"
    save_trained(CNN(width=2, depth=1), spec_of(experiment="fixed_lights"), [], str(fixed))
    refused(["render", fixed, "living_room", "--light", "turntable"], "--light", "fixed_lights")
    assert not list(tmp_path.glob("video*"))
