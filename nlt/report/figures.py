"""Charts of a comparison, drawn from its stored results: accuracy over time per frame, and along the trainings."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any

import matplotlib
import matplotlib.pyplot as plt
import numpy as np

from nlt.evaluation.paper import label
from nlt.evaluation.results import HISTORY, OK, TRAINING_IMAGES, Results
from nlt.metrics.quantities import METRICS, heading
from nlt.report import plots

# The supplementary's six panels and two more.
_PANELS = ("mssim", "fid", *(f"feature_l1_layer{k}" for k in range(4)), "mse", "flip")
_CURVES = ("0.3", "#8C510A", "#000000")
_LEARNING = ("mse", "mssim", "fid", "feature_l1", "flip")
_LINE = 56  # characters of a panel's width, in the smallest print
_MAX_PANELS = 4  # of the learning curves, per row
_SHADES = (0.0, 0.65)  # of grey, for the first and the last method of a curve


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
    points, is_linear, notes = _points(results, key), METRICS[key].direction == "higher", []
    if far := far_behind(results, key):
        points = {method: point for method, point in points.items() if method not in far}
        notes = textwrap.wrap(f"not shown: {', '.join(map(label, far))}", _LINE)
        axis.text(0, 1.01, "\n".join(notes), fontsize=6, va="bottom", transform=axis.transAxes)
    plots.draw_front(axis, points, METRICS[key].direction)
    for k, (name, members) in enumerate(families.items()):
        colour = _CURVES[k % len(_CURVES)]
        drawn = [method for method in members if method in points]
        entry, labels = _labels(name, members)
        marker = "x+."[(k + k // len(_CURVES)) % 3]  # another for each curve of the same colour
        dashes = plots.DASHES[k % len(plots.DASHES)]
        _plot(axis, results, key, {m: points[m] for m in drawn}, label=entry, color=colour, ls=dashes, marker=marker)
        for number, m in enumerate(drawn):
            plots.annotate(axis, labels[m], points[m], -11 if number % 2 else 5, fontsize=7, color=colour, zorder=4)
    for k, m in enumerate(_alone(results, families)):
        point = {m: points[m]} if m in points else {}
        _plot(axis, results, key, point, label=label(m), ls="", mec="white", mew=0.6, zorder=3, **plots.style(k))
    if not is_linear:
        axis.set_yscale("log")
        _set_ticks(axis.yaxis)
    axis.margins(0.09, 0.12)
    axis.set_title(heading(key), pad=5 + 8 * len(notes))


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
    rays = lambda m: runs[m]["spp"] * runs[m]["pixel_fraction"]
    for members in families.values():
        if len({rays(m) for m in members}) > 1:
            varied = "spp" if len({runs[m]["spp"] for m in members}) > 1 else "pixels traced"
            joined[f"{label(members[0]).partition(' (')[0]} ({varied})"] = sorted(members, key=rays)
    return joined


def far_behind(results: Results, key: str) -> list[str]:
    """Return the methods that a chart leaves out, because they would press all others together.

    They are four times as far from the best value of the metric `key` as the median method, on a logarithmic axis if
    lower is better.
    """
    values = {m: value for m in results.methods if math.isfinite(value := results.mean(m, key))}
    if METRICS[key].direction == "lower":
        values = {method: -math.log(value) for method, value in values.items() if value > 0}
    gaps = {method: max(values.values()) - value for method, value in values.items()}
    return [method for method, gap in gaps.items() if gap > 4 * np.median(list(gaps.values())) > 0]


def setting(method: str) -> str:
    """Return what tells a method from the others of its curve: its variant, or its pixels or samples per pixel."""
    return method.partition("@")[2] or label(method).partition("(")[2].rstrip(")").removesuffix(" spp")


def _labels(curve: str, members: Sequence[str]) -> tuple[str, dict[str, str]]:
    """Return a curve's entry in the legend, and the label of each of its methods in a panel.

    The names of three or more variants would cover each other, so they stand in the legend, and letters in the panel.
    """
    settings = {method: setting(method) for method in members}
    if len(members) < 3 or "@" not in members[0]:
        return curve, settings
    letters = {method: chr(ord("a") + k) for k, method in enumerate(members)}
    return "\n".join([curve, *(f"{letters[method]}: {settings[method]}" for method in members)]), letters


def _alone(results: Results, families: Mapping[str, Sequence[str]]) -> list[str]:
    """Return the methods that are part of no curve."""
    return [m for m in results.methods if all(m not in members for members in families.values())]


def draw_learning_curves(results: Results) -> None:
    """Draw learning_curves.png and .svg: a row of panels per file; bands are ± 1 standard deviation over seeds."""
    files = {
        HISTORY: ("images_seen", "images seen in training", "validation"),
        TRAINING_IMAGES: ("train_images", "training images per scene", "test"),
    }
    rows = {name: [row for row in results.rows(name) if row.get("status", OK) == OK] for name in files}
    panels = {}
    for name in files:
        measured = [key for key in _LEARNING if any(np.isfinite(row.get(key, np.nan)) for row in rows[name])]
        if measured:
            panels[name] = measured[:_MAX_PANELS]
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
            axis.set(xlabel=title, title=f"{heading(key)}, {split} split")
    handles: dict[str, Any] = {}
    for axis in axes.flat:
        handles |= dict(zip(*axis.get_legend_handles_labels()[::-1], strict=True))
    longest = 0.5 + 0.07 * max(map(len, handles))  # inches of an entry
    side_by_side = max(1, min(2 * columns, int(figure.get_figwidth() / longest)))
    height = 0.25 * -(-len(handles) // side_by_side) / figure.get_figheight()
    figure.legend(handles.values(), handles, loc="lower center", ncols=side_by_side)
    figure.tight_layout(rect=(0, height, 1, 1))
    plots.save(figure, results.directory, "learning_curves")


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
    styles = {m: plots.style(k) for k, m in enumerate(_alone(results, families))}
    for members in families.values():
        for k, (m, shade) in enumerate(zip(members, np.linspace(*_SHADES, len(members)), strict=True)):
            styles[m] = {"color": str(shade), "ls": plots.DASHES[k % 4], "marker": "x+.12"[k % 5]}
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
