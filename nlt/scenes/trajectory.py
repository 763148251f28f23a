"""The states and cameras of the frames of a video, from a few keyframes or a turntable."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from scipy.interpolate import PchipInterpolator

from nlt.errors import UserError
from nlt.scenes.camera import Camera
from nlt.scenes.description import MOVING_LIGHT, SceneDescription, Section
from nlt.scenes.state import SceneState, rest_state, sample_state

TURNTABLE = "turntable"
_INNER = 0.9  # radius of a turntable, as a fraction of the box's half size


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
    fov = description.fov
    if path == TURNTABLE:
        positions = turn(description.camera, description.up, frames)
        targets = turn(description.look_at, description.up, frames, phase=0.5)
    else:
        section = _read(path, ("views", "closed", "fov"))
        views, closed = section.get("views"), section.flag("closed")
        if not isinstance(views, list) or not views:
            raise UserError(f"{path}: views: must be a list of mappings with a position and a target, is {views!r}")
        keys = [Section(Path(path), f"views[{k}]", view, ("position", "target")) for k, view in enumerate(views)]
        ends = ("position", "target")
        positions, targets = (follow(np.stack([k.numbers(end, (3,)) for k in keys]), frames, closed) for end in ends)
        fov = section.degrees("fov", default=fov)
    for k, (position, target) in enumerate(zip(positions, targets, strict=True)):
        direction = target - position
        if np.linalg.norm(np.cross(direction, description.up)) <= 1e-3 * np.linalg.norm(direction):
            raise UserError(f"--camera-path: {path}: frame {k} looks straight up or down, or nowhere; move the target")
    up = description.up
    return [Camera.look_at(p, t, up, fov, width, height) for p, t in zip(positions, targets, strict=True)]


def states(
    description: SceneDescription, experiment: str, state: str, light: str | None, frames: int
) -> list[SceneState]:
    """Return the states of a video, in which only the light moves.

    Args:
        state: the seed of a random state; or a YAML file with `seed`, the random state to start from (default: every
            object at rest), `objects`, each either "removed" or a translation from rest, and `light`, the keyframes
            of the light's centre. Lengths are in metres.
        light: "turntable" to circle in the box of the light's positions; None to follow the file's `light`, if any.

    Raises:
        UserError: the file is missing, or does not describe a state of this scene and experiment.
    """
    movables = description.movables(experiment)
    names = [movable.name for movable in movables]
    if state.isdecimal():
        base, keys, closed = sample_state(description, experiment, np.random.default_rng(int(state))), None, False
    else:
        base, keys, closed = _read_state(description, experiment, state)
    moving = description.light
    if moving is None or MOVING_LIGHT not in names:
        if light or keys is not None:
            raise UserError(f"--light: {description.name} has no moving light in the experiment {experiment}")
        return [base] * frames
    if light:
        positions = turn(moving.box, description.up, frames)
    elif keys is not None:
        positions = follow(keys, frames, closed)
    else:
        return [base] * frames
    row = names.index(MOVING_LIGHT)
    moved = []
    for position in positions:
        translation = base.translation.copy()
        translation[row] = position - moving.centre
        moved.append(replace(base, translation=translation))
    return moved


def _read_state(
    description: SceneDescription, experiment: str, path: str
) -> tuple[SceneState, np.ndarray | None, bool]:
    section = _read(path, ("seed", "objects", "light", "closed"))
    base, seed = rest_state(description, experiment), section.data.get("seed")
    if seed is not None:
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise UserError(f"{path}: seed: must be a whole number of at least 0, is {seed!r}")
        base = sample_state(description, experiment, np.random.default_rng(seed))
    names = tuple(m.name for m in description.movables(experiment) if m.name != MOVING_LIGHT)
    objects = Section(Path(path), "objects", section.data.get("objects") or {}, names)
    for name, value in objects.data.items():
        row = names.index(name)
        base.present[row] = value != "removed"
        base.translation[row] = objects.numbers(name, (3,)) if base.present[row] else 0
    keys = section.data.get("light")
    if keys is not None:
        count = len(keys) if isinstance(keys, list) else 0
        keys = section.numbers("light", (max(count, 1), 3))
    return base, keys, section.flag("closed")


def _read(path: str, known: tuple[str, ...]) -> Section:
    """Read a YAML or JSON file (JSON is valid YAML)."""
    try:
        data: Any = yaml.safe_load(Path(path).read_text())
    except OSError as error:
        raise UserError(f"{path}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{path}: not valid YAML: {' '.join(str(error).split())}") from None
    return Section(Path(path), "", data, known)
