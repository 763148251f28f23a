"""Figures of the methods' errors, from stored results: insets, error maps, and causes of the worst pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import matplotlib
import numpy as np
from scipy.ndimage import uniform_filter

from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import Results, read_rows, write_rows
from nlt.report.plots import PICTURE, PICTURE_DPI, grid, in_lines, plt, save, shown
from nlt.report.table_writer import Table, write_texts

FAILURES = "failures.csv"
_LINES, _COLUMNS, _SAMPLE = 6, 7, 1.92  # lines of samples.webp, images of a line, inches of an image
_VIEWS = 3  # in qualitative.webp
_INSET = 4  # image side / inset side
WORST = 0.1  # fraction of a method's pixels
# The hard cases that the supplementary names, in order of precedence, with colours of Okabe and Ito.
CAUSES = {
    "mirror": "#0072B2",
    "glass": "#56B4E9",
    "near camera": "#E69F00",
    "shadow edge": "#D55E00",
    "light not in view": "#CC79A7",
    "none of these": "#999999",
}


@dataclass(frozen=True)
class Shown:
    """The stored views as displayed, (V, H, W, 3) each."""

    results: Results
    reference: np.ndarray
    noisy: np.ndarray
    methods: dict[str, np.ndarray]

    @classmethod
    def load(cls, results: Results) -> Shown | None:
        """Load the views; None if the images are on another machine."""
        reference = results.images("reference")
        if reference is None:
            return None
        finished = [m for m in results.methods if results.runs_of(m)]
        stored = {"reference": reference, **{name: results.images(name) for name in ("noisy", *finished)}}
        images = {
            name: np.stack([shown(r, e) for r, e in zip(arrays["radiance"], reference["exposure"], strict=True)])
            for name, arrays in stored.items()
            if arrays is not None
        }
        return cls(results, images.pop("reference"), images.pop("noisy"), images)

    @property
    def titles(self) -> list[str]:
        """The titles of the images of a `row`."""
        return ["Training image", *map(label, self.methods), "Reference"]

    def spread(self, count: int) -> np.ndarray:
        """Return the numbers of `count` views from the first to the last, or of all if there are fewer."""
        return np.unique(np.linspace(0, len(self.reference) - 1, count).round().astype(int))

    def row(self, view: int) -> list[np.ndarray]:
        """Return the training image, every method's image and the reference of a view, (H, W, 3) each."""
        return [self.noisy[view], *(images[view] for images in self.methods.values()), self.reference[view]]

    def error(self, method: str) -> np.ndarray:
        """Return the RMS difference over RGB between the displayed images, (V, H, W)."""
        return np.sqrt(np.square(self.methods[method] - self.reference).mean(-1))

    @cached_property
    def scale(self) -> float:
        """The error drawn brightest: the 99th percentile over all methods and views, or 1 without any error."""
        return float(np.quantile([self.error(m) for m in self.methods], 0.99) if self.methods else 1) or 1.0

    @cached_property
    def causes(self) -> dict[str, np.ndarray]:
        """The pixels (V, H, W) to which each of `CAUSES` applies; several may apply to a pixel.

        Raises UserError if the images are from an older version.
        """
        buffers = self.results.images("gbuffer")
        assert buffers is not None
        if "transmits" not in buffers:
            raise UserError(f"{self.results.directory}: its images are from an older version; run nlt compare again")
        buffers = {name: array.astype(np.float32) for name, array in buffers.items()}
        albedo, normal, depth = buffers["albedo"].mean(1), buffers["normal"], buffers["depth"][:, 0]
        hit = depth > 0
        luminance = self.reference.mean(-1)
        near = hit & (depth < 0.5 * np.median(depth[hit])) if hit.any() else hit
        specular = hit & (albedo == 0) & (luminance < 1)  # lamps have no albedo either, but are bright
        glass = buffers["transmits"].astype(bool)
        dark = ~buffers["light_in_view"].astype(bool)
        causes = {
            "mirror": specular & ~glass,
            "glass": specular & glass,
            "near camera": near,
            "shadow edge": _shadow_edges(luminance, albedo, normal, depth),
            "light not in view": np.broadcast_to(dark[:, None, None], hit.shape),
        }
        return causes | {"none of these": ~np.any(list(causes.values()), axis=0)}


def _shadow_edges(luminance: np.ndarray, albedo: np.ndarray, normal: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return (V, H, W) bool: light changes by more than a quarter over two pixels, and the surface does not."""
    light = np.log(uniform_filter(luminance, (0, 3, 3)) + 0.02)
    edges = np.zeros(depth.shape, bool)
    for axis in (1, 2):
        change = lambda x, axis=axis: np.abs(np.roll(x, -1, axis) - np.roll(x, 1, axis))
        smooth = (change(albedo) < 0.02) & (change(depth) < 0.1 * depth)
        smooth &= np.stack([change(normal[:, k]) for k in range(3)]).max(0) < 0.1
        smooth[:, [0, -1]] = smooth[:, :, [0, -1]] = False
        edges |= smooth & (change(light) > 0.25)
    return edges


def draw_samples(images: Shown) -> None:
    """Draw samples.webp: views, each with the noisy training image, every method and the reference as displayed."""
    lines = -(-len(images.titles) // _COLUMNS)
    views = images.spread(max(_LINES // lines, 1))
    figure, axes = grid(len(views), images.titles, lines=lines, inches=_SAMPLE)
    has_room = images.reference.shape[1] < _SAMPLE * PICTURE_DPI
    for row, view in zip(axes, views, strict=True):
        for axis, image in zip(row, images.row(view), strict=True):
            axis.imshow(image, interpolation="nearest" if has_room else "antialiased")
    save(figure, images.results.directory, "samples", PICTURE)


def draw_qualitative(images: Shown) -> None:
    """Draw qualitative.webp: all methods in a few views, with an inset where trained ones err most, and errors."""
    trained = [m for m in images.methods if np.isfinite(images.results.mean(m, "train_s"))] or list(images.methods)
    errors = {m: images.error(m) for m in images.methods}
    size = images.reference.shape[1]
    side = max(size // _INSET, 4)
    views = images.spread(_VIEWS)
    figure, axes = grid(len(images.titles), ["Image", "Inset", "Error"] * len(views))
    for k, view in enumerate(views):
        mean = uniform_filter(np.mean([errors[m][view] for m in trained], axis=0), side, mode="nearest")
        inside = mean[side // 2 : size - side // 2, side // 2 : size - side // 2]
        top, left = np.unravel_index(inside.argmax(), inside.shape)
        crop = (slice(top, top + side), slice(left, left + side))
        own = axes[:, 3 * k : 3 * k + 3]
        for (whole, inset, _), image in zip(own, images.row(view), strict=True):
            whole.imshow(image)
            whole.add_patch(plt.Rectangle((left - 0.5, top - 0.5), side, side, fill=False, ec="#D55E00", lw=0.8))
            inset.imshow(image[crop])
        for row, method in zip(own[1:-1], images.methods, strict=True):
            drawn = row[2].imshow(errors[method][view], cmap="magma", vmin=0, vmax=images.scale)
    for row, title in zip(axes, images.titles, strict=True):
        _name(row[0], title)
    figure.colorbar(drawn, cax=axes[0][2].inset_axes((0.1, 0.1, 0.15, 0.8))).ax.tick_params(labelsize=5)
    save(figure, images.results.directory, "qualitative", PICTURE)


def _name(axis: plt.Axes, method: str) -> None:
    """Write a method's name into the corner of its image."""
    box = {"facecolor": "black", "alpha": 0.8, "linewidth": 0, "pad": 1}
    text = in_lines(method, 18)
    axis.text(0.02, 0.98, text, color="white", fontsize=5, va="top", bbox=box, transform=axis.transAxes)


def worst_pixels(images: Shown, method: str) -> np.ndarray:
    """Return (V, H, W) bool: the tenth of a method's pixels with the largest error."""
    error = images.error(method)
    return error > np.quantile(error, 1 - WORST)


def draw_failures(images: Shown) -> None:
    """Write failures.webp, .csv, .md and .tex: the causes in each method's worst tenth of the pixels, counted.

    The figure shows the view with most of these pixels: prediction, reference, error, and the worst pixels in the
    colour of the first cause that applies.
    """
    rows = []
    figure, axes = grid(
        len(images.methods), ["Prediction", "Reference", "Error", "Worst pixels"], bottom=0.45, inches=_SAMPLE
    )
    colours = np.array([matplotlib.colors.to_rgb(colour) for colour in CAUSES.values()])
    first = np.argmax([images.causes[cause] for cause in CAUSES], axis=0)
    for row, method in zip(axes, images.methods, strict=True):
        worst = worst_pixels(images, method)
        view = int(worst.sum((1, 2)).argmax())
        overlay = np.where(worst[view][..., None], colours[first[view]], 0.25 * images.reference[view])
        error = images.error(method)[view]
        pictures = (images.methods[method][view], images.reference[view], error, overlay)
        for axis, picture in zip(row, pictures, strict=True):
            axis.imshow(picture, cmap="magma", vmin=0, vmax=images.scale)
        _name(row[0], label(method))
        for cause, mask in images.causes.items():
            rows.append({
                "method": method, "cause": cause, "pixels": int((worst & mask).sum()),
                "share_of_worst": float(mask[worst].mean()) if worst.any() else 0.0, "share_of_all": float(mask.mean()),
            })  # fmt: skip
    handles = [plt.Rectangle((0, 0), 1, 1, color=colour) for colour in CAUSES.values()]
    figure.legend(handles, CAUSES, loc="lower center", ncols=3, fontsize=7, frameon=False)
    save(figure, images.results.directory, "failures", PICTURE)
    write_rows(images.results.directory / FAILURES, rows)
    table = failures(images.results)
    assert table
    write_texts(images.results.directory / "failures", [table], f"images/*.npz, {FAILURES}")


def failures(results: Results) -> Table | None:
    """Return the counts of failures.csv as a table; None if the file is missing."""
    path = results.directory / FAILURES
    if not path.exists():
        return None
    cells = {(row["method"], row["cause"]): row for row in read_rows(path)}
    methods, causes = (list(dict.fromkeys(names)) for names in zip(*cells, strict=True))
    text = lambda row: f"{row['share_of_worst']:.1%} ({row['pixels']:,})"
    rows = [[label(method), *(text(cells[method, cause]) for cause in causes)] for method in methods]
    rows.append(["all pixels", *(f"{cells[methods[0], cause]['share_of_all']:.1%}" for cause in causes)])
    return Table(
        "Causes of the worst pixels",
        f"Each method's worst tenth of the pixels in {len(results.manifest['shown'])} test views: the share to which a "
        "cause applies, and the number of these pixels. Several causes may apply to a pixel. If the share exceeds that "
        "of all pixels, the cause is associated with errors.",
        causes,
        rows,
    )
