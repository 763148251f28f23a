"""Read glTF, GLB and OBJ files as arrays: named parts, each a triangle mesh with a material. Needs no renderer."""

from __future__ import annotations

import base64
import io
import json
import math
import re
import struct
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
import trimesh
from PIL import Image

from nlt.errors import UserError
from nlt.scenes.mitsuba_xml import linear


@dataclass(frozen=True)
class Triangles:
    """A mesh: `vertices` (V, 3), `faces` (F, 3); `normals` (V, 3) or None, `uv` (V, 2) or None; v = 0 is at the top."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uv: np.ndarray | None = None

    def moved(self, matrix: np.ndarray) -> Triangles:
        """Return the mesh transformed by a matrix (4, 4); a mirrored mesh keeps its front."""
        linear = matrix[:3, :3]
        determinant, normals = np.linalg.det(linear), self.normals
        if normals is not None and abs(determinant) > 1e-20:
            normals = normals @ np.linalg.inv(linear)
            normals = normals / np.linalg.norm(normals, axis=1, keepdims=True).clip(1e-20)
        faces = self.faces if determinant >= 0 else self.faces[:, ::-1]
        return Triangles(self.vertices @ linear.T + matrix[:3, 3], faces, normals, self.uv)


@dataclass
class Material:
    """A metallic-roughness material (glTF 2.0, Appendix B), colours linear; images multiply the factors above them."""

    colour: tuple[float, ...] = (0.8, 0.8, 0.8)
    image: Image.Image | None = None
    alpha: float = 1.0
    alpha_image: Image.Image | None = None
    cutoff: float | None = None  # opacity below it counts as 0, all other opacity as 1
    metallic: float = 0.0
    roughness: float = 1.0
    rough_image: Image.Image | None = None  # roughness in green, metallic in blue
    transmission: float = 0.0
    thin: bool = True  # a sheet that does not refract light
    ior: float = 1.5
    emission: tuple[float, ...] = (0.0, 0.0, 0.0)
    emission_image: Image.Image | None = None


@dataclass
class Model:
    """A model: `parts` in the order of the file, and point lights `lamps` as name, position and intensity (W/sr)."""

    parts: list[tuple[str, Triangles, Material]] = field(default_factory=list)
    lamps: list[tuple[str, np.ndarray, np.ndarray]] = field(default_factory=list)
    warnings: Counter[str] = field(default_factory=Counter)


def named_files(path: Path) -> list[str]:
    """Return the names of the files that a model refers to, as written in it: buffers, images, material libraries."""
    if path.suffix.lower() == ".obj":
        libraries = [words for words in _lines(path) if words[0] == "mtllib"]
        names = [" ".join(words[1:]) for words in libraries]
        files = [path.parent / name for name in names]
        inner = [words for f in files if f.is_file() for words in _lines(f) if words[0].lower() in _MAPS]
        return [*names, *sorted({words[-1].replace("\\", "/") for words in inner})]
    header = _gltf_header(path)
    uris = [part.get("uri", "") for key in ("buffers", "images") for part in header.get(key, [])]
    return [unquote(uri) for uri in uris if uri and not uri.startswith("data:")]


def read_gltf(path: Path) -> Model:
    """Read the default scene of a glTF 2.0 or GLB file, with its transforms applied.

    Raises:
        UserError: the file is not valid glTF 2.0.
    """
    header = _gltf_header(path)
    model, materials = Model(), header.get("materials", [])
    for k, material in enumerate(materials):
        material["name"] = str(k)  # identifies the material of a loaded part
    for part in (*header.get("buffers", []), *header.get("images", [])):
        if not part.get("uri", "data:").startswith("data:"):
            part["uri"] = unquote(part["uri"])  # trimesh opens the file of this name
    lamps = _gltf_lamps(header, model)
    try:
        loaded = trimesh.load_scene(
            io.BytesIO(json.dumps(header).encode()),
            file_type="gltf",
            resolver=trimesh.resolvers.FilePathResolver(str(path)),
            process=False,
        )
    except Exception as error:  # a broken file can make trimesh raise any exception
        raise UserError(f"{path}: not readable as glTF 2.0: {type(error).__name__}: {error}") from None
    converted = [_gltf_material(m, model) for m in materials]
    placed = [(_part_name(loaded.graph, node), *loaded.graph[node]) for node in loaded.graph.nodes_geometry]
    for name, matrix, geometry in sorted(placed, key=lambda part: (part[0], part[2])):
        mesh = loaded.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh):
            model.warnings[f"{name} consists of points or lines and is ignored"] += 1
            continue
        material, uv = _gltf_surface(mesh.visual, materials, converted, model)
        normals = np.asarray(mesh.vertex_normals) if "vertex_normals" in mesh._cache.cache else None
        triangles = Triangles(np.asarray(mesh.vertices, float), np.asarray(mesh.faces), normals, uv)
        model.parts.append((name, triangles.moved(matrix), material))
    for node, (name, intensity) in lamps.items():
        if node in loaded.graph.nodes:
            model.lamps.append((name, loaded.graph[node][0][:3, 3], intensity))
    return model


def _gltf_header(path: Path) -> dict[str, Any]:
    """Return the JSON header; the binary part of a GLB file becomes a data URI in it."""
    data, binary = path.read_bytes(), b""
    if path.suffix.lower() == ".glb":
        if data[:4] != b"glTF" or len(data) < 20:
            raise UserError(f"{path}: not a GLB file: it does not start with glTF")
        (length,) = struct.unpack("<I", data[12:16])
        data, binary = data[20 : 20 + length], data[28 + length :]
    try:
        header = json.loads(data)
        assert isinstance(header, dict) and header["asset"]["version"].startswith("2")
    except (ValueError, AssertionError, LookupError, TypeError, AttributeError):
        raise UserError(f"{path}: not a glTF 2.0 file") from None
    if binary and header.get("buffers"):
        header["buffers"][0]["uri"] = f"data:application/octet-stream;base64,{base64.b64encode(binary).decode()}"
    return header


def _gltf_lamps(header: dict[str, Any], model: Model) -> dict[str, tuple[str, np.ndarray]]:
    """Give every light of KHR_lights_punctual a node of its own; return name and intensity (3,) by node."""
    lights = header.get("extensions", {}).get("KHR_lights_punctual", {}).get("lights", [])
    nodes, lamps = header.get("nodes", []), {}
    for k, node in enumerate(list(nodes)):
        index = node.get("extensions", {}).get("KHR_lights_punctual", {}).get("light")
        if index is None or index >= len(lights):
            continue
        light = lights[index]
        if light.get("type") == "directional":
            model.warnings["a directional light is ignored: nlt has only area lights and environments"] += 1
            continue
        if light.get("type") == "spot":
            model.warnings["a spot light is treated as a point light"] += 1
        own = f"KHR_lights_punctual {k}"
        node["children"] = [*node.get("children", []), len(nodes)]
        nodes.append({"name": own})
        intensity = light.get("intensity", 1.0) * np.array(light.get("color", [1.0, 1.0, 1.0]))
        lamps[own] = node.get("name", light.get("name", f"light_{k}")), intensity
    return lamps


def _part_name(graph: Any, node: str) -> str:
    """Return a node's name, without the random suffix that trimesh gives to parts of meshes of several materials."""
    parent = graph.transforms.parents.get(node, "")
    return parent if re.fullmatch(re.escape(parent) + r"_\w{6}", node) else node


def _gltf_surface(
    visual: Any, materials: list[dict[str, Any]], converted: list[Material], model: Model
) -> tuple[Material, np.ndarray | None]:
    """Return the material and the texture coordinates (V, 2) or None of a loaded part."""
    if isinstance(visual, trimesh.visual.ColorVisuals) and visual.kind == "vertex":
        model.warnings["vertex colours are replaced by their mean"] += 1
        return Material(tuple(linear(np.asarray(visual.vertex_colors)[:, :3].mean(0) / 255))), None
    if not isinstance(visual, trimesh.visual.TextureVisuals):
        return Material((1.0, 1.0, 1.0)), None
    uv = None if visual.uv is None else np.asarray(visual.uv, float) * [1, -1] + [0, 1]
    if not (visual.material.name or "").isdigit():
        return Material((1.0, 1.0, 1.0)), uv
    source = int(visual.material.name)
    material, loaded = converted[source], visual.material
    assert isinstance(loaded, trimesh.visual.material.PBRMaterial)
    material.image, material.rough_image = loaded.baseColorTexture, loaded.metallicRoughnessTexture
    material.emission_image = loaded.emissiveTexture
    if material.image is not None and loaded.alphaMode in ("MASK", "BLEND") and "A" in material.image.getbands():
        material.alpha_image = material.image.getchannel("A")
    if "baseColorTexture" in materials[source].get("pbrMetallicRoughness", {}) and material.image is None:
        model.warnings["an unreadable image is ignored"] += 1
    return material, None if uv is None else _texture_transform(materials[source], uv)


def _gltf_material(data: dict[str, Any], model: Model) -> Material:
    pbr, extensions = data.get("pbrMetallicRoughness", {}), data.get("extensions", {})
    colour = pbr.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    mode = data.get("alphaMode", "OPAQUE")
    known = ("ior", "emissive_strength", "transmission", "volume", "unlit")
    for name in extensions:
        if name.removeprefix("KHR_materials_") not in known:
            model.warnings[f"{name} is ignored"] += 1
    if "normalTexture" in data:
        model.warnings["normal maps are ignored"] += 1
    return Material(
        colour=tuple(colour[:3]),
        alpha=1.0 if mode == "OPAQUE" else colour[3],
        cutoff=data.get("alphaCutoff", 0.5) if mode == "MASK" else None,
        metallic=pbr.get("metallicFactor", 1.0),
        roughness=pbr.get("roughnessFactor", 1.0),
        transmission=extensions.get("KHR_materials_transmission", {}).get("transmissionFactor", 0.0),
        thin=not extensions.get("KHR_materials_volume", {}).get("thicknessFactor", 0.0),
        ior=extensions.get("KHR_materials_ior", {}).get("ior", 1.5),
        emission=tuple(strength * np.array(data.get("emissiveFactor", [0.0, 0.0, 0.0]))),
    )


def _texture_transform(material: dict[str, Any], uv: np.ndarray) -> np.ndarray:
    """Apply the KHR_texture_transform of one texture, which all textures of the material then share."""
    candidates = (material.get("pbrMetallicRoughness", {}).get("baseColorTexture"), material.get("emissiveTexture"))
    texture: dict[str, Any] = next((p for p in candidates if p), {})
    transform = texture.get("extensions", {}).get("KHR_texture_transform", {})
    angle = transform.get("rotation", 0.0)
    rotation_matrix = np.array([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    return uv * transform.get("scale", [1, 1]) @ rotation_matrix.T + transform.get("offset", [0, 0])


# OBJ files are parsed here because trimesh joins all parts of one material and loses the texture coordinates of quads.
_MAPS = {"map_kd": "image", "map_d": "alpha_image", "map_ke": "emission_image"}
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)


def _lines(path: Path) -> Iterator[list[str]]:
    """Yield the words of every line that has any; a backslash at its end joins a line with the next."""
    text = path.read_text(errors="replace").replace("\\\n", " ")
    return (words for line in text.splitlines() if (words := line.split("#")[0].split()))


def read_obj(path: Path) -> Model:
    """Read a Wavefront OBJ file and its materials, with one part per object or group and material.

    Raises:
        UserError: a number or an index is invalid.
    """
    model, materials = Model(), dict[str, Material]()
    arrays: dict[str, list[list[float]]] = {"v": [], "vt": [], "vn": []}
    parts: dict[tuple[str, str], list[list[tuple[int, ...]]]] = {}
    name, material_name = path.stem, ""
    try:
        for words in _lines(path):
            match words[0]:
                case "v" | "vt" | "vn":
                    arrays[words[0]].append([float(w) for w in words[1 : 3 if words[0] == "vt" else 4]])
                case "o" | "g" if len(words) > 1:
                    name = "_".join(words[1:])
                case "usemtl":
                    material_name = " ".join(words[1:])
                case "mtllib":
                    materials |= _read_mtl(path.parent / " ".join(words[1:]), model)
                case "f":
                    corners = [_corner(w, arrays) for w in words[1:]]
                    fan = [[corners[0], *corners[k : k + 2]] for k in range(1, len(corners) - 1)]
                    parts.setdefault((name, material_name), []).extend(fan)
        for (name, material_name), faces in parts.items():
            if material_name not in materials:
                model.warnings[f"material {material_name or '(none)'} is not in the MTL files: replaced by grey"] += 1
            unique, inverse = np.unique(np.array(faces).reshape(-1, 3), axis=0, return_inverse=True)
            vertices, uv, normals = (
                np.array([array[k] for k in indices]) if (indices >= 0).all() else None
                for indices, array in zip(unique.T, arrays.values(), strict=True)
            )
            if vertices is None:
                raise ValueError("a face without vertices")
            # In OBJ, v = 0 is the bottom row of an image.
            uv = None if uv is None else uv * [1, -1] + [0, 1]
            triangles = Triangles(vertices, inverse.reshape(-1, 3), normals, uv)
            model.parts.append((name, triangles, materials.get(material_name, Material())))
    except (ValueError, IndexError) as error:
        raise UserError(f"{path}: not readable as OBJ: {error}") from None
    return model


def _corner(word: str, arrays: dict[str, list[list[float]]]) -> tuple[int, ...]:
    """Return the indices (v, vt, vn) from 0, or -1 if absent. Negative indices in the file count from the end."""
    fields = [*word.split("/"), "", ""][:3]
    indices = []
    for text, array in zip(fields, arrays.values(), strict=True):
        index = int(text) if text else 0
        indices.append(index - 1 if index > 0 else len(array) + index if index < 0 else -1)
    return tuple(indices)


def _read_mtl(path: Path, model: Model) -> dict[str, Material]:
    materials: dict[str, Material] = {}
    raw: dict[str, dict[str, list[str]]] = {}
    for words in _lines(path):
        if words[0] == "newmtl":
            raw[" ".join(words[1:])] = current = {}
        elif raw:
            current[words[0].lower()] = words[1:]
    for name, data in raw.items():
        numbers = {key: [float(w) for w in words[:3] if _NUMBER.fullmatch(w)] for key, words in data.items()}
        number = lambda key, default, numbers=numbers: numbers.get(key) or default
        opacity = number("d", [1 - number("tr", [0.0])[0]])[0]
        illumination, shininess = int(number("illum", [2])[0]), number("ns", [0.0])[0]
        shine = max(number("ks", [0.0]))
        glass = illumination in (4, 6, 7, 9) and (opacity < 1 or max(number("kd", [0.8])) < 0.2)
        mirror = illumination in (3, 5, 8) and not glass
        ior = number("ni", [1.5])[0]
        material = Material(colour=tuple(number("kd", [0.8] * 3)), ior=ior if ior > 1.01 else 1.5, alpha=opacity)
        material.emission = tuple(number("ke", [0.0] * 3))
        if glass:
            material.colour, material.alpha = (1.0, 1.0, 1.0), 1.0
            material.transmission, material.thin, material.roughness = 1.0, False, 0.0
        elif mirror:
            material.colour, material.metallic, material.roughness = tuple(number("ks", [1.0] * 3)), 1.0, 0.0
        elif shine > 0.01 and shininess > 1:
            material.roughness = float((2 / (shininess + 2)) ** 0.25)  # a highlight of the same width
        for key, attribute in _MAPS.items():
            if key in data:
                image = Image.open(path.parent / data[key][-1].replace("\\", "/"))
                setattr(material, attribute, image.convert("L") if key == "map_d" else image)
        for key in set(data) & {"bump", "map_bump", "norm", "map_ks", "map_ns", "refl", "disp"}:
            model.warnings[f"{key} of OBJ materials is ignored"] += 1
        if material.image is not None:
            material.colour = (1.0, 1.0, 1.0)
        materials[name] = material
    return materials
