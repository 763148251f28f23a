"""The comparison's pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import torch
from torch import Tensor

from nlt.evaluation.paper import label
from nlt.evaluation.tables import heading
from nlt.metrics.display import display
from nlt.models.module import Batch
from nlt.models.projection import average, visible_pixels

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_INCH = 1.1  # of an image in samples.png
_PANELS = ("mssim", "fid", "feature_l1", "mse")


def draw_samples(path: Path, views: Batch, predictions: dict[str, Tensor]) -> None:
    """One row per test view: noisy, every method, reference; all by the one display transform."""
    columns = {"Noisy (1 spp)": views["noisy"], **{label(name): image for name, image in predictions.items()}}
    columns["Reference"] = (views["reference_a"] + views["reference_b"]) / 2
    count = len(views["noisy"])
    figure, axes = plt.subplots(count, len(columns), figsize=(_INCH * len(columns), _INCH * count), squeeze=False)
    for column, (name, images) in enumerate(columns.items()):
        for row, image in enumerate(display(images.float(), views["exposure"])):
            axes[row][column].imshow(image.permute(1, 2, 0).numpy(), interpolation="nearest")
            axes[row][column].set_axis_off()
        axes[0][column].set_title(name.replace(" (", "\n("), fontsize=7)
    figure.subplots_adjust(0.002, 0.002, 0.998, 1 - 0.35 / (_INCH * count), 0.02, 0.02)
    figure.savefig(path, dpi=150)
    plt.close(figure)


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
        "(6) points in view": _scatter(in_view, albedo, height, width),
        "(7) without occluded points": _scatter(kept, albedo, height, width),
    }
    clouds: dict[str, tuple[Tensor, Tensor]] = {
        "(8) visibility": (points, torch.tensor([[1, 0.9, 0], [0.3, 0.2, 0.5]])[visible.long()]),
        "(9) point albedo": (points[visible], albedo[visible]),
        "(10) point emission": (points[visible], emission[visible].clamp(min=0.3)),
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


def draw_speed_accuracy(path: Path, rows: list[dict[str, Any]]) -> None:
    """Accuracy over time per frame, a panel per metric; methods that trace pixels are one curve."""
    figure, axes = plt.subplots(1, len(_PANELS), figsize=(4 * len(_PANELS), 3.6))
    traced = sorted((row for row in rows if row["pixel_fraction"] > 0), key=lambda row: row["pixel_fraction"])
    others = [row for row in rows if row["pixel_fraction"] == 0]
    markers = "osD^vP*X"
    for axis, key in zip(axes, _PANELS, strict=True):
        milliseconds = [1e3 * row["time_per_frame_s"] for row in traced]
        axis.plot(milliseconds, [row[key] for row in traced], "x-", color="0.4", label="Denoising (pixels traced)")
        for x, row in zip(milliseconds, traced, strict=True):
            axis.annotate(f"1/{round(1 / row['pixel_fraction'])}", (x, row[key]), (3, 4), textcoords="offset points",
                          fontsize=8, color="0.3")  # fmt: skip
        for k, row in enumerate(others):
            axis.plot(1e3 * row["time_per_frame_s"], row[key], markers[k % len(markers)], ms=8,
                      label=label(row["method"]))  # fmt: skip
        axis.set_xscale("log")
        axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.tick_params(axis="x", which="both", labelsize=7)
        axis.set_xlabel("time per frame (ms)")
        axis.set_title(heading(key))
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=120)
    plt.close(figure)
