"""`nlt teachers`: which integrator, path or bdpt, has the lower variance at equal time, scene by scene.

Both render the same views in the same states, with interleaved timing. Efficiency is 1 / (variance * time), so the
ratio of two efficiencies is the ratio of the variances at equal time. The variance of linear radiance decides, because
methods are trained on linear radiance. Its estimate is unreliable where a few fireflies make up most of it; two figures
show this: the bootstrap interval over renders, and the share of the variance that comes from the worst pixel. The
variance after the display transform, which clips fireflies, is the variance that the eye sees.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from scipy import stats

from nlt.data.engines import Process
from nlt.data.files import write_bytes
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import write_manifest, write_rows
from nlt.metrics.display import display
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import choose_variant, use_variant
from nlt.scenes.assembly import Scene
from nlt.scenes.description import TEACHERS, load_description
from nlt.scenes.state import sample_state
from nlt.scenes.views import Views

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_SPP = 16  # samples per pixel of a render
_LEAST = 8  # least number of renders of every view
_BLOCK = 4  # width in pixels of the blocks whose agreement is tested
_RESAMPLES = 1000
_ACROSS = 4  # panels in a row
_UNSURE = 0.1  # share of the variance in one pixel above which the table warns
_COLOURS = {"path": "#0072B2", "bdpt": "#D55E00"}


def teachers(
    names: list[str],
    out: Path,
    seconds: float = 60,
    resolution: int = 64,
    views: int = 4,
    experiment: str = "fixed_lights",
    seed: int = 0,
) -> list[dict[str, Any]]:
    """Compare the integrators in scenes; write table.csv, table.md, teachers.png and manifest.json.

    Args:
        names: scenes, by name or path.
        out: the directory of the results.
        seconds: rendering time per scene, without the warm-up.
        resolution: pixels on each side of a view.
        views: number of views per scene.
        experiment: the experiment from which states are drawn.
        seed: seed of the states, the views and the renders.

    Returns:
        A row per scene. `ratio` is the efficiency of bdpt over that of path: above one, bdpt is better.

    Raises:
        UserError: a scene is unknown or does not load, or Mitsuba's variant cannot run bdpt.
    """
    begun = origin()
    for name in names:
        load_description(name)  # reports mistakes before anything is rendered
    choose_variant()  # chosen once; the processes inherit it
    rows = []
    # A process per scene, because Mitsuba's memory grows with every scene.
    for name in names:
        rows.append(Process(_measure, name, seconds, resolution, views, experiment, seed).result())
        print(_line(rows[-1]), flush=True)
        write_rows(out / "table.csv", rows)
        write_bytes(out / "table.md", _markdown(rows).encode())
    _draw(out / "teachers.png", rows)
    settings = {"scenes": names, "seconds": seconds, "resolution": resolution, "views": views, "spp": _SPP}
    more = {"experiment": experiment, "seed": seed}
    write_manifest(out, {**begun, **surroundings(torch.device("cpu")), **settings, **more})
    return rows


def _measure(name: str, seconds: float, resolution: int, views: int, experiment: str, seed: int) -> dict[str, Any]:
    use_variant()
    description = load_description(name)
    scene = Scene(description, experiment)
    look = Views(scene)
    renderers = {teacher: Renderer(scene, teacher) for teacher in TEACHERS}
    placed = []
    for view in range(views):
        rng = np.random.default_rng([seed, view])
        scene.set_state(sample_state(description, experiment, rng))
        placed.append((scene.state, look.sample(resolution, rng)))
    images: dict[str, list[list[np.ndarray]]] = {teacher: [[] for _ in placed] for teacher in TEACHERS}
    times: dict[str, list[float]] = {teacher: [] for teacher in TEACHERS}
    start, renders = time.perf_counter(), -1  # the first render is the warm-up
    while renders < _LEAST or time.perf_counter() - start < seconds:
        if renders < 1:
            start = time.perf_counter()
        for view, (state, camera) in enumerate(placed):
            scene.set_state(state)
            for k, teacher in enumerate(TEACHERS):
                key = [seed, renders + 1, view, k]
                random = int(np.random.SeedSequence(key).generate_state(1)[0])
                began = time.perf_counter()
                image = renderers[teacher].radiance(camera, _SPP, random)
                if renders >= 0:
                    times[teacher].append(time.perf_counter() - began)
                    images[teacher][view].append(image)
        renders += 1
    arrays = {teacher: np.array(images[teacher], np.float64) for teacher in TEACHERS}
    return {"scene": description.name, "experiment": experiment, "renders": renders, **_figures(arrays, times,
            description.exposure, resolution)}  # fmt: skip


def _figures(
    images: dict[str, np.ndarray], times: dict[str, list[float]], exposure: float, resolution: int
) -> dict[str, Any]:
    """Return a row's figures from images (views, renders, 3, H, W) and seconds per render, by integrator."""
    views, renders = images["path"].shape[:2]
    rng = np.random.default_rng(0)
    counts = rng.multinomial(renders, np.full(renders, 1 / renders), (_RESAMPLES, views)).astype(float)
    row: dict[str, Any] = {}
    work, resampled = {}, {}
    for teacher, linear in images.items():
        row[f"{teacher}_s"] = float(np.median(times[teacher])) / (resolution**2 * _SPP)  # per sample of a pixel
        flat = linear.reshape(views, renders, -1)
        products = flat @ flat.transpose(0, 2, 1) / flat.shape[2]
        variances = _SPP * _variance(products, np.ones((1, views, renders)))
        row[f"{teacher}_variance"] = float(variances[0])
        resampled[teacher] = _SPP * _variance(products, counts) * row[f"{teacher}_s"]
        work[teacher] = float(variances[0]) * row[f"{teacher}_s"]
        squares = (linear - linear.mean(1, keepdims=True)) ** 2
        row[f"{teacher}_worst_pixel"] = float(squares.sum(2).max() / squares.sum())
        shown = display(torch.from_numpy(linear).flatten(0, 1), torch.full((views * renders,), exposure))
        row[f"{teacher}_display_variance"] = float(shown.unflatten(0, (views, renders)).var(1).mean())
    ratios = resampled["path"] / resampled["bdpt"]
    row["ratio"] = work["path"] / work["bdpt"]
    row["ratio_low"], row["ratio_high"] = (float(q) for q in np.quantile(ratios, (0.025, 0.975)))
    displayed = {teacher: row[f"{teacher}_display_variance"] * row[f"{teacher}_s"] for teacher in images}
    row["display_ratio"] = displayed["path"] / displayed["bdpt"]
    row["p_agreement"] = _agreement(images["path"], images["bdpt"])
    row["better"] = "bdpt" if row["ratio_low"] > 1 else "path" if row["ratio_high"] < 1 else "undecided"
    return row


def _variance(products: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the variance over renders, averaged over views and pixels: (K,).

    Args:
        products: (views, renders, renders), mean products of two renders' pixels.
        counts: (K, views, renders), the number of times that a render is drawn.
    """
    n = products.shape[1]
    square = np.einsum("kvr,vrr->kv", counts, products) / n
    mean = np.einsum("kvr,vrs,kvs->kv", counts, products, counts, optimize=True) / n**2
    return ((square - mean) * n / (n - 1)).mean(1)


def _agreement(first: np.ndarray, second: np.ndarray) -> float:
    """Return the Bonferroni-corrected p-value of Welch's test on the block of pixels that differs most."""
    blocks = []
    for images in (first, second):
        views, renders, _, height, width = images.shape
        cut = images[..., : height // _BLOCK * _BLOCK, : width // _BLOCK * _BLOCK]
        cut = cut.reshape(views, renders, 3, height // _BLOCK, _BLOCK, width // _BLOCK, _BLOCK).mean((4, 6))
        blocks.append(np.moveaxis(cut, 1, 0).reshape(renders, -1))
    noisy = (blocks[0].std(0) > 0) & (blocks[1].std(0) > 0)
    p = stats.ttest_ind(*(block[:, noisy] for block in blocks), equal_var=False).pvalue
    return float(min(1, p.min() * p.size)) if p.size else 1.0


def _line(row: dict[str, Any]) -> str:
    interval = f"{row['ratio']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})"
    return f"{row['scene']}: variance of path over that of bdpt at equal time: {interval}; better: {row['better']}"


def _markdown(rows: list[dict[str, Any]]) -> str:
    lines = [
        "# Integrators",
        "",
        "Variance of one sample per pixel (linear radiance), and time of one sample of one pixel. The ratio is path's",
        "variance over bdpt's at equal time: above one, bdpt is better. The 95% bootstrap interval over renders, in",
        "brackets, decides. Displayed: the ratio after the display transform, which clips fireflies. !: one pixel",
        f"makes up more than {_UNSURE:.0%} of the variance: its estimate is unreliable. p: of a test that both agree.",
        "",
        "| scene | path: µs | variance | bdpt: µs | variance | ratio at equal time | displayed | p | better |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---|",
    ]
    for row in rows:
        cells = [f"{row['scene']} ({row['experiment'].replace('_', ' ')})"]
        for teacher in TEACHERS:
            unsure = " !" if row[f"{teacher}_worst_pixel"] > _UNSURE else ""
            cells += [f"{1e6 * row[f'{teacher}_s']:.2f}", f"{row[f'{teacher}_variance']:.3g}{unsure}"]
        cells.append(f"{row['ratio']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})")
        cells += [f"{row['display_ratio']:.2f}", f"{row['p_agreement']:.2g}", row["better"]]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", "Where the numbers come from: manifest.json."]) + "\n"


def _draw(path: Path, rows: list[dict[str, Any]]) -> None:
    """Plot variance over time, one panel per scene; the samples per pixel grow along a line."""
    across = min(_ACROSS, len(rows))
    down = -(-len(rows) // across)
    figure, axes = plt.subplots(down, across, figsize=(3.4 * across, 3.4 * down), squeeze=False)
    spp = np.array([1, 4, 16, 64, 256])
    for axis in axes.flat[len(rows) :]:
        axis.set_axis_off()
    for axis, row in zip(axes.flat, rows, strict=False):
        for teacher, marker in zip(TEACHERS, "os", strict=True):
            x, y = row[f"{teacher}_s"] * spp * 1e6, row[f"{teacher}_variance"] / spp
            axis.plot(x, y, f"{marker}-", color=_COLOURS[teacher], label=teacher)
            axis.annotate("1 spp", (x[0], y[0]), (5, 4), textcoords="offset points", fontsize=7, color="0.3")
        axis.set(xscale="log", yscale="log", xlabel="time per pixel (µs)")
        interval = f"{row['ratio']:.2g} ({row['ratio_low']:.2g} to {row['ratio_high']:.2g})"
        axis.set_title(f"{row['scene']}\nat equal time {interval}", fontsize=9)
        axis.grid(alpha=0.3)
    for axis in axes[:, 0]:
        axis.set_ylabel("variance of radiance")
    axes[0][0].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=130)
    plt.close(figure)
