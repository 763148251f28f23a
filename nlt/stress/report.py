"""The report section of the stress suites: sentences, tables and figures, made from their rows alone."""

import math
from pathlib import Path

import numpy as np
import scipy.stats

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label
from nlt.evaluation.results import MANIFEST, OK, write_rows
from nlt.report.page import Section
from nlt.report.table_writer import Table, section
from nlt.stress.breaking import Row, Stressed
from nlt.stress.figures import draw_curves, draw_map, draw_worst
from nlt.stress.suites import FLICKER, PATHS, ROWS, STEADY, STRESS, TRAININGS

BREAKING, TEXT = "breaking.csv", "stress.md"
_DENOISER = "oidn_1"  # what a method must not be worse than
_WORSE = 1.1  # ratio of errors above which it is
_FLICKERS = {"points": "points", "photons": "photons", "noise": "input noise"}
_NONE = "–"


def stress_section(results: Path) -> Section | None:
    """Write tables and figures of a comparison's stress results and return their report section; None without them."""
    stressed = Stressed.load(results / STRESS)
    if stressed is None:
        return None
    directory = stressed.directory
    paragraphs = [_introduction(stressed), *(_about(stressed, method) for method in stressed.methods)]
    tables = _tables(stressed)
    lines = ["# Where methods fail", "", *(line for paragraph in paragraphs for line in (paragraph, ""))]
    lines += [line for table in tables for line in section(table)]
    lines += [f"Where the numbers come from: {MANIFEST}, {ROWS}, {TRAININGS}, {BREAKING}.", ""]
    write_bytes(directory / TEXT, "\n".join(lines).encode())
    write_rows(directory / BREAKING, _breaking_rows(stressed))
    if stressed.errors:
        draw_curves(stressed)
        draw_map(stressed)
        draw_worst(stressed)
    files = (ROWS, BREAKING, TRAININGS, TEXT, MANIFEST)
    source = f"{STRESS}/{BREAKING}, {ROWS}, {TRAININGS}"
    return Section(STRESS, "Where methods fail", paragraphs, tables, directory, files, source)


def _breaking_rows(stressed: Stressed) -> list[Row]:
    """Return the rows of breaking.csv, by method and ladder: errors, growth and ranks by severity, breaking point."""
    rows = []
    for ladder, errors in stressed.errors.items():
        ranks = scipy.stats.rankdata(list(errors.values()), axis=0, method="min").astype(int)
        for (method, own), own_ranks in zip(errors.items(), ranks, strict=True):
            row: Row = {"method": method, "suite": ladder[0], "ladder": ladder[1]}
            for column, values in {"error": own, "growth": own / own[0], "rank": own_ranks}.items():
                row |= {f"{column}_{k}": value for k, value in enumerate(values)}
            low, high = stressed.intervals[ladder][method]
            rows.append(row | {"breaks_at": stressed.breaks[ladder][method], "breaks_low": low, "breaks_high": high})
    return rows


def _introduction(stressed: Stressed) -> str:
    """Return a paragraph on the measurement and the parts left out."""
    manifest = stressed.manifest
    return (
        f"`{manifest['command']}`, commit {str(manifest['commit'])[:12]}: at each severity "
        f"{manifest['views']} of each scene's views ({', '.join(manifest['scenes'])}), "
        f"suites of version {manifest['manifest']['version']}. "
        "Errors are squared, relative to the reference's square (plus 0.01) at each pixel, without the reference's "
        "noise; a method breaks where its error is twice that of the clean views."
        + (f" Left out: {'; '.join(manifest['left_out'])}." if manifest["left_out"] else "")
    )


def _about(stressed: Stressed, method: str) -> str:
    """Return a Markdown paragraph: where and how much a method breaks, which is better there, what it withstands."""
    points = {ladder: own[method] for ladder, own in stressed.breaks.items() if method in own}
    broken = sorted((at, ladder) for ladder, at in points.items() if math.isfinite(at))
    held = [stressed.says(ladder) for ladder, at in points.items() if not math.isfinite(at)]
    parts = [f"**{label(method)}** has a clean error of {stressed.clean(method):.3g}."]
    for at, ladder in broken[:5]:
        errors = stressed.errors[ladder]
        worst = int(errors[method].argmax())  # not always the highest severity: a camera close to a wall sees little
        at_worst = {m: errors[m][worst] if m in errors else stressed.clean(m) for m in stressed.methods}
        own = at_worst.pop(method)
        best = min(at_worst, key=at_worst.__getitem__, default=None)
        advice = ""
        if best is not None and at_worst[best] < own:
            advice = f"; there {label(best)} has {at_worst[best]:.3g} against its {own:.3g}"
        elif best is not None:
            advice = f"; yet no other method has less than its {own:.3g} there"
        times = f"{own / errors[method][0]:.3g} times the clean error at severity {worst}"
        parts.append(f"It breaks with {stressed.says(ladder)} at severity {at:.1f} ({times}{advice}).")
    if len(broken) > 5:
        rest = ", ".join(f"{stressed.says(ladder)} ({at:.1f})" for at, ladder in broken[5:])
        parts.append(f"Further, it breaks with {rest}.")
    if held:
        parts.append(f"It withstands: {', '.join(held)}.")
    bad = int(sum(row["nonfinite"] for row in stressed.rows if row["method"] == method))
    parts.append(f"**{bad} pixels are not finite.**" if bad else "Every output is finite.")
    return " ".join(parts)


def _tables(stressed: Stressed) -> list[Table]:
    """Return the tables of breaking points, ranks, flicker and trainings, without empty ones."""
    methods = stressed.methods
    points, ranks, flicker, steady = [], [], [], []
    for ladder, errors in stressed.errors.items():
        cells = [stressed.break_cell(ladder, method) if method in errors else _NONE for method in methods]
        points.append([stressed.title(ladder), *cells])
        if len(errors) > 1:
            values = np.stack(list(errors.values()))[:, [0, -1]]
            best = [label(list(errors)[k]) for k in values.argmin(0)]
            ranks.append([stressed.title(ladder), *best, _number(scipy.stats.kendalltau(*values.T).statistic, ".2f")])
    for method in methods if any(row["suite"] == FLICKER for row in stressed.rows) else ():
        value = lambda kind, method=method: stressed.mean(method, (FLICKER, kind), 0, "value")
        draws = [_number(100 * value(kind), ".2f") for kind in _FLICKERS]
        flicker.append([label(method), *draws, *(_number(value(kind)) for kind in PATHS)])
        if any(row["ladder"].endswith(STEADY) for row in stressed.rows if row["suite"] == FLICKER):
            error = lambda kind, method=method: stressed.mean(method, (FLICKER, kind), 0)
            ratios = ((of(kind + STEADY) / of(kind) for of in (value, error)) for kind in PATHS)
            steady.append([label(method), *(_number(ratio) for pair in ratios for ratio in pair)])
    note = (
        "Severity at which the error doubles; > where it does not up to the highest. In brackets is the 95% interval, "
        "bootstrapped over the views; there is none where no choice of them would break the method."
    )
    flicker_note = (
        "Standard deviation of a pixel over draws in a fixed scene, in % of the image's root mean square; and the mean "
        "square change from frame to frame on a smooth path, over the reference's."
    )
    rank_columns = ["best, clean", "best at the highest severity", "Kendall's τ of the two orders"]
    steady_note = (
        "Blended frames (`nlt render --steady`) over frames as they are, on the same paths: change from frame to "
        "frame, and error. Below 1 is better; where the error is above 1, the blended frames lag behind."
    )
    steady_columns = [f"{what}, {kind}" for kind in PATHS for what in ("change", "error")]
    all_tables = [
        Table("Breaking points", note, [label(method) for method in methods], points, first="ladder"),
        _against_denoiser(stressed),
        Table("Ranks", "", rank_columns, ranks, first="ladder"),
        Table("Flicker", flicker_note, [*_FLICKERS.values(), *(f"path of the {kind}" for kind in PATHS)], flicker),
        Table("Steady frames", steady_note, steady_columns, steady),
        _trainings(stressed),
    ]
    return [table for table in all_tables if table.rows]


def _against_denoiser(stressed: Stressed) -> Table:
    """Return the largest ratio of each method's error to that of Open Image Denoise on 1 spp, by ladder."""
    ratios = {
        ladder: {method: own / errors[_DENOISER] for method, own in errors.items() if method != _DENOISER}
        for ladder, errors in stressed.errors.items()
        if _DENOISER in errors
    }
    methods = [method for method in stressed.methods if any(method in own for own in ratios.values())]
    cell = lambda own: _NONE if own is None else _number(own.max(), ".2f")
    rows = [[stressed.title(ladder), *(cell(own.get(m)) for m in methods)] for ladder, own in ratios.items()]
    if rows:
        changed = {m: np.concatenate([own[m][1:] for own in ratios.values() if m in own]) for m in methods}
        rows.append(["median", *(_number(np.median(own), ".2f") for own in changed.values())])
        above = lambda own: f"{(own > _WORSE).sum()} of {len(own)}"
        rows.append([f"severities above {_WORSE}", *map(above, changed.values())])
    note = f"Error over that of {label(_DENOISER)}: the largest of a ladder's severities, the clean views included."
    return Table("Against Open Image Denoise", note, [label(method) for method in methods], rows, first="ladder")


def _trainings(stressed: Stressed) -> Table:
    by_method: dict[str, dict[tuple[str, str], Row]] = {}
    for row in stressed.trainings:
        by_method.setdefault(row["method"], {})[row["variation"], str(row["value"])] = row
    kinds = list(dict.fromkeys(kind for own in by_method.values() for kind in own if kind[0] != "seed"))
    cells = []
    for method, own in by_method.items():
        seeds = [row for (variation, _), row in own.items() if variation == "seed"]
        errors = np.array([row["error"] for row in seeds if row["status"] == OK])
        lost = f", {len(seeds) - len(errors)} lost" if len(errors) < len(seeds) else ""
        mean = errors.mean() if len(errors) else math.nan
        spread = f"{mean:.3g} ± {errors.std(ddof=1):.2g}" if len(errors) > 1 else _number(mean)
        outcomes = [own.get(kind, {"status": _NONE}) for kind in kinds]
        cells.append([label(method), spread + lost])
        cells[-1] += [_number(row["error"]) if row["status"] == OK else row["status"] for row in outcomes]
    content = stressed.manifest["manifest"]["training"]
    note = (
        f"Trained again for {content['share']:.0%} of the steps: the error over {content['seeds']} seeds "
        "(mean ± standard deviation), and that of one seed with a change."
    )
    return Table("Training", note, ["seeds", *(f"{a} {b}" for a, b in kinds)], cells)


def _number(value: float, form: str = ".3g") -> str:
    return format(value, form) if math.isfinite(value) else _NONE
