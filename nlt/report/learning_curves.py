"""Accuracy over iterations and over training images, from history.csv and training_images.csv."""

from __future__ import annotations

from typing import Any

import matplotlib
import numpy as np

from nlt.evaluation.paper import label
from nlt.evaluation.results import HISTORY, OK, TRAINING_IMAGES, Results
from nlt.metrics.quantities import METRICS, heading
from nlt.report.figures import curves
from nlt.report.plots import COLOURS, DASHES, MARKERS, plt, save

_PANELS = ("mse", "mssim", "fid", "feature_l1", "flip")
_MAX_PANELS = 4  # per row
_SHADES = (0.0, 0.65)  # of grey, for the first and the last method of a curve


def draw_learning_curves(results: Results) -> None:
    """Draw learning_curves.png and .svg: a row of panels per file; bands are ± 1 standard deviation over seeds."""
    files = {
        HISTORY: ("images_seen", "images seen in training", "validation"),
        TRAINING_IMAGES: ("train_images", "training images per scene", "test"),
    }
    rows = {name: [row for row in results.rows(name) if row.get("status", OK) == OK] for name in files}
    panels = {
        name: [key for key in _PANELS if any(np.isfinite(row.get(key, np.nan)) for row in file_rows)][:_MAX_PANELS]
        for name, file_rows in rows.items()
    }
    panels = {name: keys for name, keys in panels.items() if keys}
    if not panels:
        return
    columns = max(map(len, panels.values()))
    figure, axes = plt.subplots(len(panels), columns, figsize=(3.3 * columns, 2.9 * len(panels) + 0.6), squeeze=False)
    for line, (name, keys) in zip(axes, panels.items(), strict=True):
        x, title, split = files[name]
        for axis in line[len(keys) :]:
            axis.set_axis_off()
        for axis, key in zip(line, keys, strict=False):
            for method, style in _styles(results).items():
                _curve(axis, [row for row in rows[name] if row["method"] == method], x, key, label(method), style)
            axis.set_xscale("log")
            _set_ticks(axis.xaxis)
            if METRICS[key].direction == "lower":
                axis.set_yscale("log")
                _set_ticks(axis.yaxis)
            if name == TRAINING_IMAGES:
                axis.set_xticks(sorted({row[x] for row in rows[name]}))
            axis.set_xlabel(title, fontsize=8)
            axis.set_title(f"{heading(key)}, {split} split", fontsize=9)
            axis.tick_params(labelsize=8)
            axis.grid(alpha=0.3)
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        handles |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    height = 0.25 * -(-len(handles) // (2 * columns)) / figure.get_figheight()
    figure.legend(handles.values(), handles, loc="lower center", ncols=2 * columns, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, height, 1, 1))
    save(figure, results.directory, "learning_curves")


def _set_ticks(axis: matplotlib.axis.Axis) -> None:
    """Set the ticks of a logarithmic axis so that their labels do not overlap."""
    low, high = axis.get_data_interval()
    subs = (1, 2, 5) if high < 30 * low else (1,)
    few = matplotlib.ticker.MaxNLocator(4)  # if powers of ten would give at most one tick
    axis.set_major_locator(few if high < 5 * low else matplotlib.ticker.LogLocator(subs=subs))
    axis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
    axis.set_minor_formatter(matplotlib.ticker.NullFormatter())


def _styles(results: Results) -> dict[str, dict[str, Any]]:
    """Return plot styles by method: a colour and a marker; methods of one curve of speed_accuracy are grey."""
    families = curves(results)
    alone = [m for m in results.methods if all(m not in members for members in families.values())]
    styles = {m: {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)]} for k, m in enumerate(alone)}
    for members in families.values():
        for k, (m, shade) in enumerate(zip(members, np.linspace(*_SHADES, len(members)), strict=True)):
            styles[m] = {"color": str(shade), "ls": DASHES[k % len(DASHES)], "marker": "x+.12"[k % 5]}
    return {m: styles[m] for m in results.methods}


def _curve(axis: plt.Axes, rows: list[dict[str, Any]], x: str, key: str, name: str, style: dict[str, Any]) -> None:
    """Draw the mean over seeds with a band of ± 1 standard deviation."""
    values: dict[float, list[float]] = {}
    for row in rows:
        if np.isfinite(row.get(key, np.nan)):
            values.setdefault(row[x], []).append(row[key])
    if not values:
        return
    xs = sorted(values)
    mean = np.array([np.mean(values[position]) for position in xs])
    axis.plot(xs, mean, lw=1.2, ms=4, label=name, **style)
    deviation = np.array([np.std(values[position], ddof=1) if len(values[position]) > 1 else 0 for position in xs])
    if deviation.any():
        axis.fill_between(xs, mean - deviation, mean + deviation, color=style["color"], alpha=0.15, lw=0)
