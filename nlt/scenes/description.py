"""Strict reader of `scene.yaml`: movable objects, camera volume, exposure, moving light.

Lengths in the file are in scene units, so that they can be read off the scene's XML. In this module, as everywhere
else in nlt, they are in metres.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import yaml

from nlt.errors import UserError
from nlt.paths import config_names, find_config, scenes_root
from nlt.scenes.sources import scene_files

Experiment = Literal["static", "fixed_lights", "moving_lights"]
EXPERIMENTS: tuple[str, ...] = get_args(Experiment)
Teacher = Literal["path", "bdpt"]
TEACHERS: tuple[str, ...] = get_args(Teacher)  # integrators that render the images to learn from
# Material types of surfaces, by the lobes of their BSDFs. Datasets store the index into this tuple.
MATERIALS = ("diffuse", "coated", "glossy", "mirror", "glass", "other")
MOVING_LIGHT = "moving_light"  # the light's name as a movable object, and its shape id
STATIC = "static"  # the name of the parts that never move
UP = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
BUILTIN = "builtin:"


@dataclass(frozen=True)
class Movable:
    """An object that a state translates or removes; `box` (2, 3) bounds its translations, in metres."""

    name: str
    shapes: tuple[str, ...]
    box: np.ndarray
    removable: bool = True


@dataclass(frozen=True)
class MovingLight:
    """The rectangular ceiling light of the dynamic-lights experiment; lengths in metres.

    `box` (2, 3) bounds the positions of its centre. `size` (2,) is along the two horizontal axes, in axis order.
    """

    size: np.ndarray
    radiance: np.ndarray
    box: np.ndarray

    @property
    def centre(self) -> np.ndarray:
        """The position (3,) of the light at zero translation."""
        return self.box.mean(0)


@dataclass(frozen=True)
class SceneDescription:
    """The content of a `scene.yaml`, lengths in metres.

    `camera` and `look_at` are (2, 3) boxes (supp., View Sampling). If the file has no `look_at`, it is half as large as
    `camera` and has the same centre. `room` (2, 3) bounds the inside of the room; None stands for the whole scene.
    `teacher` is the integrator with the lower variance at equal time in this scene.
    """

    name: str
    file: Path
    source: str
    units_per_metre: float
    up: np.ndarray
    exposure: float
    fov: float
    camera: np.ndarray
    look_at: np.ndarray
    objects: tuple[Movable, ...]
    light: MovingLight | None
    room: np.ndarray | None = None
    teacher: str = "path"

    def movables(self, experiment: str) -> tuple[Movable, ...]:
        """Return the objects that a state of this experiment moves: none, all objects, or all objects and the light.

        Raises:
            UserError: the experiment moves the light, and the file has no `moving_light`.
        """
        if experiment == "static":
            return ()
        if experiment == "fixed_lights":
            return self.objects
        if self.light is None:
            raise UserError(f"{self.file}: moving_light: missing, but the experiment moving_lights needs it")
        box = self.light.box - self.light.centre
        return (*self.objects, Movable(MOVING_LIGHT, (MOVING_LIGHT,), box, removable=False))

    @property
    def path(self) -> Path | None:
        """The scene file, or None for a built-in scene."""
        return None if self.source.startswith(BUILTIN) else Path(self.source)

    @cached_property
    def digest(self) -> str:
        """SHA-256 over all files of the scene: `scene.yaml`, the scene file and the files that it refers to.

        For a built-in scene, every module in `builtin` counts: even a new comment there renames its datasets.
        """
        files = [self.file]
        if self.path is None:
            files += sorted(Path(__file__).with_name("builtin").glob("*.py"))
        else:
            files += scene_files(self.path)
        total = hashlib.sha256()
        for file in files:
            total.update(hashlib.sha256(file.read_bytes()).digest())
        return total.hexdigest()


class Section:
    """A mapping in a file. It rejects unknown keys, and its name appears in error messages."""

    def __init__(self, file: Path, name: str, data: Any, known: tuple[str, ...]) -> None:
        self.file, self.name = file, name
        if not isinstance(data, Mapping):
            raise UserError(f"{file}: {name or 'the file'} must be a mapping with the keys {', '.join(known)}")
        for key in data:
            if key not in known:
                raise UserError(f"{file}: {self.field(key)}: unknown key; known are {', '.join(known)}")
        self.data = data

    def field(self, key: str) -> str:
        return f"{self.name}.{key}" if self.name else str(key)

    def get(self, key: str, default: Any = None) -> Any:
        value = self.data.get(key, default)
        if value is None:
            raise UserError(f"{self.file}: {self.field(key)}: missing")
        return value

    def numbers(self, key: str, shape: tuple[int, ...], default: Any = None) -> np.ndarray:
        try:
            array = np.array(self.get(key, default), float)
        except (TypeError, ValueError):
            array = np.array(np.nan)
        if array.shape != shape or not np.isfinite(array).all():
            expected = "a number" if shape == () else f"numbers of shape {' x '.join(map(str, shape))}"
            raise UserError(f"{self.file}: {self.field(key)}: must be {expected}, is {self.data.get(key)!r}")
        return array

    def positive(self, key: str, shape: tuple[int, ...] = (), default: Any = None) -> np.ndarray:
        array = self.numbers(key, shape, default)
        if not (array > 0).all():
            raise UserError(f"{self.file}: {self.field(key)}: must be above zero, is {array.tolist()}")
        return array

    def degrees(self, key: str, default: float) -> float:
        """A field of view in degrees, between 0 and 180."""
        angle = float(self.positive(key, default=default))
        if angle >= 180:
            raise UserError(f"{self.file}: {self.field(key)}: must be below 180 degrees, is {angle:g}")
        return angle

    def flag(self, key: str) -> bool:
        """A boolean, False if absent."""
        value = self.get(key, False)
        if not isinstance(value, bool):
            raise UserError(f"{self.file}: {self.field(key)}: must be true or false, is {value!r}")
        return value

    def box(self, key: str) -> np.ndarray:
        box = self.numbers(key, (2, 3))
        if (box[0] > box[1]).any():
            raise UserError(f"{self.file}: {self.field(key)}: is empty: minimum {box[0]} is above maximum {box[1]}")
        return box

    def min_max(self, key: str) -> np.ndarray:
        section = Section(self.file, self.field(key), self.get(key), ("min", "max"))
        box = np.stack([section.numbers(end, (3,)) for end in ("min", "max")])
        if (box[0] > box[1]).any():
            raise UserError(f"{self.file}: {self.field(key)}: is empty: min is above max")
        return box


def load_description(name: str, need_source: bool = True) -> SceneDescription:
    """Read `configs/scenes/<name>.yaml`, or the file at the path `name`.

    Raises:
        UserError: the file is missing or has a mistake, or its scene file is missing although `need_source`.
    """
    file = find_config("scenes", name)
    try:
        data = yaml.safe_load(file.read_text())
    except FileNotFoundError:
        known = ", ".join(config_names("scenes"))
        raise UserError(f"{file}: no such scene description; known scenes are {known}") from None
    except yaml.YAMLError as error:
        raise UserError(f"{file}: not valid YAML: {' '.join(str(error).split())}") from None
    keys = (
        *("name", "source", "units_per_metre", "up", "exposure", "fov", "camera", "look_at", "room", "teacher"),
        *("objects", "moving_light"),
    )
    top = Section(file, "", data, keys)
    scale = 1.0 / float(top.positive("units_per_metre", default=1.0))
    up = top.get("up", "y")
    if up not in UP:
        raise UserError(f"{file}: up: must be one of {', '.join(UP)}, is {up!r}")
    camera = top.min_max("camera") * scale
    half = camera.mean(0) + (camera - camera.mean(0)) / 2
    teacher = top.get("teacher", "path")
    if teacher not in TEACHERS:
        raise UserError(f"{file}: teacher: must be one of {', '.join(TEACHERS)}, is {teacher!r}")
    objects = []
    entries = data.get("objects") or {}
    if not isinstance(entries, Mapping):
        raise UserError(f"{file}: objects: must be a mapping from names to shapes and box, is {entries!r}")
    for key, value in entries.items():
        if key in (MOVING_LIGHT, STATIC):
            raise UserError(f"{file}: objects.{key}: this name is reserved; choose another name")
        section = Section(file, f"objects.{key}", value, ("shapes", "box"))
        shapes = section.get("shapes")
        if not isinstance(shapes, list) or not shapes:
            raise UserError(f"{file}: objects.{key}.shapes: must be a list of shape ids, is {shapes!r}")
        objects.append(Movable(str(key), tuple(map(str, shapes)), section.box("box") * scale))
    light = None
    if data.get("moving_light") is not None:
        section = Section(file, MOVING_LIGHT, data[MOVING_LIGHT], ("size", "radiance", "box"))
        size = section.positive("size", (2,)) * scale
        radiance = section.numbers("radiance", (3,))
        if (radiance < 0).any() or not radiance.any():
            raise UserError(f"{file}: moving_light.radiance: must be above zero, is {radiance.tolist()}")
        light = MovingLight(size, radiance, section.box("box") * scale)
    return SceneDescription(
        name=str(top.get("name", file.stem)),
        file=file,
        source=_find_source(file, str(top.get("source")), need_source),
        units_per_metre=1.0 / scale,
        up=np.array(UP[up]),
        exposure=float(top.positive("exposure", default=1.0)),
        fov=top.degrees("fov", default=70.0),
        camera=camera,
        look_at=top.min_max("look_at") * scale if "look_at" in data else half,
        objects=tuple(objects),
        light=light,
        room=top.box("room") * scale if "room" in data else None,
        teacher=teacher,
    )


def _find_source(file: Path, source: str, needed: bool) -> str:
    if source.startswith(BUILTIN):
        return source
    candidates = [Path(source)] if Path(source).is_absolute() else [file.parent / source, scenes_root() / source]
    for path in candidates:
        if path.is_file():
            return str(path.resolve())
    if not needed:
        return str(candidates[-1])
    raise UserError(
        f"{file}: source: no scene file at {' or '.join(map(str, candidates))}; set NLT_SCENES to the scenes' folder"
    )
