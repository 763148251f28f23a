"""Load any scene file as a Mitsuba scene of triangle meshes, one per shape, each with a unique, reproducible id."""

import re
import tempfile
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np

from nlt.errors import UserError
from nlt.scenes import mitsuba_xml
from nlt.scenes.meshes import bsdf, curved, live_mesh, texture
from nlt.scenes.mitsuba_xml import LAMP_RADIUS, unique
from nlt.scenes.model import Material, named_files, read_gltf, read_obj

SUFFIXES = (".xml", ".gltf", ".glb", ".obj")


@dataclass(frozen=True)
class Imported:
    """A loaded file. `warnings` lists what was lost, `camera` (4, 4) is its sensor's pose and `up` its up axis."""

    scene: Any
    warnings: tuple[str, ...]
    camera: np.ndarray | None = None
    up: str | None = None


def read(path: Path) -> Imported:
    """Load a Mitsuba XML (0.5 to 3.x), glTF, GLB or OBJ file in the active variant, always as the same scene.

    Raises:
        UserError: the file has another format, it refers to missing files (all are listed), or Mitsuba refuses it.
    """
    suffix = path.suffix.lower()
    if not path.is_file():
        problem = "a folder, not a scene file" if path.is_dir() else "no such file"
        raise UserError(f"{path}: {problem}; give a file ending in {', '.join(SUFFIXES)}")
    if suffix not in SUFFIXES:
        raise UserError(f"{path}: {suffix or 'no suffix'}: nlt reads scene files ending in {', '.join(SUFFIXES)}")
    camera = up = None
    if suffix == ".xml":
        scene, counts, camera = _read_xml(path)
        if camera is not None:
            axis = int(np.abs(camera[:3, 1]).argmax())
            up = "xyz"[axis] if camera[axis, 1] > 0.7 else None
    else:
        scene, counts = _read_model(path)
        up = None if suffix == ".obj" else "y"
    warnings = tuple(f"{text} ({n} times)" if n > 1 else text for text, n in sorted(counts.items()))
    if not scene.shapes():
        raise UserError(f"{path}: no shapes to render{''.join(f'; {w}' for w in warnings)}")
    return Imported(scene, warnings, camera, up)


def _check_missing(path: Path, missing: list[str]) -> None:
    if missing:
        raise UserError(f"{path}: missing: {', '.join(sorted(missing))}; add them, paths are relative to {path.parent}")


def _read_xml(path: Path) -> tuple[Any, Counter[str], np.ndarray | None]:
    """Return the scene, counts of warnings and the pose (4, 4) of the file's camera, if it has one."""
    document = mitsuba_xml.read(path)
    _check_missing(path, document.missing)
    pose = None if document.sensor is None else document.sensor.find("transform")
    with tempfile.TemporaryDirectory() as folder, _reporting(path, document.warnings):
        for shape in document.root.findall("shape"):
            if shape.get("type") in mitsuba_xml.ANALYTIC:
                _to_mesh_file(shape, Path(folder))
        scene = _instantiate(document.root)
        return scene, document.warnings, None if pose is None else _probe("disk", [pose])[1]


def _read_model(path: Path) -> tuple[Any, Counter[str]]:
    """Return the scene, with a small sphere for every lamp, and counts of warnings."""
    _check_missing(path, [name for name in named_files(path) if not (path.parent / name).is_file()])
    model = read_obj(path) if path.suffix.lower() == ".obj" else read_gltf(path)
    parts = list(model.parts)
    for name, position, intensity in model.lamps:
        placed = np.diag([LAMP_RADIUS, LAMP_RADIUS, LAMP_RADIUS, 1])
        placed[:3, 3] = position
        glow = Material(colour=(0.0, 0.0, 0.0), emission=tuple(intensity / (np.pi * LAMP_RADIUS**2)))
        parts.append((name, curved("sphere").moved(placed), glow))
    bsdfs: dict[int, Any] = {}  # one per material, because each instance costs tracing time
    meshes: dict[str, Any] = {}
    for name, triangles, material in parts:
        if len(triangles.faces) == 0:
            continue
        key = unique(re.sub(r"\W", "_", name), meshes)
        if id(material) not in bsdfs:
            bsdfs[id(material)] = mi.load_dict(bsdf(material))
        light = None
        if any(material.emission):
            radiance = texture(material.emission, material.emission_image)
            light = mi.load_dict({"type": "area", "radiance": radiance})
        meshes[key] = live_mesh(key, triangles, bsdfs[id(material)], light)
    return mi.load_dict({"type": "scene", **meshes}), model.warnings


class _WarningCounter(mi.Appender):
    """Counts Mitsuba's warnings instead of printing them."""

    def __init__(self, counts: Counter[str]) -> None:
        super().__init__()
        self.counts = counts

    def append(self, _: Any, text: str) -> None:
        if plugin := re.search(r'in (\w+) plugin of type "(\w+)"', text):
            for name in re.findall(r'^ +- \w+ "(\w+)"', text, re.MULTILINE):
                self.counts[f"{name} of {plugin[2]} {plugin[1]} is ignored: Mitsuba 3 does not know it"] += 1
        else:
            self.counts[re.sub(r"^\S+ \S+ \w+ +\[\w+(\.cpp:\d+)?\] ", "", " ".join(text.split()))] += 1

    def log_progress(self, *_: Any) -> None: ...


@contextmanager
def _reporting(path: Path, warnings: Counter[str]) -> Iterator[None]:
    """Count Mitsuba's warnings and convert its errors to UserErrors for the duration of the context."""
    logger: Any = mi.logger()  # type: ignore[operator]
    appenders, level = [logger.appender(k) for k in range(logger.appender_count())], logger.log_level()
    logger.clear_appenders()
    logger.add_appender(_WarningCounter(warnings))
    logger.set_log_level(mi.LogLevel.Warn)
    try:
        yield
    except RuntimeError as error:
        places = r"\[[\w.:]+\] |(At|while loading) string \(line \d+, col \d+\): "
        text = re.sub(places, "", " ".join(str(error).split()))
        raise UserError(f"{path}: Mitsuba 3 cannot load it; edit it to what Mitsuba 3 has: {text}") from None
    finally:
        logger.set_log_level(level)
        logger.clear_appenders()
        for appender in appenders:
            logger.add_appender(appender)


def _instantiate(root: ET.Element) -> Any:
    """Instantiate a scene with Mitsuba's parser, which upgrades old names. Shapes are not merged and keep their ids."""
    config = mi.parser.ParserConfig(str(mi.variant()))
    config.merge_equivalent = config.merge_meshes = False
    config.unused_properties = mi.LogLevel.Warn
    state = mi.parser.parse_string(config, ET.tostring(root, encoding="unicode"))
    mi.parser.transform_all(config, state)
    return mi.parser.instantiate(config, state)


def _probe(kind: str, place: list[ET.Element]) -> tuple[Any, np.ndarray | None]:
    """Return an analytic shape at its transform, centre, radius or ends, and its matrix (4, 4) unless it is a mesh."""
    root = ET.Element("scene", version=mitsuba_xml.OLD)
    ET.SubElement(root, "shape", type=kind).extend(place)
    (shape,) = _instantiate(root).shapes()
    if isinstance(shape, mi.Mesh):  # a rectangle or a cube
        return shape, None
    return shape, np.array(mi.traverse(shape)["to_world"].matrix, float).reshape(4, 4)


def _to_mesh_file(shape: ET.Element, folder: Path) -> None:
    """Replace an analytic shape by a mesh file."""
    kind, file = shape.get("type", ""), str(folder / f"{shape.get('id')}.ply")
    place = [child for child in shape if child.tag in ("transform", "point", "float")]
    exact, matrix = _probe(kind, place)
    if matrix is None:
        exact.write_ply(file)
    else:
        live_mesh(kind, curved(kind).moved(matrix)).write_ply(file)
    for child in place:
        shape.remove(child)
    shape.set("type", "ply")
    ET.SubElement(shape, "string", name="filename", value=file)
