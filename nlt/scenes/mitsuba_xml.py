"""Convert Mitsuba scene files of versions 0.5 to 3.x into XML that Mitsuba 3 reads. Needs no Mitsuba.

Mitsuba itself renames old properties (`toWorld`, `diffuseReflectance`, `uscale`). This module handles the values,
textures, lights and shapes that Mitsuba 3 refuses. It drops media, which nlt does not trace, and sensors, integrators,
films and samplers, because nlt has its own. Materials that Mitsuba 3 does not have are left for it to refuse.
"""

import copy
import itertools
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Container
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from nlt.errors import UserError

OLD = "0.6.0"  # version written to the output, which makes Mitsuba upgrade old names; harmless for newer files
ANALYTIC = ("sphere", "disk", "cylinder", "rectangle", "cube")  # shapes that the importer converts to meshes
_MESHES = ("obj", "ply", "serialized")
_MEDIA = ("medium", "subsurface")
_DROPPED = ("sensor", "integrator", "film", "sampler", "rfilter", "phase", "volume")
_ENVIRONMENTS = ("envmap", "constant", "sunsky", "timed_sunsky")
_LAMPS = {"point": "sphere", "spot": "disk"}  # the shapes of the small lamps that replace these lights
LAMP_RADIUS = 0.05  # scene units


@dataclass
class Document:
    """A scene with includes and parameters resolved. `warnings` counts duplicates; `sensor` is the first one."""

    root: ET.Element = field(default_factory=lambda: ET.Element("scene"))
    files: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    warnings: Counter[str] = field(default_factory=Counter)
    sensor: ET.Element | None = None
    old: bool = False  # a file of version 0.x or 1.x


def read(path: Path) -> Document:
    """Read and convert a scene file.

    Raises:
        UserError: the file is not a Mitsuba scene.
    """
    document, folders = Document(), [path.parent]
    document.root = root = _resolve(document, path, folders, {})
    if root.tag != "scene":
        raise UserError(f"{path}: not a Mitsuba scene: it starts with <{root.tag}>, not with <scene>")
    for element in root.iter():
        _value(element)
    document.sensor = root.find("sensor")
    _drop(document, root)
    _flatten_shapes(document, root)
    _drop_unused(root)
    for element in root.iter("texture"):
        _texture(element)
    _convert_lights(document, root)
    _name_shapes(root)
    _locate(document, root, folders)
    root.set("version", OLD)
    return document


def _resolve(document: Document, path: Path, folders: list[Path], values: dict[str, str]) -> ET.Element:
    """Return the root of the file, with $parameters substituted and includes inlined."""
    document.files.append(path)
    try:
        root = ET.parse(path).getroot()
    except ET.ParseError as error:
        raise UserError(f"{path}: not valid XML: {error}") from None
    except UnicodeDecodeError:
        raise UserError(f"{path}: not a text file; nlt reads Mitsuba XML, glTF, GLB and OBJ") from None
    document.old |= root.get("version", OLD).startswith(("0", "1"))

    def visit(element: ET.Element) -> None:
        for key, value in element.attrib.items():
            for name in sorted(values, key=len, reverse=True):
                value = value.replace(f"${name}", values[name])
            element.set(key, value)
        children: list[ET.Element] = []
        for child in list(element):
            if child.tag == "default":
                values.setdefault(child.get("name", ""), child.get("value", ""))
                continue
            visit(child)
            if child.tag == "path":
                folders.append(path.parent / child.get("value", ""))
            elif child.tag == "include":
                included = _find(child.get("filename", ""), folders)
                if not included.is_file():
                    document.missing.append(child.get("filename", ""))
                elif included in document.files:
                    raise UserError(f"{path}: include: {included} includes itself")
                else:
                    inner = _resolve(document, included, folders, values)
                    children += list(inner) if inner.tag == "scene" else [inner]
            else:
                children.append(child)
        element[:] = children

    visit(root)
    return root


def _find(name: str, folders: list[Path]) -> Path:
    return next((f / name for f in folders if (f / name).is_file()), folders[0] / name)


def _property(element: ET.Element, name: str) -> ET.Element | None:
    """Return the child with this name in Mitsuba 3; `sun_direction` also finds `sunDirection`."""
    snake_case = lambda old: re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", old).lower()
    return next((child for child in element if snake_case(child.get("name", "")) == name), None)


def linear(encoded: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear, both in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _set(element: ET.Element, tag: str, name: str, value: object) -> None:
    old = _property(element, name)
    if old is not None:
        element.remove(old)
    ET.SubElement(element, tag, name=name, value=str(value))


def _transform(element: ET.Element) -> ET.Element:
    """Return the `to_world` of an element, created if absent."""
    child = element.find("transform")
    return ET.SubElement(element, "transform", name="to_world") if child is None else child


def _drop(document: Document, root: ET.Element) -> None:
    """Drop media, and what nlt has its own of."""
    for parent in list(root.iter()):
        for child in list(parent):
            is_medium = child.tag in _MEDIA or child.get("name") in ("interior", "exterior")
            if is_medium:
                document.warnings["media and subsurface scattering are ignored: nlt traces only surfaces"] = 1
            if is_medium or child.tag in _DROPPED:
                parent.remove(child)


def _flatten_shapes(document: Document, root: ET.Element) -> None:
    """Replace instances by copies and merged shapes by their parts; drop shapes that cannot become a mesh."""
    groups = {e.get("id"): e for e in root.iter("shape") if e.get("type") == "shapegroup"}
    flat: list[ET.Element] = []  # the scene's children, in order

    def add(shape: ET.Element, prefix: str, outer: list[ET.Element]) -> None:
        kind, name = shape.get("type", ""), shape.get("id", "")
        if kind in ("shapegroup", "merge", "instance"):
            parts: ET.Element | None = shape
            if kind == "instance":
                reference = shape.find("ref")
                parts = shape.find("shape") if reference is None else groups.get(reference.get("id"))
                outer = [*(shape.find("transform") or ()), *outer]
            for part in parts.findall("shape") if parts is not None else ():
                add(copy.deepcopy(part), f"{prefix}{name}_" if name and kind == "instance" else prefix, outer)
        elif kind in (*_MESHES, *ANALYTIC):
            if outer:
                _transform(shape).extend(copy.deepcopy(outer))
            if name:
                shape.set("id", prefix + name)
            flat.append(shape)
        else:
            document.warnings[
                f"shape {name or '(no id)'} is a {kind} and is ignored: it cannot become a triangle mesh"
            ] += 1

    for child in root:
        if child.tag != "shape":
            flat.append(child)
        elif child.get("type") != "shapegroup":
            add(child, "", [])
    root[:] = flat


def _drop_unused(root: ET.Element) -> None:
    """Keep only the BSDFs and textures that a shape or emitter refers to, by their own or a nested id."""
    definitions = {e for e in root if e.tag in ("bsdf", "texture", "spectrum")}
    named = {e.get("id"): e for top in root if top in definitions for e in top.iter() if e.get("id") and e.tag != "ref"}
    used: set[ET.Element] = set()
    waiting = others = [e for e in root if e not in definitions]
    while waiting:
        found = {named.get(reference.get("id")) for element in waiting for reference in element.iter("ref")}
        waiting = [e for e in found - used if e is not None]
        used.update(waiting)
    inside = {e for outer in used for e in outer.iter() if e is not outer}
    kept = [e for e in named.values() if e in used - inside]
    for element in kept:
        element.attrib.pop("name", None)
    root[:] = [*kept, *others]


def _value(element: ET.Element) -> None:
    """Rewrite a value in a spelling that Mitsuba 3 reads."""
    value = element.get("value", "").strip()
    if element.tag == "lookAt":
        element.tag = "lookat"
    elif element.tag in ("point", "vector") and not value:
        element.attrib = {"x": "0", "y": "0", "z": "0", **element.attrib}
    elif element.tag == "spectrum" and value and ":" not in value:
        element.tag = "rgb"  # one or three plain numbers, which the RGB mode of Mitsuba 0.x read as linear RGB
    elif element.tag == "srgb" or (element.tag == "rgb" and value.startswith("#")):
        if value.startswith("#"):
            encoded = np.frombuffer(bytes.fromhex(value[1:]), np.uint8) / 255
        else:
            encoded = np.array(re.split(r"[\s,]+", value), float)
        element.tag = "rgb"
        element.set("value", ", ".join(f"{v:.6g}" for v in linear(encoded)))


def _texture(element: ET.Element) -> None:
    """Replace options of images that Mitsuba 3 refuses or ignores."""
    filtering, gamma = _property(element, "filter_type"), _property(element, "gamma")
    if filtering is not None and filtering.get("value") not in ("nearest", "bilinear"):
        element.remove(filtering)  # trilinear, ewa: Mitsuba 3 has no mipmaps
    if gamma is not None and float(gamma.get("value", 0)) == 1:
        element.remove(gamma)
        _set(element, "boolean", "raw", "true")


def _convert_lights(document: Document, root: ET.Element) -> None:
    """Convert sun, sky, point and spot lights; keep one environment, and drop other lights without an area."""
    kept = ""
    for element in root.findall("emitter"):
        kind = element.get("type", "")
        if kind in ("sun", "sky", "sunsky"):
            element.set("type", "sunsky")
            if document.old:  # up was +y in Mitsuba 0.x and is +z in Mitsuba 3
                _transform(element).insert(0, ET.Element("rotate", x="1", angle="-90"))
            for part in ("sun", "sky"):
                if part not in kind:
                    _set(element, "float", f"{part}_scale", 0)
        if element.get("type") in _ENVIRONMENTS and not kept:
            kept = kind
            continue
        root.remove(element)
        if element.get("type") in _ENVIRONMENTS:
            text = f"Mitsuba allows one environment: {kept} is kept, {kind} ignored"
        elif kind in _LAMPS:
            root.append(_lamp(element))
            text = f"a {kind} light is replaced by a {_LAMPS[kind]} of radius {LAMP_RADIUS:g} and the same intensity"
        else:
            text = f"a {kind} light is ignored: nlt has only area lights and environments"
        document.warnings[text] += 1


def _lamp(light: ET.Element) -> ET.Element:
    """Return a small area light as bright as a point or spot light."""
    kind = light.get("type", "")
    lamp = ET.Element("shape", type=_LAMPS[kind], id=light.get("id", f"{kind}_light"))
    lamp.extend(light.findall("transform"))
    if kind == "point":
        _set(lamp, "float", "radius", LAMP_RADIUS)
    else:
        _transform(lamp).insert(0, ET.Element("scale", value=str(LAMP_RADIUS)))
    position, intensity = _property(light, "position"), _property(light, "intensity")
    if position is not None:
        position.set("name", "center")
        lamp.append(position)
    values = re.split(r"[\s,]+", "1" if intensity is None else intensity.get("value", "1").strip())
    radiance = [float(v.split(":")[-1]) / (np.pi * LAMP_RADIUS**2) for v in values]
    _set(ET.SubElement(lamp, "emitter", type="area"), "rgb", "radiance", ", ".join(f"{v:.6g}" for v in radiance))
    return lamp


def _name_shapes(root: ET.Element) -> None:
    """Give every shape a unique, reproducible id: its own, else the numbered name of its file or its type."""
    taken = {e.get("id", "") for e in root.iter() if e.get("id") and e.tag not in ("shape", "ref")}
    for shape in sorted(root.findall("shape"), key=lambda s: s.get("id") is None):  # those that have an id come first
        file, part = _property(shape, "filename"), _property(shape, "shape_index")
        stem = shape.get("type", "") if file is None else Path(file.get("value", "")).stem
        stem += "" if part is None else f"_{part.get('value')}"
        name = unique(re.sub(r"\W", "_", shape.get("id") or stem), taken)
        taken.add(name)
        shape.set("id", name)


def unique(name: str, taken: Container[str]) -> str:
    """Return the name, numbered from 2 if it is taken."""
    return next(n for k in itertools.count(1) if (n := name if k == 1 else f"{name}_{k}") not in taken)


def _locate(document: Document, root: ET.Element, folders: list[Path]) -> None:
    """Make all file names absolute and record the missing files."""
    for element in root.iter():
        key = "value" if element.tag == "string" and element.get("name") == "filename" else "filename"
        name = element.get(key)
        if name is None:
            continue
        file = _find(name, folders)
        if file.is_file():
            document.files.append(file)
        elif name not in document.missing:
            document.missing.append(name)
        element.set(key, str(file.resolve()))
