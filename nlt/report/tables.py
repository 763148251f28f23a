"""The tables of a comparison, made from stored results: CSV, Markdown and LaTeX; and what variants change."""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from nlt.data.files import write_bytes
from nlt.evaluation.claims import difference
from nlt.evaluation.paper import COLUMNS, FLOOR, label, paper, published
from nlt.evaluation.results import OK, Results, write_rows
from nlt.metrics.quantities import METRICS, QUANTITIES, STAGES, heading, text
from nlt.report.table_writer import Table, section, write_texts

# Metrics that the paper does not report.
_MORE = tuple(key for key in METRICS if key not in (*COLUMNS, "reference_noise"))
_SIZES = ("parameters", "flops", "peak_memory_bytes", "train_s", "images_seen")
_STAGES = (*(f"{stage}_s" for stage in STAGES), "moving_camera_s")
_BOUNDED = tuple(
    key for key in METRICS if METRICS[key].per_image and key != "reference_noise" and not key.startswith("feature_l1_")
)


def write_tables(results: Results) -> None:
    """Write table.csv with unrounded numbers, table.md and table.tex; and variants.md if there are any."""
    n_test, rows = results.manifest["n_test"], []
    for method in results.methods:
        row: dict[str, Any] = {"method": method, "status": results.status(method), "n_test": n_test}
        row["seeds"] = len(results.runs_of(method))
        for key in _measured(results, dict.fromkeys((*COLUMNS, *QUANTITIES))):
            row |= {key: results.mean(method, key), f"{key}_std": results.std(method, key)}
            if QUANTITIES[key].per_image:
                row[f"{key}_low"], row[f"{key}_high"] = results.interval(method, key)
        rows.append(row)
    if results.floor:
        rows.append({"method": FLOOR, "status": OK, "n_test": n_test, **results.floor})
    write_rows(results.directory / "table.csv", rows)
    write_texts(results.directory / "table", tables(results), "runs.csv, views.csv")
    if variants := variant_table(results):
        write_bytes(results.directory / "variants.md", "\n".join(section(variants, level=1)).encode())


def tables(results: Results) -> list[Table]:
    """Return all tables: the paper's columns, other metrics, sizes, stages, intervals, times by device."""
    paper_table = results.manifest["table"]
    title = paper()[paper_table]["title"] if paper_table else "Comparison"
    stages = [*_measured(results, _STAGES), "time_per_frame_p95_s"]
    on_network = "FLOPs and memory are those of the network, without the renderer."
    bounded = _measured(results, _BOUNDED)
    return [
        _table(results, title, _note(results), COLUMNS, paper_table=paper_table),
        _table(results, "Further metrics", "", _MORE),
        _table(results, "Sizes", on_network, _SIZES),
        _table(results, "Time per stage", "Medians.", stages),
        _table(results, "95% bootstrap intervals over test views", "", bounded, _interval),
        *([_by_device(results)] if len(results.devices) > 1 else []),
    ]


def variant_table(results: Results) -> Table | None:
    """Return by how much each METHOD@VARIANT differs from METHOD; None if no method is there with a variant."""
    methods = [m for m in results.methods if "@" in m and m.partition("@")[0] in results.methods]
    keys = _measured(results, (key for key in COLUMNS if key in METRICS))
    rows = [[_name(results, method), *(_change(results, method, key) for key in keys)] for method in methods]
    seeds = len(results.manifest["seeds"])
    over = f"test views and {seeds} seeds" if seeds > 1 else "test views, not over seeds, because there is only one"
    note = (
        "Each row compares a variant with the same method without it. Positive numbers are increases. In brackets is "
        f"the 95% interval over {over}."
    )
    return Table("What each variant changes", note, [heading(key) for key in keys], rows) if rows else None


def _change(results: Results, method: str, key: str) -> str:
    """Return a variant's relative difference to its method, with its interval, in percent."""
    base = method.partition("@")[0]
    value, error = difference(results, key, method, base)
    scale = 100 / results.mean(base, key)
    if not math.isfinite(value * scale):
        return "–"
    bounds = f" [{(value - error) * scale:+.1f}, {(value + error) * scale:+.1f}]" if math.isfinite(error) else ""
    return f"{value * scale:+.1f} %{bounds}"


def _note(results: Results) -> str:
    """Return what the first table's numbers are, and which of them may be compared."""
    manifest = results.manifest
    seeds = len(manifest["seeds"])
    over = f"mean ± standard deviation over {seeds} seeds of training." if seeds > 1 else "one seed."
    notes = [f"N = {manifest['n_test']} test views; {over}"]
    if table := manifest["table"]:
        notes.append(
            f"After the slash: the paper's numbers ({paper()[table]['scale']}, on a GPU). Its scale and scenes are "
            "different, so compare the order of the methods, not the numbers."
        )
    if variant := manifest.get("variant"):
        notes.append(
            f"All trainings use the output and settings of configs/variant/{variant}.yaml instead of the paper's."
        )
    if results.floor:
        notes.append(
            "The last row judges one half of the reference against the other. The reference is the mean of both, so a "
            "perfect image would still differ from it by a quarter of this MSE. A value marked ≈ is closer to the best "
            "of its column than the last row is to a perfect value, so the reference cannot tell the two apart."
        )
    integrators = [f"{name} in {scene}" for scene, name in manifest.get("integrators", {}).items() if name != "path"]
    if integrators:
        listed = ", ".join(integrators)
        notes.append(f"Path-traced rows and the inputs of OIDN and denoising are rendered with {listed}.")
    return " ".join(notes)


def _measured(results: Results, keys: Iterable[str]) -> list[str]:
    """Return the quantities that were measured of any method."""
    return [key for key in keys if any(len(results.values(method, key)) for method in results.methods)]


def _table(
    results: Results,
    title: str,
    note: str,
    keys: Sequence[str],
    cell: Callable[[Results, str, str], str] | None = None,
    paper_table: str | None = None,
) -> Table:
    """Return a table of quantities, by default of their means with the reference's floor in the last row."""
    rows = []
    for method in results.methods:
        known = published(paper_table, method)
        cells = [(cell or _mean)(results, method, key) + (f" / {known[key]:g}" if key in known else "") for key in keys]
        rows.append([_name(results, method), *cells])
    if cell is None and any(key in results.floor for key in keys):
        rows.append([FLOOR, *(text(key, results.floor.get(key)) for key in keys)])
    return Table(title, note, [heading(key) for key in keys], rows, [(key, results) for key in keys])


def _by_device(results: Results) -> Table:
    """Return the time per frame on every device."""
    key = "time_per_frame_s"
    sources = [(key, results.on(device)) for device in results.devices]
    rows = [[_name(results, m), *(_mean(source, m, key) for _, source in sources)] for m in results.methods]
    names = ", ".join(f"({k}) {device}" for k, device in enumerate(results.devices, 1))
    columns = [f"{heading(key)}, ({k})" for k in range(1, len(sources) + 1)]
    note = f"{names}. The other tables have the times of (1)."
    return Table("Time per frame by device", note, columns, rows, sources)


def _name(results: Results, method: str) -> str:
    status = results.status(method)
    return label(method) + (f" [{status}]" if status != OK else "")


def _mean(results: Results, method: str, key: str) -> str:
    """Return the mean ± the standard deviation; ≈ marks it if the reference cannot tell it from the best."""
    mean, std, best = results.mean(method, key), results.std(method, key), results.best(key)
    is_tied = best not in (None, method) and results.is_below_floor(key, mean - results.mean(str(best), key))
    return text(key, mean) + (f" ± {text(key, std)}" if math.isfinite(std) else "") + " ≈" * is_tied


def _interval(results: Results, method: str, key: str) -> str:
    return " to ".join(text(key, bound) for bound in results.interval(method, key))
