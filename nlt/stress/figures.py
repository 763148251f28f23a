"""The figures and the report section of the stress suites: curves, heat map, gallery."""

from __future__ import annotations

import math
from pathlib import Path
from textwrap import fill

import matplotlib
import numpy as np

from nlt.evaluation.paper import label
from nlt.evaluation.results import IMAGES, MANIFEST
from nlt.report.figures import COLOURS, DASHES, MARKERS, PICTURE, grid, save, shown
from nlt.report.page import Section
from nlt.stress.suites import RENDERED
from nlt.stress.tables import (
    BREAKING,
    DOUBLED,
    ROWS,
    STRESS,
    TEXT,
    TRAININGS,
    Stressed,
    breaking_point,
    introduction,
    load_stress,
    paragraphs,
    severity,
    tables,
    write_stress,
)  # fmt: skip

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_CEILING = 1e3  # growth at which curves are clipped
_WORST = 8  # rows of the gallery


def draw_stress(directory: Path) -> None:
    """Write breaking.csv, stress.md and the figures from a directory's rows; do nothing where there are none."""
    stressed = load_stress(directory)
    if stressed is None:
        return
    write_stress(stressed)
    if stressed.ladders:
        _curves(stressed)
        _heat_map(stressed)
        _gallery(stressed)


def stress_section(results: Path) -> Section | None:
    """Draw the stress suites of a comparison's results and return their report section; None without results."""
    directory = results / STRESS
    draw_stress(directory)
    stressed = load_stress(directory)
    if stressed is None:
        return None
    prose = [introduction(stressed), *paragraphs(stressed)]
    files = (ROWS, BREAKING, TRAININGS, TEXT, MANIFEST)
    source = f"{STRESS}/{BREAKING}, {ROWS}, {TRAININGS}"
    return Section(STRESS, "Where methods fail", prose, tables(stressed), directory, files, source)


def _curves(stressed: Stressed) -> None:
    """Draw stress_curves: the growth of the error over severity, one panel per ladder, on one scale."""
    columns = 6
    count = math.ceil(len(stressed.ladders) / columns)
    figure, axes = plt.subplots(
        count, columns, figsize=(2.4 * columns, 2 * count + 0.6), squeeze=False, sharex=True, sharey=True
    )
    for axis in axes.flat[len(stressed.ladders) :]:
        axis.set_axis_off()
    for axis, ladder in zip(axes.flat, stressed.ladders, strict=False):
        for k, method in enumerate(stressed.methods):
            growth = stressed.growth(method, ladder)
            if len(growth):
                axis.plot(
                    np.clip(growth, 1 / DOUBLED**2, _CEILING), DASHES[k // len(COLOURS) % len(DASHES)], lw=1, ms=3,
                    marker=MARKERS[k % len(MARKERS)], color=COLOURS[k % len(COLOURS)], label=label(method),
                )  # fmt: skip
        axis.axhline(DOUBLED, color="0.6", lw=0.8, ls=":")
        axis.set_yscale("log")
        axis.set_title(f"{ladder[0]}: {stressed.says(ladder)}", fontsize=6.5)
        axis.set_xticks(range(6))
        axis.tick_params(labelsize=7, labelbottom=True)
        axis.grid(alpha=0.3)
    figure.supylabel("error over clean error, by severity", fontsize=8)
    handles = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(handles.values(), handles.keys(), loc="lower center", ncols=7, fontsize=7, frameon=False)
    figure.tight_layout(rect=(0.01, 0.15 / count + 0.01, 1, 1))
    save(figure, stressed.directory, "stress_curves")


def _heat_map(stressed: Stressed) -> None:
    """Draw stress_map: each method's breaking point on each ladder; darker is earlier, blank is not affected."""
    methods, ladders = stressed.methods, stressed.ladders
    points = np.full((len(ladders), len(methods)), np.nan)
    highest = np.full(len(ladders), 5)
    for i, ladder in enumerate(ladders):
        for j, method in enumerate(methods):
            growth = stressed.growth(method, ladder)
            if len(growth):
                points[i, j], highest[i] = breaking_point(growth), len(growth) - 1
    figure, axis = plt.subplots(figsize=(2.6 + 0.55 * len(methods), 1.4 + 0.22 * len(ladders)))
    axis.imshow(np.minimum(points, 5.5), cmap="cividis", vmin=0, vmax=5.5, aspect="auto")
    for (i, j), at in np.ndenumerate(points):
        if not math.isnan(at):
            colour = "white" if min(at, 5.5) < 3 else "black"
            axis.text(j, i, severity(at, int(highest[i])), ha="center", va="center", fontsize=6.5, color=colour)
    axis.set_xticks(range(len(methods)), [label(m) for m in methods], rotation=40, ha="right", fontsize=7)
    axis.set_yticks(range(len(ladders)), [f"{s}: {stressed.says((s, n))}" for s, n in ladders], fontsize=7)
    axis.set_title("Severity at which the error doubles", fontsize=8)
    figure.tight_layout()
    save(figure, stressed.directory, "stress_map")


def _gallery(stressed: Stressed) -> None:
    """Draw stress_worst: the views whose error grew most at a ladder's highest severity, by reference and every method.

    The method whose error grew most is framed.
    """
    candidates = []
    for ladder in stressed.ladders:
        if ladder[0] not in RENDERED:
            continue
        for method in stressed.methods:
            rows = [r for r in stressed.rows if (r["method"], r["suite"], r["ladder"]) == (method, *ladder)]
            top = [row for row in rows if row["severity"] == max(r["severity"] for r in rows)]
            for place, row in enumerate(top):
                candidates.append((row["error"] / stressed.clean(method), ladder, place, method))
    chosen: dict[tuple[str, str], tuple[float, int, str]] = {}
    for growth, ladder, place, method in sorted(candidates, reverse=True):
        chosen.setdefault(ladder, (growth, place, method))
    picked = sorted(chosen.items(), key=lambda item: -item[1][0])[:_WORST]
    suites = {ladder[0] for ladder, _ in picked}
    stored = {(s, m): _images(stressed, s, m) for s in suites for m in ("reference", *stressed.methods)}
    if not picked or not all(stored[suite, "reference"] for suite in suites):
        return  # images exist only on the machine that made them
    methods = [m for m in stressed.methods if all(stored[suite, m] for suite in suites)]
    figure, axes = grid(len(picked), ["Reference", *(label(m) for m in methods)])
    for row, ((suite, name), (growth, place, worst)) in zip(axes, picked, strict=True):
        exposure = float(stored[suite, "reference"]["exposure"][place])
        for axis, m in zip(row, ("reference", *methods), strict=True):
            axis.imshow(shown(stored[suite, m][name][place], exposure), interpolation="nearest")
            if m == worst:
                frame = {"fill": False, "ec": COLOURS[1], "lw": 4, "transform": axis.transAxes}
                axis.add_patch(plt.Rectangle((0, 0), 1, 1, **frame))
        row[0].text(
            0.02, 0.03, f"{fill(stressed.says((suite, name)), 18)}\n{growth:.3g}x", transform=row[0].transAxes,
            fontsize=6, color="white", bbox={"facecolor": "black", "alpha": 0.6, "pad": 1, "lw": 0},
        )  # fmt: skip
    save(figure, stressed.directory, "stress_worst", PICTURE)


def _images(stressed: Stressed, suite: str, method: str) -> dict[str, np.ndarray]:
    path = stressed.directory / IMAGES / f"{suite}-{method}.npz"
    if not path.exists():
        return {}
    with np.load(path) as file:
        return dict(file)
