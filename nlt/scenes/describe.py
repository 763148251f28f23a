"""`nlt scenes show`, `check` and `add`: summarise a scene, and write a first description of a new scene."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nlt.errors import UserError
from nlt.paths import OWN_SCENES, find_config, scenes_root
from nlt.scenes.assembly import Shape, load_source, read_shape, some
from nlt.scenes.description import MATERIALS, Movable, load_description
from nlt.scenes.importer import Imported, read
from nlt.scenes.pointcloud import material
from nlt.scenes.proposal import Proposal, propose

_FAR = 1e6  # at this coordinate, the 7 digits of float32 leave none for a millimetre


def show(name: str) -> str:
    """Return a summary of a description (lengths in metres) and of its scene."""
    description = load_description(name)
    source = load_source(description)
    shapes = [read_shape(mesh, description.units_per_metre) for mesh in source.shapes()]
    lines = [
        f"{description.name}: {description.file}",
        f"source: {description.source}, {description.units_per_metre:g} units per metre",
        f"camera: {_span(description.camera)} m, field of view {description.fov:g} degrees",
        f"room: {'not given' if description.room is None else _span(description.room) + ' m'}",
        f"exposure: {description.exposure:g}; integrator: {description.integrator}",
    ]
    if description.light is not None:
        size, box = description.light.size, description.light.box
        lines.append(f"moving light: {size[0]:.3g} x {size[1]:.3g} m in {_span(box)} m")
    lines += _objects(description.objects)
    return "\n".join([*lines, *_contents(shapes, source.environment() is not None)])


def check(path: Path) -> str:
    """Load a scene file and return a summary of it and of a proposed description; lengths in scene units.

    Raises:
        UserError: the file cannot be loaded, see `importer.read`.
    """
    imported, shapes, proposal, warnings = _propose(path)
    because = proposal.because
    lines = [
        str(path),
        *_contents(list(shapes.values()), imported.scene.environment() is not None),
        f"bounding box: {_span(proposal.bounds)}",
        f"up: +{proposal.up} ({because['up']})",
        f"units per metre: {proposal.units_per_metre:g} ({because['units_per_metre']})",
        f"room: {_span(proposal.room)} ({because['room']})",
        f"camera: {_span(proposal.camera)} ({because['camera']})",
        f"ceiling: {proposal.room[1, 'xyz'.index(proposal.up)]:.4g}; moving light: "
        f"{proposal.light.size[0]:.3g} x {proposal.light.size[1]:.3g} in {_span(proposal.light.box)}",
        *_objects(proposal.objects),
    ]
    if imported.camera is not None:
        eye, forward = imported.camera[:3, 3], imported.camera[:3, 2]
        lines.append(f"the file's own camera: at {_numbers(eye)}, looking along {_numbers(forward)}")
    return "\n".join(lines + [f"warning: {warning}" for warning in warnings])


def add(path: Path, name: str | None = None, output: Path | None = None) -> Path:
    """Write a first description of a scene file, to be edited, and return its path.

    Raises:
        UserError: the file cannot be loaded, or the description already exists.
    """
    name = name or re.sub(r"[^\w-]+", "_", path.resolve().parent.name if path.stem == "scene" else path.stem)
    file = output or OWN_SCENES / f"{name}.yaml"
    for taken in (file, find_config("scenes", name)) if output is None else (file,):
        if taken.exists():
            raise UserError(f"{taken}: already exists; choose another name with --name, or another file with -o")
    *_, proposal, warnings = _propose(path)
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(_yaml(path, name, proposal, warnings))
    return file


def _propose(path: Path) -> tuple[Imported, dict[str, Shape], Proposal, list[str]]:
    """Load a scene file; return it, its shapes, a proposed description and warnings."""
    imported = read(path)
    shapes = {mesh.id(): read_shape(mesh) for mesh in imported.scene.shapes()}
    for shape in shapes.values():
        if not np.isfinite(shape.vertices).all():
            raise UserError(f"{path}: shape {shape.id}: a vertex is not finite; repair the mesh")
    proposal, warnings = propose(imported.scene, shapes, imported.up), list(imported.warnings)
    if not imported.scene.emitters():
        warnings.append("nothing emits light: only moving_lights will work")
    farthest = np.abs(proposal.bounds).max()
    if farthest > _FAR:
        warnings.append(f"coordinates reach {farthest:.3g}, too far for float32: move or scale the scene")
    return imported, shapes, proposal, warnings


def _contents(shapes: Sequence[Shape], environment: bool) -> list[str]:
    kinds = Counter(material(shape.bsdf) for shape in shapes)
    emitting = [shape.id for shape in shapes if shape.emitter is not None]
    lights = f"{len(emitting)} area emitters{': ' + some(emitting) if emitting else ''}"
    return [
        f"shapes: {len(shapes)}, triangles: {sum(len(shape.faces) for shape in shapes):,}",
        f"light: {lights}{'; an environment' if environment else '; no environment'}",
        f"materials: {', '.join(f'{kinds[kind]} {kind}' for kind in MATERIALS if kinds[kind])}",
    ]


def _objects(objects: Sequence[Movable]) -> list[str]:
    lines = [f"  {movable.name}: {some(movable.shapes)}; moves by {_span(movable.box)}" for movable in objects]
    return [f"movable objects: {len(objects)}", *lines]


def _span(box: np.ndarray) -> str:
    return " to ".join(_numbers(corner) for corner in box)


def _numbers(values: Any) -> str:
    return "[" + ", ".join(f"{v + 0:.4g}" for v in np.where(np.abs(values) < 1e-6, 0, values)) + "]"


def _yaml(path: Path, name: str, proposal: Proposal, warnings: list[str]) -> str:
    root, source = scenes_root().resolve(), path.resolve()
    because, light = proposal.because, proposal.light
    pair = lambda box: f"[{_numbers(box[0])}, {_numbers(box[1])}]"
    comments = "".join(f"# {warning}\n" for warning in warnings)
    objects = "".join(
        f"  {_word(o.name)}: {{shapes: [{', '.join(map(_word, o.shapes))}], box: {pair(o.box)}}}\n"
        for o in proposal.objects
    )
    return f"""# Written by `nlt scenes add`. All values are guesses: check and edit them. Lengths are in scene units.
# Preview: nlt scenes preview {name} -o {name}.png
{comments}name: {_word(name)}
source: {_word(str(source.relative_to(root) if source.is_relative_to(root) else source))}
units_per_metre: {proposal.units_per_metre:g}  # {because["units_per_metre"]}
up: {proposal.up}  # {because["up"]}
exposure: 1.0  # check: `nlt scenes preview` suggests a value
fov: 70.0
camera: {{min: {_numbers(proposal.camera[0])}, max: {_numbers(proposal.camera[1])}}}  # {because["camera"]}
room: {pair(proposal.room)}  # check: {because["room"]}
# Check and rename the objects. Shapes that touch form one object; `box` bounds its translations.
objects:{"" if proposal.objects else " {}"}
{objects}moving_light:  # check: it must be below the ceiling and above everything else
  size: {_numbers(light.size)}
  radiance: {_numbers(light.radiance)}
  box: {pair(light.box)}
"""


def _word(text: str) -> str:
    """Return a string as YAML, quoted if necessary."""
    return text if re.fullmatch(r"[\w./-]+", text) and yaml.safe_load(text) == text else json.dumps(text)
