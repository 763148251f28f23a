"""Figures of a comparison, drawn from its stored results, and the figure of a dataset's sample."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from torch import Tensor

from nlt.display import display
from nlt.evaluation.paper import label
from nlt.evaluation.results import OK, Results
from nlt.metrics.quantities import METRICS, heading
from nlt.models.method import Batch
from nlt.models.projection import average, visible_pixels
from nlt.report import plots

_ROWS = 6  # views in samples.webp
# The supplementary's six panels and two more.
_PANELS = ("mssim", "fid", *(f"feature_l1_layer{k}" for k in range(4)), "mse", "flip")
_CURVES = ("0.3", "#8C510A", "#000000")


def draw_samples(results: Results) -> None:
    """Draw samples.webp: a row per view, with the noisy training image, every method and the reference as displayed."""
    finished = [method for method in results.methods if results.runs_of(method)]
    stored = {name: results.images(name) for name in ("noisy", *finished, "reference")}
    reference = stored["reference"]
    if reference is None or stored["noisy"] is None:
        return  # the images are only on the machine that made them
    titles = {"noisy": "Training image", "reference": "Reference"}
    columns = {titles.get(name) or label(name): found["radiance"] for name, found in stored.items() if found}
    views = np.unique(np.linspace(0, len(reference["radiance"]) - 1, _ROWS).round().astype(int))
    figure, axes = plots.grid(len(views), list(columns))
    for line, view in zip(axes, views, strict=True):
        for axis, images in zip(line, columns.values(), strict=True):
            axis.imshow(plots.shown(images[view], reference["exposure"][view]))
    plots.save(figure, results.directory, "samples", plots.PICTURE)


def draw_sample(path: Path, sample: Batch) -> None:
    """Draw the twelve pictures of the supplementary's figure "Data Sample Components" from a batch of one."""
    visible, valid = sample["point_visible"][0], sample["photon_valid"][0]
    height, width = sample["depth"].shape[-2:]
    camera = (sample["camera_matrix"], sample["world_to_view"])
    # A depth map of "no hit" occludes nothing.
    in_view, kept = (
        visible_pixels(sample["point_position"], sample["point_visible"], *camera, depth, sample["normal"])
        for depth in (torch.zeros_like(sample["depth"]), sample["depth"])
    )
    points, hits = sample["point_position"][0], sample["photon_hit"][0][valid]
    reference = (sample["reference_a"] + sample["reference_b"]) / 2
    albedo, colour = sample["point_albedo"][0], (sample["photon_flux"] / sample["photon_flux"].amax())[0] * 0.8
    shown = lambda image: display(image, sample["exposure"])[0].permute(1, 2, 0)
    scatter = lambda pixels: average(albedo[None], pixels, height, width)[0].permute(1, 2, 0)
    emission = shown(sample["point_emission"].mT[..., None])[:, 0]
    images = {
        "(1) noisy, 1 spp": shown(sample["noisy"]),
        "(2) reference": shown(reference),
        "(3) depth": (sample["depth"] / sample["depth"].amax())[0, 0],
        "(4) normal": sample["normal"][0].permute(1, 2, 0) / 2 + 0.5,
        "(5) albedo": sample["albedo"][0].permute(1, 2, 0),
        "(6) point cloud": scatter(in_view),
        "(7) point cloud, occluded points masked": scatter(kept),
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
        figure.add_subplot(3, 4, k, title=name).imshow(image.clamp(0, 1).numpy(), cmap="viridis")
    low, high = points.amin(0), points.amax(0)
    for k, (name, (cloud, colours)) in enumerate(clouds.items(), len(images) + 1):
        axis = figure.add_subplot(3, 4, k, title=name, projection="3d", facecolor="none")
        x, y, z = cloud[:, 0], -cloud[:, 2], cloud[:, 1]
        axis.scatter(x, y, z, c=colours.clamp(0, 1).numpy(), s=1.5, linewidths=0)
        axis.set(xlim=(low[0], high[0]), ylim=(-high[2], -low[2]), zlim=(low[1], high[1]))
        axis.set_box_aspect((high - low)[[0, 2, 1]].tolist())
        axis.view_init(elev=35, azim=-60)
    for axis in figure.axes:
        axis.title.set(fontsize=8, color="white")
        axis.set_axis_off()
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def draw_speed_accuracy(results: Results) -> None:
    """Draw speed_accuracy.png and .svg: accuracy over time per frame, a panel per metric and device.

    Methods of one class that path trace form a curve, labelled by their pixels or samples per pixel. Error bars are
    the standard deviation over seeds or, with one seed, the 95% interval over test views. Grey is the Pareto front.
    """
    timed = {device: results.on(device) for device in results.devices}
    panels = [key for key in _PANELS if any(_points(on, key) for on in timed.values())]
    if not panels:
        return
    columns = math.ceil(len(panels) / 2)
    figure = plt.figure(figsize=(3.3 * columns, 6.1 * len(timed) + 0.6), layout="constrained")
    blocks = figure.subfigures(len(timed), 1, squeeze=False)[:, 0]
    for block, (device, on) in zip(blocks, timed.items(), strict=True):
        block.suptitle(f"Timed on {device}" if device else "", fontsize=10)
        axes = block.subplots(2, columns, squeeze=False)
        for axis, key, first in zip(axes.flat, panels, figure.axes, strict=False):
            _draw_panel(axis, on, key, curves(results))
            axis.sharex(figure.axes[0])  # one scale shows how much faster a device is
            axis.sharey(first)
    for axis in figure.axes:
        plots.set_time_axis(axis)
    plots.add_legend(figure, min(6, 2 * columns), "outside lower center")
    plots.save(figure, results.directory, "speed_accuracy")


def _points(results: Results, key: str) -> dict[str, tuple[float, float]]:
    """Return the time per frame in ms and the metric of every method that has both."""
    points = {m: (1e3 * results.mean(m, "time_per_frame_s"), results.mean(m, key)) for m in results.methods}
    return {method: point for method, point in points.items() if np.isfinite(point).all()}


def _draw_panel(axis: plt.Axes, results: Results, key: str, families: Mapping[str, Sequence[str]]) -> None:
    """Draw a metric over time; `families` has the methods of each curve."""
    points = _points(results, key)
    plots.draw_front(axis, points, METRICS[key].direction)
    for k, (name, members) in enumerate(families.items()):
        colour = _CURVES[k % len(_CURVES)]
        drawn = [method for method in members if method in points]
        _plot(axis, results, key, {m: points[m] for m in drawn}, label=name, color=colour, ls=plots.DASHES[k % 4],
              marker="x+."[k % 3])  # fmt: skip
        for number, m in enumerate(drawn):
            setting = m.partition("@")[2] or label(m).partition("(")[2].rstrip(")").removesuffix(" spp")
            plots.annotate(axis, setting, points[m], -11 if number % 2 else 5, fontsize=7, color=colour, zorder=4)
    alone = [m for m in results.methods if all(m not in members for members in families.values())]
    for k, m in enumerate(alone):
        point = {m: points[m]} if m in points else {}
        _plot(axis, results, key, point, label=label(m), ls="", mec="white", mew=0.6, zorder=3, **plots.style(k))
    axis.margins(0.09, 0.12)
    axis.set_title(heading(key))


def _plot(
    axis: plt.Axes, results: Results, key: str, points: Mapping[str, tuple[float, float]], **options: Any
) -> None:
    """Draw points with their error bars, joined by the line that the options give."""
    if points:
        bars = np.transpose([bar(results, method, key, value) for method, (_, value) in points.items()])
        x, y = zip(*points.values(), strict=True)
        axis.errorbar(x, y, yerr=bars, ms=6, lw=1.2, elinewidth=0.9, capsize=2, **options)


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
    runs = {run["method"]: run for run in results.runs if run["status"] == OK}
    variants: dict[str, list[str]] = {}
    families: dict[tuple[str, str], list[str]] = {}
    for method, run in runs.items():
        name, is_variant, _ = method.partition("@")
        if is_variant:
            variants.setdefault(label(name), []).append(method)
        elif run["spp"]:
            # Denoising and guided denoising share a class, but not a label.
            families.setdefault((run["family"], label(name).rpartition(" (")[0]), []).append(method)
    time = partial(results.mean, key="time_per_frame_s")
    joined = {f"{name}, variants": sorted(members, key=time) for name, members in variants.items() if len(members) > 1}
    for members in families.values():
        if len(members) > 1:
            varied = "spp" if len({runs[m]["spp"] for m in members}) > 1 else "pixels traced"
            rays = lambda m: runs[m]["spp"] * runs[m]["pixel_fraction"]
            joined[f"{label(members[0]).partition(' (')[0]} ({varied})"] = sorted(members, key=rays)
    return joined
