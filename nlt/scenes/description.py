"""Strict reader of `scene.yaml`: movable objects, camera volume, exposure, moving light.

Lengths in the file are in scene units, so that they can be read off the scene's XML. In this module, as everywhere
else in nlt, they are in metres.
"""

import hashlib
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
from pydantic import AfterValidator, Field, FiniteFloat, field_validator

from nlt.config import Settings, parse, read_configs
from nlt.errors import UserError
from nlt.paths import config_names, find_config, scenes_root
from nlt.scenes import mitsuba_xml

Experiment = Literal["static", "fixed_lights", "moving_lights"]
EXPERIMENTS: tuple[str, ...] = get_args(Experiment)
Integrator = Literal["path", "bdpt"]  # integrators that render the images to learn from
# Material types of surfaces, by the lobes of their BSDFs. Datasets store the index into this tuple.
MATERIALS = ("diffuse", "coated", "glossy", "mirror", "glass", "other")
MOVING_LIGHT = "moving_light"  # the light's name as a movable object, and its shape id
STATIC = "static"  # the name of the parts that never move
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
    `integrator` is the integrator with the lower variance at equal time in this scene.
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
    integrator: str = "path"

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
        elif self.path.suffix.lower() == ".xml":
            files += sorted(set(mitsuba_xml.read(self.path).files))
        else:
            from nlt.scenes.model import named_files  # imported here because most scenes do not need trimesh

            files += sorted({self.path, *(f for n in named_files(self.path) if (f := self.path.parent / n).is_file())})
        total = hashlib.sha256()
        for file in files:
            total.update(hashlib.sha256(file.read_bytes()).digest())
        return total.hexdigest()


# The content of the file, lengths in scene units.

Point = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
Positive = Annotated[FiniteFloat, Field(gt=0)]
FieldOfView = Annotated[float, Field(gt=0, lt=180)]  # degrees


def _check_box(box: tuple[Point, Point]) -> tuple[Point, Point]:
    if any(low > high for low, high in zip(*box, strict=True)):
        raise ValueError(f"is empty: minimum {list(box[0])} is above maximum {list(box[1])}")
    return box


_Radiance = Annotated[FiniteFloat, Field(ge=0)]
_Box = Annotated[tuple[Point, Point], AfterValidator(_check_box)]


class _Corners(Settings):
    min: Point
    max: Point


_CornerBox = Annotated[_Corners, AfterValidator(lambda corners: _check_box((corners.min, corners.max)))]


class _Object(Settings):
    shapes: Annotated[tuple[str, ...], Field(min_length=1)]
    box: _Box


class _Light(Settings):
    size: tuple[Positive, Positive]
    radiance: tuple[_Radiance, _Radiance, _Radiance]
    box: _Box

    @field_validator("radiance")
    @classmethod
    def _shines(cls, radiance: tuple[float, ...]) -> tuple[float, ...]:
        if not any(radiance):
            raise ValueError("must be above 0 in at least one channel")
        return radiance


class _File(Settings):
    source: str
    name: str | None = None
    units_per_metre: Positive = 1.0
    up: Literal["x", "y", "z"] = "y"
    exposure: Positive = 1.0
    fov: FieldOfView = 70.0
    camera: _CornerBox
    look_at: _CornerBox | None = None
    room: _Box | None = None
    integrator: Integrator = "path"
    objects: dict[str, _Object] = Field(default={})
    moving_light: _Light | None = None

    @field_validator("objects")
    @classmethod
    def _free_names(cls, objects: dict[str, _Object]) -> dict[str, _Object]:
        for name in (MOVING_LIGHT, STATIC):
            if name in objects:
                raise ValueError(f"the name {name} is reserved; choose another one")
        return objects


def load_description(name: str, need_source: bool = True) -> SceneDescription:
    """Read the description of a scene, given by name or by path (see `find_config`).

    Raises:
        UserError: the file is missing or has a mistake, or its scene file is missing although `need_source`.
    """
    file = find_config("scenes", name)
    if not file.exists():
        raise UserError(f"{file}: no such scene description; known scenes are {', '.join(config_names('scenes'))}")
    content = {key: value for key, value in read_configs([file]).items() if value is not None}
    read = parse(_File, content, file)
    metres = lambda lengths: np.array(lengths, float) * (1 / read.units_per_metre)
    camera, light = metres(read.camera), None
    half = camera.mean(0) + (camera - camera.mean(0)) / 2
    if (lamp := read.moving_light) is not None:
        light = MovingLight(metres(lamp.size), np.array(lamp.radiance), metres(lamp.box))
    return SceneDescription(
        name=read.name or file.stem,
        file=file,
        source=_find_source(file, read.source, need_source),
        units_per_metre=read.units_per_metre,
        up=np.eye(3)["xyz".index(read.up)],
        exposure=read.exposure,
        fov=read.fov,
        camera=camera,
        look_at=half if read.look_at is None else metres(read.look_at),
        objects=tuple(Movable(key, entry.shapes, metres(entry.box)) for key, entry in read.objects.items()),
        light=light,
        room=None if read.room is None else metres(read.room),
        integrator=read.integrator,
    )


def _find_source(file: Path, source: str, needed: bool) -> str:
    if source.startswith(BUILTIN):
        return source
    # An absolute path replaces both folders.
    candidates = list(dict.fromkeys(folder / source for folder in (file.parent, scenes_root())))
    for path in candidates:
        if path.is_file():
            return str(path.resolve())
    if not needed:
        return str(candidates[-1])
    remedy = "correct the path" if Path(source).is_absolute() else "set NLT_SCENES to the scenes' folder"
    raise UserError(f"{file}: source: no scene file at {' or '.join(map(str, candidates))}; {remedy}")


def listing() -> str:
    """Return a table with one line per description; the line of a broken description holds its error."""
    rows = [("scene", "source", "objects", "moving light", "integrator")]
    broken = []
    for name in config_names("scenes"):
        try:
            scene = load_description(name, need_source=False)
        except UserError as error:
            broken.append(f"{name}  broken: {error}")
            continue
        location = "built in" if scene.path is None else "here" if scene.path.is_file() else "not here"
        rows.append((name, location, str(len(scene.objects)), "yes" if scene.light else "no", scene.integrator))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines + broken)
