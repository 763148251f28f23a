"""What all figures share: style, logarithmic time axes, Pareto fronts, legends, grids of images, files."""

import textwrap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
import torch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import LogLocator, NullFormatter
from PIL import Image

from nlt.display import display

matplotlib.use("Agg")
import matplotlib.pyplot as plt

plt.rcParams.update({
    "svg.hashsalt": "nlt",  # the same drawing gives the same bytes
    "image.interpolation": "nearest",
    "axes.grid": True, "grid.alpha": 0.3, "axes.titlesize": 9, "axes.labelsize": 8,
    "xtick.labelsize": 8, "ytick.labelsize": 8, "legend.fontsize": 8, "legend.frameon": False,
    "figure.constrained_layout.h_pad": 0.08, "figure.constrained_layout.w_pad": 0.08,  # inches
})  # fmt: skip

# Okabe and Ito's colours for colour-blind readers; markers and dashes for print without colour.
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#56B4E9", "#E69F00", "#000000")
MARKERS, DASHES = "osD^v*PX<>", ("-", "--", ":", "-.")
PICTURE = ("webp",)  # the kind of file for a figure made of images; its lossy pixels are a sixth of a PNG's size
PICTURE_DPI = 100
_INCH, _LINE = 1.1, 0.12  # inches: an image of a grid, and a line of its title
_TITLE = 20  # characters of such a line over an image of this size


def style(number: int) -> dict[str, Any]:
    """Return the colour and the marker of a figure's curve, by its number."""
    return {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}


def set_time_axis(axis: plt.Axes) -> None:
    """Make the horizontal axis a logarithmic one of the time per frame in ms, with ticks for the data drawn so far."""
    axis.set(xscale="log", xlabel="time per frame (ms)")
    low, high = axis.get_xlim()
    axis.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if high < 50 * low else (1,)))
    axis.xaxis.set_major_formatter("{x:g}")
    axis.xaxis.set_minor_formatter(NullFormatter())


def annotate(axis: plt.Axes, text: str, at: tuple[float, float], above: float, **options: Any) -> None:
    """Write a text with a white outline `above` points over a position in data coordinates."""
    halo = [withStroke(linewidth=1.5, foreground="white")]
    axis.annotate(text, at, (0, above), textcoords="offset points", ha="center", path_effects=halo, **options)


def draw_front(axis: plt.Axes, points: Mapping[str, tuple[float, float]], direction: str) -> None:
    """Draw the Pareto front of (time, value) points in grey; `direction` says whether lower or higher is better."""
    sign = 1 if direction == "lower" else -1
    front: list[tuple[float, float]] = []
    for x, y in sorted(points.values(), key=lambda point: (point[0], sign * point[1])):
        if not front or sign * y < sign * front[-1][1]:
            front.append((x, y))
    if front:
        axis.step(*zip(*front, strict=True), where="post", color="0.8", lw=5, zorder=0, label="Pareto front")


def add_legend(
    figure: plt.Figure, columns: int, place: Literal["outside upper center", "outside lower center"]
) -> None:
    """Add one legend for all panels of a figure with a constrained layout, and hide the panels without data."""
    entries: dict[str, Any] = {}
    for axis in figure.axes:
        if not axis.has_data():
            axis.set_axis_off()
        for handle, text in zip(*axis.get_legend_handles_labels(), strict=True):
            entries.setdefault(text, handle)
    figure.legend(entries.values(), entries, loc=place, ncols=columns)


def in_lines(name: str, characters: int) -> str:
    """Return a method's name broken before its variant, or else before its brackets, and at so many characters."""
    broken = name.replace(", ", "\n") if ", " in name else name.replace(" (", "\n(")
    return "\n".join(textwrap.fill(line.replace("_", " "), characters) for line in broken.split("\n"))


def grid(
    rows: int, titles: list[str], bottom: float = 0.02, lines: int = 1, inches: float = _INCH
) -> tuple[plt.Figure, np.ndarray]:
    """Return a figure for rows of titled images, and its axes (rows, images of a row); `bottom` inches stay free.

    A row is drawn in `lines`; if there are several, every line has titles, else the first row alone.
    """
    columns = -(-len(titles) // lines)
    texts = [in_lines(name, round(_TITLE * inches / _INCH)) for name in titles]
    top = _LINE * (2 + max(text.count("\n") for text in texts))
    titled = rows * lines if lines > 1 else 1
    size = (inches * columns, inches * rows * lines + top * titled + bottom)
    figure, all_axes = plt.subplots(rows * lines, columns, figsize=size, squeeze=False)
    for axis in all_axes.flat:
        axis.set_axis_off()
    axes = all_axes.reshape(rows, -1)[:, : len(titles)]
    for row in axes[:titled]:
        for axis, text in zip(row, texts, strict=True):
            axis.set_title(text, fontsize=7)
    between = top / inches if lines > 1 else 0.02
    figure.subplots_adjust(0.002, bottom / size[1], 0.998, 1 - top / size[1], 0.02, between)
    return figure, axes


def shown(radiance: np.ndarray, exposure: float) -> np.ndarray:
    """Return linear radiance (3, H, W) as displayed: sRGB in [0, 1], (H, W, 3)."""
    return display(torch.from_numpy(radiance[None].astype(np.float32)), float(exposure))[0].permute(1, 2, 0).numpy()


def save(figure: plt.Figure, directory: Path, name: str, kinds: tuple[str, ...] = ("png", "svg")) -> None:
    """Write a figure into a directory of results; the same figure gives the same bytes.

    A PNG has 256 colours, which makes it a third as large and changes no colour visibly.
    """
    options: dict[str, dict[str, Any]] = {
        "png": {"dpi": 150, "metadata": {"Software": None}},
        "svg": {"dpi": 150, "metadata": {"Date": None}},
        "webp": {"dpi": PICTURE_DPI, "pil_kwargs": {"quality": 90, "method": 6}},
    }
    for kind in kinds:
        file = directory / f"{name}.{kind}"
        figure.savefig(file, **options[kind])
        if kind == "png":
            with Image.open(file) as drawn:
                few = drawn.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE)
            few.save(file, optimize=True)
    plt.close(figure)
