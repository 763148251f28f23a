"""report.html: tables, charts and images of a comparison in one file that opens from disk and loads no others."""

import json
import math
import re
from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import yaml
from jinja2 import Environment, FileSystemLoader
from markupsafe import Markup, escape

from nlt.data.files import write_bytes
from nlt.evaluation.claims import Claim
from nlt.evaluation.paper import label, paper
from nlt.evaluation.results import OK, TIMES, Results
from nlt.metrics.quantities import METRICS, QUANTITIES, STAGES, heading, text
from nlt.report.claims import BELOW_FLOOR
from nlt.report.claims import text as claim_text
from nlt.report.figures import bar, curves, far_behind, setting
from nlt.report.gallery import FAILURES, Shown, failures
from nlt.report.packing import SMALLEST, data_url, max_error, pack_to_fit
from nlt.report.table_writer import Table
from nlt.report.tables import tables

PAGE = "report.html"
_PARTS = Path(__file__).parent / "page_parts"
_MEGABYTES = 25  # maximum size of the file
_AXES = ("time_per_frame_s", "flops", "parameters", "peak_memory_bytes")
_RUN = ("seed", "status", "message", "steps", "trained_at_commit", "run")
_MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?", "not measured": "–"}
_FILES = (
    *("table.csv", "table.md", "table.tex", "runs.csv", "timings.csv", "views.csv"),
    *("failures.csv", "failures.md", "failures.tex", "claims.md", "claims.json", "manifest.json"),
)


@dataclass(frozen=True)
class Section:
    """A section of report.html that another feature provides.

    `paragraphs` are Markdown; `directory` holds the section's figures and `files`; `source` names the files that its
    tables come from.
    """

    name: str
    title: str
    paragraphs: list[str]
    tables: list[Table]
    directory: Path
    files: tuple[str, ...]
    source: str


@dataclass(frozen=True)
class _Grid:
    """A sortable table of the page, with the origin of all its numbers and of those in a column, a row or a cell."""

    id: str
    table: Table
    origin: str
    column_origins: Sequence[str] = ()
    row_origins: Sequence[str] = ()
    cell_origins: Sequence[Sequence[str]] = ()
    best: Collection[tuple[int, int]] = ()  # (row, column) of bold cells

    @property
    def directions(self) -> list[str]:
        """Whether lower or higher values are better, for each column."""
        return [QUANTITIES[key].direction for key, _ in self.table.sources] or ["lower"] * len(self.table.columns)


def write_page(
    results: Results, claims: list[Claim], megabytes: float | None = None, sections: Iterable[Section | None] = ()
) -> None:
    """Write report.html from the stored results, the verdicts on the claims, and the figures in the same directory.

    The number and the precision of the images, of at least one view, are chosen so that the file stays below
    `megabytes` (10^6 bytes; default: 25). `None` in `sections` is skipped.
    """
    limit = megabytes or _MEGABYTES
    name = str(results.manifest.get("comparison", "Comparison"))
    views, data = _images(results)
    data |= {"methods": _methods(results), "curves": curves(results), "quantities": _quantities(results)}
    data |= {"stages": list(STAGES), "devices": results.devices}
    content = {
        "results": results,
        "title": f"{name}: {paper()[table]['title']}" if (table := results.manifest["table"]) else name,
        "limit": limit,
        "max_error": max_error,
        "commit": _commit(results),
        "problems": [f"{label(m)}: {results.status(m)}" for m in results.methods if results.status(m) != OK],
        "marks": _MARKS,
        "counts": Counter(claim.verdict for claim in claims),
        "claims": [(claim, claim_text(claim), _claim_grid(results, claim)) for claim in claims],
        "grids": [_results_grid(results, table, number) for number, table in enumerate(tables(results))],
        "failures": _failures_grid(results),
        "table_files": _FILES,
        "sections": [
            (section, [_Grid(f"{section.name}-{k}", table, section.source) for k, table in enumerate(section.tables)])
            for section in sections
            if section
        ],
        "runs": _runs_grid(results),
        "style": Markup((_PARTS / "report.css").read_text()),
        "script": Markup((_PARTS / "report.js").read_text()),
    }
    page = partial(_environment().get_template("template.html").render, content)
    if views:
        frame = page(data=data)
        data["pictures"], data["steps"] = pack_to_fit(views, int(limit * 1e6) - len(frame.encode()))
        data["views"] = data["views"][: len(data["pictures"])]
    write_bytes(results.directory / PAGE, page(data=data).encode())


def _environment() -> Environment:
    """Return what renders the template; text that is not `Markup` is escaped."""
    environment = Environment(loader=FileSystemLoader(_PARTS), autoescape=True, trim_blocks=True, lstrip_blocks=True)
    to_json = partial(json.dumps, separators=(",", ":"), allow_nan=False)
    environment.filters |= {
        "label": label,
        "plain": _plain,
        "marked_up": _marked_up,
        "figures": _figures,
        "yaml": partial(yaml.safe_dump, sort_keys=False),
        "script_json": lambda data: Markup(to_json(data).replace("</", "<\\/")),
        "data_url": lambda path: data_url(path.read_bytes(), "text/plain"),
    }
    return environment


# --- data of the script ---


def _quantities(results: Results) -> dict[str, dict[str, Any]]:
    everywhere = [results.on(device) for device in results.devices]
    quantities: dict[str, dict[str, Any]] = {
        key: {
            "heading": heading(key),
            "axis": heading(key),
            "direction": quantity.direction,
            "scale": quantity.scale,
            "unit": quantity.unit,
            "role": "metric" if key in METRICS and key != "reference_noise" else "cost" if key in _AXES else "",
            "per_image": quantity.per_image,
            "far": far_behind(results, key) if key in METRICS else [],
        }
        for key, quantity in QUANTITIES.items()
        if any(len(on.values(method, key)) for on in everywhere for method in results.methods)
    }
    if time := quantities.get("time_per_frame_s"):
        time |= {"axis": "time per frame (ms)", "unit": "ms", "scale": 1e3}
    return quantities


def _methods(results: Results) -> list[dict[str, Any]]:
    others = [key for key in QUANTITIES if key not in TIMES]
    return [
        {
            "id": method,
            "label": label(method),
            "setting": setting(method),
            "status": results.status(method),
            "command": _command(results, method),
            "values": _values(results, method, others),
            "times": [_values(results.on(device), method, TIMES) for device in results.devices],
        }
        for method in results.methods
    ]


def _command(results: Results, method: str) -> str:
    """Return the command that renders a video with a trained method, or that measures an untrained one again."""
    for run in results.runs_of(method):
        if isinstance(run.get("run"), str):
            config = (results.manifest.get("configs") or {}).get(method, {})
            scene = config.get("data", {}).get("dataset", {}).get("scenes", ["SCENE"])[0]
            return f"nlt render {run['run']}/checkpoints/*.ckpt {scene} -o {method}.mp4"
    words = str(results.manifest.get("command") or "").replace("=", " ").split()
    options = [(word, words[k + 1]) for k, word in enumerate(words) if word in ("--config", "--scale", "--data")]
    return " ".join(["nlt compare", *(" ".join(o) for o in options), f"--methods {method} --out results/{method}"])


def _values(results: Results, method: str, keys: Iterable[str]) -> dict[str, list[Any]]:
    """Return the mean, the ends of its error bar and its text for each measured quantity."""
    values = {}
    for key in keys:
        if key in QUANTITIES and math.isfinite(mean := results.mean(method, key)):
            below, above = bar(results, method, key, mean)
            values[key] = [mean, mean - below, mean + above, text(key, mean)]
    return values


def _images(results: Results) -> tuple[list[np.ndarray], dict[str, Any]]:
    """Return the images of each view, (K, 3, H, W), radiance times exposure, and what the script needs to show them."""
    reference, gbuffer = results.images("reference"), results.images("gbuffer")
    if reference is None:
        return [], {"images": [], "views": []}
    exposure = reference["exposure"].astype(np.float32).reshape(-1, 1, 1, 1)
    titles = {"reference": "Reference", "noisy": "Training image (1 spp)"}
    titles |= {method: label(method) for method in results.methods if results.runs_of(method)}
    images: dict[str, tuple[str, str, np.ndarray]] = {
        name: (title, "radiance", arrays["radiance"] * exposure)
        for name, title in titles.items()
        if (arrays := results.images(name)) is not None
    }
    if gbuffer is not None:
        images["albedo"] = ("Albedo", "albedo", gbuffer["albedo"])
        images["normal"] = ("Normals", "normal", gbuffer["normal"] / 2 + 0.5)
    views = [np.stack(arrays) for arrays in zip(*(array for _, _, array in images.values()), strict=True)]
    shown = Shown.load(results)
    return views, {
        "images": [{"id": name, "label": title, "kind": kind} for name, (title, kind, _) in images.items()],
        "height": views[0].shape[-2],
        "width": views[0].shape[-1],
        "smallest": SMALLEST,
        "steps": 1,
        "stored": len(views),
        "pictures": [],
        "error_scale": float(f"{shown.scale:.3g}") if shown else 1.0,
        "colours": matplotlib.colormaps["inferno"](np.arange(256), bytes=True)[:, :3].tolist(),
        "views": [
            {"view": int(view), "exposure": float(e), "metrics": _view_metrics(results, int(view), list(images))}
            for view, e in zip(reference["view"], reference["exposure"], strict=True)
        ],
    }


def _view_metrics(results: Results, view: int, names: list[str]) -> dict[str, dict[str, list[Any]]]:
    """Return a view's metrics as numbers and as text, for the seed whose images are shown."""
    seed = results.manifest["seeds"][0]
    rows = {row["method"]: row for row in results.views if row["view"] == view and row["seed"] == seed}
    return {
        name: {
            key: [rows[name][key], text(key, rows[name][key])]
            for key in METRICS
            if QUANTITIES[key].per_image and math.isfinite(rows[name].get(key, math.nan))
        }
        for name in names
        if name in rows
    }


# --- parts of the page that need no script ---


def _commit(results: Results) -> str:
    commit = str(results.manifest.get("commit") or "unknown")[:12]
    return f"commit {commit}" + " with uncommitted changes" * bool(results.manifest.get("uncommitted_changes"))


def _results_grid(results: Results, table: Table, number: int) -> _Grid:
    """Return a table of results, with the best value of each metric in bold."""
    keys = [key for key, _ in table.sources]
    chosen = [(results.best(key), column) for column, key in enumerate(keys) if key in METRICS]
    return _Grid(
        f"table-{number}",
        table,
        _measurement(results),
        [_column_origin(results, *source) for source in table.sources],
        [*(_training_lines(results, method) for method in results.methods), "manifest.json, floor"],
        [
            *([_exact_values(source, method, key) for key, source in table.sources] for method in results.methods),
            [repr(results.floor.get(key, "not measured")) for key in keys],
        ],
        {(results.methods.index(method), column) for method, column in chosen if method is not None},
    )


def _measurement(results: Results) -> str:
    manifest = results.manifest
    facts = [f"N = {manifest['n_test']} test views", manifest.get("device"), _commit(results), manifest.get("command")]
    return "; ".join(filter(None, facts))


def _column_origin(results: Results, key: str, source: Results) -> str:
    """Return the file and the column that a table's column comes from."""
    if source is not results:
        return f"timings.csv, column {key}, {source.manifest['device']}, {_commit(source)}"
    return f"runs.csv, column {key}" + (f"; interval: views.csv, column {key}" if QUANTITIES[key].per_image else "")


def _training_lines(results: Results, method: str) -> str:
    """Return a line for each run of a method: seed, training directory, steps, commit."""
    lines = []
    for run in results.runs:
        if run["method"] != method:
            continue
        facts = [f"seed {run['seed']}"] + ([f"{run['status']}: {run['message']}"] if run["status"] != OK else [])
        facts += [f"checkpoint in {run['run']}"] if isinstance(run.get("run"), str) else ["not trained"]
        for name, key in (("steps", "steps"), ("trained at commit", "trained_at_commit")):
            facts += [f"{name} {value[:12]}"] if (value := _plain(run.get(key))) else []
        lines.append(", ".join(facts))
    return "\n".join(lines)


def _exact_values(results: Results, method: str, key: str) -> str:
    """Return the unrounded values of a cell."""
    runs = results.runs_of(method)
    parts = [f"seed {run['seed']}: {run[key]!r}" for run in runs if math.isfinite(run.get(key, math.nan))]
    low, high = results.interval(method, key)
    if math.isfinite(low):
        parts.append(f"95% interval over views: {low:.6g} to {high:.6g}")
    return "; ".join(parts) if parts else f"not measured; {results.status(method)}"


def _failures_grid(results: Results) -> _Grid | None:
    table = failures(results)
    if table is None:
        return None
    origin = f"images/*.npz of seed {results.manifest['seeds'][0]}; {_measurement(results)}"
    columns = [f"{FAILURES}, share_of_worst and pixels of the cause {cause}" for cause in table.columns]
    return _Grid("failures", table, origin, columns)


def _claim_grid(results: Results, claim: Claim) -> _Grid:
    rows = []
    for c in claim.comparisons:
        margin = f"{c.margin:+.3g} [{c.low:+.3g}, {c.high:+.3g}]" if math.isfinite(c.margin) else "–"
        verdict = f"{_MARKS[c.verdict]} {c.verdict}" + f"; {BELOW_FLOOR}" * c.below_floor
        rows.append([label(c.method), label(c.other), heading(c.metric), margin, verdict])
    table = Table(f"Comparisons of {claim.id}", "", ["against", "metric", "margin", "verdict"], rows)
    origin = f"claims.json; computed from runs.csv and views.csv, {_measurement(results)}"
    return _Grid(f"comparisons-{claim.id}", table, origin)


def _runs_grid(results: Results) -> _Grid:
    """Return the table of all runs with their unrounded numbers."""
    keys = [key for key in QUANTITIES if any(math.isfinite(run.get(key, math.nan)) for run in results.runs)]
    rows = [
        [run["method"], *(_plain(run.get(name)) for name in _RUN), *(text(key, run.get(key)) for key in keys)]
        for run in results.runs
    ]
    columns = [f"runs.csv, column {name}" for name in (*_RUN, *keys)]
    cells = [["" for _ in _RUN] + [_plain(run.get(key)) for key in keys] for run in results.runs]
    table = Table("All runs", "", [*_RUN, *map(heading, keys)], rows)
    return _Grid("runs", table, _measurement(results), columns, cell_origins=cells)


# --- what the template calls ---


def _figures(directory: Path) -> dict[str, str]:
    """Return the data URLs of the directory's figures by name."""
    kinds = {".svg": "image/svg+xml", ".webp": "image/webp"}
    paths = sorted(path for path in directory.iterdir() if path.suffix in kinds)
    return {path.stem.replace("_", " "): data_url(path.read_bytes(), kinds[path.suffix]) for path in paths}


def _marked_up(text: str) -> Markup:
    """Return Markdown with strong text and code converted to HTML."""
    code = re.sub(r"`(.*?)`", r"<code>\1</code>", escape(text))
    return Markup(re.sub(r"\*\*(.*?)\*\*", r"<strong>\1</strong>", code))


def _plain(value: Any) -> str:
    """Return a value of a CSV cell or of the manifest as text; NaN stands for an empty cell."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {item}" for key, item in value.items())
    if isinstance(value, list):
        return ", ".join(map(str, value))
    return "" if value is None or value != value else str(value)
