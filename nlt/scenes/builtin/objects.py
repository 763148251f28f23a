"""Small objects of the built-in scenes, and bathroom and kitchen fittings: at the origin, facing +z."""

from __future__ import annotations

import numpy as np

from nlt.scenes.builtin.materials import Bsdf, Vec
from nlt.scenes.builtin.shapes import Box, BuiltinShape, Shapes, ball, boxes, join, lathe, ring, rod, rounded, transform


def tub(ceramic: Bsdf, length: float = 1.65, width: float = 0.78, height: float = 0.58) -> Shapes:
    """A free-standing oval bath."""
    r = width / 2
    outside = [(0, 0), (0.7 * r, 0), (0.74 * r, 0.03), (0.86 * r, 0.3), (0.95 * r, height - 0.05), (r, height - 0.02)]
    inside = [(r, height), (r - 0.06, height), (0.8 * r, height - 0.1), (0.68 * r, 0.2), (0.55 * r, 0.12), (0, 0.1)]
    return {"body": lathe(ceramic, outside + inside, stretch=(length / width, 1, 1), sections=48)}


def bowl(bsdf: Bsdf, radius: float = 0.18, height: float = 0.075, stretch: Vec = (1, 1, 1)) -> BuiltinShape:
    foot = 0.4 * radius
    return lathe(
        bsdf,
        [(0, 0), (foot, 0), (0.8 * radius, 0.5 * height), (radius, height), (radius - 0.01, height + 0.004),
         (0.75 * radius, 0.55 * height), (foot - 0.01, 0.015), (0, 0.015)],
        stretch=stretch,
    )  # fmt: skip


def tap(steel: Bsdf, height: float = 0.22, reach: float = 0.14) -> BuiltinShape:
    h, z = height, reach
    column = lathe(steel, [(0, 0), (0.03, 0), (0.03, 0.01), (0.016, 0.02), (0.016, h + 0.01), (0, h + 0.01)])
    spout = (rod(steel, (0, h, -0.005), (0, h, z), 0.012), rod(steel, (0, h + 0.01, z), (0, h - 0.05, z), 0.012))
    return join(column, *spout, rod(steel, (0.015, 0.06, 0), (0.09, 0.1, 0), 0.008))


def toilet(ceramic: Bsdf, seat: Bsdf, steel: Bsdf) -> Shapes:
    """A toilet whose cistern has its back at z = -0.33."""
    pan = [(0, 0), (0.12, 0), (0.11, 0.1), (0.13, 0.22), (0.185, 0.36), (0.185, 0.4), (0.13, 0.4), (0.09, 0.27)]
    lid = [(0, 0.4), (0.19, 0.4), (0.19, 0.425), (0.175, 0.435), (0, 0.435)]
    cistern = rounded(ceramic, ((0, 0.58, -0.24), (0.4, 0.38, 0.18)), radius=0.04)
    neck = boxes(ceramic, ((0, 0.3, -0.22), (0.22, 0.24, 0.18)))
    return {
        "pan": join(lathe(ceramic, [*pan, (0, 0.22)], (0, 0, 0.06), (1, 1, 1.35)), cistern, neck),
        "lid": lathe(seat, lid, (0, 0, 0.06), (1, 1, 1.35)),
        "button": lathe(steel, [(0, 0.765), (0.025, 0.765), (0.025, 0.775), (0, 0.775)], (0, 0, -0.24)),
    }


def bottle(bsdf: Bsdf, height: float = 0.2, radius: float = 0.03, at: Vec = (0, 0, 0)) -> BuiltinShape:
    r, h = radius, height
    return lathe(bsdf, [(0, 0), (r, 0), (r, 0.65 * h), (0.4 * r, 0.8 * h), (0.4 * r, h), (0, h)], at, sections=24)


def tumbler(bsdf: Bsdf, height: float = 0.11, radius: float = 0.035, at: Vec = (0, 0, 0)) -> BuiltinShape:
    r, h = radius, height
    return lathe(bsdf, [(0, 0), (0.85 * r, 0), (r, h), (r - 0.003, h), (0.85 * r - 0.003, 0.012), (0, 0.012)], at)


def hob(black: Bsdf, steel: Bsdf, width: float = 0.58, depth: float = 0.5) -> Shapes:
    spots = ((-0.15, -0.12, 0.09), (0.15, -0.12, 0.075), (-0.15, 0.12, 0.075), (0.15, 0.12, 0.09))
    return {
        "top": boxes(black, ((0, 0.004, 0), (width, 0.008, depth))),
        "rings": join(*(ring(steel, r, 0.012, 0.009, (x, 0, z)) for x, z, r in spots)),
    }


def pan(steel: Bsdf, handle: Bsdf, radius: float = 0.13, height: float = 0.05) -> Shapes:
    r = radius
    body = lathe(steel, [(0, 0), (0.8 * r, 0), (r, height), (r - 0.004, height), (0.8 * r - 0.004, 0.005), (0, 0.005)])
    return {"body": body, "handle": rod(handle, (0.95 * r, height - 0.01, 0), (r + 0.17, height + 0.02, 0), 0.011)}


def pot(steel: Bsdf, knob: Bsdf, radius: float = 0.11, height: float = 0.13) -> Shapes:
    r, h = radius, height
    body = [(0, 0), (r, 0), (r, h), (r + 0.006, h), (r + 0.006, h + 0.008), (0.5 * r, h + 0.02), (0, h + 0.025)]
    grip = lambda s: boxes(knob, ((s * (r + 0.02), 0.8 * h, 0), (0.05, 0.014, 0.07)))
    top = ball(knob, 0.018, (0, h + 0.035, 0), subdivisions=2)
    return {"body": lathe(steel, body), "grips": join(top, grip(-1), grip(1))}


def kettle(steel: Bsdf, black: Bsdf) -> Shapes:
    body = lathe(steel, [(0, 0.015), (0.085, 0.015), (0.085, 0.04), (0.06, 0.19), (0.03, 0.205), (0, 0.21)])
    spout = rod(steel, (0.05, 0.12, 0), (0.11, 0.19, 0), 0.016)
    bars: list[Box] = [((-0.1, 0.19, 0), (0.09, 0.02, 0.022)), ((-0.135, 0.12, 0), (0.02, 0.15, 0.022))]
    grip = boxes(black, *bars, ((-0.105, 0.055, 0), (0.06, 0.02, 0.022)))
    base = lathe(black, [(0, 0), (0.09, 0), (0.09, 0.015), (0, 0.015)])
    return {"body": join(body, spout), "grip": join(base, grip, ball(black, 0.016, (0, 0.22, 0), subdivisions=2))}


def toaster(steel: Bsdf, black: Bsdf) -> Shapes:
    slots: list[Box] = [((0, 0.196, z), (0.2, 0.01, 0.028)) for z in (-0.035, 0.035)]
    slots += [((0.15, 0.14, 0), (0.03, 0.02, 0.05)), ((0, 0.01, 0), (0.24, 0.02, 0.12))]
    return {"body": rounded(steel, ((0, 0.105, 0), (0.29, 0.18, 0.16)), radius=0.035), "slots": boxes(black, *slots)}


def hood(steel: Bsdf, top: float) -> BuiltinShape:
    """An extractor hood: a chimney up to `top` metres above its lower edge."""
    parts: list[Box] = [((0, 0.03, 0.245), (0.62, 0.06, 0.49)), ((0, (top + 0.2) / 2, 0.14), (0.24, top - 0.2, 0.24))]
    for k in range(7):
        parts.append(((0, 0.07 + 0.02 * k, 0.24 - 0.014 * k), (0.6 - 0.05 * k, 0.02, 0.48 - 0.034 * k)))
    return boxes(steel, *parts)


def vase(bsdf: Bsdf, height: float = 0.6) -> Shapes:
    t = np.linspace(0, 1, 15)
    radius = height * (0.16 + 0.13 * np.sin(np.pi * t**0.8) - 0.07 * t**2)
    outside = [(0.0, 0.0), *zip(radius, t * height, strict=True)]
    inside = [(r - 0.015, y) for r, y in outside[:3:-2]]
    return {"body": lathe(bsdf, [*outside, *inside, (0.0, inside[-1][1])])}


def plant(clay: Bsdf, leaf: Bsdf, height: float = 0.9, spread: float = 0.28, leaves: int = 40, seed: int = 0) -> Shapes:
    """A pot plant with long leaves."""
    rng = np.random.default_rng(seed)
    rim, deep = 0.42 * spread + 0.03, 0.3 * height
    body = [(0, 0), (0.7 * rim, 0), (rim, deep), (rim - 0.012, deep), (rim - 0.02, 0.85 * deep), (0, 0.85 * deep)]
    green = []
    for _ in range(leaves):
        lean, length = rng.uniform(0.1, 0.95), (height - deep) * rng.uniform(0.75, 1.05)
        blade = ball(leaf, 1, (0, 0.85 * length / 2, 0), (0.09 * length + 0.008, length / 2, 0.006), subdivisions=1)
        lean *= min(1.0, spread / length)
        tipped = transform(transform(blade, turn=float(rng.uniform(-40, 40))), turn=np.degrees(lean), axis=(1, 0, 0))
        green.append(transform(tipped, (0, 0.85 * deep, 0), float(rng.uniform(0, 360))))
    return {"pot": lathe(clay, body), "leaves": join(*green)}


def cup(bsdf: Bsdf, at: Vec = (0, 0, 0)) -> BuiltinShape:
    body = [(0, 0), (0.035, 0), (0.042, 0.09), (0.038, 0.09), (0.032, 0.012), (0, 0.012)]
    bars: list[Box] = [((0.055, y, 0), (0.035, 0.01, 0.012)) for y in (0.03, 0.07)]
    return transform(join(lathe(bsdf, body), boxes(bsdf, *bars, ((0.068, 0.05, 0), (0.01, 0.05, 0.012)))), at)


def basket(bsdf: Bsdf, size: Vec = (0.4, 0.45, 0.32)) -> BuiltinShape:
    """An open box of four sides and a bottom."""
    (w, h, d), t = size, 0.02
    sides: list[Box] = [((s * (w - t) / 2, h / 2, 0), (t, h, d)) for s in (-1, 1)]
    sides += [((0, h / 2, s * (d - t) / 2), (w - 2 * t, h, t)) for s in (-1, 1)]
    return boxes(bsdf, *sides, ((0, t / 2, 0), (w - 2 * t, t, d - 2 * t)), tile=0.4)


def teddy(fur: Bsdf, dark: Bsdf, size: float = 0.3) -> Shapes:
    """A sitting teddy bear."""
    parts: list[tuple[Vec, float, Vec]] = [((0, 0.3, 0), 0.27, (1, 1.1, 0.9)), ((0, 0.72, 0.02), 0.2, (1, 1, 1))]
    parts += [((0, 0.68, 0.18), 0.09, (1, 0.8, 1))]
    parts += [((s * 0.15, 0.89, 0), 0.08, (1, 1, 0.6)) for s in (-1, 1)]
    parts += [((s * 0.28, 0.42, 0.1), 0.1, (0.8, 1.6, 0.8)) for s in (-1, 1)]
    parts += [((s * 0.2, 0.1, 0.3), 0.1, (1, 1, 1.8)) for s in (-1, 1)]
    spots: list[tuple[Vec, float, Vec]] = [((s * 0.075, 0.77, 0.195), 0.026, (1, 1, 1)) for s in (-1, 1)]
    spots += [((0, 0.71, 0.265), 0.035, (1.2, 0.8, 0.6))]
    bodies = lambda bsdf, spec: join(
        *(ball(bsdf, r * size, tuple(size * np.array(at)), stretch, subdivisions=2) for at, r, stretch in spec)
    )
    return {"fur": bodies(fur, parts), "face": bodies(dark, spots)}


def egg_of(bsdf: Bsdf, height: float, at: Vec) -> BuiltinShape:
    """An egg that stands on its blunt end."""
    angle = np.linspace(0, np.pi, 40)
    y = (1 - np.cos(angle)) / 2
    radius = 0.36 * np.sin(angle) * (1 + 0.18 * np.cos(angle))
    return lathe(bsdf, list(zip(radius * height, y * height, strict=True)), at, sections=64)


def jug(bsdf: Bsdf) -> BuiltinShape:
    outside = [(0.05, 0), (0.065, 0.1), (0.045, 0.2), (0.055, 0.24)]
    return lathe(bsdf, [(0, 0), *outside, *[(r - 0.003, max(y, 0.01)) for r, y in outside[::-1]], (0, 0.01)])


def jar(bsdf: Bsdf, height: float, at: Vec) -> BuiltinShape:
    h = height
    return lathe(bsdf, [(0, 0), (0.05, 0), (0.055, h), (0.04, h + 0.01), (0.04, h + 0.03), (0, h + 0.03)], at)


def flowers(petal: Bsdf, stalk: Bsdf, height: float = 0.4, count: int = 7) -> Shapes:
    """Tulips whose stalks start at the origin."""
    rng = np.random.default_rng(11)
    heads = [(*rng.uniform(-0.09, 0.09, 2), y) for y in height * rng.uniform(0.8, 1.1, count)]
    return {
        "petals": join(*(ball(petal, 0.028, (x, y, z), (0.85, 1.3, 0.85), subdivisions=2) for x, z, y in heads)),
        "stalks": join(*(rod(stalk, (0.2 * x, 0.02, 0.2 * z), (x, y, z), 0.004) for x, z, y in heads)),
    }
