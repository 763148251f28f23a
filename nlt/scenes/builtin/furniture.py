"""Furniture of the built-in scenes: at the origin, on the floor, facing +z; hanging pieces have backs at z = 0."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from nlt.scenes.builtin.materials import Bsdf, Vec, area, diffuse, rgb, texture
from nlt.scenes.builtin.shapes import (
    Box,
    BuiltinShape,
    Shapes,
    ball,
    boxes,
    disc,
    join,
    lathe,
    quads,
    ring,
    rod,
    rounded,
    transform,
)

BOOKS = ((0.5, 0.08, 0.06), (0.1, 0.22, 0.45), (0.75, 0.6, 0.25), (0.1, 0.3, 0.15), (0.7, 0.68, 0.6), (0.3, 0.12, 0.3),
         (0.1, 0.1, 0.12))  # fmt: skip


def legs(width: float, depth: float, height: float, thick: float = 0.05) -> list[Box]:
    x, z = (width - thick) / 2, (depth - thick) / 2
    return [((sx * x, height / 2, sz * z), (thick, height, thick)) for sx in (-1, 1) for sz in (-1, 1)]


def frame(width: float, height: float, border: float, depth: float) -> list[Box]:
    """Four bars around an upright opening, with their backs at z = 0."""
    x, y = (width + border) / 2, (height + border) / 2
    bars: list[Box] = [((s * x, 0, depth / 2), (border, height + 2 * border, depth)) for s in (-1, 1)]
    return bars + [((0, s * y, depth / 2), (width, border, depth)) for s in (-1, 1)]


# ---- the room -------------------------------------------------------------------------------------------


def room(size: Vec, floor: Bsdf, ceiling: Bsdf, walls: Sequence[Bsdf], floor_tile: float = 2.0) -> Shapes:
    """Six quads that face inward, with the middle of the floor at the origin; walls: left, right, back, front."""
    x, y, z = size[0] / 2, size[1], size[2] / 2
    e = 0.01  # each quad extends past the corners, so that no ray slips through them
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


def skirting(bsdf: Bsdf, size: Vec, height: float = 0.08) -> BuiltinShape:
    """A board along the foot of all walls of a room."""
    x, z, y = size[0] / 2, size[2] / 2, height / 2
    along: list[Box] = [((0, y, s * (z - 0.006)), (size[0], height, 0.012)) for s in (-1, 1)]
    return boxes(bsdf, *along, *[((s * (x - 0.006), y, 0), (0.012, height, size[2] - 0.026)) for s in (-1, 1)])


def area_light(width: float, height: float, light: Vec, border: Bsdf) -> Shapes:
    """A framed panel that shines towards +z.

    The panel is flush with the front of the frame. Otherwise it would light the inner side of the frame from a very
    short distance, and one-sample path tracing would turn these small, very bright areas into fireflies.
    """
    panel = quads(border, ((-width / 2, -height / 2, 0.04), (width, 0, 0), (0, height, 0)), emitter=area(rgb(*light)))
    return {"panel": panel, "frame": boxes(border, *frame(width, height, 0.05, 0.04))}


def ceiling_light(width: float, depth: float, light: Vec, border: Bsdf) -> Shapes:
    """A framed panel that shines down, with its top at the origin."""
    return {k: transform(s, turn=90, axis=(1, 0, 0)) for k, s in area_light(width, depth, light, border).items()}


def window(
    width: float,
    height: float,
    border: Bsdf,
    pane: Bsdf,
    sky: Vec,
    grid: tuple[int, int] = (2, 2),
    trees: Bsdf | None = None,
) -> Shapes:
    """Shining panes of total size width x height, with mullions and a sill, centred at the origin.

    `trees` stand in front of the sky and do not shine. The mullions are flush with the panes, see `area_light`.
    """
    (nx, ny), bar = grid, 0.045
    w, h = width / nx, height / ny
    x1, y1 = (width + (nx - 1) * bar) / 2, (height + (ny - 1) * bar) / 2
    columns = 1 if trees is None else 40
    bright: list[tuple[Vec, Vec, Vec]] = []
    dark: list[Box] = []
    for left, low, k in product(np.arange(nx) * (w + bar) - x1, np.arange(ny) * (h + bar) - y1, range(columns)):
        c = w / columns
        x = left + k * c
        skyline = y1 * (0.45 * np.sqrt(np.abs(np.sin(6 * x + 1))) + 0.2 * np.sin(2 * x) + 0.03 * np.sin(70 * x) - 0.8)
        top = float(np.clip(skyline, low, low + h)) if trees else low
        if top > low:
            dark.append(((x + c / 2, (low + top) / 2, 0.038), (c, top - low, 0.004)))
        if top < low + h:
            bright.append(((x, top, 0.04), (c, 0, 0), (0, low + h - top, 0)))
    bars: list[Box] = frame(2 * x1, 2 * y1, 0.06, 0.045)
    bars += [((i * (w + bar) - x1 - bar / 2, 0, 0.02), (bar, 2 * y1, 0.04)) for i in range(1, nx)]
    bars += [
        ((i * (w + bar) - x1 + w / 2, j * (h + bar) - y1 - bar / 2, 0.02), (w, bar, 0.04))
        for i in range(nx)
        for j in range(1, ny)
    ]
    sill: Box = ((0, -y1 - 0.075, 0.08), (2 * x1 + 0.24, 0.03, 0.16))
    shapes = {"panel": quads(pane, *bright, emitter=area(rgb(*sky))), "frame": boxes(border, *bars, sill)}
    return shapes if trees is None else {**shapes, "trees": boxes(trees, *dark)}


def door(leaf: Bsdf, border: Bsdf, handle: Bsdf, width: float = 0.85, height: float = 2.05) -> Shapes:
    """A door with four panels in its frame."""
    w, y = width / 2, height / 2
    jambs: list[Box] = [((s * (w + 0.035), y, 0.03), (0.07, height, 0.06)) for s in (-1, 1)]
    fields: list[Box] = [
        ((s * width * 0.22, height * c, 0.03), (width * 0.3, height * h, 0.025))
        for s in (-1, 1)
        for c, h in ((0.28, 0.36), (0.74, 0.38))
    ]
    knob = rod(handle, (w - 0.07, 1.0, 0.03), (w - 0.07, 1.0, 0.08), 0.01)
    lever = rod(handle, (w - 0.06, 1.0, 0.085), (w - 0.19, 1.0, 0.085), 0.01)
    return {
        "leaf": boxes(leaf, ((0, y, 0.015), (width, height, 0.03)), *fields),
        "frame": boxes(border, *jambs, ((0, height + 0.035, 0.03), (width + 0.14, 0.07, 0.06))),
        "handle": join(knob, lever),
    }


def curtain(fabric: Bsdf, width: float, height: float, folds: int = 7) -> BuiltinShape:
    """A curtain of hanging folds, with its top at the origin."""
    radius = 0.62 * width / folds
    profile = [(0, -height), (1.25 * radius, -height), (radius, 0), (0, 0)]
    places = [(x, 0, 0.06 + 0.015 * (k % 2)) for k, x in enumerate(_spread(width, folds))]
    return join(*(lathe(fabric, profile, at, sections=16) for at in places))


def curtains(fabric: Bsdf, pole: Bsdf, opening: float, width: float, height: float) -> Shapes:
    """Two curtains and their pole, whose middle is above the origin."""
    x = (opening + width) / 2
    end = opening / 2 + width + 0.08
    knobs = [ball(pole, 0.03, (s * end, 0.02, 0.065), subdivisions=2) for s in (-1, 1)]
    return {
        "cloth": join(*(transform(curtain(fabric, width, height), (s * x, 0, 0)) for s in (-1, 1))),
        "pole": join(rod(pole, (-end, 0.02, 0.065), (end, 0.02, 0.065), 0.015), *knobs),
    }


def hung(bsdf: Bsdf, border: Bsdf, width: float, height: float) -> Shapes:
    """A picture or mirror in a frame, centred at the origin."""
    return {
        "panel": boxes(bsdf, ((0, 0, 0.0125), (width, height, 0.025)), tile=None),
        "frame": boxes(border, *frame(width, height, 0.05, 0.04)),
    }


def radiator(paint: Bsdf, width: float = 1.0, height: float = 0.55) -> BuiltinShape:
    """A radiator: ribs on two pipes and brackets."""
    count = int(width / 0.07)
    parts: list[Box] = [((x, 0.12 + height / 2, 0.06), (0.05, height, 0.08)) for x in _spread(width, count)]
    parts += [((0, 0.12 + y, 0.06), (width - 0.03, 0.04, 0.04)) for y in (0.05, height - 0.05)]
    return boxes(paint, *parts, *[((s * 0.35 * width, 0.3, 0.02), (0.03, 0.06, 0.04)) for s in (-1, 1)])


def _spread(width: float, count: int) -> np.ndarray:
    """The middles of `count` equal parts of a width."""
    return ((np.arange(count) + 0.5) / count - 0.5) * width


def clock(face: Bsdf, dark: Bsdf, radius: float = 0.15) -> Shapes:
    r = radius
    disc = lathe(face, [(0, 0), (r - 0.01, 0), (r - 0.01, 0.02), (0, 0.02)])
    upright = lambda shape: transform(shape, turn=90, axis=(1, 0, 0))
    hours = [
        transform(boxes(dark, ((0, 0.8 * r, 0.021), (0.01, 0.03, 0.004))), turn=30.0 * k, axis=(0, 0, 1))
        for k in range(12)
    ]
    hands = [
        transform(boxes(dark, ((0, 0.4 * r * s, 0.024), (0.012, 0.8 * r * s, 0.004))), turn=t, axis=(0, 0, 1))
        for s, t in ((0.65, 55), (1, -60))
    ]
    return {"face": upright(disc), "hands": join(upright(ring(dark, r, 0.012, 0.035)), *hours, *hands)}


def radiator_rail(steel: Bsdf, width: float = 0.5, height: float = 1.1) -> BuiltinShape:
    """A ladder of bars for towels, with its foot at the origin."""
    posts = [rod(steel, (s * width / 2, 0, 0.06), (s * width / 2, height, 0.06), 0.018) for s in (-1, 1)]
    levels = [y for y in np.linspace(0.06, height - 0.06, 9) if abs(y - 0.55) > 0.1]
    bars = [rod(steel, (-width / 2, y, 0.06), (width / 2, y, 0.06), 0.011) for y in levels]
    return join(*posts, *bars, *(boxes(steel, ((s * width / 2, 0.9, 0.03), (0.02, 0.02, 0.06))) for s in (-1, 1)))


# ---- tables, seats, cupboards ---------------------------------------------------------------------------


def table(wood: Bsdf, width: float = 1.3, depth: float = 0.8, height: float = 0.74) -> Shapes:
    under = height - 0.04
    apron: list[Box] = [((0, under - 0.04, s * (depth / 2 - 0.1)), (width - 0.2, 0.08, 0.03)) for s in (-1, 1)]
    return {
        "top": boxes(wood, ((0, height - 0.02, 0), (width, 0.04, depth))),
        "legs": boxes(wood, *legs(width - 0.1, depth - 0.1, under, 0.06), *apron),
    }


def chair(wood: Bsdf, fabric: Bsdf, size: float = 0.44) -> Shapes:
    back = size / 2 - 0.02
    bars: list[Box] = [((s * back, 0.69, -back), (0.04, 0.46, 0.04)) for s in (-1, 1)]
    bars += [((0, y, -back), (size - 0.08, 0.07, 0.025)) for y in (0.64, 0.76, 0.88)]
    return {
        "frame": boxes(wood, *legs(size, size, 0.42, 0.04), ((0, 0.44, 0), (size, 0.04, size)), *bars),
        "seat": boxes(fabric, ((0, 0.475, 0.02), (size - 0.04, 0.03, size - 0.08))),
    }


def stool(wood: Bsdf, height: float = 0.45, radius: float = 0.17) -> Shapes:
    seat = lathe(wood, [(0, height - 0.035), (radius, height - 0.035), (radius, height), (0, height)])
    feet = [(0.85 * radius * np.cos(a), 0.85 * radius * np.sin(a)) for a in np.pi * (0.25 + np.arange(4) / 2)]
    posts = [rod(wood, (x, 0.002, z), (0.7 * x, height - 0.02, 0.7 * z), 0.016) for x, z in feet]
    return {"wood": join(seat, *posts)}


def sofa(fabric: Bsdf, cushion: Bsdf, width: float = 1.9, depth: float = 0.85, seats: int = 2) -> Shapes:
    """A sofa; with one seat, an armchair."""
    arm = 0.18
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
    pillow = rounded(cushion, ((0, 0, 0), (0.42, 0.42, 0.15)), radius=0.16, tile=0.42)
    return {
        "body": rounded(fabric, *body, radius=0.05, subdivisions=2),
        "pads": rounded(fabric, *pads, radius=0.05, subdivisions=2),
        "pillow": transform(pillow, (inner / 2 - 0.24, 0.64, -depth / 2 + 0.34), np.degrees(-0.3), (1, 0, 0)),
    }


def cupboard(
    body: Bsdf,
    front: Bsdf,
    handle: Bsdf,
    size: Vec,
    columns: int = 2,
    rows: int = 1,
    plinth: float = 0.08,
) -> Shapes:
    """A carcass with columns x rows doors, or drawers if wider than high; back at z = -depth/2."""
    width, height, depth = size
    w, h, z = width / columns, (height - plinth) / rows, depth / 2 - 0.01
    fronts: list[Box] = []
    pulls: list[Box] = []
    for i, x in enumerate(_spread(width, columns)):
        for y in plinth + (height - plinth) / 2 + _spread(height - plinth, rows):
            fronts.append(((x, y, z), (w - 0.012, h - 0.012, 0.02)))
            if w >= h:
                pulls.append(((x, y + 0.25 * h, z + 0.03), (min(0.16, 0.6 * w), 0.014, 0.04)))
            else:
                side = 1 if i % 2 == 0 else -1  # doors open in pairs
                up = 0.3 if plinth else -0.3  # a cupboard on the wall is opened from below
                pulls.append(((x + side * (w / 2 - 0.04), y + up * h, z + 0.03), (0.014, 0.16, 0.04)))
    carcass: list[Box] = [((0, (height + plinth) / 2, -0.01), (width, height - plinth, depth - 0.02))]
    if plinth:
        carcass.append(((0, plinth / 2, -0.03), (width - 0.04, plinth, depth - 0.08)))
    return {"body": boxes(body, *carcass), "front": boxes(front, *fronts), "handles": boxes(handle, *pulls)}


def shelf(
    wood: Bsdf,
    colours: Sequence[Vec] = BOOKS,
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
    spines: list[Box] = []
    for level in levels[:-1] + t / 2:
        x, end = -inner / 2 + 0.01, inner / 2 - rng.uniform(0.1, 0.55)
        while x < end:
            w, h, d = rng.uniform([0.02, 0.18, 0.13], [0.055, 0.31, 0.2])
            spines.append(((x + w / 2, level + h / 2, 0.02 + (0.2 - d) / 2), (w - 0.002, h, d)))
            x += w
    return {"frame": boxes(wood, *parts), "books": _coloured(spines, colours, rng)}


def books(count: int = 4, seed: int = 5) -> BuiltinShape:
    """A pile of books."""
    rng = np.random.default_rng(seed)
    pile, y = [], 0.0
    for _ in range(count):
        w, h, d = rng.uniform([0.2, 0.02, 0.14], [0.27, 0.045, 0.19])
        pile.append(((rng.uniform(-0.02, 0.02), y + h / 2, rng.uniform(-0.01, 0.01)), (w, h, d)))
        y += h
    return _coloured(pile, BOOKS, rng)


def _coloured(parts: Sequence[Any], colours: Sequence[Vec], rng: np.random.Generator) -> BuiltinShape:
    """Boxes of random colours, as one shape with one texture."""
    shape = boxes(diffuse(texture(np.asarray([colours]), nearest=True)), *parts)
    pick = rng.integers(len(colours), size=len(parts))
    uv = np.stack([(pick + 0.5) / len(colours), np.full(len(parts), 0.5)], axis=1)
    return replace(shape, uv=np.repeat(uv, 24, axis=0))


def wall_shelf(wood: Bsdf, width: float = 0.9, depth: float = 0.2, boards: int = 2, step: float = 0.35) -> BuiltinShape:
    """Boards on brackets, with the top of the lowest board at the origin."""
    parts: list[Box] = []
    for y in step * np.arange(boards):
        parts.append(((0, y - 0.0125, depth / 2), (width, 0.025, depth)))
        parts += [((s * width * 0.4, y - 0.07, 0.4 * depth), (0.02, 0.09, 0.7 * depth)) for s in (-1, 1)]
    return boxes(wood, *parts)


def bed(wood: Bsdf, linen: Bsdf, cover: Bsdf, width: float = 1.6, length: float = 2.05) -> Shapes:
    """A bed with its head at the back."""
    w, z = width / 2, length / 2
    parts: list[Box] = [((0, 0.22, 0), (width, 0.16, length)), ((0, 0.5, -z - 0.03), (width + 0.06, 1.0, 0.06))]
    pillows: list[Box] = [((s * w / 2, 0.6, -z + 0.27), (w - 0.12, 0.16, 0.42)) for s in (-1, 1)]
    return {
        "frame": boxes(wood, *parts, *legs(width, length, 0.14, 0.08)),
        "mattress": rounded(linen, ((0, 0.41, 0), (width - 0.04, 0.24, length - 0.04)), radius=0.06),
        "cover": rounded(cover, ((0, 0.43, 0.31), (width + 0.06, 0.28, length - 0.58)), radius=0.09, tile=1.2),
        "pillows": rounded(linen, *pillows, radius=0.2),
    }


# ---- lamps ----------------------------------------------------------------------------------------------


def shade(bsdf: Bsdf, low: float, high: float, bottom: float, top: float, light: Vec | None = None) -> BuiltinShape:
    """A lampshade given by two heights and their radii. With a radiance it glows, large and dim, without fireflies."""
    cone = [(bottom + 0.005, low), (top + 0.005, high), (top, high), (bottom, low), (bottom + 0.005, low)]
    return replace(lathe(bsdf, cone), emitter=None if light is None else area(rgb(*light)))


def floor_lamp(steel: Bsdf, cloth: Bsdf, height: float = 1.55) -> Shapes:
    pole = [(0, 0), (0.15, 0), (0.15, 0.02), (0.015, 0.035), (0.015, height - 0.1), (0, height - 0.1)]
    return {"stand": lathe(steel, pole), "shade": shade(cloth, height - 0.3, height, 0.2, 0.14)}


def table_lamp(foot: Bsdf, cloth: Bsdf, light: Vec, height: float = 0.45) -> Shapes:
    """A glowing shade on a bulbous foot."""
    bulb = [(0, 0), (0.07, 0), (0.07, 0.015), (0.03, 0.03), (0.06, 0.1), (0.05, 0.16), (0.012, 0.21)]
    top = height - 0.04
    return {
        "foot": lathe(foot, [*bulb, (0.012, top), (0, top)]),
        "shade": shade(cloth, height - 0.22, height, 0.15, 0.1, light),
    }


def pendant(steel: Bsdf, cloth: Bsdf, light: Vec, drop: float, radius: float = 0.22) -> Shapes:
    """A glowing shade on a cord, with its top at the origin."""
    cord = [(0, -drop), (0.006, -drop), (0.006, -0.03), (0.05, -0.03), (0.05, 0), (0, 0)]
    return {"cord": lathe(steel, cord), "shade": shade(cloth, -drop - 0.12, -drop + 0.12, radius, 0.6 * radius, light)}


def spot_lamp(steel: Bsdf, dark: Bsdf, light: Vec) -> Shapes:
    """A lamp on a bent arm; a bright disc deep in its shade shines down and towards +x."""
    aim = lambda shape: transform(transform(shape, turn=45, axis=(0, 0, 1)), (0.2, 0.3, 0))
    outside, inside = [(0.07, 0), (0.075, 0), (0.03, 0.13), (0.03, 0.14)], [(0, 0.13), (0.025, 0.13), (0.07, 0)]
    arm = ((0, 0.015, 0), (-0.02, 0.32, 0)), ((-0.02, 0.32, 0), (0.11, 0.395, 0))
    foot = lathe(steel, [(0, 0), (0.09, 0), (0.09, 0.015), (0, 0.02)])
    return {
        "stand": join(foot, *(rod(steel, start, end, 0.009) for start, end in arm)),
        "shade": aim(lathe(dark, [*outside, (0, 0.14), *inside])),
        "bulb": aim(transform(disc(dark, 0.04, area(rgb(*light))), (0, 0.07, 0), 180, (1, 0, 0))),
    }


def uplight(steel: Bsdf, dark: Bsdf, light: Vec, height: float = 1.4) -> Shapes:
    """A standing bowl with a bright disc that only the ceiling sees."""
    h = height
    pole = [(0, 0), (0.17, 0), (0.17, 0.02), (0.016, 0.04), (0.016, h - 0.12), (0.06, h - 0.1), (0.17, h)]
    return {
        "stand": lathe(steel, [*pole, (0.165, h), (0.05, h - 0.09), (0, h - 0.09)]),
        "bulb": transform(disc(dark, 0.135, area(rgb(*light))), (0, h - 0.02, 0)),
    }
