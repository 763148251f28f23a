"""`nlt render`: a video of a scene, drawn by trained methods, next to path tracing."""

import dataclasses
import hashlib
import io
import itertools
import json
import os
import statistics
import sys
import time
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import av
import numpy as np
import torch
from PIL import Image, ImageDraw
from tqdm import tqdm

from nlt.data.files import remove_leftovers, write_bytes
from nlt.display import display_bytes
from nlt.errors import UserError
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.policy import Policy, default_device
from nlt.models.steady import Steady
from nlt.rendering.exr import exr
from nlt.scenes.camera import Camera
from nlt.scenes.description import Experiment
from nlt.scenes.state import SceneState
from nlt.scenes.trajectory import cameras, states
from nlt.view.drawing import ModelRenderer, load_models, open_models

MANIFEST = "render.json"
_WARM, _TIMED = 2, 5  # frames; the warm-up compiles kernels
_FEW, _MANY = 1, 8  # samples per pixel whose times give the cost of one sample
_MAX_SPP = 4096
_CAPTION = 20  # height in pixels


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
        scene: a scene of the methods' datasets; any scene if no method has embeddings or a field.
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


def _begin(models: Mapping[str, ModelRenderer], steady: bool) -> None:
    """Let each method forget the frames before, if it blends its own with them."""
    for model in models.values():
        model.steady = Steady() if steady else None


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
        sheet.paste(Image.fromarray(display_bytes(radiance, exposure)), (column * columns, 0))
        size = 12.0
        while draw.textlength(text, font_size=size) > columns - 4 and size > 4:
            size -= 0.5
        draw.text((column * columns + 2, rows + 3), text, "white", font_size=size)
    file = io.BytesIO()
    sheet.save(file, "PNG")
    return file.getvalue()


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
