"""The comparison's pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
from torch import Tensor

from nlt.evaluation.paper import label
from nlt.evaluation.tables import heading
from nlt.metrics.display import display
from nlt.models.module import Batch

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


def draw_speed_accuracy(path: Path, rows: list[dict[str, Any]]) -> None:
    """Accuracy over time per frame, a panel per metric; methods that trace pixels are one curve."""
    figure, axes = plt.subplots(1, len(_PANELS), figsize=(4 * len(_PANELS), 3.6))
    traced = sorted((row for row in rows if row["pixel_fraction"] > 0), key=lambda row: row["time_per_frame_s"])
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
