"""report.html: tables, charts and images of a comparison in one file that opens from disk and loads nothing."""

from __future__ import annotations

import base64
import io
import json
import math
from html import escape
from pathlib import Path
from string import Template
from typing import Any

import matplotlib
import numpy as np
import yaml
from PIL import Image

from nlt.data.files import write_bytes
from nlt.evaluation.claims import Claim, Comparison
from nlt.evaluation.claims import text as claim_text
from nlt.evaluation.figures import bar, curves
from nlt.evaluation.gallery import Shown
from nlt.evaluation.packing import max_error, pack_to_fit
from nlt.evaluation.paper import label, paper
from nlt.evaluation.results import OK, Results
from nlt.evaluation.tables import Table, heading, tables, text
from nlt.metrics.quantities import METRICS, QUANTITIES, STAGES

PAGE = "report.html"
_PARTS = Path(__file__).parent / "page"
_SIZE = 25_000_000  # bytes of the file, at most
_OTHER = 500_000  # of these, for what describes the images and the methods
_AXES = ("time_per_frame_s", "flops", "parameters", "peak_memory_bytes")
_RUN = ("method", "seed", "status", "message", "steps", "trained_at_commit")
_MARKS = {"holds": "✓", "does not hold": "✗", "undecided": "?", "not measured": "–"}
_FILES = ("table.csv", "table.md", "table.tex", "runs.csv", "views.csv", "manifest.json")
_WEBP = 90  # quality of pixel figures, which lie beside the report as they are


def write_page(results: Results, claims: list[Claim]) -> None:
    """Write report.html from the stored results, what they say of the claims, and the figures beside them."""
    manifest = results.manifest
    title = str(manifest.get("comparison", "Comparison"))
    if manifest["table"]:
        title += f": {paper()[manifest['table']]['title']}"
    parts = {
        "title": escape(title),
        "summary": _summary(results),
        "style": (_PARTS / "report.css").read_text(),
        "script": (_PARTS / "report.js").read_text(),
        "claims": _claims(claims),
        "tables": "\n".join(_table(results, table, number) for number, table in enumerate(tables(results))),
        "files": _files(results),
        "figures": _figures(results),
        "provenance": _provenance(results),
    }
    packed, data = _images(results, _SIZE - sum(map(len, parts.values())) - _OTHER)
    data |= {"methods": _methods(results), "curves": curves(results), "quantities": _quantities(results)}
    data["stages"] = list(STAGES)
    images = "\n".join(
        f'<script type="text/plain" id="images-{k}">{base64.b64encode(view).decode()}</script>'
        for k, view in enumerate(packed)
    )
    page = Template((_PARTS / "template.html").read_text())
    text = page.substitute(parts, precision=_precision(results, data), data=_json(data), images=images)
    write_bytes(results.directory / PAGE, text.encode())


# --- what the script draws from ---


def _json(data: Any) -> str:
    return json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")


def _quantities(results: Results) -> dict[str, dict[str, Any]]:
    measured = [key for key in QUANTITIES if any(len(results.values(method, key)) for method in results.methods)]
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
    found = []
    for method in results.methods:
        values = {}
        for key in QUANTITIES:
            mean = results.mean(method, key)
            if math.isfinite(mean):
                below, above = bar(results, method, key, mean)
                values[key] = [mean, mean - below, mean + above, text(key, mean)]
        found.append(
            {
                "id": method,
                "label": label(method),
                "status": results.status(method),
                "values": values,
            }
        )
    return found


def _images(results: Results, size: int) -> tuple[list[bytes], dict[str, Any]]:
    """The packed images of each view, and what unpacks and describes them."""
    stored = {name: results.images(name) for name in ("reference", "noisy", "gbuffer", *results.methods)}
    reference, gbuffer = stored["reference"], stored["gbuffer"]
    if reference is None:
        return [], {"images": [], "views": []}
    exposure = reference["exposure"].astype(np.float32).reshape(-1, 1, 1, 1)
    listed = [("reference", "Reference"), ("noisy", "Teaching input (1 spp)")]
    listed += [(method, label(method)) for method in results.methods if results.runs_of(method)]
    images: dict[str, tuple[str, str, np.ndarray]] = {
        name: (title, "radiance", found["radiance"] * exposure)
        for name, title in listed
        if (found := stored[name]) is not None
    }
    if gbuffer is not None:
        images["albedo"] = ("Albedo", "albedo", gbuffer["albedo"])
        images["normal"] = ("Normals", "normal", gbuffer["normal"] / 2 + 0.5)
    views = [np.stack([array[v] for _, _, array in images.values()]) for v in range(len(reference["view"]))]
    packed, dropped = pack_to_fit(views, size * 3 // 4)  # base64
    height, width = views[0].shape[-2:]
    compared = Shown.load(results)
    return packed, {
        "images": [{"id": name, "label": title, "kind": kind} for name, (title, kind, _) in images.items()],
        "height": height,
        "width": width,
        "dropped": dropped,
        "stored": len(views),
        "error_scale": float(f"{compared.scale:.3g}") if compared else 1.0,
        "colours": base64.b64encode(
            matplotlib.colormaps["inferno"](np.arange(256), bytes=True)[:, :3].tobytes()
        ).decode(),
        "views": [
            {
                "view": int(view),
                "exposure": float(reference["exposure"][k]),
                "metrics": _of_view(results, int(view), list(images)),
            }
            for k, view in enumerate(reference["view"][: len(packed)])
        ],
    }


def _of_view(results: Results, view: int, names: list[str]) -> dict[str, dict[str, list[Any]]]:
    """A view's metrics, as numbers and as text, of the seed whose images are shown."""
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


# --- what stands in the page without it ---


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
    unwell = [f"{label(m)}: {results.status(m)}" for m in results.methods if results.status(m) != OK]
    warning = f'<p class="warning" role="note">{escape("; ".join(unwell))}</p>' if unwell else ""
    return f"<p>{' · '.join(escape(fact) for fact in facts if fact)}</p>{warning}"


def _commit(manifest: Any) -> str:
    commit = str(manifest.get("commit") or "unknown")[:12]
    return commit + (" with uncommitted changes" if manifest.get("uncommitted_changes") else "")


def _table(results: Results, table: Table, number: int) -> str:
    """Sortable; the best of each metric is bold; a cell's title says what the number is."""
    key_of = {heading(key): key for key in QUANTITIES}
    keys = [key_of.get(column) for column in table.columns]
    best = {k: _best(results, key) for k, key in enumerate(keys) if key in METRICS}
    cells = []
    for index, (method, (name, *row)) in enumerate(zip(results.methods, table.rows, strict=True)):
        cells.append(f'<tr data-index="{index}"><th scope="row">{escape(name)}</th>')
        for k, cell in enumerate(row):
            chosen = ' class="best"' if best.get(k) == method else ""
            cells.append(f'<td{chosen} title="{escape(_origin(results, method, keys[k]))}">{escape(cell)}</td>')
        cells.append("</tr>")
    note = f'<p class="note">{escape(table.note)}</p>' if table.note else ""
    return (
        f'<h3 id="table-{number}-title">{escape(table.title)}</h3>{note}'
        f'<div class="scroll" role="region" tabindex="0" aria-labelledby="table-{number}-title">'
        f'<table id="table-{number}" aria-labelledby="table-{number}-title"><thead><tr>'
        + "".join(
            f'<th scope="col" data-direction="{QUANTITIES[key].direction if key else "lower"}">'
            f'<button type="button">{escape(column)}</button></th>'
            for key, column in zip([None, *keys], ["method", *table.columns], strict=True)
        )
        + f"</tr></thead><tbody>{''.join(cells)}</tbody></table></div>"
    )


def _best(results: Results, key: str | None) -> str | None:
    means = {method: results.mean(method, str(key)) for method in results.methods}
    means = {method: mean for method, mean in means.items() if math.isfinite(mean)}
    choose = min if QUANTITIES[str(key)].direction == "lower" else max
    return choose(means, key=means.__getitem__, default=None)


def _origin(results: Results, method: str, key: str | None) -> str:
    """Where a number comes from, to the digit."""
    if key is None:
        return ""
    runs = results.runs_of(method)
    parts = [f"seed {run['seed']}: {run[key]!r}" for run in runs if math.isfinite(run.get(key, math.nan))]
    low, high = results.interval(method, key)
    if math.isfinite(low):
        parts.append(f"95% interval over views: {low:.6g} to {high:.6g}")
    where = f"runs.csv, column {key}, {_commit(results.manifest)}"
    return "; ".join([*parts, where]) if parts else f"not measured; {results.status(method)}"


def _figures(results: Results) -> str:
    """The pictures beside the results, as vectors where there are both."""
    found = {path.stem: path for path in sorted(results.directory.glob("*.[ps][nv]g"))}  # .svg comes after .png
    return "\n".join(
        f'<figure><img alt="{escape(name.replace("_", " "))}" src="{_picture(path)}">'
        f"<figcaption>{escape(name.replace('_', ' ').capitalize())}</figcaption></figure>"
        for name, path in found.items()
    )


def _picture(path: Path) -> str:
    if path.suffix == ".svg":
        return _url(path.read_bytes(), "image/svg+xml")
    webp = io.BytesIO()
    Image.open(path).convert("RGB").save(webp, "WEBP", quality=_WEBP)
    return _url(webp.getvalue(), "image/webp")


def _url(content: bytes, mime: str) -> str:
    return f"data:{mime};base64,{base64.b64encode(content).decode()}"


def _files(results: Results) -> str:
    """Links that hold the tables and raw numbers as files."""
    found = [path for name in _FILES if (path := results.directory / name).exists()]
    return ", ".join(
        f'<a download="{path.name}" href="{_url(path.read_bytes(), "text/plain")}">{path.name}</a>' for path in found
    )


def _claims(claims: list[Claim]) -> str:
    """A line per claim, which opens into its comparisons; nothing where the results' table makes none."""
    if not claims:
        return ""
    verdicts = [claim.verdict for claim in claims]
    count = ", ".join(f"{v}: {verdicts.count(v)}" for v in _MARKS if v in verdicts)
    lines = []
    for claim in claims:
        rows = "".join(
            f"<tr><td>{escape(label(c.method))}</td><td>{escape(label(c.other))}</td><td>{escape(heading(c.metric))}</td>"
            f"<td>{_margin(c)}</td><td>{_MARKS[c.verdict]} {c.verdict}</td></tr>"
            for c in claim.comparisons
        )
        lines.append(
            f'<details id="{escape(claim.id)}"><summary><span class="verdict {claim.verdict.replace(" ", "-")}">'
            f"{_MARKS[claim.verdict]} {claim.verdict}</span> {escape(claim.says)}</summary>"
            f'<p class="note">{escape(claim.where)}. What decides: {escape(claim_text(claim))}.</p><div class="scroll" '
            f'role="region" tabindex="0" aria-label="Comparisons of {escape(claim.id)}"><table><thead><tr>'
            + "".join(f'<th scope="col">{name}</th>' for name in ("method", "against", "metric", "margin", "verdict"))
            + f"</tr></thead><tbody>{rows}</tbody></table></div></details>"
        )
    return (
        '<section id="claims" aria-labelledby="claims-title"><h2 id="claims-title">Claims of the paper</h2>'
        f'<p class="note">At this scale {count}. A margin is positive where the comparison is as claimed; in brackets '
        f"its 95% interval over test images and seeds. A line opens.</p>{''.join(lines)}</section>"
    )


def _margin(comparison: Comparison) -> str:
    if not math.isfinite(comparison.margin):
        return "–"
    return f"{comparison.margin:+.3g} [{comparison.low:+.3g}, {comparison.high:+.3g}]"


def _precision(results: Results, data: dict[str, Any]) -> str:
    if not data["views"]:
        return "No images are stored beside these results; the machine that made them has them, in images/."
    error = max_error(data["dropped"])
    some = (
        f"{len(data['views'])} of {data['stored']} stored views, so that this file stays below {_SIZE / 1e6:.0f} MB; "
    )
    return (
        (some if len(data["views"]) < data["stored"] else f"{data['stored']} views; ")
        + f"linear radiance within {100 * error:.2g} % ({255 * 1.055 / 2.4 * error:.2g} of 255 levels as displayed); "
        f"images and their metrics are of seed {results.manifest['seeds'][0]}."
    )


def _provenance(results: Results) -> str:
    manifest = dict(results.manifest)
    configs = manifest.pop("configs", {})
    facts = "".join(f"<dt>{escape(k.replace('_', ' '))}</dt><dd>{_fact(v)}</dd>" for k, v in manifest.items())
    keys = [key for key in QUANTITIES if any(math.isfinite(run.get(key, math.nan)) for run in results.runs)]
    head = "".join(f'<th scope="col">{escape(name)}</th>' for name in (*_RUN, *map(heading, keys)))
    rows = "".join(
        "<tr>"
        + "".join(f"<td>{escape(_plain(run.get(name)))}</td>" for name in _RUN)
        + "".join(f"<td>{escape(text(key, run.get(key)))}</td>" for key in keys)
        + "</tr>"
        for run in results.runs
    )
    return (
        f"<dl>{facts}</dl><h3>Every run</h3>"
        f'<div class="scroll" role="region" tabindex="0" aria-label="Every run"><table id="runs"><thead><tr>{head}</tr>'
        f"</thead><tbody>{rows}</tbody></table></div><h3>Configurations</h3>"
        + "".join(
            f"<details><summary>{escape(label(method))}</summary>"
            f"<pre>{escape(yaml.safe_dump(config, sort_keys=False))}</pre></details>"
            for method, config in configs.items()
        )
    )


def _fact(value: Any) -> str:
    if isinstance(value, dict):
        return escape(", ".join(f"{k} {v}" for k, v in value.items()))
    return escape(", ".join(map(str, value)) if isinstance(value, list) else _plain(value))


def _plain(value: Any) -> str:
    """Of a CSV's cell: NaN stands for an empty one."""
    return "" if value is None or value != value else str(value)
