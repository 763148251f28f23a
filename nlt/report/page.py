"""report.html: tables, charts and images of a comparison in one file that opens from disk and loads no others."""

from __future__ import annotations

import base64
import io
import json
import math
import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import matplotlib
import numpy as np
import yaml
from PIL import Image

from nlt.data.files import write_bytes
from nlt.evaluation.claims import BELOW_FLOOR, Claim, Inequality
from nlt.evaluation.claims import text as claim_text
from nlt.evaluation.paper import label, paper
from nlt.evaluation.results import OK, TIMES, Results
from nlt.metrics.quantities import METRICS, QUANTITIES, STAGES, heading, text
from nlt.report.figures import bar, curves
from nlt.report.gallery import FAILURES, Shown, failures
from nlt.report.packing import max_error, pack_to_fit
from nlt.report.table_writer import Table
from nlt.report.tables import tables

PAGE = "report.html"
_PARTS = Path(__file__).parent / "page_parts"
_MEGABYTES = 25  # maximum size of the file
_OTHER = 500_000  # bytes reserved for the data on images and methods
_AXES = ("time_per_frame_s", "flops", "parameters", "peak_memory_bytes")
_RUN = ("seed", "status", "message", "steps", "trained_at_commit", "run")
_MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?", "not measured": "–"}
_FILES = (
    *("table.csv", "table.md", "table.tex", "runs.csv", "timings.csv", "views.csv"),
    *("failures.csv", "failures.md", "failures.tex", "claims.md", "claims.json", "manifest.json"),
)
_WEBP = 90  # quality of embedded pixel figures; the originals are in the report's directory


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


def write_page(
    results: Results, claims: list[Claim], megabytes: float | None = None, sections: Iterable[Section | None] = ()
) -> None:
    """Write report.html from the stored results, the verdicts on the claims, and the figures in the same directory.

    The number and the precision of the images, of at least one view, are chosen so that the file stays below
    `megabytes` (10^6 bytes; default: 25). `None` in `sections` is skipped.
    """
    megabytes = megabytes or _MEGABYTES
    manifest = results.manifest
    title = str(manifest.get("comparison", "Comparison"))
    if manifest["table"]:
        title += f": {paper()[manifest['table']]['title']}"
    parts = {
        "title": escape(title),
        "summary": _summary(results),
        "style": (_PARTS / "report.css").read_text(),
        "script": (_PARTS / "report.js").read_text(),
        "claims": _claims(results, claims),
        "tables": "\n".join(_table(results, table, number) for number, table in enumerate(tables(results))),
        "failures": _failures(results),
        "files": _files(results.directory, _FILES),
        "figures": _figures(results.directory),
        "sections": "\n".join(_section(section) for section in sections if section),
        "provenance": _provenance(results),
    }
    packed, data = _images(results, int(megabytes * 1e6) - sum(map(len, parts.values())) - _OTHER)
    data |= {"methods": _methods(results), "curves": curves(results), "quantities": _quantities(results)}
    data |= {"stages": list(STAGES), "devices": results.devices}
    images = "\n".join(
        f'<script type="text/plain" id="images-{k}">{base64.b64encode(view).decode()}</script>'
        for k, view in enumerate(packed)
    )
    page = Template((_PARTS / "template.html").read_text())
    text = page.substitute(parts, precision=_precision(results, data, megabytes), data=_json(data), images=images)
    write_bytes(results.directory / PAGE, text.encode())


# --- data of the script ---


def _json(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")


def _quantities(results: Results) -> dict[str, dict[str, Any]]:
    everywhere = [results.on(device) for device in results.devices]
    measured = [key for key in QUANTITIES if any(len(on.values(m, key)) for on in everywhere for m in results.methods)]
    return {
        key: {
            "heading": heading(key),
            "direction": QUANTITIES[key].direction,
            "scale": QUANTITIES[key].scale * (1e3 if key == "time_per_frame_s" else 1),
            "unit": "ms" if key == "time_per_frame_s" else QUANTITIES[key].unit,
            "role": "metric" if key in METRICS and key != "reference_noise" else "cost" if key in _AXES else "",
            "per_image": QUANTITIES[key].per_image,
        }
        for key in measured
    }


def _methods(results: Results) -> list[dict[str, Any]]:
    others = [key for key in QUANTITIES if key not in TIMES]
    return [
        {
            "id": method,
            "label": label(method),
            "status": results.status(method),
            "values": _values(results, method, others),
            "times": [_values(results.on(device), method, TIMES) for device in results.devices],
        }
        for method in results.methods
    ]


def _values(results: Results, method: str, keys: Iterable[str]) -> dict[str, list[Any]]:
    """Return the mean, the ends of its error bar and its text for each measured quantity."""
    values = {}
    for key in keys:
        if key in QUANTITIES and math.isfinite(mean := results.mean(method, key)):
            below, above = bar(results, method, key, mean)
            values[key] = [mean, mean - below, mean + above, text(key, mean)]
    return values


def _images(results: Results, size: int) -> tuple[list[bytes], dict[str, Any]]:
    """Return the packed images of each view, and the data that the script needs to unpack and label them."""
    stored = {name: results.images(name) for name in ("reference", "noisy", "gbuffer", *results.methods)}
    reference, gbuffer = stored["reference"], stored["gbuffer"]
    if reference is None:
        return [], {"images": [], "views": []}
    exposure = reference["exposure"].astype(np.float32).reshape(-1, 1, 1, 1)
    listed = [("reference", "Reference"), ("noisy", "Training image (1 spp)")]
    listed += [(method, label(method)) for method in results.methods if results.runs_of(method)]
    images: dict[str, tuple[str, str, np.ndarray]] = {
        name: (title, "radiance", arrays["radiance"] * exposure)
        for name, title in listed
        if (arrays := stored[name]) is not None
    }
    if gbuffer is not None:
        images["albedo"] = ("Albedo", "albedo", gbuffer["albedo"])
        images["normal"] = ("Normals", "normal", gbuffer["normal"] / 2 + 0.5)
    views = [np.stack([array[v] for _, _, array in images.values()]) for v in range(len(reference["view"]))]
    packed, dropped = pack_to_fit(views, size * 3 // 4)  # leaves room for base64
    height, width = views[0].shape[-2:]
    displayed = Shown.load(results)
    return packed, {
        "images": [{"id": name, "label": title, "kind": kind} for name, (title, kind, _) in images.items()],
        "height": height,
        "width": width,
        "dropped": dropped,
        "stored": len(views),
        "error_scale": float(f"{displayed.scale:.3g}") if displayed else 1.0,
        "colours": base64.b64encode(
            matplotlib.colormaps["inferno"](np.arange(256), bytes=True)[:, :3].tobytes()
        ).decode(),
        "views": [
            {
                "view": int(view),
                "exposure": float(reference["exposure"][k]),
                "metrics": _view_metrics(results, int(view), list(images)),
            }
            for k, view in enumerate(reference["view"][: len(packed)])
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


def _summary(results: Results) -> str:
    manifest = results.manifest
    seeds = len(manifest["seeds"])
    facts = [
        f"{len(results.methods)} methods",
        f"{manifest['n_test']} test views",
        f"{seeds} seed{'s' * (seeds > 1)}",
        ", ".join(manifest.get("scenes", [manifest.get("dataset", "")])),
        manifest.get("device", ""),
        f"commit {_commit(manifest)}",
    ]
    problems = [f"{label(m)}: {results.status(m)}" for m in results.methods if results.status(m) != OK]
    warning = f'<p class="warning" role="note">{escape("; ".join(problems))}</p>' if problems else ""
    return f"<p>{' · '.join(escape(fact) for fact in facts if fact)}</p>{warning}"


def _commit(manifest: Any) -> str:
    commit = str(manifest.get("commit") or "unknown")[:12]
    return commit + (" with uncommitted changes" if manifest.get("uncommitted_changes") else "")


@dataclass(frozen=True)
class _Origins:
    """The provenance of a grid's numbers: of the table, each column, row and cell; report.js joins them."""

    table: str
    columns: list[str]
    rows: list[str] = field(default_factory=list)
    cells: list[list[str]] = field(default_factory=list)


def _grid(name: str, title: str, table: Table, origins: _Origins, best: Collection[tuple[int, int]] = ()) -> str:
    """Return a sortable table with keyboard navigation as HTML; `best` has the (row, column) of bold cells."""
    origin = lambda note: f' data-origin="{escape(note)}"' if note else ""
    directions = [QUANTITIES[key].direction for key, _ in table.sources] or ["lower"] * len(table.columns)
    rows = []
    for r, (head, *row) in enumerate(table.rows):
        cells = "".join(
            f"<td{' class=best' * ((r, c) in best)}{origin(origins.cells[r][c] if origins.cells else '')}>"
            f"{escape(cell)}</td>"
            for c, cell in enumerate(row)
        )
        row_origin = origin(origins.rows[r] if origins.rows else "")
        rows.append(f'<tr data-index="{r}"{row_origin}><th scope="row">{escape(head)}</th>{cells}</tr>')
    headings = zip([table.first, *table.columns], ["lower", *directions], ["", *origins.columns], strict=True)
    return (
        f'<div class="scroll" role="region" tabindex="0" aria-label="{escape(title)}">'
        f'<table class="grid" id="{escape(name)}" aria-label="{escape(title)}"{origin(origins.table)}><thead><tr>'
        + "".join(
            f'<th scope="col" data-direction="{direction}"{origin(note)}>'
            f'<button type="button">{escape(column)}</button></th>'
            for column, direction, note in headings
        )
        + f"</tr></thead><tbody>{''.join(rows)}</tbody></table></div>"
    )


def _titled(table: Table, grid: str) -> str:
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return f"<h3>{escape(table.title)}</h3>{note}{grid}"


def _table(results: Results, table: Table, number: int) -> str:
    """Return a table of results as HTML, with the best value of each metric in bold."""
    keys = [key for key, _ in table.sources]
    chosen = [(results.best(key), c) for c, key in enumerate(keys) if key in METRICS]
    best = {(results.methods.index(method), c) for method, c in chosen if method is not None}
    origins = _Origins(
        _measurement(results),
        [_column_origin(results, *source) for source in table.sources],
        [_training_lines(results, method) for method in results.methods],
        [[_exact_values(source, method, key) for key, source in table.sources] for method in results.methods],
    )
    if len(table.rows) > len(results.methods):
        origins.rows.append("manifest.json, floor")
        origins.cells.append([repr(results.floor.get(key, "not measured")) for key, _ in table.sources])
    return _titled(table, _grid(f"table-{number}", table.title, table, origins, best))


def _measurement(results: Results) -> str:
    manifest = results.manifest
    facts = [
        f"N = {manifest['n_test']} test views",
        manifest.get("device", ""),
        f"commit {_commit(manifest)}",
        manifest.get("command", ""),
    ]
    return "; ".join(filter(None, facts))


def _column_origin(results: Results, key: str, source: Results) -> str:
    """Return the file and the column that a table's column comes from."""
    if source is not results:
        return f"timings.csv, column {key}, {source.manifest['device']}, commit {_commit(source.manifest)}"
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


def _failures(results: Results) -> str:
    """Return the table of failures as HTML; empty if there is none."""
    table = failures(results)
    if table is None:
        return ""
    columns = [f"{FAILURES}, share_of_worst and pixels of the cause {cause}" for cause in table.columns]
    origins = _Origins(f"images/*.npz of seed {results.manifest['seeds'][0]}; {_measurement(results)}", columns)
    return _titled(table, _grid("failures", table.title, table, origins))


def _section(section: Section) -> str:
    """Return another feature's section as HTML."""
    heading = f'<h2 id="{section.name}-title">{escape(section.title)}</h2>'
    parts = [f'<section id="{section.name}" aria-labelledby="{section.name}-title">', heading]
    parts += [f"<p>{_marked_up(text)}</p>" for text in section.paragraphs]
    for number, table in enumerate(section.tables):
        origins = _Origins(section.source, [""] * len(table.columns))
        parts.append(_titled(table, _grid(f"{section.name}-{number}", table.title, table, origins)))
    files = f'<p class="note">Files: {_files(section.directory, section.files)}.</p>'
    return "\n".join([*parts, _figures(section.directory), files, "</section>"])


def _marked_up(text: str) -> str:
    """Return Markdown with strong text and code converted to HTML."""
    code = re.sub(r"`(.*?)`", r"<code>\1</code>", escape(text))
    return re.sub(r"\*\*(.*?)\*\*", r"<strong>\1</strong>", code)


def _figures(directory: Path) -> str:
    """Return the directory's figures as HTML, SVG preferred."""
    kinds = (".png", ".svg", ".webp")
    paths = {path.stem: path for path in sorted(directory.glob("*.*")) if path.suffix in kinds}  # .svg after .png
    return "\n".join(
        f'<figure><img alt="{escape(name.replace("_", " "))}" src="{_picture(path)}">'
        f"<figcaption>{escape(name.replace('_', ' ').capitalize())}</figcaption></figure>"
        for name, path in paths.items()
    )


def _picture(path: Path) -> str:
    if path.suffix == ".svg":
        return _url(path.read_bytes(), "image/svg+xml")
    if path.suffix == ".webp":
        return _url(path.read_bytes(), "image/webp")
    webp = io.BytesIO()
    Image.open(path).convert("RGB").save(webp, "WEBP", quality=_WEBP)
    return _url(webp.getvalue(), "image/webp")


def _url(content: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(content).decode()}"


def _files(directory: Path, names: Iterable[str]) -> str:
    """Return links with embedded files of tables and raw numbers."""
    paths = [path for name in names if (path := directory / name).exists()]
    return ", ".join(
        f'<a download="{path.name}" href="{_url(path.read_bytes(), "text/plain")}">{path.name}</a>' for path in paths
    )


def _claims(results: Results, claims: list[Claim]) -> str:
    """Return a line per claim that opens to its comparisons; empty if the results' table has no claims."""
    if not claims:
        return ""
    verdicts = [claim.verdict for claim in claims]
    count = ", ".join(f"{v}: {verdicts.count(v)}" for v in _MARKS if v in verdicts)
    lines = []
    for claim in claims:
        table = Table(
            claim.id,
            "",
            ["against", "metric", "margin", "verdict"],
            [[label(c.method), label(c.other), heading(c.metric), _margin(c), _verdict(c)] for c in claim.comparisons],
        )
        origins = _Origins(f"claims.json; computed from runs.csv and views.csv, {_measurement(results)}", [""] * 4)
        lines.append(
            f'<details id="{escape(claim.id)}"><summary><span class="verdict {claim.verdict.replace(" ", "-")}">'
            f"{_MARKS[claim.verdict]} {claim.verdict}</span> {escape(claim.says)}</summary>"
            f'<p class="note">{escape(claim.where)}. Deciding comparison: {escape(claim_text(claim))}.</p>'
            + _grid(f"comparisons-{claim.id}", f"Comparisons of {claim.id}", table, origins)
            + "</details>"
        )
    return (
        '<section id="claims" aria-labelledby="claims-title"><h2 id="claims-title">Claims of the paper</h2>'
        f'<p class="note">At this scale: {count}. A positive margin supports the claim; in brackets is its 95% '
        f"interval over test images and seeds. Click on a claim to see its comparisons.</p>{''.join(lines)}</section>"
    )


def _verdict(comparison: Inequality) -> str:
    below = f"; {BELOW_FLOOR}" if comparison.below_floor else ""
    return f"{_MARKS[comparison.verdict]} {comparison.verdict}{below}"


def _margin(comparison: Inequality) -> str:
    if not math.isfinite(comparison.margin):
        return "–"
    return f"{comparison.margin:+.3g} [{comparison.low:+.3g}, {comparison.high:+.3g}]"


def _precision(results: Results, data: dict[str, Any], megabytes: float) -> str:
    if not data["views"]:
        return "No images are stored with these results; they are in images/ on the machine that made them."
    error = max_error(data["dropped"])
    subset = f"{len(data['views'])} of {data['stored']} stored views, so that this file stays below {megabytes:g} MB; "
    return (
        (subset if len(data["views"]) < data["stored"] else f"{data['stored']} views; ")
        + f"linear radiance accurate to {100 * error:.2g} % ({255 * 1.055 / 2.4 * error:.2g} of 255 display levels); "
        f"images and their metrics are from seed {results.manifest['seeds'][0]}."
    )


def _provenance(results: Results) -> str:
    manifest = dict(results.manifest)
    configs = manifest.pop("configs", {})
    facts = "".join(f"<dt>{escape(k.replace('_', ' '))}</dt><dd>{_fact(v)}</dd>" for k, v in manifest.items())
    keys = [key for key in QUANTITIES if any(math.isfinite(run.get(key, math.nan)) for run in results.runs)]
    table = Table(
        "All runs",
        "",
        [*_RUN, *map(heading, keys)],
        [
            [run["method"], *(_plain(run.get(name)) for name in _RUN), *(text(key, run.get(key)) for key in keys)]
            for run in results.runs
        ],
    )
    columns = [f"runs.csv, column {name}" for name in (*_RUN, *keys)]
    cells = [["" for _ in _RUN] + [_plain(run.get(key)) for key in keys] for run in results.runs]
    grid = _grid("runs", table.title, table, _Origins(_measurement(results), columns, cells=cells))
    return f"<dl>{facts}</dl>{_titled(table, grid)}<h3>Configurations</h3>" + "".join(
        f"<details><summary>{escape(label(method))}</summary>"
        f"<pre>{escape(yaml.safe_dump(config, sort_keys=False))}</pre></details>"
        for method, config in configs.items()
    )


def _fact(value: Any) -> str:
    if isinstance(value, dict):
        return escape(", ".join(f"{k} {v}" for k, v in value.items()))
    return escape(", ".join(map(str, value)) if isinstance(value, list) else _plain(value))


def _plain(value: Any) -> str:
    """Return a CSV cell's text; NaN stands for an empty cell."""
    return "" if value is None or value != value else str(value)
