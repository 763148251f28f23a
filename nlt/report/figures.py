"""Figures of a comparison, drawn from its stored results, and the figure of a dataset's sample."""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from matplotlib.patheffects import withStroke
from torch import Tensor

from nlt.display import display
from nlt.evaluation.paper import label
from nlt.evaluation.results import OK, Results
from nlt.metrics.quantities import METRICS, heading
from nlt.models.method import Batch
from nlt.models.projection import average, visible_pixels

matplotlib.use("Agg")
import matplotlib.pyplot as plt

matplotlib.rcParams["svg.hashsalt"] = "nlt"  # the same drawing gives the same bytes

_INCH, _TITLE = 1.1, 0.35  # inches: an image of a grid, and the space above it
PICTURE = ("webp",)  # the kind of file for a figure made of images; its lossy pixels are a sixth of a PNG's size
_ROWS = 6  # views in samples.webp
# The supplementary's six panels and two more.
_PANELS = ("mssim", "fid", *(f"feature_l1_layer{k}" for k in range(4)), "mse", "flip")
# Okabe and Ito's colours for colour-blind readers; markers and dashes for print without colour.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS, DASHES = "osD^v*PX<>", ("-", "--", ":", "-.")
_CURVES = ("0.3", "#8C510A", "#000000")
HALO = [withStroke(linewidth=1.5, foreground="white")]


def draw_samples(results: Results) -> None:
    """Draw samples.webp: a row per view, with the noisy training image, every method and the reference as displayed."""
    reference, noisy = results.images("reference"), results.images("noisy")
    if reference is None or noisy is None:
        return  # the images are only on the machine that made them
    columns = {"Training image": noisy["radiance"]}
    for method in results.methods:
        stored = results.images(method)
        if stored is not None and results.runs_of(method):
            columns[label(method)] = stored["radiance"]
    columns["Reference"] = reference["radiance"]
    rows = np.unique(np.linspace(0, len(noisy["radiance"]) - 1, _ROWS).round().astype(int))
    figure, axes = grid(len(rows), list(columns))
    for column, images in enumerate(columns.values()):
        for row, view in enumerate(rows):
            axes[row][column].imshow(shown(images[view], reference["exposure"][view]), interpolation="nearest")
    save(figure, results.directory, "samples", PICTURE)


def grid(rows: int, columns: list[str], bottom: float = 0.02) -> tuple[plt.Figure, np.ndarray]:
    """Return a figure for a grid of images with column titles, and its axes; `bottom` inches stay free."""
    size = (_INCH * len(columns), _INCH * rows + _TITLE + bottom)
    figure, axes = plt.subplots(rows, len(columns), figsize=size, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes[0], columns, strict=True):
        axis.set_title(name.replace(", ", "\n") if ", " in name else name.replace(" (", "\n("), fontsize=7)
    figure.subplots_adjust(0.002, bottom / size[1], 0.998, 1 - _TITLE / size[1], 0.02, 0.02)
    return figure, axes


def save(figure: plt.Figure, directory: Path, name: str, kinds: tuple[str, ...] = ("png", "svg")) -> None:
    """Write a figure into a directory of results; the same figure gives the same bytes."""
    options: dict[str, dict[str, Any]] = {
        "png": {"dpi": 150, "metadata": {"Software": None}},
        "svg": {"dpi": 150, "metadata": {"Date": None}},
        "webp": {"dpi": 100, "pil_kwargs": {"quality": 90, "method": 6}},
    }
    for kind in kinds:
        figure.savefig(directory / f"{name}.{kind}", **options[kind])
    plt.close(figure)


def shown(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Return linear radiance (3, H, W) as displayed: sRGB in [0, 1], (H, W, 3)."""
    return display(torch.from_numpy(radiance[None].astype(np.float32)), float(exposure))[0].permute(1, 2, 0).numpy()


def draw_sample(path: Path, sample: Batch) -> None:
    """Draw the twelve pictures of the supplementary's figure "Data Sample Components" from a batch of one."""
    visible, valid = sample["point_visible"][0], sample["photon_valid"][0]
    height, width = sample["depth"].shape[-2:]
    camera = (sample["camera_matrix"], sample["world_to_view"])
    # A depth map of "no hit" occludes nothing.
    in_view, kept = (
        visible_pixels(sample["point_position"], sample["point_visible"], *camera, depth, sample["normal"])[0]
        for depth in (torch.zeros_like(sample["depth"]), sample["depth"])
    )
    points, hits = sample["point_position"][0], sample["photon_hit"][0][valid]
    reference = (sample["reference_a"] + sample["reference_b"]) / 2
    albedo, colour = sample["point_albedo"][0], (sample["photon_flux"] / sample["photon_flux"].amax())[0] * 0.8
    shown = lambda image: display(image, sample["exposure"])[0].permute(1, 2, 0)
    emission = shown(sample["point_emission"].mT[..., None])[:, 0]
    images = {
        "(1) noisy, 1 spp": shown(sample["noisy"]),
        "(2) reference": shown(reference),
        "(3) depth": (sample["depth"] / sample["depth"].amax())[0, 0],
        "(4) normal": sample["normal"][0].permute(1, 2, 0) / 2 + 0.5,
        "(5) albedo": sample["albedo"][0].permute(1, 2, 0),
        "(6) point cloud": _scatter(in_view, albedo, height, width),
        "(7) point cloud, occluded points masked": _scatter(kept, albedo, height, width),
    }
    clouds: dict[str, tuple[Tensor, Tensor]] = {
        "(8) per-point visibility": (points, torch.tensor([[1, 0.9, 0], [0.3, 0.2, 0.5]])[visible.long()]),
        "(9) per-point albedo": (points[visible], albedo[visible]),
        "(10) per-point emission": (points[visible], emission[visible].clamp(min=0.3)),
        "(11) photon origins": (sample["photon_origin"][0], colour),
        "(12) photon hits": (hits, colour[valid]),
    }  # fmt: skip
    figure = plt.figure(figsize=(12, 8), facecolor="0.15")  # dark, because emitters are white
    for k, (name, image) in enumerate(images.items(), 1):
        axis = figure.add_subplot(3, 4, k)
        axis.imshow(image.clamp(0, 1).numpy(), interpolation="nearest", cmap="viridis")
        axis.set_title(name, fontsize=8, color="white")
        axis.set_axis_off()
    low, high = points.amin(0), points.amax(0)
    for k, (name, (cloud, colours)) in enumerate(clouds.items(), len(images) + 1):
        axis = figure.add_subplot(3, 4, k, projection="3d", facecolor="none")
        x, y, z = cloud[:, 0], -cloud[:, 2], cloud[:, 1]
        axis.scatter(x, y, z, c=colours.clamp(0, 1).numpy(), s=1.5, linewidths=0)
        axis.set(xlim=(low[0], high[0]), ylim=(-high[2], -low[2]), zlim=(low[1], high[1]))
        axis.set_box_aspect((high - low)[[0, 2, 1]].tolist())
        axis.view_init(elev=35, azim=-60)
        axis.set_title(name, fontsize=8, color="white")
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _scatter(pixels: Tensor, colours: Tensor, height: int, width: int) -> Tensor:
    """Return an image of the points' mean colour, from flat pixel indices (N,); height * width drops a point."""
    return average(colours[None], pixels[None], height, width)[0].permute(1, 2, 0)


def draw_speed_accuracy(results: Results) -> None:
    """Draw speed_accuracy.png and .svg: accuracy over time per frame, a panel per metric and device.

    Methods of one class that path trace form a curve, labelled by their pixels or samples per pixel. Error bars are
    the standard deviation over seeds or, with one seed, the 95% interval over test views. Grey is the Pareto front.
    """
    seconds = {
        device: {m: time for m in results.methods if math.isfinite(time := on.mean(m, "time_per_frame_s"))}
        for device in results.devices
        for on in [results.on(device)]
    }
    timed = {m: time for times in seconds.values() for m, time in times.items()}
    panels = [key for key in _PANELS if any(math.isfinite(results.mean(m, key)) for m in timed)]
    if not panels:
        return
    columns = math.ceil(len(panels) / 2)
    heights = [*[6.1] * len(seconds), 0.6]  # inches; the last is for the legend
    figure = plt.figure(figsize=(3.3 * columns, sum(heights)))
    *blocks, below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    axes = np.stack([block.subplots(2, columns, squeeze=False).ravel() for block in blocks])
    for device, block, row in zip(seconds, blocks, axes, strict=True):
        block.suptitle(f"Timed on {device}" if device else "", fontsize=10)
        block.subplots_adjust(0.18 / columns, 0.08, 1 - 0.03 / columns, 0.9, 0.18, 0.38)
        for axis, key, first in zip(row, panels, axes[0], strict=False):
            points = {m: (1e3 * time, results.mean(m, key)) for m, time in seconds[device].items()}
            _draw_panel(axis, results, key, {m: point for m, point in points.items() if math.isfinite(point[1])})
            axis.sharex(axes[0][0])  # one scale shows how much faster a device is
            axis.sharey(first)
        for axis in row[len(panels) :]:
            axis.set_axis_off()
    all_times = [time for times in seconds.values() for time in times.values()]
    subs = (1, 2, 5) if max(all_times) < 30 * min(all_times) else (1,)
    for axis in axes[:, : len(panels)].flat:
        axis.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=subs))
        axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        handles = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True)) | handles
    below.legend(handles.values(), handles, loc="center", ncols=min(6, len(handles)), fontsize=8, frameon=False)
    save(figure, results.directory, "speed_accuracy")


def _draw_panel(axis: plt.Axes, results: Results, key: str, xy: Mapping[str, tuple[float, float]]) -> None:
    """Draw a panel; `xy` has each method's time in ms and its metric."""
    families = curves(results)
    in_curves = {method for members in families.values() for method in members}
    if front := pareto_front(xy, METRICS[key].direction):
        axis.step(*zip(*front, strict=True), where="post", color="0.8", lw=5, zorder=0, label="Pareto front")
    for k, (name, members) in enumerate(families.items()):
        drawn = [m for m in members if m in xy]
        style = {"color": _CURVES[k % len(_CURVES)], "ls": DASHES[k % 4], "marker": "x+."[k % 3]}
        _plot(axis, results, key, drawn, xy, name, style)
        for number, m in enumerate(drawn):
            annotation = m.partition("@")[2] or label(m).partition("(")[2].rstrip(")").removesuffix(" spp")
            axis.annotate(annotation, xy[m], (0, -11 if number % 2 else 5), textcoords="offset points", ha="center",
                          fontsize=7, color=style["color"], zorder=4, path_effects=HALO)  # fmt: skip
    for k, m in enumerate(m for m in results.methods if m not in in_curves):
        style = {"color": COLOURS[k % len(COLOURS)], "ls": "", "marker": MARKERS[k % len(MARKERS)]}
        _plot(
            axis, results, key, [m] if m in xy else [], xy, label(m), style | {"mec": "white", "mew": 0.6, "zorder": 3}
        )
    axis.set_xscale("log")
    axis.margins(0.09, 0.12)
    axis.set_xlabel("time per frame (ms)", fontsize=8)
    axis.set_title(heading(key), fontsize=9)
    axis.tick_params(labelsize=8)
    axis.grid(alpha=0.3)


def _plot(
    axis: plt.Axes,
    results: Results,
    key: str,
    methods: list[str],
    xy: Mapping[str, tuple[float, float]],
    name: str,
    style: Mapping[str, Any],
) -> None:
    """Draw points with their error bars, joined by the style's line."""
    if not methods:
        return
    x, y = np.array([xy[m] for m in methods]).T
    bars = np.array([bar(results, m, key, value) for m, value in zip(methods, y, strict=True)]).T
    axis.errorbar(x, y, yerr=bars, ms=6, lw=1.2, elinewidth=0.9, capsize=2, label=name, **style)


def bar(results: Results, method: str, key: str, mean: float) -> tuple[float, float]:
    """Return an error bar's lengths below and above the mean: deviation over seeds, else the 95% interval."""
    if math.isfinite(std := results.std(method, key)):
        return std, std
    low, high = results.interval(method, key)
    return (max(mean - low, 0), max(high - mean, 0)) if math.isfinite(low) else (0, 0)


def curves(results: Results) -> dict[str, list[str]]:
    """Return the methods to join by a curve, by the curve's name, cheapest first.

    A curve joins the variants of one method, or the path-tracing methods of one class.
    """
    families: dict[tuple[str, str], dict[str, tuple[float, float]]] = {}
    variants: dict[str, list[str]] = {}
    for run in results.runs:
        if run["status"] != OK:
            continue
        name, is_variant, _ = run["method"].partition("@")
        if is_variant and run["method"] not in variants.setdefault(name, []):
            variants[name].append(run["method"])
        elif run["spp"] and not is_variant:
            # Denoising and guided denoising share a class, but not a label.
            family = (run["family"], label(name).rpartition(" (")[0])
            families.setdefault(family, {})[name] = (run["spp"], run["pixel_fraction"])
    time = partial(results.mean, key="time_per_frame_s")
    curves = {f"{label(name)}, variants": sorted(names, key=time) for name, names in variants.items() if len(names) > 1}
    for members in families.values():
        if len(members) > 1:
            varied = "spp" if len({spp for spp, _ in members.values()}) > 1 else "pixels traced"
            name = f"{label(next(iter(members))).partition(' (')[0]} ({varied})"
            curves[name] = sorted(members, key=lambda m: math.prod(members[m]))
    return curves


def pareto_front(points: Mapping[str, tuple[float, float]], direction: str) -> list[tuple[float, float]]:
    """Return the Pareto-optimal (time, value) points, in order of time."""
    sign = 1 if direction == "lower" else -1
    front: list[tuple[float, float]] = []
    for x, y in sorted(points.values(), key=lambda point: (point[0], sign * point[1])):
        if not front or sign * y < sign * front[-1][1]:
            front.append((x, y))
    return front
