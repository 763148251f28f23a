"""The figures of the stress suites: growth of the error by severity, breaking points, and the worst views."""

import math
from textwrap import fill

import matplotlib.pyplot as plt
import numpy as np

from nlt.evaluation.paper import label
from nlt.evaluation.results import Results
from nlt.report import plots
from nlt.stress.breaking import DOUBLED, Stressed
from nlt.stress.suites import RENDERED

_CEILING = 1e3  # growth at which curves are clipped
_ACROSS = 6  # panels of curves in a row
_WORST = 8  # rows of the gallery


def draw_curves(stressed: Stressed) -> None:
    """Draw stress_curves: the growth of the error over severity, one panel per ladder, on one scale."""
    rows = math.ceil(len(stressed.errors) / _ACROSS)
    size = (2.4 * _ACROSS, 2 * rows + 0.6)
    figure, axes = plt.subplots(
        rows, _ACROSS, figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    for axis, (ladder, errors) in zip(axes.flat, stressed.errors.items(), strict=False):
        for method, own in errors.items():
            k = stressed.methods.index(method)
            look = {**plots.style(k), "ls": plots.DASHES[k // len(plots.COLOURS) % len(plots.DASHES)]}
            axis.plot(np.clip(own / own[0], 1 / DOUBLED**2, _CEILING), lw=1, ms=3, label=label(method), **look)
        axis.axhline(DOUBLED, color="0.6", lw=0.8, ls=":")
        axis.set_title(stressed.title(ladder), fontsize=6.5)
        axis.set(yscale="log", xticks=range(6))
        axis.tick_params(labelsize=7, labelbottom=True)
    figure.supylabel("error over clean error, by severity", fontsize=8)
    plots.add_legend(figure, 7, "outside lower center")
    plots.save(figure, stressed.directory, "stress_curves")


def draw_map(stressed: Stressed) -> None:
    """Draw stress_map: each method's breaking point on each ladder; darker is earlier, blank is not affected."""
    ladders, methods = list(stressed.breaks), stressed.methods
    size = (2.6 + 0.55 * len(methods), 1.4 + 0.22 * len(ladders))
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    points = np.full((len(ladders), len(methods)), np.nan)
    for row, ladder in enumerate(ladders):
        for method, at in stressed.breaks[ladder].items():
            column, text = methods.index(method), stressed.break_text(ladder, method)
            points[row, column] = min(at, 5.5)
            axis.text(column, row, text, ha="center", va="center", fontsize=6.5, color="white" if at < 3 else "black")
    axis.imshow(points, cmap="cividis", vmin=0, vmax=5.5, aspect="auto")
    axis.set_xticks(range(len(methods)), map(label, methods), rotation=40, ha="right", fontsize=7)
    axis.set_yticks(range(len(ladders)), map(stressed.title, ladders), fontsize=7)
    axis.set_title("Severity at which the error doubles", fontsize=8)
    axis.grid(False)
    plots.save(figure, stressed.directory, "stress_map")


def draw_worst(stressed: Stressed) -> None:
    """Draw stress_worst: the views whose error grew most at a ladder's highest severity, by reference and every method.

    The method whose error grew most is framed.
    """
    worst_of_ladders = [
        max(
            (row["error"] / own[0], ladder, place, method)
            for method, own in errors.items()
            for place, row in enumerate(stressed.views(method, ladder, len(own) - 1))
        )
        for ladder, errors in stressed.errors.items()
        if ladder[0] in RENDERED
    ]
    picked = sorted(worst_of_ladders, reverse=True)[:_WORST]
    suites, names = {suite for _, (suite, _), _, _ in picked}, ("reference", *stressed.methods)
    results = Results(stressed.directory, stressed.manifest, [], [])
    stored = {(suite, name): results.images(f"{suite}-{name}") or {} for suite in suites for name in names}
    columns = [name for name in names if all(stored[suite, name] for suite in suites)]
    if not picked or "reference" not in columns:
        return  # images exist only on the machine that made them
    figure, axes = plots.grid(len(picked), ["Reference", *map(label, columns[1:])])
    for row, (growth, (suite, ladder), place, worst) in zip(axes, picked, strict=True):
        exposure = stored[suite, "reference"]["exposure"][place]
        for axis, name in zip(row, columns, strict=True):
            axis.imshow(plots.shown(stored[suite, name][ladder][place], exposure))
            if name == worst:
                frame = {"fill": False, "ec": plots.COLOURS[1], "lw": 4, "transform": axis.transAxes}
                axis.add_patch(plt.Rectangle((0, 0), 1, 1, **frame))
        row[0].text(
            0.02, 0.03, f"{fill(stressed.says((suite, ladder)), 18)}\n{growth:.3g}x", transform=row[0].transAxes,
            fontsize=6, color="white", bbox={"facecolor": "black", "alpha": 0.6, "pad": 1, "lw": 0},
        )  # fmt: skip
    plots.save(figure, stressed.directory, "stress_worst", plots.PICTURE)
