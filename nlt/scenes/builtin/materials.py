"""Materials of the built-in scenes: Mitsuba dicts and procedural textures (linear RGB, (H, W, 3), top row first)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mitsuba as mi
import numpy as np

Vec = Sequence[float]
Bsdf = dict[str, Any]


def rgb(*value: float) -> dict[str, Any]:
    return {"type": "rgb", "value": list(value)}


def texture(image: np.ndarray, nearest: bool = False) -> dict[str, Any]:
    """A repeating texture of linear RGB values (H, W, 3), its first row at the top."""
    bitmap = mi.Bitmap(np.ascontiguousarray(image[::-1], dtype=np.float32))  # Mitsuba's row 0 is v = 0
    return {"type": "bitmap", "bitmap": bitmap, "filter_type": "nearest" if nearest else "bilinear"}


def checks(colour: Vec, other: Vec, count: int = 3) -> dict[str, Any]:
    to_uv = mi.ScalarTransform4f().scale([count, count, 1])
    return {"type": "checkerboard", "color0": rgb(*colour), "color1": rgb(*other), "to_uv": to_uv}


def diffuse(reflectance: dict[str, Any]) -> Bsdf:
    return {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": reflectance}}


def rough_plastic(reflectance: dict[str, Any], alpha: float = 0.15) -> Bsdf:
    bsdf = {"type": "roughplastic", "diffuse_reflectance": reflectance, "alpha": alpha}
    return {"type": "twosided", "bsdf": bsdf}


def metal(material: str = "Al", alpha: float = 0.2) -> Bsdf:
    return {"type": "roughconductor", "material": material, "alpha": alpha}


def mirror() -> Bsdf:
    return {"type": "conductor", "material": "none", "specular_reflectance": rgb(0.92, 0.92, 0.92)}


def glass() -> Bsdf:
    return {"type": "dielectric", "int_ior": 1.5}


def area(radiance: dict[str, Any]) -> dict[str, Any]:
    return {"type": "area", "radiance": radiance}


# ---- textures -------------------------------------------------------------------------------------------


def noise(rng: np.random.Generator, height: int, width: int, fu: float, fv: float) -> np.ndarray:
    """Seamless noise in [-1, 1] of up to about `fu` and `fv` cycles along u and v."""
    spectrum = np.fft.rfft2(rng.standard_normal((height, width)))
    u, v = np.fft.rfftfreq(width) * width, np.fft.fftfreq(height) * height
    spectrum *= np.exp(-((u / fu) ** 2) - ((v[:, None] / fv) ** 2))
    smooth = np.fft.irfft2(spectrum, (height, width))
    return np.clip(smooth / (2 * smooth.std()), -1, 1)


def planks(colour: Vec, rows: int = 12, size: int = 384, seed: int = 0) -> np.ndarray:
    """Wooden boards along u, each with its own tone and grain, with dark joints."""
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
        band *= 1 + 0.12 * noise(rng, height, size, 6, height / 3)
        band[0] *= 0.45
        image[row * height : (row + 1) * height] = band
    return np.clip(image[..., None] * np.asarray(colour), 0, 0.9)


def grain(colour: Vec, size: int = 128, seed: int = 1) -> np.ndarray:
    """Wood with its grain along u."""
    values = noise(np.random.default_rng(seed), size, size, 6, size / 3)
    return (1 + 0.3 * values[..., None]) * np.asarray(colour)


def tiles(colours: Sequence[Vec], count: int = 4, joint: Vec = (0.4, 0.39, 0.37), size: int = 256) -> np.ndarray:
    """count x count square tiles with joints; the colours alternate and vary slightly from tile to tile."""
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:size, :size] * count / size
    row, column = v.astype(int), u.astype(int)
    image = np.asarray(colours)[(row + column) % len(colours)] * rng.uniform(0.88, 1.05, (count, count, 1))[row, column]
    edge = np.maximum(np.abs(v % 1 - 0.5), np.abs(u % 1 - 0.5)) > 0.5 - 3 * count / size / 2
    return np.where(edge[..., None], joint, image)


def bricks(colour: Vec, rows: int = 8, joint: Vec = (0.5, 0.49, 0.47), size: int = 256) -> np.ndarray:
    """Oblong tiles in running bond, twice as long as high."""
    rng = np.random.default_rng(6)
    v, u = np.mgrid[:size, :size] / size
    row = (v * rows).astype(int)
    x = u * rows / 2 + 0.5 * (row % 2)
    tone = rng.uniform(0.88, 1.05, (rows, rows // 2))[row, x.astype(int) % (rows // 2)]
    edge = (np.abs(v * rows % 1 - 0.5) > 0.5 - 1.5 * rows / size) | (np.abs(x % 1 - 0.5) > 0.5 - 0.75 * rows / size)
    return np.where(edge[..., None], joint, tone[..., None] * np.asarray(colour))


def terrazzo(colour: Vec, chips: Sequence[Vec], size: int = 256) -> np.ndarray:
    """Stone with chips of other colours."""
    rng = np.random.default_rng(4)
    image = np.tile(np.asarray(colour, float), (size, size, 1))
    for chip in chips:
        image[noise(rng, size, size, 26, 26) > 0.55] = chip
    return image


def cloth(colour: Vec, threads: int = 32, size: int = 128) -> np.ndarray:
    """A coarse weave."""
    v, u = np.mgrid[:size, :size] * 2 * np.pi * threads / size
    tone = 0.9 + 0.12 * np.sin(u) * np.sin(v) + 0.1 * noise(np.random.default_rng(5), size, size, 40, 6)
    return np.clip(tone[..., None] * np.asarray(colour), 0, 0.95)


def wicker(colour: Vec, count: int = 12, size: int = 192) -> np.ndarray:
    """Basketwork: short strands that alternately pass over and under."""
    v, u = np.mgrid[:size, :size] * count / size
    over = (u.astype(int) + v.astype(int)) % 2 == 0
    tone = 0.35 + 0.65 * np.abs(np.sin(np.pi * np.where(over, v, u)))
    return tone[..., None] * np.asarray(colour)


def stripes(colour: Vec, other: Vec, count: int = 4, size: int = 96) -> np.ndarray:
    """Wallpaper: vertical stripes along u with a row of small diamonds on each."""
    v, u = np.mgrid[:size, :size] / size
    phase = (u * count) % 1
    light = (phase < 0.5) ^ (np.abs(phase - 0.56) < 0.015) ^ (np.abs(phase - 0.94) < 0.015)
    diamond = np.abs(phase - 0.25) * 2 + np.abs((v * count) % 1 - 0.5) < 0.16
    return np.where((light ^ diamond)[..., None], colour, other)


def sprigs(ground: Vec, leaf: Vec, flower: Vec, count: int = 4, size: int = 192) -> np.ndarray:
    """Wallpaper: small flowers in staggered rows."""
    v, u = np.mgrid[:size, :size] * count / size
    x, y = (u + 0.5 * (v.astype(int) % 2)) % 1 - 0.5, v % 1 - 0.5
    angle, radius = np.arctan2(y, x), np.hypot(x, y)
    image = np.where((radius < 0.1 + 0.05 * np.cos(5 * angle))[..., None], flower, ground)
    stalk = (np.abs(x - 0.5 * (y - 0.1) ** 2) < 0.015) & (y > 0.1) & (y < 0.4)
    blades = np.abs(np.hypot(np.abs(x) - 0.08, y - 0.3) - 0.03) < 0.025
    return np.where((stalk | blades)[..., None], leaf, image)


def carpet(colours: Sequence[Vec], size: int = 128) -> np.ndarray:
    """Nested borders around a field of diamonds; colours: field, diamond, border."""
    v, u = np.abs((np.mgrid[:size, :size] + 0.5) / size * 2 - 1)
    edge = np.maximum(u, v)
    diamonds = (np.abs((u * 3) % 1 - 0.5) + np.abs((v * 3) % 1 - 0.5) < 0.3) & (edge < 0.72)
    border = (edge > 0.93) | ((edge > 0.76) & (edge < 0.84))
    return np.asarray(colours)[np.where(border, 2, np.where(diamonds, 1, 0))]


def quilt(colours: Sequence[Vec], count: int = 6, size: int = 192) -> np.ndarray:
    """Patchwork: squares cut into two triangles, with seams."""
    rng = np.random.default_rng(8)
    v, u = np.mgrid[:size, :size] * count / size
    patch = rng.integers(len(colours), size=(count, count, 2))
    image = np.asarray(colours)[patch[v.astype(int), u.astype(int), (u % 1 > v % 1).astype(int)]]
    seam = np.maximum(np.abs(u % 1 - 0.5), np.abs(v % 1 - 0.5)) > 0.47
    return np.where(seam[..., None], 0.7 * image, image)


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


def abstract(size: int = 128) -> np.ndarray:
    """A picture: discs and a beam on paper."""
    v, u = np.mgrid[:size, :size] / size
    image = np.tile(np.array([0.78, 0.74, 0.64]), (size, size, 1))
    image[np.abs(u - 0.3 - 0.4 * v) < 0.035] = (0.05, 0.05, 0.06)
    red, blue, yellow = (0.6, 0.1, 0.06), (0.1, 0.25, 0.5), (0.8, 0.55, 0.1)
    for x, y, radius, colour in ((0.35, 0.35, 0.2, red), (0.66, 0.55, 0.16, blue), (0.4, 0.76, 0.11, yellow)):
        image[np.hypot(u - x, v - y) < radius] = colour
    return image
