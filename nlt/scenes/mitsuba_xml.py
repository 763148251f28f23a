"""Convert Mitsuba scene files of versions 0.5 to 3.x into XML that Mitsuba 3 reads. Needs no Mitsuba.

Mitsuba itself renames old properties (`toWorld`, `diffuseReflectance`, `uscale`). This module handles what Mitsuba
refuses: it replaces elements and plugins that no longer exist by their nearest equivalents, with a warning. It drops
media, which nlt does not trace, and sensors, integrators, films and samplers, because nlt has its own.
"""

from __future__ import annotations

import copy
import importlib.util
import itertools
import re
import xml.etree.ElementTree as ET
from collections import Counter
from collections.abc import Container, Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import numpy as np

from nlt.errors import UserError

OLD = "0.6.0"  # version written to the output, which makes Mitsuba upgrade old names; harmless for newer files
ANALYTIC = ("sphere", "disk", "cylinder", "rectangle", "cube")  # shapes that the importer converts to meshes
_MESHES = ("obj", "ply", "serialized")
_DROPPED = ("integrator", "film", "sampler", "rfilter", "medium", "subsurface", "phase", "volume")
_ENVIRONMENTS = ("envmap", "constant", "sunsky", "timed_sunsky")
LAMP_RADIUS = 0.05  # scene units; radius of the small lamp that replaces a point light


@dataclass
class Document:
    """A scene with includes and parameters resolved. `warnings` counts duplicates; `sensor` is the first one."""

    path: Path
    root: ET.Element = field(default_factory=lambda: ET.Element("scene"))
    files: list[Path] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    warnings: Counter[str] = field(default_factory=Counter)
    sensor: ET.Element | None = None
    old: bool = False

    def warn(self, message: str) -> None:
        self.warnings[message] += 1


def read(path: Path) -> Document:
    """Read and convert a scene file.

    Raises:
        UserError: the file is not a Mitsuba scene.
    """
    document = Document(path)
    folders = [path.parent]
    root = _resolve(document, path, folders, {})
    if root.tag != "scene":
        raise UserError(f"{path}: not a Mitsuba scene: it starts with <{root.tag}>, not with <scene>")
    for element in root.iter():
        _values(document, element)
    document.sensor = root.find("sensor")
    _drop(document, root)
    _flatten_shapes(document, root)
    _drop_unused(root)
    index = {e.get("id", ""): e for e in root.iter() if e.get("id") and e.tag != "ref"}
    _rewrite(document, root, index)
    _one_environment(document, root)
    _name_shapes(root)
    _locate(document, root, folders)
    root.set("version", OLD)
    document.root = root
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
    version = re.findall(r"\d+", root.get("version", OLD))
    document.old |= int(version[0] if version else 0) < 2

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
    """Return the child with this name in Mitsuba 3; `int_ior` also finds `intIOR`."""
    for child in element:
        if child.get("name") and snake_case(child.get("name", "")) == name:
            return child
    return None


def snake_case(name: str) -> str:
    """Convert a property name from Mitsuba 0.x to Mitsuba 3."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", name).lower()


def _pop(element: ET.Element, name: str) -> ET.Element | None:
    child = _property(element, name)
    if child is not None:
        element.remove(child)
    return child


def linear(encoded: np.ndarray) -> np.ndarray:
    """Convert sRGB to linear, both in [0, 1]."""
    return np.where(encoded <= 0.04045, encoded / 12.92, ((encoded + 0.055) / 1.055) ** 2.4)


def _number(element: ET.Element, name: str, default: float) -> float:
    child = _property(element, name)
    return default if child is None else _number_of(child, default)


def _number_of(element: ET.Element, default: float) -> float:
    try:
        return float(element.get("value", default))
    except ValueError:
        return default


def _set(element: ET.Element, tag: str, name: str, value: object) -> None:
    _pop(element, name)
    ET.SubElement(element, tag, name=name, value=str(value))


def _become(element: ET.Element, other: ET.Element) -> None:
    """Replace an element by another one in place; it keeps its own name and id."""
    kept = {k: v for k, v in element.attrib.items() if k in ("name", "id")}
    taken = {k: v for k, v in other.attrib.items() if k not in ("name", "id")}
    element.tag, element.text, element.attrib = other.tag, None, {**taken, **kept}
    if other.tag == "ref":
        element.set("id", other.get("id", ""))
    element[:] = copy.deepcopy(list(other))
    for inside in element.iter():
        if inside is not element and inside.tag != "ref":
            inside.attrib.pop("id", None)


def _transform(element: ET.Element) -> ET.Element:
    """Return the `to_world` of an element, created if absent."""
    child = element.find("transform")
    return ET.SubElement(element, "transform", name="to_world") if child is None else child


def _drop(document: Document, root: ET.Element) -> None:
    media = 0
    for parent in list(root.iter()):
        for child in list(parent):
            medium = child.tag in ("medium", "subsurface") or child.get("name") in ("interior", "exterior")
            if medium or child.tag in _DROPPED or child.tag == "sensor":
                media += medium
                parent.remove(child)
    if media:
        document.warn("media and subsurface scattering are ignored: nlt traces only surfaces")


def _flatten_shapes(document: Document, root: ET.Element) -> None:
    """Replace instances by copies and merged shapes by their parts; drop shapes that cannot become a mesh."""
    groups = {e.get("id"): e for e in root.iter("shape") if e.get("type") == "shapegroup"}
    flat: list[ET.Element] = []  # the scene's children, in order

    def add(shape: ET.Element, prefix: str, outer: list[ET.Element]) -> None:
        kind, name = shape.get("type", ""), shape.get("id", "")
        if kind in ("shapegroup", "merge", "instance"):
            parts = shape
            if kind == "instance":
                reference = shape.find("ref")
                parts = groups.get(reference.get("id")) if reference is not None else shape.find("shape")  # type: ignore[assignment]
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
            document.warn(f"shape {name or '(no id)'} is a {kind} and is ignored: it cannot become a triangle mesh")

    for child in root:
        if child.tag != "shape":
            flat.append(child)
        elif child.get("type") != "shapegroup":
            add(child, "", [])
    root[:] = flat


def _drop_unused(root: ET.Element) -> None:
    """Keep only the top-level BSDFs and textures that a shape or emitter refers to, by their own or a nested id."""
    tops = {
        e: {i.get("id"): i for i in e.iter() if i.get("id") and i.tag != "ref"}
        for e in root
        if e.tag in ("bsdf", "texture", "spectrum")
    }
    owner = {key: top for top, inner in tops.items() for key in inner if key}
    used: set[str] = set()
    waiting = [e for e in root if e not in tops]
    while waiting:
        for reference in waiting.pop().iter("ref"):
            key = reference.get("id", "")
            if key in owner and key not in used:
                used.add(key)
                waiting.append(tops[owner[key]][key])  # type: ignore[index]
    for top, inner in tops.items():
        wanted = [i for key, i in inner.items() if key in used]
        if top in wanted:
            continue
        place = list(root).index(top)
        root.remove(top)
        for inside in reversed(wanted):
            inside.attrib.pop("name", None)
            root.insert(place, inside)


def _values(document: Document, element: ET.Element) -> None:
    """Rewrite a value in a spelling that Mitsuba 3 reads."""
    value = element.get("value", "")
    if element.tag == "lookAt":
        element.tag = "lookat"
    elif element.tag in ("point", "vector") and "value" not in element.attrib:
        for axis in "xyz":
            element.attrib.setdefault(axis, "0")
    elif element.tag == "spectrum" and value and ":" not in value:
        element.tag = "rgb"  # one or three plain numbers, which the RGB mode of Mitsuba 0.x read as linear RGB
    elif element.tag == "blackbody":
        scaled = element.get("scale")
        kelvin = element.get("temperature", "6500").strip().rstrip("Kk")
        element.tag = "spectrum"
        element.attrib = {"type": "blackbody", "name": element.get("name", "")}
        _set(element, "float", "temperature", kelvin)
        if scaled:
            document.warn("the scale of a blackbody spectrum is ignored")
    if element.tag == "srgb" or (element.tag == "rgb" and value.startswith("#")):
        if value.startswith("#"):
            encoded = np.array([int(value[k : k + 2], 16) for k in (1, 3, 5)]) / 255
        else:
            encoded = np.array([float(v) for v in re.split(r"[\s,]+", value.strip())])
        element.tag = "rgb"
        element.set("value", ", ".join(f"{v:.6g}" for v in linear(encoded)))


def _rewrite(document: Document, parent: ET.Element, index: dict[str, ET.Element]) -> None:
    """Replace, depth first, plugins and options that Mitsuba 3 does not have by their nearest equivalents."""
    for element in list(parent):
        _rewrite(document, element, index)
        if element.tag == "bsdf":
            _bsdf(document, element, index)
        elif element.tag == "texture":
            _texture(document, element)
        elif element.tag == "emitter":
            _emitter(document, parent, element)
        elif element.tag == "shape":
            references = element.findall("ref")
            if len(references) > 1:
                document.warn(
                    f"shape with {len(references)} materials: the first, {references[0].get('id')}, is used everywhere"
                )
                for reference in references[1:]:
                    element.remove(reference)


@cache
def _installed() -> tuple[frozenset[str], frozenset[str]]:
    """Return the names of Mitsuba's plugins and of its conductor materials, read from the installed package."""
    spec = importlib.util.find_spec("mitsuba")
    assert spec is not None and spec.origin is not None
    folder = Path(spec.origin).parent
    plugins = frozenset(f.name.split(".")[0].removeprefix("lib") for f in (folder / "plugins").iterdir())
    return plugins, frozenset(f.name.removesuffix(".eta.spd") for f in folder.glob("data/ior/*.eta.spd")) | {"none"}


def _inner(element: ET.Element, index: dict[str, ET.Element]) -> ET.Element | None:
    """Return the BSDF nested in this one, looking through references and `twosided`."""
    for child in element:
        target = index.get(child.get("id", "")) if child.tag == "ref" else child
        if target is not None and target.tag == "bsdf":
            return _inner(target, index) if target.get("type") == "twosided" else target
    return None


def _transmits(element: ET.Element | None, index: dict[str, ET.Element]) -> bool:
    if element is None:
        return False
    if "dielectric" in element.get("type", "") or element.get("type") in ("mask", "null", "principledthin"):
        return True
    targets = (index.get(c.get("id", "")) if c.tag == "ref" else c for c in element)
    return _number(element, "spec_trans", 0) > 0 or any(_transmits(t, index) for t in targets if t is not None)


def _bsdf(document: Document, element: ET.Element, index: dict[str, ET.Element]) -> None:
    kind = element.get("type", "")
    inner = _inner(element, index)
    if kind in ("coating", "roughcoating") and inner is not None:
        if inner.get("type") == "diffuse":
            element.set("type", "plastic" if kind == "coating" else "roughplastic")
            _replace_by(element, inner, {"reflectance": "diffuse_reflectance"})
            document.warn(f"Mitsuba 3 has no {kind}: over a diffuse surface, {element.get('type')} replaces it")
        else:
            _become(element, inner)
            document.warn(f"Mitsuba 3 has no {kind}: the coating of a {inner.get('type')} is ignored")
    elif kind in ("phong", "ward"):
        if kind == "phong":
            alpha = np.sqrt(2 / (_number(element, "exponent", 30) + 2))
        else:
            alpha = (_number(element, "alpha_u", 0.1) + _number(element, "alpha_v", 0.1)) / 2
        for name in ("exponent", "alpha_u", "alpha_v", "variant"):
            _pop(element, name)
        element.set("type", "roughplastic")
        _set(element, "float", "alpha", f"{max(alpha, 1e-3):.6g}")
        document.warn(f"Mitsuba 3 has no {kind}: replaced by roughplastic of the same width")
    elif kind == "mixturebsdf":
        _mixture(element)
        document.warn("Mitsuba 3 has no mixturebsdf: replaced by blendbsdf")
    elif kind == "difftrans":
        element.set("type", "principledthin")
        colour = _pop(element, "transmittance")
        if colour is not None:
            colour.set("name", "base_color")
            element.append(colour)
        _set(element, "float", "diff_trans", 2)
        document.warn("Mitsuba 3 has no difftrans: replaced by a principledthin that transmits diffusely")
    elif kind == "twosided" and inner is not None and _transmits(inner, index):
        if inner.get("type") == "mask":  # a mask is always two-sided, but the BSDF inside it may not be
            masked = next((c for c in inner if c.tag in ("bsdf", "ref")), None)
            copied = copy.deepcopy(inner)
            target = _inner(inner, index)
            if masked is not None and not _transmits(target, index):
                place = list(inner).index(masked)
                copied[place] = ET.Element("bsdf", type="twosided")
                copied[place].append(copy.deepcopy(target if target is not None else masked))
            _become(element, copied)
        else:
            _become(element, inner)
    elif kind not in _installed()[0]:
        element.set("type", "diffuse")
        colour = next((c for n in ("reflectance", "diffuse_reflectance") if (c := _pop(element, n)) is not None), None)
        element[:] = [] if colour is None else [colour]
        if colour is not None:
            colour.set("name", "reflectance")
        document.warn(f"Mitsuba 3 has no {kind}: replaced by diffuse")
    _lobes(document, element)


def _replace_by(element: ET.Element, inner: ET.Element, rename: dict[str, str]) -> None:
    """Give a coating the properties of the BSDF inside it, in place of that BSDF."""
    kept = [c for c in element if snake_case(c.get("name", "")) in ("int_ior", "ext_ior", "alpha", "distribution")]
    for child in copy.deepcopy(list(inner)):
        name = snake_case(child.get("name", ""))
        if name in rename:
            child.set("name", rename[name])
            kept.append(child)
    element[:] = kept


def _mixture(element: ET.Element) -> None:
    """Express n weighted BSDFs as n - 1 nested blends, each of which takes its share of the remaining weight."""
    listed = _pop(element, "weights")
    parts = [c for c in element if c.tag in ("bsdf", "ref")]
    weights = [float(w) for w in re.split(r"[\s,]+", listed.get("value", "").strip())] if listed is not None else []
    weights = (weights + [1.0] * len(parts))[: len(parts)]
    element.set("type", "blendbsdf")
    element[:] = []
    for k in range(len(parts) - 1):
        element.append(parts[k])
        rest = element if k == len(parts) - 2 else ET.Element("bsdf", type="blendbsdf")
        ET.SubElement(element, "float", name="weight", value=f"{1 - weights[k] / (sum(weights[k:]) or 1):.6g}")
        element.append(parts[-1] if rest is element else rest)
        element = rest


def _lobes(document: Document, element: ET.Element) -> None:
    """Replace microfacet options and conductor materials that Mitsuba 3 does not know."""
    kind = element.get("type", "")
    distribution = _property(element, "distribution")
    if distribution is not None and distribution.get("value") not in ("beckmann", "ggx"):
        document.warn(f"microfacet distribution {distribution.get('value')}: replaced by beckmann")
        distribution.set("value", "beckmann")
    alpha = _property(element, "alpha")
    if kind == "roughplastic" and alpha is not None and alpha.tag == "texture":
        element.remove(alpha)
        document.warn("roughplastic with a textured alpha: replaced by 0.1")
    material = _property(element, "material")
    if (
        kind in ("conductor", "roughconductor")
        and material is not None
        and material.get("value") not in _installed()[1]
    ):
        document.warn(f"unknown conductor {material.get('value')}: replaced by a perfect mirror")
        material.set("value", "none")
    if kind in ("conductor", "roughconductor") and _pop(element, "ext_eta") is not None:
        document.warn(f"ext_eta of {kind} is ignored: Mitsuba 3 assumes air")


def _texture(document: Document, element: ET.Element) -> None:
    kind = element.get("type", "")
    if kind == "bitmap":
        filtering, wrapping, gamma = (_property(element, n) for n in ("filter_type", "wrap_mode", "gamma"))
        if filtering is not None and filtering.get("value") not in ("nearest", "bilinear"):
            element.remove(filtering)  # trilinear, ewa: Mitsuba 3 has no mipmaps
        if wrapping is not None and wrapping.get("value") not in ("repeat", "mirror", "clamp"):
            document.warn(f"texture wrap mode {wrapping.get('value')}: replaced by clamp")
            wrapping.set("value", "clamp")
        if gamma is not None:
            element.remove(gamma)
            if _number_of(gamma, 0) == 1:
                _set(element, "boolean", "raw", "true")
            else:
                document.warn("the gamma of a texture is ignored: images are read as sRGB")
        if _pop(element, "channel") is not None:
            document.warn("the channel of a texture is ignored: the whole image is used")
    elif kind == "scale":
        inner = next((c for c in element if c.tag in ("texture", "rgb", "ref")), ET.Element("rgb", value="0.5"))
        _become(element, inner)
        document.warn("Mitsuba 3 has no scale texture: the texture inside it is used unscaled")
    elif kind == "vertexcolors":
        element.set("type", "mesh_attribute")
        element[:] = [ET.Element("string", {"name": "name", "value": "vertex_color"})]
    elif kind not in _installed()[0]:
        colour = _property(element, "color0")
        element.attrib.pop("type")
        element.tag, element[:] = "rgb", []
        element.set("value", colour.get("value", "0.5") if colour is not None else "0.5")
        document.warn(f"Mitsuba 3 has no texture {kind}: replaced by one colour")


def _emitter(document: Document, parent: ET.Element, element: ET.Element) -> None:
    kind = element.get("type", "")
    if kind in ("sun", "sky", "sunsky"):
        _sky(document, element)
    elif kind in ("point", "spot"):
        lamp = ET.Element("shape", type="sphere" if kind == "point" else "disk", id=element.get("id", f"{kind}_light"))
        lamp.extend(t for t in element.findall("transform"))
        position = _property(element, "position")
        if position is not None:
            position.set("name", "center")
            lamp.append(position)
        if kind == "point":
            ET.SubElement(lamp, "float", name="radius", value=str(LAMP_RADIUS))
        else:
            _transform(lamp).insert(0, ET.Element("scale", value=str(LAMP_RADIUS)))
        light = ET.SubElement(lamp, "emitter", type="area")
        intensity = _property(element, "intensity")
        values = re.split(r"[\s,]+", intensity.get("value", "1").strip()) if intensity is not None else ["1"]
        radiance = [float(v.split(":")[-1]) / (np.pi * LAMP_RADIUS**2) for v in values]
        ET.SubElement(light, "rgb", name="radiance", value=", ".join(f"{v:.6g}" for v in radiance))
        parent.remove(element)
        parent.append(lamp)
        document.warn(
            f"a {kind} light is replaced by a {lamp.get('type')} of radius {LAMP_RADIUS:g} and the same intensity"
        )
    elif kind not in ("area", "directionalarea", *_ENVIRONMENTS):
        parent.remove(element)
        document.warn(f"a {kind} light is ignored: nlt has only area lights and environments")


def _sky(document: Document, element: ET.Element) -> None:
    kind = element.get("type")
    if document.old:  # up was +y in Mitsuba 0.x and is +z in Mitsuba 3
        _transform(element).insert(0, ET.Element("rotate", x="1", angle="-90"))
    scale = _pop(element, "scale")
    for part in ("sun", "sky"):
        if kind in ("sun", "sky") and kind != part:
            _set(element, "float", f"{part}_scale", 0)
        elif scale is not None:
            _set(element, "float", f"{part}_scale", scale.get("value"))
    radius = _pop(element, "sun_radius_scale")
    if radius is not None:
        _set(element, "float", "sun_aperture", f"{0.5358 * float(radius.get('value', 1)):.6g}")
    for name in ("stretch", "resolution", "extend", "filename"):
        _pop(element, name)
    element.set("type", "sunsky")


def _one_environment(document: Document, root: ET.Element) -> None:
    environments = [e for e in root.findall("emitter") if e.get("type") in _ENVIRONMENTS]
    for other in environments[1:]:
        first = environments[0]
        root.remove(other)
        absent = [p for p in ("sun", "sky") if _number(first, f"{p}_scale", 1) == 0]
        if first.get("type") == other.get("type") == "sunsky" and absent:
            for name in (f"{absent[0]}_scale", "sun_direction", "sun_aperture"):
                given = _property(other, name)
                if given is not None:
                    _pop(first, name)
                    first.append(given)
            if _property(other, f"{absent[0]}_scale") is None:
                _pop(first, f"{absent[0]}_scale")
        else:
            document.warn(f"Mitsuba allows one environment: {first.get('type')} is kept, {other.get('type')} ignored")


def _name_shapes(root: ET.Element) -> None:
    """Give every shape a unique, reproducible id: its own, else the numbered name of its file or its type."""
    taken = {e.get("id", "") for e in root.iter() if e.get("id") and e.tag not in ("shape", "ref")}
    shapes = root.findall("shape")
    shapes.sort(key=lambda s: s.get("id") is None)  # shapes that have an id choose first
    for shape in shapes:
        file, part = _property(shape, "filename"), _property(shape, "shape_index")
        stem = Path(file.get("value", "")).stem if file is not None else shape.get("type", "")
        stem += f"_{part.get('value')}" if part is not None else ""
        base = re.sub(r"\W", "_", shape.get("id") or stem)
        name = unique(base, taken)
        taken.add(name)
        shape.set("id", name)


def unique(name: str, taken: Container[str]) -> str:
    """Return the name, numbered from 2 if it is taken."""
    return next(n for k in itertools.count(1) if (n := name if k == 1 else f"{name}_{k}") not in taken)


def _locate(document: Document, root: ET.Element, folders: list[Path]) -> None:
    """Make all file names absolute and record the missing files."""
    for element in _named_files(root):
        key = "filename" if "filename" in element.attrib else "value"
        name = element.get(key, "")
        file = _find(name, folders)
        if file.is_file():
            document.files.append(file)
        elif name not in document.missing:
            document.missing.append(name)
        element.set(key, str(file.resolve()))


def _named_files(root: ET.Element) -> Iterator[ET.Element]:
    for element in root.iter():
        if (element.tag == "string" and element.get("name") == "filename") or "filename" in element.attrib:
            yield element
