"""`nlt render`: a trained method as a renderer of videos, beside path tracing."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import statistics
import sys
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from PIL import Image, ImageDraw
from torch import Tensor
from tqdm import tqdm

from nlt.data.dataset import SampleTensors, collate
from nlt.data.files import remove_leftovers, write_bytes
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, points_crc, points_name, read_points
from nlt.errors import UserError
from nlt.evaluation.export import load_trained
from nlt.evaluation.provenance import origin, surroundings
from nlt.metrics.display import display
from nlt.models.method import Batch
from nlt.models.module import RenderingModule
from nlt.models.moving_camera import MovingCamera
from nlt.models.policy import Policy, default_device
from nlt.paths import find_config
from nlt.scenes.camera import Camera
from nlt.scenes.description import load_description
from nlt.scenes.state import SceneState
from nlt.scenes.trajectory import cameras, states

DEMO = Path(__file__).with_name("pretrained") / "living_room.safetensors"
MANIFEST = "render.json"
_DATASETS = "datasets"  # where they are looked for
_MODEL, _TRACED = 0, 1  # seeds
_WARM, _TIMED = 2, 5  # frames: the first compile kernels
_FEW, _MANY = 1, 8  # samples per pixel, between which the cost of one is measured
_MOST_SPP = 4096
_CAPTION = 20  # pixels


class ModelRenderer:
    """Frames by a trained method. What does not depend on the camera is computed once for each of the scene's states.

    `scene`: which one of the spec's. Photons have the same seed in all states, so that with a light's motion they move
    and do not flicker.
    """

    def __init__(self, method: RenderingModule, spec: DatasetSpec, scene: int, device: torch.device) -> None:
        self.spec, self.scene, self.device = spec, scene, device
        self.render = SampleRenderer(spec, scene)
        self.method = method.to(device).eval()
        self.moving = MovingCamera(self.method)
        self._seeds = np.random.SeedSequence([_MODEL])
        self._state: dict[str, np.ndarray] = {}
        self._key: bytes | None = None
        self._of_state = {name for name in method.fields if name.startswith("photon_")}
        self.points: Points = self._cloud() if any(name.startswith("point_") for name in method.fields) else {}
        if self.points:
            self._of_state |= {"translation", "present"}
        wanted = {*method.fields} - {"view_direction"}  # added here, of any size
        self._tensors = SampleTensors(spec, {scene: self.points} if self.points else {}, wanted)

    def _cloud(self) -> Points:
        """The points of training, whose embeddings are learned row by row: the dataset's own where it is here."""
        stored = self.spec.directory(_DATASETS) / points_name(self.scene)
        return read_points(stored) if stored.exists() else self.render.points()

    def batch(self, state: SceneState, camera: Camera) -> Batch:
        """What the method reads of a frame, as a batch of one."""
        images = {*self.method.fields} & {"depth", "normal", "albedo", "emission", "noisy_input"}
        few = self.method.pixel_fraction < 1
        images -= {"noisy_input"} if few else set()
        self._enter(state)
        if state.key != self._key:
            self._state = self.render.view(camera, self._seeds, self._of_state)
            self._key = state.key
        view = self.render.view(camera, self._seeds, {*images, "camera_matrix", "world_to_view"})
        tensors = self._tensors(self.scene, self._state | view)
        tensors["view_direction"] = torch.from_numpy(camera.view_directions())
        batch = {name: value.to(self.device) for name, value in collate([tensors]).items()}
        return batch | {"noisy_input": self._few_pixels(batch, camera)} if few else batch

    def _few_pixels(self, batch: Batch, camera: Camera) -> Tensor:
        """(1, 3, H, W): radiance of the pixels that the method looks at, which alone are traced; 0 elsewhere."""
        mask = self.method.mask(batch, camera.height, camera.width)[0, 0].cpu().numpy()
        image = np.zeros((3, *mask.shape), np.float32)
        seed = int(self._seeds.generate_state(1)[0])
        image[:, mask] = self.render.radiance(camera, self.spec.input_spp, seed, np.flatnonzero(mask))
        return torch.from_numpy(image)[None].to(self.device)

    def _enter(self, state: SceneState) -> None:
        if state.key != self.render.scene.state.key:
            self.render.scene.set_state(state)

    def frame(self, state: SceneState, camera: Camera) -> Tensor:
        """Radiance (1, 3, H, W)."""
        return self.moving(self.method.subsample(self.batch(state, camera)))

    def traced(self, state: SceneState, camera: Camera, spp: int, frame: int) -> Tensor:
        """Path-traced radiance (1, 3, H, W)."""
        self._enter(state)
        (seed,) = np.random.SeedSequence([_TRACED, frame]).generate_state(1)
        return torch.from_numpy(self.render.radiance(camera, spp, int(seed)))[None]


def render(
    checkpoint: str,
    scene: str,
    output: str,
    state: str = "0",
    light: str | None = None,
    camera_path: str = "turntable",
    frames: int = 36,
    resolution: tuple[int, int] = (256, 256),
    fps: int = 24,
    spp: int | None = None,
    photons: int | None = None,
) -> Path:
    """Write a video of a scene, left the method, right path tracing; in each corner what a frame took, measured.

    Frames are written one by one. Those that are there are kept when the same is asked for again.

    Args:
        checkpoint: of `nlt fit`, within its run, or safetensors of `nlt export`.
        scene: one of its dataset; for a method without embeddings of points, any.
        output: VIDEO.mp4, beside which come VIDEO.png, the first frame, and VIDEO.json, how it was made; or a folder
            of PNGs.
        state, light, camera_path: as nlt/scenes/trajectory.py says.
        resolution: width and height of each of the two images.
        spp: of path tracing; None for what takes as long as the method, 0 for no path tracing.
        photons: to cast (default: as in the dataset).

    Raises:
        UserError: a file is missing or wrong, the scene is not the method's, or the folder is of another command.
    """
    begun, video = origin(), output.endswith(".mp4")
    if not video and Path(output).suffix:
        raise UserError(f"-o: must be NAME.mp4 or a folder for PNGs, is {output!r}")
    folder = Path(output).with_suffix(".frames") if video else Path(output)
    method, spec, points = load_trained(checkpoint)
    spec, index = _with_scene(method, spec, scene, checkpoint)
    spec = dataclasses.replace(spec, photons=photons or spec.photons)
    description = spec.descriptions[index]
    views = cameras(description, camera_path, frames, *resolution)
    moments = states(description, spec.experiment, state, light, frames)
    key = _digest(
        Path(checkpoint).read_bytes(),
        description.digest.encode(),
        json.dumps([dataclasses.asdict(spec), resolution, spp], sort_keys=True).encode(),
        *(part for v in views for part in (v.matrix.tobytes(), v.world_to_view.tobytes())),
        *(moment.key for moment in moments),
    )
    known = _known(folder, key)
    names = [folder / f"{k:05d}.png" for k in range(frames)]
    missing = [k for k, name in enumerate(names) if not name.exists()]
    if missing:
        device = default_device()
        policy = Policy.for_device(device)
        model = ModelRenderer(method, spec, index, device)
        if method.has_point_embeddings and points and points_crc(model.points) != points[index]:
            raise UserError(
                f"CKPT: {checkpoint}: has embeddings of other points than there are here, as with another NLT_VARIANT; "
                f"put the dataset that it was trained on at {spec.directory(_DATASETS)}"
            )
        with torch.no_grad(), policy.applied(device):
            if not known:
                timed = _measure(model, moments, views, spp)
                known = {"key": key, **begun, **surroundings(device, policy), "checkpoint": checkpoint, **timed}
                known |= {"scene": scene, "experiment": spec.experiment, "frames": frames, "resolution": resolution}
                write_bytes(folder / MANIFEST, (json.dumps(known, indent=1) + "\n").encode())
            done = frames - len(missing)
            for k in tqdm(missing, "rendering", frames, unit="frame", file=sys.stderr, initial=done):
                write_bytes(names[k], _picture(model, moments[k], views[k], k, description.exposure, known))
    made = Path(output)
    if video:
        write_video(made, (np.asarray(Image.open(name)) for name in names), fps)
        write_bytes(made.with_suffix(".png"), names[0].read_bytes())
        write_bytes(made.with_suffix(".json"), (folder / MANIFEST).read_bytes())
        for file in (*names, folder / MANIFEST):
            file.unlink()
        folder.rmdir()
    print(f"{made}: {known['method']} {_ms(known['model_ms'])} per frame", end="")
    print(f", path tracing of {known['spp']} spp {_ms(known['path_tracing_ms'])}" if known["spp"] else "")
    return made


def _with_scene(method: RenderingModule, spec: DatasetSpec, scene: str, checkpoint: str) -> tuple[DatasetSpec, int]:
    """The dataset's spec with the scene, and which it is."""
    files = [find_config("scenes", name).resolve() for name in spec.scenes]
    file = find_config("scenes", scene).resolve()
    if method.has_point_embeddings:
        points = min(spec.points, method.hparams["max_points"] or spec.points)
        if (method.hparams["num_scenes"], method.hparams["num_points"]) != (len(files), points):
            raise UserError(
                f"CKPT: {checkpoint}: has embeddings of {method.hparams['num_scenes']} scenes of "
                f"{method.hparams['num_points']} points, but its run's dataset {len(files)} of {points}"
            )
    if file in files:
        return spec, files.index(file)
    load_description(scene)
    if method.has_point_embeddings:
        raise UserError(
            f"SCENE: {scene}: {checkpoint} has embeddings of the points of {', '.join(spec.scenes)} alone; "
            "name one of these, or train on this scene"
        )
    return dataclasses.replace(spec, scenes=[scene]), 0


def _digest(*parts: bytes) -> str:
    total = hashlib.sha256()
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def _known(folder: Path, key: str) -> dict[str, Any]:
    """The manifest of the frames in a folder, empty for none.

    Raises:
        UserError: they are of another command, or other things are there.
    """
    if not folder.exists():
        return {}
    remove_leftovers(folder)
    manifest = folder / MANIFEST
    known = json.loads(manifest.read_text()) if manifest.exists() else {}
    if known.get("key") != key and any(folder.iterdir()):
        what = "holds frames of another command" if known else f"is not empty and has no {MANIFEST}"
        raise UserError(f"{folder}: {what}; delete it, or give another -o")
    return known


def _measure(model: ModelRenderer, moments: list[SceneState], views: list[Camera], spp: int | None) -> dict[str, Any]:
    """Milliseconds that a frame takes, medians after warm-up, by the model and by path tracing; its spp."""
    places = [(moments[k % len(views)], views[k % len(views)]) for k in range(_WARM + _TIMED)]
    cost = lambda work: 1e3 * statistics.median([_seconds(work, *place) for place in places][_WARM:])
    timed: dict[str, Any] = {"method": type(model.method).__name__, "model_ms": cost(model.frame)}
    traced = lambda count: cost(lambda moment, view: model.traced(moment, view, count, 0))
    if spp is None:
        few, many = traced(_FEW), traced(_MANY)
        each = max((many - few) / (_MANY - _FEW), 1e-3)
        spp = min(max(_FEW, round(_FEW + (timed["model_ms"] - few) / each)), _MOST_SPP)
    clock = {"batch": 1, "warm_up_frames": _WARM, "timed_frames": _TIMED}
    timed |= {"spp": spp, "path_tracing_ms": traced(spp) if spp else None}
    return {**timed, "clock": clock, "load_average": os.getloadavg()}


def _ms(value: float) -> str:
    return f"{value:.{0 if value >= 100 else 1}f} ms"


def _seconds(work: Any, *arguments: Any) -> float:
    start = time.perf_counter()
    work(*arguments).cpu()  # waits for the device
    return time.perf_counter() - start


def _picture(
    model: ModelRenderer, moment: SceneState, view: Camera, k: int, exposure: float, known: dict[str, Any]
) -> bytes:
    """A frame as a PNG of even size: the images side by side, and below what they are."""
    panels = [(model.frame(moment, view), f"{known['method']}, {_ms(known['model_ms'])}")]
    if known["spp"]:
        traced = model.traced(moment, view, known["spp"], k)
        panels.append((traced, f"path tracing, {known['spp']} spp, {_ms(known['path_tracing_ms'])}"))
    width, height = len(panels) * view.width, view.height + _CAPTION
    sheet = Image.new("RGB", (width + width % 2, height + height % 2))
    draw = ImageDraw.Draw(sheet)
    for column, (radiance, text) in enumerate(panels):
        shown = display(radiance.cpu(), exposure)[0].permute(1, 2, 0).numpy()
        sheet.paste(Image.fromarray((shown * 255).round().astype(np.uint8)), (column * view.width, 0))
        size = 12.0
        while draw.textlength(text, font_size=size) > view.width - 4 and size > 4:
            size -= 0.5
        draw.text((column * view.width + 2, view.height + 3), text, "white", font_size=size)
    file = io.BytesIO()
    sheet.save(file, "PNG")
    return file.getvalue()


def write_video(path: Path, images: Iterable[np.ndarray], fps: int) -> None:
    """An mp4 (H.264, yuv420p) of images (H, W, 3) uint8, H and W even."""
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
