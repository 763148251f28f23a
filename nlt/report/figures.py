"""The comparison's pictures, from results on disk; and that of a sample of a dataset."""

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

from nlt.evaluation.paper import label
from nlt.evaluation.results import OK, Results
from nlt.metrics.display import display
from nlt.metrics.quantities import METRICS, heading
from nlt.models.method import Batch
from nlt.models.projection import average, visible_pixels

matplotlib.use("Agg")
import matplotlib.pyplot as plt

matplotlib.rcParams["svg.hashsalt"] = "nlt"  # the same drawing gives the same bytes

_INCH, _TITLE = 1.1, 0.35  # of an image in a grid, and above it
_ROWS = 6  # views in samples.png
# The supplementary's six panels, and two.
_PANELS = ("mssim", "fid", *(f"feature_l1_layer{k}" for k in range(4)), "mse", "flip")
# Okabe and Ito's colours, which the colour-blind tell apart; markers and dashes for print without colour.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS, DASHES = "osD^v*PX<>", ("-", "--", ":", "-.")
_CURVES = ("0.3", "#8C510A", "#000000")
HALO = [withStroke(linewidth=1.5, foreground="white")]


def draw_samples(results: Results) -> None:
    """samples.png: a row per view; teaching input, every method, reference; all by the one display transform."""
    reference, noisy = results.images("reference"), results.images("noisy")
    if reference is None or noisy is None:
        return  # images stay on the machine that made them
    columns = {"Teaching input": noisy["radiance"]}
    for method in results.methods:
        found = results.images(method)
        if found is not None and results.runs_of(method):
            columns[label(method)] = found["radiance"]
    columns["Reference"] = reference["radiance"]
    rows = np.unique(np.linspace(0, len(noisy["radiance"]) - 1, _ROWS).round().astype(int))
    figure, axes = grid(len(rows), list(columns))
    for column, images in enumerate(columns.values()):
        for row, view in enumerate(rows):
            axes[row][column].imshow(shown(images[view], reference["exposure"][view]), interpolation="nearest")
    save(figure, results.directory, "samples", ("png",))


def grid(rows: int, columns: list[str], bottom: float = 0.02) -> tuple[plt.Figure, np.ndarray]:
    """A figure for images side by side, and its axes (rows, columns); columns have titles. `bottom`: inches free."""
    size = (_INCH * len(columns), _INCH * rows + _TITLE + bottom)
    figure, axes = plt.subplots(rows, len(columns), figsize=size, squeeze=False)
    for axis in axes.flat:
        axis.set_axis_off()
    for axis, name in zip(axes[0], columns, strict=True):
        axis.set_title(name.replace(", ", "\n") if ", " in name else name.replace(" (", "\n("), fontsize=7)
    figure.subplots_adjust(0.002, bottom / size[1], 0.998, 1 - _TITLE / size[1], 0.02, 0.02)
    return figure, axes


def save(figure: plt.Figure, directory: Path, name: str, kinds: tuple[str, ...] = ("png", "svg")) -> None:
    """Into a directory of results; the same figure gives the same bytes."""
    dpi = 150 if "svg" in kinds else 100  # without lines and letters to keep sharp, small files
    for kind in kinds:
        metadata = {"png": {"Software": None}, "svg": {"Date": None}}[kind]
        figure.savefig(directory / f"{name}.{kind}", dpi=dpi, metadata=metadata)
    plt.close(figure)


def shown(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Linear radiance (3, H, W) as displayed: (H, W, 3) sRGB in [0, 1]."""
    return display(torch.from_numpy(radiance[None].astype(np.float32)), float(exposure))[0].permute(1, 2, 0).numpy()


def draw_sample(path: Path, sample: Batch) -> None:
    """The twelve pictures of the supplementary's figure "Data Sample Components", of a batch of one."""
    visible, valid = sample["point_visible"][0], sample["photon_valid"][0]
    height, width = sample["depth"].shape[-2:]
    camera = (sample["camera_matrix"], sample["world_to_view"])
    # Against a depth map of "no hit", nothing is occluded.
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
    figure = plt.figure(figsize=(12, 8), facecolor="0.15")  # dark: emitters show white
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
    """Points (N,) at flat pixels, height * width where dropped, as an image of their mean colour."""
    return average(colours[None], pixels[None], height, width)[0].permute(1, 2, 0)


def draw_speed_accuracy(results: Results) -> None:
    """speed_accuracy.png and .svg: accuracy over time per frame, a panel per metric; all of them for each device.

    Methods of one class that path trace are a curve, labelled by their pixels or samples per pixel. Bars are the
    standard deviation over seeds, with one seed the 95% interval over test views. The grey line is the Pareto front.
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
    heights = [*[6.1] * len(seconds), 0.6]  # inches; the last for the legend
    figure = plt.figure(figsize=(3.3 * columns, sum(heights)))
    *blocks, below = figure.subfigures(len(heights), 1, squeeze=False, height_ratios=heights)[:, 0]
    axes = np.stack([block.subplots(2, columns, squeeze=False).ravel() for block in blocks])
    for device, block, row in zip(seconds, blocks, axes, strict=True):
        block.suptitle(f"Timed on {device}" if device else "", fontsize=10)
        block.subplots_adjust(0.18 / columns, 0.08, 1 - 0.03 / columns, 0.9, 0.18, 0.38)
        for axis, key, first in zip(row, panels, axes[0], strict=False):
            at = {m: (1e3 * time, results.mean(m, key)) for m, time in seconds[device].items()}
            _speed_accuracy(axis, results, key, {m: place for m, place in at.items() if math.isfinite(place[1])})
            axis.sharex(axes[0][0])  # one scale shows what a device gains
            axis.sharey(first)
        for axis in row[len(panels) :]:
            axis.set_axis_off()
    every = [time for times in seconds.values() for time in times.values()]
    subs = (1, 2, 5) if max(every) < 30 * min(every) else (1,)
    for axis in axes[:, : len(panels)].flat:
        axis.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=subs))
        axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
    named: dict[str, Any] = {}
    for axis in axes.flat:
        named = dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True)) | named
    below.legend(named.values(), named, loc="center", ncols=min(6, len(named)), fontsize=8, frameon=False)
    save(figure, results.directory, "speed_accuracy")


def _speed_accuracy(axis: plt.Axes, results: Results, key: str, at: Mapping[str, tuple[float, float]]) -> None:
    """A panel: the methods at their places, time in ms and metric."""
    families = curves(results)
    in_curves = {method for members in families.values() for method in members}
    if front := pareto_front(at, METRICS[key].direction):
        axis.step(*zip(*front, strict=True), where="post", color="0.8", lw=5, zorder=0, label="Pareto front")
    for k, (name, members) in enumerate(families.items()):
        found = [m for m in members if m in at]
        style = {"color": _CURVES[k % len(_CURVES)], "ls": DASHES[k % 4], "marker": "x+."[k % 3]}
        _plot(axis, results, key, found, at, name, style)
        for number, m in enumerate(found):
            part = m.partition("@")[2] or label(m).partition("(")[2].rstrip(")").removesuffix(" spp")
            axis.annotate(part, at[m], (0, -11 if number % 2 else 5), textcoords="offset points", ha="center",
                          fontsize=7, color=style["color"], zorder=4, path_effects=HALO)  # fmt: skip
    for k, m in enumerate(m for m in results.methods if m not in in_curves):
        style = {"color": COLOURS[k % len(COLOURS)], "ls": "", "marker": MARKERS[k % len(MARKERS)]}
        _plot(
            axis, results, key, [m] if m in at else [], at, label(m), style | {"mec": "white", "mew": 0.6, "zorder": 3}
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
    at: Mapping[str, tuple[float, float]],
    name: str,
    style: Mapping[str, Any],
) -> None:
    """Points with their error bars, joined by the style's line."""
    if not methods:
        return
    x, y = np.array([at[m] for m in methods]).T
    bars = np.array([bar(results, m, key, value) for m, value in zip(methods, y, strict=True)]).T
    axis.errorbar(x, y, yerr=bars, ms=6, lw=1.2, elinewidth=0.9, capsize=2, label=name, **style)


def bar(results: Results, method: str, key: str, mean: float) -> tuple[float, float]:
    """How far an error bar reaches below and above the mean: the deviation over seeds, else the 95% interval."""
    if math.isfinite(std := results.std(method, key)):
        return std, std
    low, high = results.interval(method, key)
    return (max(mean - low, 0), max(high - mean, 0)) if math.isfinite(low) else (0, 0)


def curves(results: Results) -> dict[str, list[str]]:
    """Variants of one method, and classes with several methods that path trace: the methods, by what they are called.

    The cheapest comes first.
    """
    families: dict[tuple[str, str], dict[str, tuple[float, float]]] = {}
    variants: dict[str, list[str]] = {}
    for run in results.runs:
        if run["status"] != OK:
            continue
        name, at, _ = run["method"].partition("@")
        if at and run["method"] not in variants.setdefault(name, []):
            variants[name].append(run["method"])
        elif run["spp"] and not at:
            # The label tells denoising from guided denoising, which are of one class.
            family = (run["family"], label(name).rpartition(" (")[0])
            families.setdefault(family, {})[name] = (run["spp"], run["pixel_fraction"])
    time = partial(results.mean, key="time_per_frame_s")
    curves = {f"{label(name)}, variants": sorted(found, key=time) for name, found in variants.items() if len(found) > 1}
    for members in families.values():
        if len(members) > 1:
            varied = "spp" if len({spp for spp, _ in members.values()}) > 1 else "pixels traced"
            name = f"{label(next(iter(members))).partition(' (')[0]} ({varied})"
            curves[name] = sorted(members, key=lambda m: math.prod(members[m]))
    return curves


def pareto_front(at: Mapping[str, tuple[float, float]], direction: str) -> list[tuple[float, float]]:
    """The (time, value) places that no other place is better than in both, by time."""
    sign = 1 if direction == "lower" else -1
    front: list[tuple[float, float]] = []
    for x, y in sorted(at.values(), key=lambda place: (place[0], sign * place[1])):
        if not front or sign * y < sign * front[-1][1]:
            front.append((x, y))
    return front
