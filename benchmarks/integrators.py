"""Compares the integrators `path` and `bdpt`: which has the lower variance at equal time, scene by scene.

    python benchmarks/integrators.py egg living_room --out results/integrators/fixed_lights

Both render the same views in the same states, with interleaved timing. Efficiency is 1 / (variance * time), so the
ratio of two efficiencies is the ratio of the variances at equal time. The variance of linear radiance decides, because
methods are trained on linear radiance. Its estimate is unreliable where a few fireflies make up most of it; two figures
show this: the bootstrap interval over renders, and the share of the variance that comes from the worst pixel. The
variance after the display transform, which clips fireflies, is the variance that the eye sees. Writes table.csv,
table.md, integrators.png and manifest.json.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path
from typing import Any, get_args

import matplotlib.pyplot as plt
import numpy as np
import torch
from scipy import stats

from nlt.cli import exit_code
from nlt.data.engines import Process
from nlt.data.files import write_bytes
from nlt.display import display
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import write_manifest, write_rows
from nlt.rendering.renderer import Renderer
from nlt.rendering.variant import choose_variant, use_variant
from nlt.report import plots
from nlt.report.table_writer import grid
from nlt.scenes.assembly import Scene
from nlt.scenes.description import EXPERIMENTS, Integrator, load_description
from nlt.scenes.state import sample_state
from nlt.scenes.views import Views

INTEGRATORS: tuple[str, ...] = get_args(Integrator)
SPP = 16  # samples per pixel of a render
LEAST = 8  # least number of renders of every view
BLOCK = 4  # width in pixels of the blocks whose agreement is tested
RESAMPLES = 1000
ACROSS = 4  # panels in a row
UNSURE = 0.1  # share of the variance in one pixel above which the table warns


def main() -> None:
    """Compare the integrators in each scene, and write the results after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="+", help="scene descriptions in configs/scenes, by name or path")
    parser.add_argument("--out", type=Path, default=Path("results/integrators"))
    parser.add_argument("--seconds", type=float, default=60, help="seconds of rendering per scene (default: 60)")
    parser.add_argument("--resolution", type=int, default=64, help="image height and width in pixels (default: 64)")
    parser.add_argument("--views", type=int, default=4, help="random views per scene (default: 4)")
    parser.add_argument("--experiment", choices=EXPERIMENTS, default="fixed_lights", help="default: fixed_lights")
    parser.add_argument("--seed", type=int, default=0, help="seed of states, views and noise (default: 0)")
    options = parser.parse_args()
    begun = origin()
    for name in options.names:
        load_description(name)  # reports mistakes before anything is rendered
    choose_variant()  # chosen once; the processes inherit it
    rows = []
    # A process per scene, because Mitsuba's memory grows with every scene.
    for name in options.names:
        rows.append(Process(measure, name, options).result())
        print(line(rows[-1]), flush=True)
        write_rows(options.out / "table.csv", rows)
        write_bytes(options.out / "table.md", markdown(rows).encode())
    draw(options.out, rows)
    settings = {"scenes" if key == "names" else key: value for key, value in vars(options).items() if key != "out"}
    write_manifest(options.out, {**begun, **surroundings(torch.device("cpu")), **settings, "spp": SPP})


def measure(name: str, options: argparse.Namespace) -> dict[str, Any]:
    """Return a scene's row. `ratio` is the efficiency of bdpt over that of path: above one, bdpt is better."""
    use_variant()
    description = load_description(name)
    scene = Scene(description, options.experiment)
    views = Views(scene)
    renderers = {integrator: Renderer(scene, integrator) for integrator in INTEGRATORS}
    placed = []
    for view in range(options.views):
        rng = np.random.default_rng([options.seed, view])
        scene.set_state(sample_state(description, options.experiment, rng))
        placed.append((scene.state, views.sample(options.resolution, rng)))
    images: dict[str, list[list[np.ndarray]]] = {integrator: [] for integrator in INTEGRATORS}
    times: dict[str, list[float]] = {integrator: [] for integrator in INTEGRATORS}
    start, renders = time.perf_counter(), -1  # the first render is the warm-up
    while renders < LEAST or time.perf_counter() - start < options.seconds:
        if renders < 1:
            start = time.perf_counter()
        for rows in images.values():
            rows.append([])
        for view, (state, camera) in enumerate(placed):
            scene.set_state(state)
            for k, integrator in enumerate(INTEGRATORS):
                seed = np.random.SeedSequence([options.seed, renders + 1, view, k]).generate_state(1)[0]
                began = time.perf_counter()
                images[integrator][-1].append(renderers[integrator].radiance(camera, SPP, int(seed)))
                times[integrator].append(time.perf_counter() - began)
        renders += 1
    arrays = {integrator: np.array(rows[1:], np.float64).swapaxes(0, 1) for integrator, rows in images.items()}
    times = {integrator: seconds[options.views :] for integrator, seconds in times.items()}
    return {
        "scene": description.name,
        "experiment": options.experiment,
        "renders": renders,
        **figures(arrays, times, description.exposure, options.resolution),
    }


def figures(
    images: dict[str, np.ndarray], times: dict[str, list[float]], exposure: float, resolution: int
) -> dict[str, Any]:
    """Return a row's figures from images (views, renders, 3, H, W) and seconds per render, by integrator."""
    views, renders = images["path"].shape[:2]
    rng = np.random.default_rng(0)
    counts = rng.multinomial(renders, np.full(renders, 1 / renders), (RESAMPLES, views)).astype(float)
    row: dict[str, Any] = {}
    work, resampled = {}, {}
    for integrator, linear in images.items():
        row[f"{integrator}_s"] = float(np.median(times[integrator])) / (resolution**2 * SPP)  # per sample of a pixel
        flat = linear.reshape(views, renders, -1)
        products = flat @ flat.transpose(0, 2, 1) / flat.shape[2]
        variances = SPP * variance(products, np.ones((1, views, renders)))
        row[f"{integrator}_variance"] = float(variances[0])
        resampled[integrator] = SPP * variance(products, counts) * row[f"{integrator}_s"]
        work[integrator] = float(variances[0]) * row[f"{integrator}_s"]
        squares = (linear - linear.mean(1, keepdims=True)) ** 2
        row[f"{integrator}_worst_pixel"] = float(squares.sum(2).max() / squares.sum())
        shown = display(torch.from_numpy(linear).flatten(0, 1), torch.full((views * renders,), exposure))
        row[f"{integrator}_display_variance"] = float(shown.unflatten(0, (views, renders)).var(1).mean())
    ratios = resampled["path"] / resampled["bdpt"]
    row["ratio"] = work["path"] / work["bdpt"]
    row["ratio_low"], row["ratio_high"] = (float(q) for q in np.quantile(ratios, (0.025, 0.975)))
    displayed = {integrator: row[f"{integrator}_display_variance"] * row[f"{integrator}_s"] for integrator in images}
    row["display_ratio"] = displayed["path"] / displayed["bdpt"]
    row["p_agreement"] = agreement(images["path"], images["bdpt"])
    row["better"] = "bdpt" if row["ratio_low"] > 1 else "path" if row["ratio_high"] < 1 else "undecided"
    return row


def variance(products: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Return the variance over renders, averaged over views and pixels: (K,).

    Args:
        products: (views, renders, renders), mean products of two renders' pixels.
        counts: (K, views, renders), the number of times that a render is drawn.
    """
    n = products.shape[1]
    square = np.einsum("kvr,vrr->kv", counts, products) / n
    mean = np.einsum("kvr,vrs,kvs->kv", counts, products, counts, optimize=True) / n**2
    return ((square - mean) * n / (n - 1)).mean(1)


def agreement(first: np.ndarray, second: np.ndarray) -> float:
    """Return the Bonferroni-corrected p-value of Welch's test on the block of pixels that differs most."""
    blocks = []
    for images in (first, second):
        views, renders, _, height, width = images.shape
        cut = images[..., : height // BLOCK * BLOCK, : width // BLOCK * BLOCK]
        cut = cut.reshape(views, renders, 3, height // BLOCK, BLOCK, width // BLOCK, BLOCK).mean((4, 6))
        blocks.append(np.moveaxis(cut, 1, 0).reshape(renders, -1))
    noisy = (blocks[0].std(0) > 0) & (blocks[1].std(0) > 0)
    p = stats.ttest_ind(*(block[:, noisy] for block in blocks), equal_var=False).pvalue
    return float(min(1, p.min() * p.size)) if p.size else 1.0


def line(row: dict[str, Any]) -> str:
    interval = f"{row['ratio']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})"
    return f"{row['scene']}: variance of path over that of bdpt at equal time: {interval}; better: {row['better']}"


def markdown(rows: list[dict[str, Any]]) -> str:
    lines = [
        "# Integrators",
        "",
        "Variance of one sample per pixel (linear radiance), and time of one sample of one pixel. The ratio is path's",
        "variance over bdpt's at equal time: above one, bdpt is better. The 95% bootstrap interval over renders, in",
        "brackets, decides. Displayed: the ratio after the display transform, which clips fireflies. !: one pixel",
        f"makes up more than {UNSURE:.0%} of the variance: its estimate is unreliable. p: of a test that both agree.",
        "",
    ]
    headings = ["scene", "path: µs", "variance", "bdpt: µs", "variance", "ratio at equal time", "displayed", "p"]
    table = []
    for row in rows:
        cells = [f"{row['scene']} ({row['experiment'].replace('_', ' ')})"]
        for integrator in INTEGRATORS:
            unsure = " !" if row[f"{integrator}_worst_pixel"] > UNSURE else ""
            cells += [f"{1e6 * row[f'{integrator}_s']:.2f}", f"{row[f'{integrator}_variance']:.3g}{unsure}"]
        cells.append(f"{row['ratio']:.2f} ({row['ratio_low']:.2f} to {row['ratio_high']:.2f})")
        cells += [f"{row['display_ratio']:.2f}", f"{row['p_agreement']:.2g}", row["better"]]
        table.append(cells)
    lines += [*grid([*headings, "better"], table), "Where the numbers come from: manifest.json.", ""]
    return "\n".join(lines)


def draw(directory: Path, rows: list[dict[str, Any]]) -> None:
    """Plot variance over time, one panel per scene; the samples per pixel grow along a line."""
    across = min(ACROSS, len(rows))
    down = -(-len(rows) // across)
    figure, axes = plt.subplots(down, across, figsize=(3.4 * across, 3.4 * down), squeeze=False)
    spp = np.array([1, 4, 16, 64, 256])
    for axis in axes.flat[len(rows) :]:
        axis.set_axis_off()
    for axis, row in zip(axes.flat, rows, strict=False):
        for number, integrator in enumerate(INTEGRATORS):
            x, y = row[f"{integrator}_s"] * spp * 1e6, row[f"{integrator}_variance"] / spp
            axis.plot(x, y, **plots.style(number), label=integrator)
            axis.annotate("1 spp", (x[0], y[0]), (5, 4), textcoords="offset points", fontsize=7, color="0.3")
        axis.set(xscale="log", yscale="log", xlabel="time per pixel (µs)")
        interval = f"{row['ratio']:.2g} ({row['ratio_low']:.2g} to {row['ratio_high']:.2g})"
        axis.set_title(f"{row['scene']}\nat equal time {interval}")
    for axis in axes[:, 0]:
        axis.set_ylabel("variance of radiance")
    axes[0][0].legend()
    figure.tight_layout()
    plots.save(figure, directory, "integrators", ("png",))


if __name__ == "__main__":
    sys.exit(exit_code(main))
