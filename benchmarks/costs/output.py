"""A benchmark's table and figures, made from bench.json alone."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label
from nlt.metrics.quantities import STAGES
from nlt.report import plots
from nlt.report.table_writer import Table, grid, section

BENCH = "bench.json"
_COLOUR = dict(zip(STAGES, plots.COLOURS, strict=True))
_HATCH = dict(zip(STAGES, ("", "//", "..", "xx", "\\\\", "", "--"), strict=True))
_MARKER = dict(zip(STAGES, plots.MARKERS, strict=False))
Row = dict[str, Any]


def write_report(directory: Path) -> None:
    """Write bench.md, bench.png and .svg, and growth.png and .svg if growth was measured."""
    content = json.loads((directory / BENCH).read_text())
    parts = defaultdict(list)
    for part in content["parts"]:
        parts[part["kind"]].append(part)
    write_bytes(directory / "bench.md", _markdown(content["manifest"], parts).encode())
    _draw_frames(directory, parts["frame"])
    if parts["growth"]:
        _draw_growth(directory, parts["growth"], content["manifest"]["settings"])


def _stages(rows: Iterable[Row]) -> list[str]:
    """Return the stages that any row has."""
    measured = {key for row in rows for key in row}
    return [stage for stage in STAGES if f"{stage}_s" in measured]


def _names(stages: Iterable[str]) -> list[str]:
    return [stage.replace("_", " ") for stage in stages]


def _ms(row: Row, name: str) -> str:
    return f"{1e3 * row[f'{name}_s']:.2f}" if f"{name}_s" in row else "–"


def _ms_p95(row: Row, name: str) -> str:
    """Return the median and, in brackets, the 95th percentile in milliseconds."""
    return f"{_ms(row, name)} ({_ms(row, f'{name}_p95')})" if f"{name}_s" in row else "–"


def _mib(row: Row) -> str:
    return f"{row['peak_memory_bytes'] / 2**20:.0f}" if "peak_memory_bytes" in row else "–"


def _markdown(manifest: Row, parts: Mapping[str, list[Row]]) -> str:
    settings, size = manifest["settings"], manifest["settings"]["resolution"]
    before, after = manifest["load_average"]["before"], manifest["load_average"]["after"]
    (ceilings,), (generation,), (loading,) = (parts[kind] for kind in ("ceilings", "generation", "loading"))
    lines = [
        f"# {', '.join(manifest['scenes'])}, {size}x{size}, width {settings['width']}",
        "",
        f"{manifest['device']}, {manifest['threads']} threads; Mitsuba {manifest['mitsuba_variant']}; "
        f"weights: {manifest['checkpoint'] or 'random'}; "
        f"{', '.join(f'{name} {value:,}' for name, value in settings.items())}.",
        f"`{manifest['command']}` at commit {manifest['commit']}. Load average of the machine: {before[0]:.1f} before, "
        f"{after[0]:.1f} after; other work affects the ratios less than the times.",
        "",
        "## A frame",
        "",
        f"Milliseconds of a batch of {settings['batch']}: the median and, in brackets, the 95th percentile. Plain: "
        "eager, float32, contiguous NCHW, nothing cached, with interleaved timing of the same frames. Ratio: the time "
        "of transport, projection and synthesis, plain over usual, frame by frame: the median and, in brackets, the "
        "5th to 95th percentile; then the ratio of each path's fastest frame.",
        "",
        *_frames(parts["frame"], ceilings),
        *_training(parts["training"]),
        "## Samples",
        "",
        f"Rendering in one process: {generation['train_per_second']:.2f} training samples per second, "
        f"{generation['evaluated_per_second']:.2f} test samples per second; {generation['of_bare_loop']:.2f} times as "
        "fast as a bare loop of `mi.render` under `dr.freeze` that traces a training sample's rays.",
        f"Loading: {loading['samples_per_second']:.0f} samples per second, "
        f"{loading['bytes_per_second'] / 1e6:.0f} MB/s, all fields, CRCs checked, {settings['workers']} workers.",
        "",
        *grid(["part of a sample", "ms"], ([name, f"{1e3 * s:.1f}"] for name, s in generation["stages_s"].items())),
        *_ceilings(ceilings, settings),
        *_growth(parts["growth"]),
    ]
    return "\n".join(lines).rstrip() + "\n"


def _frames(rows: list[Row], ceilings: Row) -> list[str]:
    stages = _stages(rows)
    table, reached = [], []
    for row in rows:
        plain, spread = "–", "–"
        if ratio := row.get("speedup"):
            plain = _ms(row["plain"], "time_per_frame")
            spread = f"{ratio['median']:.2f} ({ratio['p5']:.2f} to {ratio['p95']:.2f}); {ratio['of_least']:.2f}"
            reached.append(_reached(row, ceilings))
        cells = [*(_ms_p95(row, name) for name in (*stages, "time_per_frame")), plain, spread, _mib(row)]
        table.append([label(row["method"]), *cells, row["timed_frames"]])
    lines = grid(["method", *_names(stages), "frame", "plain frame", "ratio", "peak MiB", "frames"], table)
    if reached:
        lines += grid(["synthesis", "precision", "parameters", "GFLOP", "GFLOP/s", "of the ceiling"], reached)
        lines += ["GFLOP: the plain path's; a path with fewer may exceed the ceiling.", ""]
    return lines


def _reached(row: Row, ceilings: Row) -> list[str]:
    """Return how close synthesis comes to the faster of matrix product and convolution in the row's precision."""
    rates = [value for name, value in ceilings["computing"].items() if name.endswith(f"_{row['precision']}")]
    flops = row["step_flops"]["synthesis"]
    speed = flops / row["synthesis_s"]
    cells = [f"{row['parameters']:,}", f"{flops / 1e9:.2f}", f"{speed / 1e9:.0f}"]
    return [label(row["method"]), row["precision"], *cells, f"{speed / max(rates, default=math.nan):.0%}"]


def _training(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    table = []
    for row in rows:
        cells = [row["skipped"], "–", "–"] if "skipped" in row else [
            f"{row['images_per_second']:.2f}", _ms_p95(row, "step"), f"{row['waiting_share']:.1%}",
        ]  # fmt: skip
        table.append([label(row["method"]), *cells])
    return section(Table("Training", "", ["images per second", "step (ms)", "waiting for data"], table))


def _ceilings(ceilings: Row, settings: Row) -> list[str]:
    computing = dict(ceilings["computing"])
    copy = computing.pop("copy")
    table = [[name.replace("_", ", "), f"{value / 1e9:.0f} GFLOP/s"] for name, value in computing.items()]
    table.append(["copying memory, read and written", f"{copy / 1e9:.1f} GB/s"])
    size = f"{settings['resolution']}x{settings['resolution']}"
    names = {
        "path_tracing": f"`mi.render` at 1 spp, {size}",
        "gbuffer": f"`mi.render` of depth, normal and albedo, {size}",
        "photons": f"{settings['num_photons']:,} photons, bare",
    }
    table += [[names[name], f"{1e3 * seconds:.2f} ms"] for name, seconds in ceilings["bare_s"].items()]
    return section(Table("This machine's ceilings, in the same run", "", ["best"], table, first=""))


def _growth(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    stages, table = _stages(rows), []
    for row in rows:
        name = f"{label(row['method'])}, {row['factor']} {row['value']:,}"
        whole = row.get("skipped") or _ms_p95(row, "time_per_frame")
        table.append([name, *(_ms(row, stage) for stage in stages), whole, _mib(row)])
    note = "Median milliseconds with one setting changed at a time; with a larger batch, those of all its frames."
    return section(Table("Growth", note, [*_names(stages), "frame", "peak MiB"], table, first=""))


def _draw_frames(directory: Path, rows: list[Row]) -> None:
    """Draw bench: one bar per method, stacked by stage, and below it, paler, the bar of its plain path."""
    bars: list[tuple[str, Row]] = []
    for row in rows:
        bars += [(label(row["method"]), row), *([("plain", row["plain"])] if "plain" in row else [])]
    figure, axis = plt.subplots(figsize=(8, 0.9 + 0.27 * len(bars)), layout="constrained")
    places = np.cumsum([0.85 if name == "plain" else 1.15 for name, _ in bars])
    for place, (name, row) in zip(places, bars, strict=True):
        left, alpha, colour = (0.0, 0.45, "0.4") if name == "plain" else (0.0, 1.0, "k")
        for stage in _stages([row]):
            width = 1e3 * row[f"{stage}_s"]
            axis.barh(
                place, width, 0.8, left, color=_COLOUR[stage], hatch=_HATCH[stage], edgecolor="white", linewidth=0.4,
                label=stage.replace("_", " "), alpha=alpha,
            )  # fmt: skip
            left += width
        whole = 1e3 * row["time_per_frame_s"]
        ratio = f", {row['speedup']['median']:.1f}x" if "speedup" in row else ""
        axis.text(whole, place, f" {whole:.1f}{ratio}", va="center", fontsize=7, color=colour)
    axis.set_yticks(places, [name for name, _ in bars])
    axis.set_ylim(places[-1] + 0.7, places[0] - 0.7)
    axis.set_xlim(0, 1.17e3 * max(row["time_per_frame_s"] for _, row in bars))
    axis.set_xlabel("time (ms), median of each stage; x: speed-up over the plain path, without the rendered stages")
    axis.grid(visible=False, axis="y")
    axis.set_axisbelow(True)
    plots.add_legend(figure, 7, "outside upper center")
    plots.save(figure, directory, "bench")


def _draw_growth(directory: Path, rows: list[Row], settings: Row) -> None:
    """Draw growth: one row per method, one column per factor; the time of each stage and, in grey, of the frame."""
    methods, factors = (list(dict.fromkeys(row[key] for row in rows)) for key in ("method", "factor"))
    size = (2.7 * len(factors), 2.7 * len(methods) + 0.7)
    figure, axes = plt.subplots(
        len(methods), len(factors), figsize=size, squeeze=False, sharey="row", layout="constrained"
    )
    for line, method in zip(axes, methods, strict=True):
        for axis, factor in zip(line, factors, strict=True):
            if mine := [row for row in rows if (row["method"], row["factor"]) == (method, factor)]:
                _draw_factor(axis, mine, factor, settings[factor])
        line[0].set_ylabel(f"{label(method)}\ntime (ms)")
    plots.add_legend(figure, 8, "outside upper center")
    note = "Dotted: the value in the other panels."
    if any("skipped" in row for row in rows):
        note += " Crosses: not measured because of a time or memory limit, given in bench.md."
    figure.supxlabel(note, fontsize=7, x=0.01, ha="left")
    plots.save(figure, directory, "growth")


def _draw_factor(axis: plt.Axes, rows: list[Row], factor: str, base: int) -> None:
    """Draw a method's times over a setting, whose value in the other panels is `base`."""
    measured = [row for row in rows if "skipped" not in row]
    x = [row["value"] for row in measured]
    for stage in _stages(rows):
        y = [1e3 * row[f"{stage}_s"] for row in measured]
        name = stage.replace("_", " ")
        axis.plot(x, y, color=_COLOUR[stage], marker=_MARKER[stage], ms=4, lw=1.2, label=name)
    whole = [1e3 * row["time_per_frame_s"] for row in measured]
    axis.plot(x, whole, color="0.5", lw=3, alpha=0.5, zorder=0, label="frame")
    skipped = [row["value"] for row in rows if "skipped" in row]
    axis.plot(skipped, [0.95] * len(skipped), "kx", ms=6, transform=axis.get_xaxis_transform())
    axis.axvline(base, color="0.6", lw=0.8, ls=":")
    axis.set(xscale="log", yscale="log", xlabel=factor)
    # Values that are too close to the base are not labelled.
    values = [v for v in (row["value"] for row in rows) if v == base or not 0.6 < v / base < 1.7]
    axis.set_xticks(values, [f"{v // 1000}k" if v >= 1000 and v % 1000 == 0 else str(v) for v in values])
    axis.tick_params(labelsize=7)
    axis.minorticks_off()
