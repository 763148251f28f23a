"""A benchmark's table and figures, made from bench.json alone."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label
from nlt.metrics.quantities import STAGES
from nlt.report.figures import COLOURS, MARKERS, plt, save

BENCH = "bench.json"
_COLOUR = dict(zip(STAGES, (*COLOURS[:6], "#999999"), strict=True))
_HATCH = dict(zip(STAGES, ("", "//", "..", "xx", "\\\\", "", "--"), strict=True))
_MARKER = dict(zip(STAGES, MARKERS, strict=False))
Row = dict[str, Any]


def write_report(directory: Path) -> None:
    """Write bench.md, bench.png and .svg, and growth.png and .svg if growth was measured."""
    content = json.loads((directory / BENCH).read_text())
    parts: list[Row] = content["parts"]
    of_kind = lambda kind: [part for part in parts if part["kind"] == kind]
    write_bytes(directory / "bench.md", (_markdown(content["manifest"], of_kind) + "\n").encode())
    _draw_frames(directory, of_kind("frame"))
    if growth := of_kind("growth"):
        _draw_growth(directory, growth, content["manifest"]["settings"])


def _stages(rows: Iterable[Row]) -> list[str]:
    """Return the stages that any row has."""
    rows = list(rows)
    return [stage for stage in STAGES if any(f"{stage}_s" in row for row in rows)]


def _table(header: list[str], rows: list[list[str]]) -> list[str]:
    lines = ["| " + " | ".join(header) + " |", "|---|" + "---:|" * (len(header) - 1)]
    return [*lines, *("| " + " | ".join(row) + " |" for row in rows), ""]


def _ms(row: Row, key: str) -> str:
    return f"{1e3 * row[key]:.2f}" if key in row else "–"


def _markdown(manifest: Row, of_kind: Any) -> str:
    settings, before, after = (
        manifest["settings"],
        manifest["load_average"]["before"],
        manifest["load_average"]["after"],
    )
    size = settings["resolution"]
    (ceilings,), (generation,), (loading,) = (of_kind(kind) for kind in ("ceilings", "generation", "loading"))
    weights = manifest["checkpoint"] or "random"
    lines = [
        f"# {', '.join(manifest['scenes'])}, {size}x{size}, width {settings['width']}",
        "",
        f"{manifest['device']}, {manifest['threads']} threads; Mitsuba {manifest['mitsuba_variant']}; "
        f"weights: {weights}; {', '.join(f'{name} {value:,}' for name, value in settings.items())}.",
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
        *_frames(of_kind("frame"), ceilings),
        *_training(of_kind("training")),
        "## Samples",
        "",
        f"Rendering in one process: {generation['train_per_second']:.2f} training samples per second, "
        f"{generation['evaluated_per_second']:.2f} test samples per second; {generation['of_bare_loop']:.2f} times as "
        "fast as a bare loop of `mi.render` under `dr.freeze` that traces a training sample's rays.",
        f"Loading: {loading['samples_per_second']:.0f} samples per second, "
        f"{loading['bytes_per_second'] / 1e6:.0f} MB/s, all fields, CRCs checked, {settings['workers']} workers.",
        "",
        *_table(
            ["part of a sample", "ms"],
            [[name, f"{1e3 * seconds:.1f}"] for name, seconds in generation["stages_s"].items()],
        ),
        *_ceilings(ceilings, settings),
        *_growth(of_kind("growth")),
    ]
    return "\n".join(lines).rstrip()


def _frames(rows: list[Row], ceilings: Row) -> list[str]:
    stages = _stages(rows)
    table, reached = [], []
    for row in rows:
        cells = [f"{_ms(row, f'{s}_s')} ({_ms(row, f'{s}_p95_s')})" if f"{s}_s" in row else "–" for s in stages]
        cells.append(f"{_ms(row, 'time_per_frame_s')} ({_ms(row, 'time_per_frame_p95_s')})")
        ratio = row.get("speedup")
        cells.append(_ms(row["plain"], "time_per_frame_s") if ratio else "–")
        spread = (
            f"{ratio['median']:.2f} ({ratio['p5']:.2f} to {ratio['p95']:.2f}); {ratio['of_least']:.2f}"
            if ratio
            else "–"
        )
        cells.append(spread)
        cells.append(f"{row['peak_memory_bytes'] / 2**20:.0f}" if "peak_memory_bytes" in row else "–")
        table.append([label(row["method"]), *cells, str(row["timed_frames"])])
        if ratio:
            speed, best = row["step_flops"]["synthesis"] / row["synthesis_s"], _ceiling(row, ceilings)
            reached.append([
                label(row["method"]), row["precision"], f"{row['parameters']:,}",
                f"{row['step_flops']['synthesis'] / 1e9:.2f}", f"{speed / 1e9:.0f}", f"{speed / best:.0%}",
            ])  # fmt: skip
    names = [stage.replace("_", " ") for stage in stages]
    lines = _table(["method", *names, "frame", "plain frame", "ratio", "peak MiB", "frames"], table)
    if reached:
        header = ["synthesis", "precision", "parameters", "GFLOP", "GFLOP/s", "of the ceiling"]
        lines += [*_table(header, reached), "GFLOP: the plain path's; a path with fewer may exceed the ceiling.", ""]
    return lines


def _ceiling(row: Row, ceilings: Row) -> float:
    """Return the faster of matrix product and convolution in the row's precision."""
    rates = [value for name, value in ceilings["computing"].items() if name.endswith(f"_{row['precision']}")]
    return max(rates, default=math.nan)


def _training(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    table = [
        [label(row["method"]), row["skipped"], "–", "–"]
        if "skipped" in row
        else [
            label(row["method"]), f"{row['images_per_second']:.2f}",
            f"{_ms(row, 'step_s')} ({_ms(row, 'step_p95_s')})", f"{row['waiting_share']:.1%}",
        ]
        for row in rows
    ]  # fmt: skip
    return ["## Training", "", *_table(["method", "images per second", "step (ms)", "waiting for data"], table)]


def _ceilings(ceilings: Row, settings: Row) -> list[str]:
    computing = dict(ceilings["computing"])
    copy = computing.pop("copy")
    table = [[name.replace("_", ", "), f"{value / 1e9:.0f} GFLOP/s"] for name, value in computing.items()]
    table.append(["copying memory, read and written", f"{copy / 1e9:.1f} GB/s"])
    names = {"path_tracing": "at 1 spp", "gbuffer": "of depth, normal and albedo", "photons": ""}
    size = settings["resolution"]
    for name, seconds in ceilings["bare_s"].items():
        title = f"`mi.render` {names[name]}, {size}x{size}" if names[name] else f"{settings['photons']:,} photons, bare"
        table.append([title, f"{1e3 * seconds:.2f} ms"])
    return ["## This machine's ceilings, in the same run", "", *_table(["", "best"], table)]


def _growth(rows: list[Row]) -> list[str]:
    if not rows:
        return []
    stages, table = _stages(rows), []
    for row in rows:
        cells = [_ms(row, f"{stage}_s") for stage in stages]
        whole = row.get("skipped") or f"{_ms(row, 'time_per_frame_s')} ({_ms(row, 'time_per_frame_p95_s')})"
        memory = f"{row['peak_memory_bytes'] / 2**20:.0f}" if "peak_memory_bytes" in row else "–"
        table.append([f"{label(row['method'])}, {row['factor']} {row['value']:,}", *cells, whole, memory])
    names = [stage.replace("_", " ") for stage in stages]
    lines = [
        "## Growth",
        "",
        "Median milliseconds with one setting changed at a time; with a larger batch, those of all its frames.",
    ]
    return [*lines, "", *_table(["", *names, "frame", "peak MiB"], table)]


def _draw_frames(directory: Path, rows: list[Row]) -> None:
    """Draw bench: one bar per method, stacked by stage, and below it, paler, the bar of its plain path."""
    bars: list[tuple[str, Row, float]] = []
    for row in rows:
        bars.append((label(row["method"]), row, 1.0))
        if "plain" in row:
            bars.append(("plain", row["plain"], 0.45))
    figure, axis = plt.subplots(figsize=(8, 0.9 + 0.27 * len(bars)))
    places = np.cumsum([0.85 if name == "plain" else 1.15 for name, _, _ in bars])
    for stage in _stages(row for _, row, _ in bars):
        left = np.array([sum(row.get(f"{s}_s", 0) for s in STAGES[: STAGES.index(stage)]) for _, row, _ in bars])
        width = np.array([row.get(f"{stage}_s", 0.0) for _, row, _ in bars])
        for k, (place, (_, _, alpha)) in enumerate(zip(places, bars, strict=True)):
            axis.barh(
                place, 1e3 * width[k], 0.8, 1e3 * left[k], color=_COLOUR[stage], alpha=alpha, hatch=_HATCH[stage],
                edgecolor="white", linewidth=0.4, label=None if k else stage.replace("_", " "),
            )  # fmt: skip
    for place, (name, row, _) in zip(places, bars, strict=True):
        ratio = f", {row['speedup']['median']:.1f}x" if "speedup" in row else ""
        text = f" {1e3 * row['time_per_frame_s']:.1f}{ratio}"
        axis.text(
            1e3 * row["time_per_frame_s"], place, text, va="center", fontsize=7, color="0.4" * (name == "plain") or "k"
        )
    axis.set_yticks(places, [name for name, _, _ in bars], fontsize=8)
    axis.set_ylim(places[-1] + 0.7, places[0] - 0.7)
    axis.set_xlim(0, 1.17e3 * max(row["time_per_frame_s"] for _, row, _ in bars))
    text = "time (ms), median of each stage; x: speed-up over the plain path, without the rendered stages"
    axis.set_xlabel(text, fontsize=8)
    axis.grid(axis="x", alpha=0.3)
    axis.set_axisbelow(True)
    figure.legend(loc="upper center", ncols=7, fontsize=8, frameon=False)
    figure.tight_layout(rect=(0, 0, 1, 1 - 0.28 / figure.get_figheight()))
    save(figure, directory, "bench")


def _draw_growth(directory: Path, rows: list[Row], settings: Row) -> None:
    """Draw growth: one row per method, one column per factor; the time of each stage and, in grey, of the frame."""
    methods, factors = (list(dict.fromkeys(row[key] for row in rows)) for key in ("method", "factor"))
    size = (2.7 * len(factors), 2.7 * len(methods) + 0.7)
    figure, axes = plt.subplots(len(methods), len(factors), figsize=size, squeeze=False, sharey="row")
    skipped = False
    for line, method in zip(axes, methods, strict=True):
        for axis, factor in zip(line, factors, strict=True):
            mine = [row for row in rows if (row["method"], row["factor"]) == (method, factor)]
            if not mine:
                axis.set_axis_off()
                continue
            measured = [row for row in mine if "skipped" not in row]
            x = [row["value"] for row in measured]
            for stage in _stages(mine):
                y = [1e3 * row[f"{stage}_s"] for row in measured]
                name = stage.replace("_", " ")
                axis.plot(x, y, color=_COLOUR[stage], marker=_MARKER[stage], ms=4, lw=1.2, label=name)
            whole = [1e3 * row["time_per_frame_s"] for row in measured]
            axis.plot(x, whole, color="0.5", lw=3, alpha=0.5, zorder=0, label="frame")
            axis.set(xscale="log", yscale="log", xlabel=factor)
            axis.axvline(settings[factor], color="0.6", lw=0.8, ls=":")
            for row in (row for row in mine if "skipped" in row):
                skipped = True
                axis.plot(row["value"], 0.95, "kx", ms=6, transform=axis.get_xaxis_transform())
            base = settings[factor]  # labelled; values too close to it are not
            values = [v for v in (row["value"] for row in mine) if v == base or not 0.6 < v / base < 1.7]
            axis.set_xticks(values, [f"{v // 1000}k" if v >= 1000 and v % 1000 == 0 else str(v) for v in values])
            axis.tick_params(labelsize=7)
            axis.minorticks_off()
            axis.grid(alpha=0.3)
        line[0].set_ylabel(f"{label(method)}\ntime (ms)", fontsize=8)
    handles = {
        text: handle for axis in axes.flat for handle, text in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    note = "Dotted: the value in the other panels."
    if skipped:
        note += " Crosses: not measured because of a time or memory limit, given in bench.md."
    figure.legend(handles.values(), handles.keys(), loc="upper center", ncols=8, fontsize=8, frameon=False)
    figure.text(0.01, 0.01, note, fontsize=7)
    height = figure.get_figheight()
    figure.tight_layout(rect=(0, 0.2 / height, 1, 1 - 0.3 / height))
    save(figure, directory, "growth")
