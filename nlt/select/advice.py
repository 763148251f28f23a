"""Advice on what a model needs, from what varies in a scene and an experiment; nothing is trained."""

import dataclasses
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from nlt.data.dataset import place_points
from nlt.data.engines import Process
from nlt.data.render import SampleRenderer
from nlt.data.sample import MATERIALS
from nlt.data.spec import DatasetSpec
from nlt.models.module import PROJECTION
from nlt.models.projection import visible_pixels
from nlt.rendering.variant import choose_variant
from nlt.report.table_writer import grid
from nlt.scenes.assembly import Scene

_VIEWS = 16
_MOST = 1 << 16  # number of points and of photons that are tried at most
_COUNTS = tuple(1 << k for k in range(7, 17))
_GAIN = 0.05  # share of the pixels that a doubled number of points must cover in addition
_FIELDS = ("depth", "normal", "camera_matrix", "world_to_view", "translation", "present", "photon_hit", "photon_valid")


@dataclass(frozen=True)
class Facts:
    """The properties of a scene in an experiment that decide what a model of it needs."""

    scene: str
    moving: tuple[str, ...]  # the objects that states move or remove
    moving_lights: tuple[str, ...]  # those among them that emit light
    materials: dict[str, float]  # share of each of `MATERIALS` in the visible surface, where it is above zero
    point_coverage: dict[int, float]  # by N, the share of the pixels with a surface that show at least one of N points
    photon_coverage: dict[int, float]  # the same for photons


@dataclass(frozen=True)
class Advice:
    """A piece of advice: what a model needs of `subject`, why, and the `methods` that have no more than that."""

    subject: str
    verdict: str
    reason: str
    methods: Sequence[str] = ()


def measure_facts(spec: DatasetSpec) -> list[Facts]:
    """Measure every scene of a dataset in its experiment, at its resolution, in a process per scene.

    Raises:
        UserError: a scene does not load.
    """
    choose_variant()  # chosen once; the processes inherit it
    spec = dataclasses.replace(spec, num_points=_MOST, num_photons=_MOST, train=0, val=0, test=_VIEWS)
    return [Process(_facts, spec, scene).result() for scene in range(len(spec.scenes))]


def _facts(spec: DatasetSpec, scene: int) -> Facts:
    torch.set_num_threads(1)  # affects this process only; on a busy machine, threads that wait are slower
    render = SampleRenderer(spec, scene)
    moving, lights = what_moves(render.scene)
    points = render.points()
    curves: dict[str, list[dict[int, float]]] = {"point_coverage": [], "photon_coverage": []}
    for view in range(spec.test):
        sample = render.sample("test", view, only=_FIELDS)
        camera: dict[str, Any] = {name: torch.from_numpy(sample[name][None].astype(np.float32)) for name in PROJECTION}
        clouds = {
            "point_coverage": place_points(points, sample["translation"], sample["present"]),
            "photon_coverage": (sample["photon_hit"], sample["photon_valid"]),
        }
        for name, (position, valid) in clouds.items():
            pixels = visible_pixels(torch.from_numpy(position)[None], torch.from_numpy(valid)[None], **camera)
            curves[name].append(occupancy(pixels[0].numpy(), sample["depth"].ravel() > 0, len(position)))
    means = {name: {n: float(np.mean([c[n] for c in views])) for n in _COUNTS} for name, views in curves.items()}
    return Facts(spec.descriptions[scene].name, moving, lights, shares_of_materials(points), **means)


def shares_of_materials(points: dict[str, np.ndarray]) -> dict[str, float]:
    """Return the share of the points by material, where it is above zero."""
    shares = np.bincount(points["material"], minlength=len(MATERIALS)) / len(points["material"])
    return {name: float(share) for name, share in zip(MATERIALS, shares, strict=True) if share > 0}


def what_moves(scene: Scene) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the names of the objects that states move or remove, and of those among them that emit light."""
    moving = [m for m in scene.movables if m.removable or np.ptp(m.box, axis=0).any()]
    emits = lambda m: any(scene.shapes[shape].emitter is not None for shape in m.shapes)
    return tuple(m.name for m in moving), tuple(m.name for m in moving if emits(m))


def occupancy(pixels: np.ndarray, surface: np.ndarray, total: int) -> dict[int, float]:
    """Return, by n, the share of the pixels in `surface` (H*W,) bool that hold at least one of n points.

    `pixels` (total,) are those of `visible_pixels`. The share is the expectation by rarefaction: each of the points is
    kept with probability n / total.
    """
    held = np.bincount(pixels, minlength=len(surface) + 1)[:-1][surface]
    return {n: float(np.mean(1 - (1 - min(n / total, 1)) ** held)) if len(held) else 0.0 for n in _COUNTS}


def enough(curve: dict[int, float]) -> int:
    """Return the count from which doubling covers less than 5 % more of the pixels, or the largest one tried."""
    counts = sorted(curve)
    worthwhile = [n for half, n in itertools.pairwise(counts) if curve[n] - curve[half] >= _GAIN]
    return max(worthwhile, default=counts[0])


def advise(spec: DatasetSpec, facts: list[Facts]) -> list[Advice]:
    """Return what a model of a dataset needs, which is what any of its scenes needs."""
    listed = lambda names: ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
    lights = listed(list(dict.fromkeys(name for fact in facts for name in fact.moving_lights)))
    moving = listed(list(dict.fromkeys(name for fact in facts for name in fact.moving)))
    if lights:
        kind, methods = "direct light or photons", ["cnn@direct", "nlt_photons"]
        reason = f"lights move or are removed: {lights}; direct light and photons say where light arrives in each state"
    elif moving:
        kind, methods = "direct light or points", ["cnn@direct", "nlt"]
        reason = f"objects move or are removed: {moving}; no light does, so a network can learn where it arrives"
    else:
        kind, methods = "none", ["feature_projection", "cnn"]
        reason = "nothing moves: the light leaving a point is always the same, so its feature or the U-Net can store it"
    transport = Advice("light transport", f"{kind}: {', '.join(methods)}", reason, methods)

    shares = {name: float(np.mean([fact.materials.get(name, 0) for fact in facts])) for name in MATERIALS}
    specular = [f"{name} {share:.2%}" for name, share in shares.items() if share and name != "diffuse"]
    verdict, reason = "needed", f"shares of the visible surface: {', '.join(specular)}"
    if not specular:
        verdict = "not needed: ablation without ray_direction"
        reason = "every surface is diffuse: it looks the same from every direction"
    return [
        transport,
        Advice("view direction", verdict, reason),
        _count("points", spec.num_points, [fact.point_coverage for fact in facts]),
        _count("photons", spec.num_photons, [fact.photon_coverage for fact in facts]),
    ]


def _count(what: str, count: int, curves: list[dict[int, float]]) -> Advice:
    best = max(enough(curve) for curve in curves)
    share = lambda n: float(np.mean([np.interp(np.log(n), np.log(list(c)), list(c.values())) for c in curves]))
    more = f"doubling that number would add less than {_GAIN:.0%}"
    if best == max(_COUNTS):
        more = "larger numbers were not tried"
    held = f"{share(count):.0%} of the pixels with a surface hold one of {count:,}, {share(best):.0%} one of {best:,}"
    return Advice(what, f"{best:,} of {count:,}" if best < count else f"all {count:,}", f"{held}; {more}")


def table(advice: list[Advice], facts: list[Facts]) -> str:
    """Return the advice with its reasons and the coverage behind it, as Markdown."""
    lines = ["# What varies", "", *(f"- **{item.subject}**: {item.verdict} ({item.reason})" for item in advice)]
    lines += ["", "Share of the pixels with a surface that hold at least one of so many, mean over random views:", ""]
    rows = [
        [f"{fact.scene}: {name}", *(f"{curve[n]:.0%}" for n in _COUNTS)]
        for fact in facts
        for name, curve in (("points", fact.point_coverage), ("photons", fact.photon_coverage))
    ]
    return "\n".join([*lines, *grid(["", *(f"{n:,}" for n in _COUNTS)], rows)])
