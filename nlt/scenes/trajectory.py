"""The states and cameras of the frames of a video, from a few keyframes or a turntable."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import Field
from scipy.interpolate import PchipInterpolator

from nlt.config import Settings, parse, read_configs
from nlt.errors import UserError
from nlt.scenes.camera import Camera
from nlt.scenes.description import MOVING_LIGHT, FieldOfView, Point, SceneDescription
from nlt.scenes.state import SceneState, rest_state, sample_state

TURNTABLE, REST = "turntable", "rest"
_INNER = 0.9  # radius of a turntable, as a fraction of the box's half size


class _View(Settings):
    position: Point
    target: Point


class _CameraPath(Settings):
    views: Annotated[tuple[_View, ...], Field(min_length=1)]
    closed: bool = False
    fov: FieldOfView | None = None


class _State(Settings):
    seed: Annotated[int, Field(ge=0)] | None = None
    objects: dict[str, Literal["removed"] | Point] = Field(default={})
    light: Annotated[tuple[Point, ...], Field(min_length=1)] | None = None
    closed: bool = False


def turn(box: np.ndarray, up: np.ndarray, frames: int, phase: float = 0.0) -> np.ndarray:
    """Points (frames, 3) of a horizontal ellipse in a box (2, 3), at half its height; `phase` is the start in turns."""
    angle = 2 * np.pi * (np.arange(frames) / frames + phase)
    first, second = np.flatnonzero(up == 0)
    around = np.zeros((frames, 3))
    around[:, first], around[:, second] = np.cos(angle), np.sin(angle)
    return box.mean(0) + _INNER * (box[1] - box[0]) / 2 * around


def follow(keys: np.ndarray, frames: int, closed: bool) -> np.ndarray:
    """Interpolate keys (K, 3) to points (frames, 3), from the first to the last key or, if `closed`, back to the first.

    The cubic curve is smooth and stays in the bounding box of neighbouring keys. One that overshoots would leave the
    room.
    """
    count = len(keys)
    if count == 1:
        return np.repeat(keys, frames, axis=0)
    if not closed:
        return PchipInterpolator(np.arange(count), keys)(np.linspace(0, count - 1, frames))
    around = np.pad(keys, ((2, 3), (0, 0)), mode="wrap")
    return PchipInterpolator(np.arange(-2, count + 3), around)(np.arange(frames) * count / frames)


def cameras(description: SceneDescription, path: str, frames: int, width: int, height: int) -> list[Camera]:
    """Return the cameras of a video.

    Args:
        path: "turntable", which circles in the scene's camera box and looks across it; or a YAML or JSON file of
            `views`, each with a position and a target in metres.

    Raises:
        UserError: the file is missing, or one of its keys is missing, unknown or not a point.
    """
    fov, up = description.fov, description.up
    if path == TURNTABLE:
        positions = turn(description.camera, up, frames)
        targets = turn(description.look_at, up, frames, phase=0.5)
    else:
        read = parse(_CameraPath, read_configs([Path(path).absolute()]), path)
        keys = np.array([(view.position, view.target) for view in read.views])
        positions, targets = (follow(keys[:, end], frames, read.closed) for end in (0, 1))
        fov = read.fov or fov
    for k, direction in enumerate(targets - positions):
        if np.linalg.norm(np.cross(direction, up)) <= 1e-3 * np.linalg.norm(direction):
            raise UserError(f"--camera-path: {path}: frame {k} looks straight up or down, or nowhere; move the target")
    return [Camera.look_at(p, t, up, fov, width, height) for p, t in zip(positions, targets, strict=True)]


def states(
    description: SceneDescription, experiment: str, state: str, light: str | None, frames: int
) -> list[SceneState]:
    """Return the states of a video, in which only the light moves.

    Args:
        state: "rest", where every object is at rest; the seed of a random state; or a YAML file with `seed`, the random
            state to start from (default: rest), `objects`, each either "removed" or a translation from rest, and
            `light`, the keyframes of the light's centre. Lengths are in metres.
        light: "turntable" to circle in the box of the light's positions; None to follow the file's `light`, if any.

    Raises:
        UserError: the file is missing, or does not describe a state of this scene and experiment.
    """
    if state == REST or state.isdecimal():
        read = _State(seed=None if state == REST else int(state))
    else:
        read = parse(_State, {k: v for k, v in read_configs([Path(state).absolute()]).items() if v is not None}, state)
    if read.seed is None:
        base = rest_state(description, experiment)
    else:
        base = sample_state(description, experiment, np.random.default_rng(read.seed))
    names = [movable.name for movable in description.movables(experiment)]
    for name, place in read.objects.items():
        if name == MOVING_LIGHT or name not in names:
            known = ", ".join(other for other in names if other != MOVING_LIGHT)
            raise UserError(f"{state}: objects.{name}: unknown object; known are {known}")
        base.present[names.index(name)] = place != "removed"
        base.translation[names.index(name)] = 0 if place == "removed" else place
    if not light and read.light is None:
        return [base] * frames
    if description.light is None or MOVING_LIGHT not in names:
        raise UserError(f"--light: {description.name} has no moving light in the experiment {experiment}")
    if light:
        positions = turn(description.light.box, description.up, frames)
    else:
        positions = follow(np.array(read.light, float), frames, read.closed)
    moved = [replace(base, translation=base.translation.copy()) for _ in range(frames)]
    for moment, position in zip(moved, positions, strict=True):
        moment.translation[names.index(MOVING_LIGHT)] = position - description.light.centre
    return moved


def write_state(description: SceneDescription, experiment: str, state: SceneState) -> str:
    """Return a YAML file from which `states` reads this state; lengths in metres."""
    content: dict[str, Any] = {"objects": {}}
    rows = zip(description.movables(experiment), state.translation.astype(float), state.present, strict=True)
    for movable, translation, present in rows:
        if movable.name == MOVING_LIGHT:
            assert description.light is not None  # otherwise movables() raises
            content["light"] = [(description.light.centre + translation).tolist()]
        else:
            content["objects"][movable.name] = translation.tolist() if present else "removed"
    return yaml.safe_dump(content, sort_keys=False, default_flow_style=None)


def write_camera(camera: Camera) -> str:
    """Return a YAML file from which `cameras` reads this camera as the only view of a path; lengths in metres."""
    target = camera.position + camera.rotation[:, 2]
    views = [{"position": camera.position.tolist(), "target": target.tolist()}]
    return yaml.safe_dump({"views": views, "fov": camera.fov}, sort_keys=False, default_flow_style=None)
