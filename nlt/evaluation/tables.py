"""The comparison's table: as CSV, as Markdown with the paper's figures beside ours, and live in the terminal."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import Any

from nlt.evaluation.clock import STAGES
from nlt.evaluation.paper import label, paper, published
from nlt.metrics.image_metrics import METRICS

# The table's leading columns, the paper's and in its order.
COLUMNS = tuple(paper()["columns"])


def text(key: str, value: float | None) -> str:
    """A number as it is printed; empty where there is none."""
    if value is None or math.isnan(value):
        return ""
    if key.endswith("_s"):
        return f"{value:.4f}"
    return format(value, METRICS[key].format)


def heading(key: str) -> str:
    """A column's heading, with the direction in which it is better."""
    if key == "time_per_frame_s":
        return "time / frame (s)"
    arrow = {"lower": "↓", "higher": "↑"}[METRICS[key].direction]
    return f"{METRICS[key].label} {arrow}"


def live_header() -> str:
    """Headings for `live_row`."""
    return f"{'method':22}" + "".join(f"{heading(key):>18}" for key in COLUMNS)


def live_row(row: dict[str, Any]) -> str:
    """One method, for the terminal."""
    return f"{label(row['method']):22}" + "".join(f"{text(key, row[key]):>18}" for key in COLUMNS)


def write_tables(directory: Path, rows: list[dict[str, Any]], table: str | None) -> None:
    """table.csv and table.md of the rows so far."""
    directory.mkdir(parents=True, exist_ok=True)
    names = list(dict.fromkeys(["method", *COLUMNS, "n_test", "seed", *(key for row in rows for key in row)]))
    with (directory / "table.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, names, restval="")
        writer.writeheader()
        for row in rows:
            writer.writerow({k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()})
    (directory / "table.md").write_text(_markdown(rows, table))


def _markdown(rows: list[dict[str, Any]], table: str | None) -> str:
    title = paper()[table]["title"] if table else "Comparison"
    lines = [f"# {title}", ""]
    if table:
        lines += [
            f"Ours, and after the slash the paper's (its {table.replace('table', 'Table ')}: 256x256 pixels, "
            "100,000 training images per scene, four scenes, 300,000 iterations, a GPU). Another scale and other "
            "scenes: compare the order of the methods, not the numbers.",
            "",
        ]
    lines += [
        "| method | " + " | ".join(heading(key) for key in COLUMNS) + " |",
        "|---|" + "---:|" * len(COLUMNS),
    ]
    for row in rows:
        theirs = published(table, row["method"])
        cells = [text(key, row[key]) + (f" / {theirs[key]:g}" if key in theirs else "") for key in COLUMNS]
        lines.append(f"| {label(row['method'])} | " + " | ".join(cells) + " |")
    lines += ["", "Milliseconds per stage, medians:", ""]
    lines += ["| method | " + " | ".join(stage.replace("_", " ") for stage in STAGES) + " | p95 of a frame |"]
    lines += ["|---|" + "---:|" * (len(STAGES) + 1)]
    for row in rows:
        times = [row.get(f"{stage}_s") for stage in (*STAGES, "time_per_frame_p95")]
        cells = ["" if t is None else f"{1e3 * t:.2f}" for t in times]
        lines.append(f"| {label(row['method'])} | " + " | ".join(cells) + " |")
    if rows:
        lines += ["", f"N = {rows[0]['n_test']} test views, seed {rows[0]['seed']}; provenance in manifest.json."]
    return "\n".join(lines) + "\n"
