"""`nlt render`: videos rendered by a trained method, next to path tracing."""

import dataclasses
import hashlib
import io
import itertools
import json
import os
import statistics
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import av
import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from tqdm import tqdm

from nlt.baselines.path_tracing import OpenImageDenoise
from nlt.data.dataset import SampleTensors, collate
from nlt.data.files import remove_leftovers, write_bytes
from nlt.data.render import SampleRenderer
from nlt.data.sample import BUFFERS, TRACED
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points
from nlt.display import display
from nlt.errors import UserError
from nlt.evaluation.export import load_trained
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule
from nlt.models.moving_camera import MovingCamera
from nlt.models.policy import Policy, accelerate, default_device
from nlt.models.steady import Steady
from nlt.paths import find_config
from nlt.rendering.exr import exr
from nlt.scenes.camera import Camera
from nlt.scenes.description import Experiment, load_description
from nlt.scenes.state import SceneState
from nlt.scenes.trajectory import cameras, states

_PRETRAINED = Path(__file__).with_name("pretrained")
# The models that come with nlt, by the name that is shown; the first is the better one.
DEMO = {
    "Guided (1 spp)": str(_PRETRAINED / "guided_1spp.safetensors"),
    "the paper's full model": str(_PRETRAINED / "nlt_photons.safetensors"),
}
DEMO_SCENE = "living_room"
# What draws a scene in which nothing was trained. No included model is as good there (docs/results.md).
UNTRAINED = "Open Image Denoise (1 spp, fast)"
MANIFEST = "render.json"
_MODEL, _TRACED = 0, 1  # seeds of photons and of path tracing
_WARM, _TIMED = 2, 5  # frames; the warm-up compiles kernels
_FEW, _MANY = 1, 8  # samples per pixel whose times give the cost of one sample
_MAX_SPP = 4096
_CAPTION = 20  # height in pixels


class ModelRenderer:
    """Renders frames with a trained method; what does not depend on the camera is reused until the state changes.

    `scene` is the scene's index in `spec`. Photons have the same seed in all states, so that they follow a moving
    light without flicker. `points` are those of training, to which embeddings belong; without them, they are sampled.
    Several methods may share the `render` of one scene. `seconds` holds the seconds of each stage since it was last
    cleared. `steady`, if set, blends each frame with those before it.
    """

    steady: Steady | None = None

    def __init__(
        self,
        method: Method,
        spec: DatasetSpec,
        scene: int,
        device: torch.device,
        points: Points | None = None,
        render: SampleRenderer | None = None,
    ) -> None:
        self.spec, self.scene, self.device = spec, scene, device
        self.render = render or SampleRenderer(spec, scene)
        self.method = method.to(device).eval()
        self.seconds: dict[str, float] = {}
        self.moving = MovingCamera(self.method, self.stage) if isinstance(self.method, RenderingModule) else None
        self._seeds = np.random.SeedSequence([_MODEL])  # of all that has the same seed in every frame
        self._state: dict[str, np.ndarray] = {}
        self._key: bytes | None = None
        self._state_fields = {name for name in method.fields if name.startswith("photon_")}
        clouds: dict[int, Points] = {}
        if any(name.startswith("point_") for name in method.fields):
            clouds[scene] = points or self.render.points()
            self._state_fields |= {"translation", "present"}
        fields = {*method.fields} - {"view_direction", "traced"}  # `batch` computes them
        self._tensors = SampleTensors(spec, clouds, fields)

    def batch(self, state: SceneState, camera: Camera, number: int = 0) -> Batch:
        """Return the fields of a frame that the method reads, as a batch of one; noise differs by its number."""
        seeds = np.random.SeedSequence([_MODEL, number])
        names = {*self.method.fields, *(Steady.fields if self.steady else ())}
        sparse = 0 < self.method.pixel_fraction < 1
        traced = set() if sparse else names & {*TRACED}
        self._set_state(state)
        if state.key != self._key:
            with self.stage("photons"):
                self._state = self.render.view(camera, self._seeds, self._state_fields)
            self._key = state.key
        with self.stage("gbuffer"):
            view = self.render.view(camera, self._seeds, {*(names & {*BUFFERS}), "camera_matrix", "world_to_view"})
        if traced:
            with self.stage("path_tracing"):
                view |= self.render.view(camera, seeds, traced)
        tensors = self._tensors(self.scene, self._state | view, number)
        tensors["view_direction"] = torch.from_numpy(camera.view_directions())
        batch = {name: value.to(self.device) for name, value in collate([tensors]).items()}
        if "traced" in names:
            batch["traced"] = self.traced(state, camera, self.method.spp or 1, number).to(self.device)
        if sparse:
            (name,) = {*self.method.fields} & {*TRACED}
            batch[name] = self._trace_input_pixels(batch, camera, seeds)
        return batch

    def _trace_input_pixels(self, batch: Batch, camera: Camera, seeds: np.random.SeedSequence) -> Tensor:
        """Return radiance (1, 3, H, W) traced only at the method's input pixels; 0 elsewhere."""
        mask = self.method.mask(batch, camera.height, camera.width)[0, 0].cpu().numpy()
        image = np.zeros((3, *mask.shape), np.float32)
        seed = int(seeds.generate_state(1)[0])
        with self.stage("path_tracing"):
            spp = self.spec.samples(self.method.fields)
            image[:, mask] = self.render.radiance(camera, spp, seed, np.flatnonzero(mask))
        return torch.from_numpy(image)[None].to(self.device)

    def _set_state(self, state: SceneState) -> None:
        if state.key != self.render.scene.state.key:
            self.render.scene.set_state(state)

    def frame(self, state: SceneState, camera: Camera, number: int = 0) -> Tensor:
        """Return the method's radiance (1, 3, H, W)."""
        batch = self.batch(state, camera, number)
        if self.moving:
            image = self.moving(self.method.subsample(batch))
        else:
            with self.stage("denoise"):
                image = self.method(batch)
        return self.steady(image, batch) if self.steady else image

    def traced(self, state: SceneState, camera: Camera, spp: int, frame: int) -> Tensor:
        """Return path-traced radiance (1, 3, H, W)."""
        self._set_state(state)
        (seed,) = np.random.SeedSequence([_TRACED, frame]).generate_state(1)
        with self.stage("path_tracing"):
            return torch.from_numpy(self.render.radiance(camera, spp, int(seed)))[None]

    def gbuffer(self, state: SceneState, camera: Camera) -> dict[str, np.ndarray]:
        """Return the G-buffer: depth (1, H, W), and albedo, normal and emission (3, H, W)."""
        self._set_state(state)
        with self.stage("gbuffer"):
            return self.render.view(camera, self._seeds, BUFFERS)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the seconds that the context takes to those of a stage."""
        start = time.perf_counter()
        yield
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start


def render(
    checkpoints: Mapping[str, str],
    scene: str,
    output: str,
    state: str = "0",
    light: str | None = None,
    experiment: Experiment | None = None,
    camera_path: str = "turntable",
    frames: int = 36,
    resolution: tuple[int, int] = (256, 256),
    fps: int = 24,
    spp: int | None = None,
    photons: int | None = None,
    layers: bool = False,
    steady: bool = False,
) -> Path:
    """Write a video of a scene: the methods left, path tracing right, captions with the measured time per frame.

    Frames are written one by one; a repeated command keeps those that exist.

    Args:
        checkpoints: checkpoints of `nlt fit` in their runs, or safetensors of `nlt export`, by the names shown; all of
            one experiment. An empty name stands for the name of the method's class. Without any, Open Image Denoise
            draws the scene.
        scene: a scene of the methods' datasets; any scene for methods without point embeddings.
        output: VIDEO.mp4, next to which VIDEO.png, the first frame, and VIDEO.json, the manifest, are written; or a
            folder for PNGs.
        state, light, camera_path: see nlt/scenes/trajectory.py.
        experiment: see `load_models`.
        resolution: width and height of each image.
        spp: samples per pixel of path tracing; None for as many as the time of the slowest method allows, 0 for none.
        photons: number of photons to cast (default: as in the dataset).
        steady: blend each of a method's frames with those before it (nlt/models/steady.py).
        layers: also write a multi-layer EXR (nlt/rendering/exr.py) of each frame; the output must be a folder.

    Raises:
        UserError: a file is missing or wrong, the scene does not suit the method, or the folder has other files.
    """
    provenance, video = origin(), output.endswith(".mp4")
    if not video and Path(output).suffix:
        raise UserError(f"-o: must be NAME.mp4 or a folder for PNGs, is {output!r}")
    if video and layers:
        raise UserError(f"--exr: -o must be a folder, is {output!r}")
    folder = Path(output).with_suffix(".frames") if video else Path(output)
    loaded = load_models(checkpoints, scene, photons, experiment)
    *_, spec, index = next(iter(loaded.values()))
    description = spec.descriptions[index]
    views = cameras(description, camera_path, frames, *resolution)
    scene_states = states(description, spec.experiment, state, light, frames)
    key = _digest(
        *(Path(checkpoint).read_bytes() for checkpoint in checkpoints.values()),
        description.digest.encode(),
        json.dumps([dataclasses.asdict(spec), resolution, spp, steady, [*loaded]], sort_keys=True).encode(),
        *(part for v in views for part in (v.matrix.tobytes(), v.world_to_view.tobytes())),
        *(moment.key for moment in scene_states),
    )
    manifest = _read_manifest(folder, key)
    names = [folder / f"{k:05d}.png" for k in range(frames)]
    is_done = lambda name: name.exists() and (not layers or name.with_suffix(".exr").exists())
    missing = [k for k, name in enumerate(names) if not is_done(name)]
    if missing:
        models = open_models(loaded)
        first = next(iter(models.values()))
        with torch.no_grad():
            if not manifest:
                _begin(models, steady)
                device = default_device()
                manifest = {
                    "key": key,
                    **provenance,
                    **surroundings(device, Policy.for_device(device)),
                    "checkpoints": {name: each.checkpoint for name, each in loaded.items()},
                    **_measure(models, scene_states, views, spp),
                }
                manifest |= {"scene": scene, "experiment": spec.experiment, "frames": frames, "resolution": resolution}
                manifest["steady"] = steady
                write_bytes(folder / MANIFEST, (json.dumps(manifest, indent=1) + "\n").encode())
            _begin(models, steady)
            if steady:  # the frames before a missing one are blended into it
                for k, model in itertools.product(range(missing[0]), models.values()):
                    model.frame(scene_states[k], views[k], k)
                missing = list(range(missing[0], frames))
            done = frames - len(missing)
            for k in tqdm(missing, "rendering", frames, unit="frame", file=sys.stderr, initial=done):
                place = scene_states[k], views[k]
                images = [model.frame(*place, k) for model in models.values()]
                if manifest["spp"]:
                    images.append(first.traced(*place, manifest["spp"], k))
                panels = [image[0].cpu().numpy() for image in images]
                write_bytes(names[k], _frame_png(panels, description.exposure, manifest))
                if layers:
                    stored = {"radiance": panels[0]} | ({"path_tracing": panels[-1]} if manifest["spp"] else {})
                    write_bytes(names[k].with_suffix(".exr"), exr(stored | first.gbuffer(*place)))
    written = Path(output)
    if video:
        write_video(written, (np.asarray(Image.open(name)) for name in names), fps)
        write_bytes(written.with_suffix(".png"), names[0].read_bytes())
        write_bytes(written.with_suffix(".json"), (folder / MANIFEST).read_bytes())
        for file in (*names, folder / MANIFEST):
            file.unlink()
        folder.rmdir()
    print(f"{written}: {'; '.join(_captions(manifest))}")
    return written


class Loaded(NamedTuple):
    """A method, and the scene that it will draw: number `scene` in `spec`, with the points of training, if any."""

    checkpoint: str
    method: Method
    points: Points | None
    spec: DatasetSpec
    scene: int


def load_models(
    checkpoints: Mapping[str, str], scene: str | None, photons: int | None = None, experiment: Experiment | None = None
) -> dict[str, Loaded]:
    """Load what `open_models` opens, for `scene`, or for the first one of the first training; see `render`.

    `experiment` is that of the picture: "fixed_lights" shows the scene's own lights. By default it is that of the
    training. Without checkpoints, Open Image Denoise draws the scene, by default under its own lights.

    Raises:
        UserError: a file is missing or wrong, or the scene does not suit a method.
    """
    if scene and not checkpoints:
        spec = DatasetSpec([scene], experiment or "fixed_lights")
        return {UNTRAINED: Loaded("", OpenImageDenoise(1, "fast"), None, spec, 0)}
    loaded = {}
    for name, checkpoint in checkpoints.items():
        method, spec, points = load_trained(checkpoint)
        if experiment and experiment != spec.experiment and method.has_point_embeddings:
            raise UserError(
                f"--lights: {checkpoint} has point embeddings, which were trained in the experiment {spec.experiment}; "
                "omit the option"
            )
        scene = scene or spec.scenes[0]
        spec, index = with_scene(method, spec, scene, checkpoint)
        spec = dataclasses.replace(
            spec, num_photons=photons or spec.num_photons, experiment=experiment or spec.experiment
        )
        own = points[index] if method.has_point_embeddings and points else None
        if method.has_point_embeddings and not own:
            raise UserError(
                f"CKPT: {checkpoint}: has embeddings of points, but not the points, which an older nlt left out; "
                "train again"
            )
        loaded[name or type(method).__name__] = Loaded(checkpoint, method, own, spec, index)
    return loaded


def open_models(loaded: Mapping[str, Loaded]) -> dict[str, ModelRenderer]:
    """Return the renderers of loaded methods, on the default device and by their fast paths; they share a scene."""
    models: dict[str, ModelRenderer] = {}
    render, device = None, default_device()
    for name, (_, method, points, spec, scene) in loaded.items():
        shared = render if render and (render.spec, render.index) == (spec, scene) else None
        fast = accelerate(method, Policy.for_device(device), device)
        models[name] = model = ModelRenderer(fast, spec, scene, device, points, shared)
        render = model.render
    return models


def _begin(models: Mapping[str, ModelRenderer], steady: bool) -> None:
    """Let each method forget the frames before, if it blends its own with them."""
    for model in models.values():
        model.steady = Steady() if steady else None


def with_scene(method: RenderingModule, spec: DatasetSpec, scene: str, checkpoint: str) -> tuple[DatasetSpec, int]:
    """Return a spec that has the scene, and the scene's index in it."""
    files = [find_config("scenes", name).resolve() for name in spec.scenes]
    file = find_config("scenes", scene).resolve()
    if method.has_point_embeddings:
        points = min(spec.num_points, method.hparams["max_points"] or spec.num_points)
        if (method.hparams["num_scenes"], method.hparams["num_points"]) != (len(files), points):
            raise UserError(
                f"CKPT: {checkpoint}: has embeddings of {method.hparams['num_scenes']} scenes with "
                f"{method.hparams['num_points']} points each, but its dataset has {len(files)} with {points}; "
                "keep the checkpoint in its own run"
            )
    if file in files:
        return spec, files.index(file)
    load_description(scene)
    if method.has_point_embeddings:
        raise UserError(
            f"SCENE: {scene}: {checkpoint} has point embeddings only for {', '.join(spec.scenes)}; "
            "name one of these, or train on this scene"
        )
    return dataclasses.replace(spec, scenes=[scene]), 0


def _digest(*parts: bytes) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def _read_manifest(folder: Path, key: str) -> dict[str, Any]:
    """Return the manifest of the frames in a folder; empty if there are none.

    Raises:
        UserError: the frames are from another command, or the folder has other files.
    """
    if not folder.exists():
        return {}
    remove_leftovers(folder)
    manifest = folder / MANIFEST
    content = json.loads(manifest.read_text()) if manifest.exists() else {}
    if content.get("key") != key and any(folder.iterdir()):
        problem = "holds frames from another command" if content else f"is not empty and has no {MANIFEST}"
        raise UserError(f"{folder}: {problem}; delete it, or give another -o")
    return content


def _measure(
    models: Mapping[str, ModelRenderer], scene_states: list[SceneState], views: list[Camera], spp: int | None
) -> dict[str, Any]:
    """Return the median milliseconds per frame of models and path tracing after warm-up, and the latter's spp."""
    places = [(scene_states[k % len(views)], views[k % len(views)]) for k in range(_WARM + _TIMED)]
    cost = lambda work: 1e3 * statistics.median([_seconds(work, *place) for place in places][_WARM:])
    milliseconds = {name: cost(model.frame) for name, model in models.items()}
    first = next(iter(models.values()))
    traced = lambda count: cost(lambda moment, view: first.traced(moment, view, count, 0))
    if spp is None:
        few, many = traced(_FEW), traced(_MANY)
        sample_ms = max((many - few) / (_MANY - _FEW), 1e-3)
        spp = min(max(_FEW, round(_FEW + (max(milliseconds.values()) - few) / sample_ms)), _MAX_SPP)
    clock = {"batch": 1, "warm_up_frames": _WARM, "timed_frames": _TIMED}
    times = {"model_ms": milliseconds, "spp": spp, "path_tracing_ms": traced(spp) if spp else None}
    return {**times, "clock": clock, "load_average": os.getloadavg()}


def _ms(value: float) -> str:
    return f"{value:.{0 if value >= 100 else 1}f} ms"


def _seconds(work: Any, *arguments: Any) -> float:
    start = time.perf_counter()
    work(*arguments).cpu()  # waits for the device
    return time.perf_counter() - start


def _captions(manifest: Mapping[str, Any]) -> list[str]:
    """Return what to write below each panel: the method and its time per frame."""
    steady = ", steady" * manifest["steady"]
    captions = [f"{name}{steady}, {_ms(value)}" for name, value in manifest["model_ms"].items()]
    if manifest["spp"]:
        captions.append(f"path tracing, {manifest['spp']} spp, {_ms(manifest['path_tracing_ms'])}")
    return captions


def _frame_png(images: Sequence[np.ndarray], exposure: float, manifest: Mapping[str, Any]) -> bytes:
    """Return a frame as a PNG of even size: the images (3, H, W) next to each other, with captions below."""
    _, rows, columns = images[0].shape
    width, height = len(images) * columns, rows + _CAPTION
    sheet = Image.new("RGB", (width + width % 2, height + height % 2))
    draw = ImageDraw.Draw(sheet)
    for column, (radiance, text) in enumerate(zip(images, _captions(manifest), strict=True)):
        sheet.paste(Image.fromarray(shown(radiance, exposure)), (column * columns, 0))
        size = 12.0
        while draw.textlength(text, font_size=size) > columns - 4 and size > 4:
            size -= 0.5
        draw.text((column * columns + 2, rows + 3), text, "white", font_size=size)
    file = io.BytesIO()
    sheet.save(file, "PNG")
    return file.getvalue()


def shown(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Return radiance (3, H, W) as displayed: sRGB (H, W, 3) uint8."""
    srgb = display(torch.from_numpy(radiance)[None], exposure)[0].permute(1, 2, 0)
    return (srgb.numpy() * 255).round().astype(np.uint8)


def write_video(path: Path, images: Iterable[np.ndarray], fps: int) -> None:
    """Write images (H, W, 3) uint8, H and W even, as an mp4 (H.264, yuv420p)."""
    file = io.BytesIO()
    with av.open(file, "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=fps, options={"crf": "16"})
        stream.pix_fmt = "yuv420p"
        for k, image in enumerate(images):
            if k == 0:
                stream.height, stream.width = image.shape[:2]
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode())
    write_bytes(path, file.getvalue())
