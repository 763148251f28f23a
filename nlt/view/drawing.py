"""Frames of a scene, drawn by a method that was trained, or by Open Image Denoise where nothing was."""

import dataclasses
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from nlt.baselines.path_tracing import OpenImageDenoise
from nlt.data.dataset import SampleTensors, collate
from nlt.data.render import SampleRenderer
from nlt.data.sample import BUFFERS, DIRECT, TRACED
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points
from nlt.errors import UserError
from nlt.evaluation.export import load_trained
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule
from nlt.models.moving_camera import MovingCamera
from nlt.models.policy import Policy, accelerate, default_device
from nlt.models.steady import Steady
from nlt.paths import find_config
from nlt.scenes.camera import Camera
from nlt.scenes.description import Experiment, load_description
from nlt.scenes.state import SceneState

PRETRAINED = Path(__file__).with_name("pretrained")
# The models that come with nlt, by the name that is shown; the first is the better one.
DEMO = {
    "Guided (1 spp), direct": str(PRETRAINED / "guided_1spp@direct_corrected.safetensors"),
    "the paper's full model": str(PRETRAINED / "nlt_photons.safetensors"),
}
DEMO_SCENE = "living_room"
# What draws a scene in which nothing was trained. No included model is as good there (docs/results.md).
UNTRAINED = "Open Image Denoise (1 spp, fast)"
_MODEL, _TRACED = 0, 1  # seeds of photons and of path tracing


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
            shown = names & {*BUFFERS, *DIRECT}
            view = self.render.view(camera, self._seeds, {*shown, "camera_matrix", "world_to_view"})
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
        if experiment and experiment != spec.experiment and method.learns_its_scenes:
            raise UserError(
                f"--lights: {checkpoint} has embeddings or a field, trained in the experiment {spec.experiment}; "
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
    if method.learns_its_scenes:
        raise UserError(
            f"SCENE: {scene}: {checkpoint} has embeddings or a field only for {', '.join(spec.scenes)}; "
            "name one of these, or train on this scene"
        )
    return dataclasses.replace(spec, scenes=[scene]), 0
