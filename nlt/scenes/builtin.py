"""Built-in rooms, made from small parametric furniture functions: no model files, no downloads."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mitsuba as mi
import numpy as np
import trimesh

from nlt.scenes.lanes import owned


@dataclass(frozen=True)
class BuiltinShape:
    """One triangle mesh with its material."""

    mesh: trimesh.Trimesh  # world coordinates, metres, y up; faces outward
    uv: np.ndarray | None  # (V, 2)
    bsdf: dict[str, Any]  # Mitsuba dict; shapes that hold the same dict object share one BSDF
    emitter: dict[str, Any] | None = None  # Mitsuba dict of an area emitter
    smooth: bool = False  # shade with the mesh's vertex normals


Shapes = dict[str, BuiltinShape]
Vec = Sequence[float]
Box = tuple[Vec, Vec]  # centre, size


# ---- materials ------------------------------------------------------------------------------------------


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def texture(image: np.ndarray, nearest: bool = False) -> dict[str, Any]:
    """A repeating texture of linear RGB values (H, W, 3), its first row at the top."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image[::-1], dtype=np.float32))  # Mitsuba's row 0 is v = 0
    return {"type": "bitmap", "bitmap": bitmap, "filter_type": "nearest" if nearest else "bilinear"}


def diffuse(reflectance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def rough_plastic(reflectance: dict[str, Any], alpha: float = 0.15) -> dict[str, Any]:
    bsdf = {"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": alpha}
    return {"type": "twosided", "bsdf": bsdf}


def planks(colour: Vec, rows: int = 12, size: int = 384, seed: int = 0) -> np.ndarray:
    """Wooden boards along u: a tone per board, dark joints and a grain that follows the board."""
    rng = np.random.default_rng(seed)
    image = np.ones((size, size))
    height = size // rows
    for row in range(rows):
        band = np.ones((height, size))
        half, start = size // 2, int(rng.integers(size))
        for board in range(2):
            columns = (start + board * half + np.arange(half)) % size
            band[:, columns] *= rng.uniform(0.7, 1.15)
            band[:, columns[:2]] *= 0.45
        band *= 1 + 0.12 * wood_noise(rng, height, size)
        band[0] *= 0.45
        image[row * height : (row + 1) * height] = band
    return np.clip(image[..., None] * np.asarray(colour), 0, 0.9)


def wood_noise(rng: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Noise stretched along u that repeats without a seam, about -1..1."""
    spectrum = np.fft.rfft2(rng.standard_normal((height, width)))
    fu, fv = np.fft.rfftfreq(width) * width, np.fft.fftfreq(height) * height
    spectrum *= np.exp(-((fu / 6) ** 2) - ((fv[:, None] / (height / 3)) ** 2))
    noise = np.fft.irfft2(spectrum, (height, width))
    return np.clip(noise / (2 * noise.std()), -1, 1)


def grain(colour: Vec, size: int = 128, seed: int = 1) -> np.ndarray:
    noise = wood_noise(np.random.default_rng(seed), size, size)
    return (1 + 0.3 * noise[..., None]) * np.asarray(colour)


def stripes(colour: Vec, other: Vec, count: int = 4, size: int = 96) -> np.ndarray:
    """Wallpaper: vertical stripes along u with a row of small diamonds on each."""
    v, u = np.mgrid[:size, :size] / size
    phase = (u * count) % 1
    light = (phase < 0.5) ^ (np.abs(phase - 0.56) < 0.015) ^ (np.abs(phase - 0.94) < 0.015)
    diamond = np.abs(phase - 0.25) * 2 + np.abs((v * count) % 1 - 0.5) < 0.16
    return np.where((light ^ diamond)[..., None], colour, other)


def carpet(colours: Sequence[Vec], size: int = 128) -> np.ndarray:
    """Nested borders around a field of diamonds; colours: field, diamond, border."""
    v, u = np.abs((np.mgrid[:size, :size] + 0.5) / size * 2 - 1)
    edge = np.maximum(u, v)
    diamonds = (np.abs((u * 3) % 1 - 0.5) + np.abs((v * 3) % 1 - 0.5) < 0.3) & (edge < 0.72)
    border = (edge > 0.93) | ((edge > 0.76) & (edge < 0.84))
    return np.asarray(colours)[np.where(border, 2, np.where(diamonds, 1, 0))]


def landscape(size: int = 128) -> np.ndarray:
    """A picture: a sun over three ridges."""
    v, u = np.mgrid[:size, :size] / size
    sky = 1 - v[..., None]
    image = sky * np.array([0.25, 0.45, 0.75]) + (1 - sky) * np.array([0.9, 0.6, 0.35])
    image[(u - 0.68) ** 2 + (v - 0.32) ** 2 < 0.012] = (0.95, 0.75, 0.2)
    ridges = ((0.5, 7.0, (0.3, 0.35, 0.5)), (0.65, 11.0, (0.15, 0.3, 0.25)), (0.82, 5.0, (0.06, 0.15, 0.08)))
    for i, (level, frequency, colour) in enumerate(ridges):
        image[v > level + 0.07 * np.sin(frequency * u + 2 * i) + 0.03 * np.sin(2.7 * frequency * u)] = colour
    return image


# ---- shapes ---------------------------------------------------------------------------------------------


def quads(
    bsdf: dict[str, Any],
    *corners: tuple[Vec, Vec, Vec],
    tile: float | None = 1.0,
    emitter: dict[str, Any] | None = None,
) -> BuiltinShape:
    """Flat parallelograms (origin, u, v) that face u x v; a texture repeats every `tile` metres or fits."""
    points, uvs = [], []
    square = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], dtype=float)
    for origin, u, v in corners:
        points.append(np.asarray(origin) + square @ np.array([u, v], dtype=float))
        lengths = np.array([np.linalg.norm(u), np.linalg.norm(v)])
        uvs.append(square if tile is None else square * lengths / tile)
    faces = np.array([[0, 1, 2], [0, 2, 3]]) + 4 * np.arange(len(corners))[:, None, None]
    mesh = trimesh.Trimesh(np.concatenate(points), faces.reshape(-1, 3), process=False)
    return BuiltinShape(mesh, np.concatenate(uvs), bsdf, emitter)


def boxes(bsdf: dict[str, Any], *parts: Box, tile: float | None = 1.0) -> BuiltinShape:
    """Flat-shaded boxes (centre, size) as one shape; wood grain (u) runs along a face's longer side."""
    faces = []
    for centre, size in parts:
        half = np.asarray(size) / 2
        for axis in range(3):
            u, v = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] * 2 * half
            normal = np.eye(3)[axis] * half
            for n, a, b in ((normal, u, v), (-normal, v, u)):
                if np.linalg.norm(b) > np.linalg.norm(a):
                    a, b = b, -a  # same normal, longer side first
                faces.append((np.asarray(centre) + n - (a + b) / 2, a, b))
    return quads(bsdf, *faces, tile=tile)


def lathe(bsdf: dict[str, Any], profile: Sequence[tuple[float, float]], at: Vec = (0, 0, 0)) -> BuiltinShape:
    """A solid of revolution about y: profile of (radius, height), upwards along the outside."""
    mesh = trimesh.creation.revolve(np.asarray(profile, dtype=float), sections=32)
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    return smooth(bsdf, mesh, at)


def ball(bsdf: dict[str, Any], radius: float, at: Vec) -> BuiltinShape:
    return smooth(bsdf, trimesh.creation.icosphere(subdivisions=4, radius=radius), at)


def smooth(bsdf: dict[str, Any], mesh: trimesh.Trimesh, at: Vec) -> BuiltinShape:
    """Smooth shading except across edges sharper than 40 degrees."""
    mesh = trimesh.graph.smooth_shade(mesh, angle=np.radians(40), facet_minarea=None)
    mesh.apply_translation(at)
    return BuiltinShape(mesh, None, bsdf, smooth=True)


def legs(width: float, depth: float, height: float, thick: float = 0.05) -> list[Box]:
    x, z = (width - thick) / 2, (depth - thick) / 2
    return [((sx * x, height / 2, sz * z), (thick, height, thick)) for sx in (-1, 1) for sz in (-1, 1)]


def frame(width: float, height: float, border: float, depth: float) -> list[Box]:
    """Four bars around an upright opening, their backs at z = 0."""
    x, y = (width + border) / 2, (height + border) / 2
    bars: list[Box] = [((s * x, 0, depth / 2), (border, height + 2 * border, depth)) for s in (-1, 1)]
    return bars + [((0, s * y, depth / 2), (width, border, depth)) for s in (-1, 1)]


def place(shapes: Shapes, name: str, at: Vec, turn: float = 0.0) -> Shapes:
    """The shapes as `name_part`, turned about y by `turn` degrees and moved."""
    matrix = trimesh.transformations.rotation_matrix(np.radians(turn), [0, 1, 0])
    matrix[:3, 3] = at
    # copied first: trimesh transforms in place
    return {
        f"{name}_{part}": replace(shape, mesh=shape.mesh.copy().apply_transform(matrix))
        for part, shape in shapes.items()
    }


# ---- furniture: at the origin, on the floor, facing +z --------------------------------------------------


def table(wood: dict[str, Any], width: float = 1.3, depth: float = 0.8, height: float = 0.74) -> Shapes:
    under = height - 0.04
    apron: list[Box] = [((0, under - 0.04, s * (depth / 2 - 0.1)), (width - 0.2, 0.08, 0.03)) for s in (-1, 1)]
    return {
        "top": boxes(wood, ((0, height - 0.02, 0), (width, 0.04, depth))),
        "legs": boxes(wood, *legs(width - 0.1, depth - 0.1, under, 0.06), *apron),
    }


def chair(wood: dict[str, Any], fabric: dict[str, Any], size: float = 0.44) -> Shapes:
    back = size / 2 - 0.02
    bars: list[Box] = [((s * back, 0.69, -back), (0.04, 0.46, 0.04)) for s in (-1, 1)]
    bars += [((0, y, -back), (size - 0.08, 0.07, 0.025)) for y in (0.64, 0.76, 0.88)]
    return {
        "frame": boxes(wood, *legs(size, size, 0.42, 0.04), ((0, 0.44, 0), (size, 0.04, size)), *bars),
        "seat": boxes(fabric, ((0, 0.475, 0.02), (size - 0.04, 0.03, size - 0.08))),
    }


def sofa(fabric: dict[str, Any], cushion: dict[str, Any], width: float = 1.9, depth: float = 0.85) -> Shapes:
    arm, seats = 0.18, 2
    inner = width - 2 * arm
    body: list[Box] = [((0, 0.18, 0), (inner, 0.24, depth)), ((0, 0.55, -depth / 2 + 0.1), (inner, 0.5, 0.2))]
    body += [((s * (width - arm) / 2, 0.31, 0), (arm, 0.5, depth)) for s in (-1, 1)]
    body += [
        ((x, 0.03, z), (0.06, 0.06, 0.06))
        for x in (-width / 2 + 0.1, width / 2 - 0.1)
        for z in (-depth / 2 + 0.1, depth / 2 - 0.1)
    ]
    seat = inner / seats
    pads: list[Box] = [
        ((seat * (i - (seats - 1) / 2), 0.37, 0.1), (seat - 0.02, 0.14, depth - 0.2)) for i in range(seats)
    ]
    pillow = boxes(cushion, ((0, 0, 0), (0.4, 0.4, 0.12)), tile=None)
    lean = trimesh.transformations.rotation_matrix(-0.3, [1, 0, 0])
    lean[:3, 3] = (inner / 2 - 0.24, 0.64, -depth / 2 + 0.34)
    return {
        "body": boxes(fabric, *body),
        "pads": boxes(fabric, *pads),
        "pillow": replace(pillow, mesh=pillow.mesh.copy().apply_transform(lean)),
    }


def shelf(
    wood: dict[str, Any],
    colours: Sequence[Vec],
    width: float = 1.0,
    height: float = 1.75,
    depth: float = 0.3,
    boards: int = 5,
    seed: int = 3,
) -> Shapes:
    """An open shelf with a back, and books of random sizes on most of its boards."""
    rng = np.random.default_rng(seed)
    t = 0.025
    inner = width - 2 * t
    parts: list[Box] = [((s * (width - t) / 2, height / 2, 0), (t, height, depth)) for s in (-1, 1)]
    levels = np.linspace(0.08, height - t / 2, boards)
    parts += [((0, y, 0.005), (inner, t, depth - 0.01)) for y in levels]
    parts += [((0, height / 2, -depth / 2 + 0.005), (inner, height, 0.01))]
    books: list[Box] = []
    for level in levels[:-1] + t / 2:
        x, end = -inner / 2 + 0.01, inner / 2 - rng.uniform(0.1, 0.55)
        while x < end:
            w, h, d = rng.uniform([0.02, 0.18, 0.13], [0.055, 0.31, 0.2])
            books.append(((x + w / 2, level + h / 2, 0.02 + (0.2 - d) / 2), (w - 0.002, h, d)))
            x += w
    shape = boxes(diffuse(texture(np.asarray([colours]), nearest=True)), *books)
    pick = rng.integers(len(colours), size=len(books))
    uv = np.stack([(pick + 0.5) / len(colours), np.full(len(books), 0.5)], axis=1)
    return {"frame": boxes(wood, *parts), "books": replace(shape, uv=np.repeat(uv, 24, axis=0))}


def floor_lamp(metal: dict[str, Any], shade: dict[str, Any], height: float = 1.55) -> Shapes:
    pole = [(0, 0), (0.15, 0), (0.15, 0.02), (0.015, 0.035), (0.015, height - 0.1), (0, height - 0.1)]
    low, high = height - 0.3, height
    cone = [(0.205, low), (0.145, high), (0.14, high), (0.2, low), (0.205, low)]
    return {"stand": lathe(metal, pole), "shade": lathe(shade, cone)}


def vase(bsdf: dict[str, Any], height: float = 0.6) -> Shapes:
    t = np.linspace(0, 1, 15)
    radius = height * (0.16 + 0.13 * np.sin(np.pi * t**0.8) - 0.07 * t**2)
    outside = [(0.0, 0.0), *zip(radius, t * height, strict=True)]
    inside = [(r - 0.015, y) for r, y in outside[:3:-2]]
    return {"body": lathe(bsdf, [*outside, *inside, (0.0, inside[-1][1])])}


def hung(bsdf: dict[str, Any], border: dict[str, Any], width: float, height: float) -> Shapes:
    """A picture or mirror in a frame, its middle at the origin, its back at z = 0."""
    return {
        "panel": boxes(bsdf, ((0, 0, 0.0125), (width, height, 0.025)), tile=None),
        "frame": boxes(border, *frame(width, height, 0.05, 0.04)),
    }


# ---- rooms ----------------------------------------------------------------------------------------------


def room(
    size: Vec, floor: dict[str, Any], ceiling: dict[str, Any], walls: Sequence[dict[str, Any]], floor_tile: float = 2.0
) -> Shapes:
    """Six quads that face inward, middle of the floor at the origin; walls: left, right, back, front."""
    x, y, z = size[0] / 2, size[1], size[2] / 2
    e = 0.01  # each quad reaches past the corners, so no ray slips through them
    w, h, d = 2 * (x + e), y + 2 * e, 2 * (z + e)
    left, right, back, front = walls
    return {
        "floor": quads(floor, ((-x - e, 0, z + e), (w, 0, 0), (0, 0, -d)), tile=floor_tile),
        "ceiling": quads(ceiling, ((-x - e, y, -z - e), (w, 0, 0), (0, 0, d))),
        "wall_left": quads(left, ((-x, -e, z + e), (0, 0, -d), (0, h, 0))),
        "wall_right": quads(right, ((x, -e, -z - e), (0, 0, d), (0, h, 0))),
        "wall_back": quads(back, ((-x - e, -e, -z), (w, 0, 0), (0, h, 0))),
        "wall_front": quads(front, ((x + e, -e, z), (-w, 0, 0), (0, h, 0))),
    }


def area_light(width: float, height: float, radiance: Vec, border: dict[str, Any]) -> Shapes:
    """A framed panel that shines towards +z, its back at z = 0.

    The panel is flush with the frame's front: a frame that saw the panel at grazing distance would be
    a small, very bright thing, which one-sample path tracing turns into fireflies.
    """
    emitter = {"type": "area", "radiance": rgb(*radiance)}
    panel = quads(border, ((-width / 2, -height / 2, 0.04), (width, 0, 0), (0, height, 0)), emitter=emitter)
    return {"panel": panel, "frame": boxes(border, *frame(width, height, 0.05, 0.04))}


def living_room() -> Shapes:
    """A living room of 5 x 2.6 x 4 m with a window, a ceiling lamp, a mirror and a glass ball."""
    paint = diffuse(rgb(0.8, 0.8, 0.78))
    paper = diffuse(texture(stripes((0.72, 0.68, 0.56), (0.5, 0.58, 0.5))))
    accent = diffuse(rgb(0.68, 0.36, 0.25))
    boards = rough_plastic(texture(planks((0.5, 0.32, 0.18))), 0.25)
    wood = diffuse(texture(grain((0.42, 0.25, 0.13))))
    blue = diffuse(rgb(0.12, 0.24, 0.42))
    cream = diffuse(rgb(0.8, 0.72, 0.55))
    check = diffuse(
        {
            "type": "checkerboard",
            "color0": rgb(0.8, 0.6, 0.15),
            "color1": rgb(0.75, 0.72, 0.65),
            "to_uv": mi.ScalarTransform4f().scale([3, 3, 1]),
        }
    )
    rug = diffuse(texture(carpet([(0.5, 0.08, 0.07), (0.75, 0.55, 0.25), (0.08, 0.1, 0.25)])))
    picture = diffuse(texture(landscape()))
    metal = {"type": "roughconductor", "material": "Al", "alpha": 0.2}
    mirror = {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.92, 0.92, 0.92)}
    glazed = rough_plastic(rgb(0.05, 0.35, 0.32), 0.1)
    glass = {"type": "dielectric", "int_ior": 1.5}
    books = [
        (0.5, 0.08, 0.06),
        (0.1, 0.22, 0.45),
        (0.75, 0.6, 0.25),
        (0.1, 0.3, 0.15),
        (0.7, 0.68, 0.6),
        (0.3, 0.12, 0.3),
        (0.1, 0.1, 0.12),
    ]

    lamp = area_light(1.0, 1.0, (5.8, 5.0, 4.1), paint)
    down = trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])
    lamp = {part: replace(s, mesh=s.mesh.copy().apply_transform(down)) for part, s in lamp.items()}
    dish = [(0, 0), (0.08, 0), (0.18, 0.07), (0.17, 0.075), (0.07, 0.015), (0, 0.015)]
    stand = boxes(wood, ((0, 0.28, 0), (0.28, 0.56, 0.28)))
    dining = {
        **table(wood),
        "bowl": lathe(glazed, dish, (0.25, 0.74, 0.1)),
        "cup": lathe(cream, [(0, 0), (0.04, 0), (0.045, 0.1), (0, 0.1)], (-0.35, 0.74, -0.15)),
    }
    return {
        **room((5.0, 2.6, 4.0), boards, paint, [accent, cream, paper, paper]),
        **place(area_light(1.5, 1.2, (3.8, 4.5, 5.5), paint), "window", (-0.5, 1.5, -2.0)),
        **place(lamp, "ceiling_lamp", (0, 2.6, 0)),
        "rug": boxes(rug, ((0, 0.004, 0.1), (2.6, 0.008, 1.8)), tile=None),
        **place(dining, "table", (0, 0, -0.2)),
        **place(chair(wood, blue), "chair_1", (-1.0, 0, -0.2), 80),
        **place(chair(wood, blue), "chair_2", (1.0, 0, -0.1), -105),
        **place(sofa(blue, check), "sofa", (-0.3, 0, 1.53), 180),
        **place(shelf(wood, books), "shelf", (-2.34, 0, -0.6), 90),
        **place(floor_lamp(metal, cream), "lamp", (-2.1, 0, 1.55)),
        **place({"plinth": stand, "glass": ball(glass, 0.2, (0, 0.76, 0))}, "ball", (1.9, 0, -1.5)),
        **place(vase(glazed), "vase", (-1.75, 0, -1.6)),
        **place(hung(mirror, wood, 0.9, 1.1), "mirror", (2.5, 1.45, 0.2), -90),
        **place(hung(picture, wood, 0.9, 0.7), "picture", (-0.3, 1.55, 2.0), 180),
    }


BUILTINS: dict[str, Callable[[], Shapes]] = {"living_room": living_room}  # scene name -> shapes by stable id


def mitsuba_scene(name: str) -> mi.Scene:
    """The room as a live Mitsuba scene, in the variant that is set."""
    bsdfs: dict[int, Any] = {}  # by the dict's identity: each BSDF instance costs tracing time
    meshes: dict[str, Any] = {}
    shapes = BUILTINS[name]()
    for key, shape in shapes.items():
        if id(shape.bsdf) not in bsdfs:
            bsdfs[id(shape.bsdf)] = mi.load_dict(shape.bsdf)
        props = mi.Properties()
        props["mesh_bsdf"] = bsdfs[id(shape.bsdf)]
        if shape.emitter is not None:
            props["mesh_emitter"] = mi.load_dict(shape.emitter)
        mesh = mi.Mesh(
            key,
            len(shape.mesh.vertices),
            len(shape.mesh.faces),
            props=props,
            has_vertex_normals=shape.smooth,
            has_vertex_texcoords=shape.uv is not None,
        )
        mesh.set_id(key)
        params = mi.traverse(mesh)
        params["vertex_positions"] = owned(np.asarray(shape.mesh.vertices, np.float32))
        params["faces"] = owned(np.asarray(shape.mesh.faces, np.uint32))
        if shape.uv is not None:
            params["vertex_texcoords"] = owned(np.asarray(shape.uv, np.float32))
        if shape.smooth:
            params["vertex_normals"] = owned(np.asarray(shape.mesh.vertex_normals, np.float32))
        params.update()
        meshes[key] = mesh
    return mi.load_dict({"type": "scene", **meshes})
