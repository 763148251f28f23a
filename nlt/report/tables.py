"""The tables of a comparison, made from stored results: CSV, Markdown and LaTeX."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from nlt.data.files import write_bytes
from nlt.evaluation.live import COLUMNS, FLOOR
from nlt.evaluation.paper import label, paper, published
from nlt.evaluation.results import OK, Results, write_rows
from nlt.metrics.quantities import METRICS, QUANTITIES, STAGES, heading, text

# Metrics that the paper does not report.
_FEATURE_LAYERS = tuple(key for key in METRICS if key.startswith("feature_l1_"))
_MORE = ("unbiased_mse", "psnr", "flip", "kid", *_FEATURE_LAYERS)
_SIZES = ("parameters", "flops", "peak_memory_bytes", "train_s", "images_seen")


@dataclass(frozen=True)
class Table:
    """A table of text cells; `first` is the heading of the first column, which names the row."""

    title: str
    note: str
    columns: list[str]
    rows: list[list[str]]
    # The quantity of each column and the results that it is from; empty for a table of other things.
    sources: list[tuple[str, Results]] = field(default_factory=list)
    first: str = "method"


def tables(results: Results) -> list[Table]:
    """Return all tables: the paper's columns, other metrics, sizes, stages, intervals, times by device."""
    table = results.manifest["table"]
    seeds = len(results.manifest["seeds"])
    note = f"N = {results.manifest['n_test']} test views; " + (
        f"mean ± standard deviation over {seeds} seeds of training." if seeds > 1 else "one seed."
    )
    if table:
        note += (
            f" After the slash: the paper's numbers ({paper()[table]['scale']}, on a GPU). Its scale and scenes are "
            "different, so compare the order of the methods, not the numbers."
        )
    if variant := results.manifest.get("variant"):
        note += f" All trainings use the output and settings of configs/variant/{variant}.yaml instead of the paper's."
    if results.floor:
        note += (
            " The last row judges one half of the reference against the other. The reference is the mean of both, so a "
            "perfect image would still differ from it by a quarter of this MSE. A value marked ≈ is closer to the best "
            "of its column than the last row is to a perfect value, so the reference cannot tell the two apart."
        )
    integrators = [f"{name} in {s}" for s, name in results.manifest.get("teachers", {}).items() if name != "path"]
    if integrators:
        note += f" Path-traced rows and the inputs of OIDN and denoising are rendered with {', '.join(integrators)}."
    times = (*(f"{stage}_s" for stage in STAGES), "moving_camera_s")
    stages = tuple(key for key in times if any(_measured(results, key)))
    bounds = [key for key in ("mse", "unbiased_mse", "psnr", "mssim", "flip", "feature_l1") if _measured(results, key)]
    interval = lambda _, method, key: " to ".join(text(key, bound) for bound in results.interval(method, key))
    own = lambda keys: [(key, results) for key in keys]
    result = [
        _table(results, paper()[table]["title"] if table else "Comparison", note, own(COLUMNS), table=table),
        _table(results, "Further metrics", "", own(_MORE)),
        _table(results, "Sizes", "FLOPs and memory are those of the network, without the renderer.", own(_SIZES)),
        _table(results, "Time per stage", "Medians.", own((*stages, "time_per_frame_p95_s"))),
        _table(results, "95% bootstrap intervals over test views", "", own(bounds), interval),
    ]
    if len(results.devices) > 1:
        on_each = [("time_per_frame_s", results.on(device)) for device in results.devices]
        names = ", ".join(f"({k}) {device}" for k, device in enumerate(results.devices, 1))
        note = f"{names}. The other tables have the times of (1)."
        by_device = _table(results, "Time per frame by device", note, on_each)
        columns = [f"{column}, ({k})" for k, column in enumerate(by_device.columns, 1)]
        result.append(dataclasses.replace(by_device, columns=columns))
    return result


def _measured(results: Results, key: str) -> list[str]:
    return [method for method in results.methods if len(results.values(method, key))]


def _name(results: Results, method: str) -> str:
    status = results.status(method)
    return label(method) + (f" [{status}]" if status != OK else "")


def _cell(results: Results, method: str, key: str) -> str:
    mean, std, best = results.mean(method, key), results.std(method, key), results.best(key)
    is_tied = best not in (None, method) and results.is_below_floor(key, mean - results.mean(str(best), key))
    return text(key, mean) + (f" ± {text(key, std)}" if math.isfinite(std) else "") + " ≈" * is_tied


def _table(
    results: Results,
    title: str,
    note: str,
    sources: list[tuple[str, Results]],
    cell: Callable[[Results, str, str], str] = _cell,
    table: str | None = None,
) -> Table:
    rows = []
    for method in results.methods:
        paper_row = published(table, method)
        cells = [
            cell(source, method, key) + (f" / {paper_row[key]:g}" if key in paper_row else "")
            for key, source in sources
        ]
        rows.append([_name(results, method), *cells])
    if cell is _cell and any(key in results.floor for key, _ in sources):
        rows.append([FLOOR, *(text(key, results.floor.get(key)) for key, _ in sources)])
    return Table(title, note, [heading(key) for key, _ in sources], rows, sources)


def write_tables(results: Results) -> None:
    """Write table.csv with unrounded numbers, table.md and table.tex."""
    all_tables = tables(results)
    rows = [_summary(results, method) for method in results.methods]
    if results.floor:
        rows.append({"method": FLOOR, "status": OK, "n_test": results.manifest["n_test"], **results.floor})
    write_rows(results.directory / "table.csv", rows)
    write_texts(results, "table", all_tables)


def write_texts(results: Results, name: str, all_tables: list[Table], source: str = "runs.csv, views.csv") -> None:
    """Write tables as `name`.md and `name`.tex; `source` names the files that the numbers come from."""
    write_bytes(results.directory / f"{name}.md", _markdown(all_tables, source).encode())
    write_bytes(results.directory / f"{name}.tex", _latex(all_tables).encode())


def _summary(results: Results, method: str) -> dict[str, Any]:
    row: dict[str, Any] = {
        "method": method,
        "status": results.status(method),
        "n_test": results.manifest["n_test"],
        "seeds": len(results.runs_of(method)),
    }
    for key in (*COLUMNS, *(key for key in QUANTITIES if key not in COLUMNS)):
        if _measured(results, key):
            row |= {key: results.mean(method, key), f"{key}_std": results.std(method, key)}
            if QUANTITIES[key].per_image:
                row |= dict(zip((f"{key}_low", f"{key}_high"), results.interval(method, key), strict=True))
    return row


def as_markdown(table: Table, level: int) -> list[str]:
    """Return a table's lines in Markdown, below a heading of this level."""
    return [
        f"{'#' * level} {table.title}", "", *([table.note, ""] if table.note else []),
        f"| {table.first} | {' | '.join(table.columns)} |", "|---|" + "---:|" * len(table.columns),
        *(f"| {' | '.join(row)} |" for row in table.rows), "",
    ]  # fmt: skip


def _markdown(all_tables: list[Table], source: str) -> str:
    lines = []
    for number, table in enumerate(all_tables, 1):
        lines += as_markdown(table, min(number, 2))
    return "\n".join([*lines, f"Source of the numbers: manifest.json, {source}."]) + "\n"


_LATEX = {
    **{c: f"\\{c}" for c in "&%$#_{}"}, "±": r"$\pm$", "↓": r"$\downarrow$", "↑": r"$\uparrow$", "≈": r"$\approx$",
    "–": "--",
}  # fmt: skip


def _latex(all_tables: list[Table]) -> str:
    """Return the tables in LaTeX; the document needs \\usepackage{booktabs}."""
    escape = lambda line: re.sub(r"[&%$#_{}±↓↑≈–]", lambda match: _LATEX[match[0]], line)
    lines = []
    for table in all_tables:
        caption = escape(f"{table.title}. {table.note}".strip())
        lines += [
            r"\begin{table}", r"\centering\footnotesize", f"\\caption{{{caption}}}",
            f"\\begin{{tabular}}{{l{'r' * len(table.columns)}}}", r"\toprule",
            " & ".join(map(escape, [table.first, *table.columns])) + r" \\", r"\midrule",
            *(" & ".join(map(escape, row)) + r" \\" for row in table.rows),
            r"\bottomrule", r"\end{tabular}", r"\end{table}", "",
        ]  # fmt: skip
    return "\n".join(lines)
