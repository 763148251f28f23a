"""The tables and sentences of the stress suites, made from their rows alone."""

from __future__ import annotations

import itertools
import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label, order
from nlt.evaluation.results import MANIFEST, OK, read_rows, write_rows
from nlt.report.table_writer import Table, section
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, PATHS, RENDERED

STRESS, ROWS, TRAININGS, BREAKING, TEXT = "stress", "stress.csv", "training.csv", "breaking.csv", "stress.md"
DOUBLED = 2.0  # growth over the clean error at which a method breaks
_FLICKERS = {"points": "points", "photons": "photons", "noise": "input noise"}
_NONE = "–"
Row = dict[str, Any]
Ladder = tuple[str, str]  # suite and name


@dataclass(frozen=True)
class Stressed:
    """The rows of stress.csv and training.csv, and their manifest."""

    directory: Path
    manifest: dict[str, Any]
    rows: list[Row]
    trainings: list[Row]

    @cached_property
    def methods(self) -> list[str]:
        return sorted({row["method"] for row in self.rows}, key=order)

    @property
    def suites(self) -> dict[str, Any]:
        """The content of the suites' config."""
        return self.manifest["manifest"]

    def says(self, ladder: Ladder) -> str:
        """Return what a ladder changes."""
        return str(self.suites[ladder[0]][ladder[1]]["says"])

    def title(self, ladder: Ladder) -> str:
        return f"{ladder[0]}: {self.says(ladder)}"

    @cached_property
    def _groups(self) -> dict[tuple[str, str, str], list[Row]]:
        groups: dict[tuple[str, str, str], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row["method"], row["suite"], row["ladder"]), []).append(row)
        return groups

    def views(self, method: str, ladder: Ladder, severity: int) -> list[Row]:
        """Return the rows of a method's views at a severity; none where the ladder does not affect the method."""
        return [row for row in self._groups.get((method, *ladder), []) if row["severity"] == severity]

    def clean(self, method: str) -> float:
        """Return the error on the clean views."""
        return _mean(self.views(method, (CLEAN, "views"), 0), "error")

    @cached_property
    def errors(self) -> dict[Ladder, dict[str, np.ndarray]]:
        """The mean errors (S + 1,) by severity, the clean one first, of the methods that each ladder affects.

        A negative estimate, which an unbiased one may be, counts as zero. Ladders without rows are left out.
        """
        errors: dict[Ladder, dict[str, np.ndarray]] = {}
        ladders = [(suite, name) for suite in (*RENDERED, *COMPUTED) for name in self.suites[suite]]
        for ladder, method in itertools.product(ladders, self.methods):
            means = [max(_mean(rows, "error"), 0.0) for k in range(1, 6) if (rows := self.views(method, ladder, k))]
            if means:
                errors.setdefault(ladder, {})[method] = np.array([self.clean(method), *means])
        return errors

    def flicker(self, method: str, kind: str) -> float:
        """Return the mean over scenes of a kind's value; NaN where the method is not affected."""
        return _mean(self._groups.get((method, FLICKER, kind), []), "value")


def _mean(rows: list[Row], key: str) -> float:
    return float(np.mean([row[key] for row in rows])) if rows else math.nan


def breaking_point(growth: np.ndarray) -> float:
    """Return the severity at which the error has doubled, by linear interpolation; infinite if it never does."""
    for severity in range(1, len(growth)):
        if growth[severity] >= DOUBLED:
            before, after = growth[severity - 1], growth[severity]
            return float(severity - 1 + (DOUBLED - before) / (after - before))
    return math.inf


def load_stress(directory: Path) -> Stressed | None:
    """Read the stress results in a directory; None where there are none."""
    if not (directory / ROWS).exists() or not (directory / MANIFEST).exists():
        return None
    trainings = read_rows(directory / TRAININGS) if (directory / TRAININGS).exists() else []
    return Stressed(directory, json.loads((directory / MANIFEST).read_text()), read_rows(directory / ROWS), trainings)


def write_stress(stressed: Stressed) -> None:
    """Write breaking.csv and stress.md."""
    write_rows(stressed.directory / BREAKING, _rows(stressed))
    lines = ["# Where methods fail", ""]
    for paragraph in (introduction(stressed), *(about(stressed, method) for method in stressed.methods)):
        lines += [paragraph, ""]
    for table in tables(stressed):
        lines += section(table)
    lines += [f"Where the numbers come from: {MANIFEST}, {ROWS}, {TRAININGS}, {BREAKING}.", ""]
    write_bytes(stressed.directory / TEXT, "\n".join(lines).encode())


def _rows(stressed: Stressed) -> list[Row]:
    """Return a row per method and ladder: errors, their growth and ranks by severity, and the breaking point."""
    rows = []
    for (suite, name), errors in stressed.errors.items():
        ranks = scipy.stats.rankdata(list(errors.values()), axis=0, method="min").astype(int)
        for (method, own), own_ranks in zip(errors.items(), ranks, strict=True):
            row: Row = {"method": method, "suite": suite, "ladder": name}
            for column, values in {"error": own, "growth": own / own[0], "rank": own_ranks}.items():
                row |= {f"{column}_{k}": value for k, value in enumerate(values)}
            rows.append(row | {"breaks_at": breaking_point(own / own[0])})
    return rows


def introduction(stressed: Stressed) -> str:
    """Return a paragraph on the measurement and the parts left out."""
    manifest = stressed.manifest
    return (
        f"`{manifest['command']}`, commit {str(manifest['commit'])[:12]}: at each severity "
        f"{manifest['views']} of each scene's views ({', '.join(manifest['scenes'])}), "
        f"suites of version {stressed.suites['version']}. "
        "Errors are squared, relative to the reference's square (plus 0.01) at each pixel, without the reference's "
        "noise; a method breaks where its error is twice that of the clean views."
        + (f" Left out: {'; '.join(manifest['left_out'])}." if manifest["left_out"] else "")
    )


def about(stressed: Stressed, method: str) -> str:
    """Return a Markdown paragraph: where and how much a method breaks, which is better there, what it withstands."""
    errors = {ladder: own for ladder, errors in stressed.errors.items() if (own := errors.get(method)) is not None}
    points = {ladder: breaking_point(own / own[0]) for ladder, own in errors.items()}
    broken = sorted((at, ladder) for ladder, at in points.items() if math.isfinite(at))
    held = [stressed.says(ladder) for ladder, at in points.items() if not math.isfinite(at)]
    parts = [f"**{label(method)}** has a clean error of {stressed.clean(method):.3g}."]
    parts += [_break(stressed, method, ladder, at) for at, ladder in broken[:5]]
    if len(broken) > 5:
        rest = ", ".join(f"{stressed.says(ladder)} ({at:.1f})" for at, ladder in broken[5:])
        parts.append(f"Further, it breaks with {rest}.")
    if held:
        parts.append(f"It withstands: {', '.join(held)}.")
    bad = int(sum(row["nonfinite"] for row in stressed.rows if row["method"] == method))
    parts.append(f"**{bad} pixels are not finite.**" if bad else "Every output is finite.")
    return " ".join(parts)


def _break(stressed: Stressed, method: str, ladder: Ladder, at: float) -> str:
    """Return a sentence on a ladder that breaks a method at severity `at`, and on the best other method there."""
    errors = stressed.errors[ladder]
    worst = int(errors[method].argmax())  # not always the highest severity: a camera very close to a wall sees little
    at_worst = {m: errors[m][worst] if m in errors else stressed.clean(m) for m in stressed.methods}
    own = at_worst.pop(method)
    best = min(at_worst, key=at_worst.__getitem__, default=None)
    advice = ""
    if best is not None and at_worst[best] < own:
        advice = f"; there {label(best)} has {at_worst[best]:.3g} against its {own:.3g}"
    elif best is not None:
        advice = f"; yet no other method has less than its {own:.3g} there"
    times = f"{own / errors[method][0]:.3g} times the clean error at severity {worst}"
    return f"It breaks with {stressed.says(ladder)} at severity {at:.1f} ({times}{advice})."


def tables(stressed: Stressed) -> list[Table]:
    """Return the tables of breaking points, ranks, flicker and trainings, without empty ones."""
    all_tables = [_breaking(stressed), _ranking(stressed), _flicker(stressed), _training(stressed)]
    return [table for table in all_tables if table.rows]


def _breaking(stressed: Stressed) -> Table:
    rows = []
    for ladder, errors in stressed.errors.items():
        growths = [errors[method] / errors[method][0] if method in errors else None for method in stressed.methods]
        cells = [_NONE if g is None else f"{severity(breaking_point(g), len(g) - 1)} ({g[-1]:.2g})" for g in growths]
        rows.append([stressed.title(ladder), *cells])
    note = "Severity at which the error doubles; > where it does not up to the highest; in brackets the growth there."
    return Table("Breaking points", note, [label(method) for method in stressed.methods], rows, first="ladder")


def severity(at: float, highest: int) -> str:
    """Return a breaking point as text."""
    return f"{at:.1f}" if math.isfinite(at) else f"> {highest}"


def _ranking(stressed: Stressed) -> Table:
    """Compare the order of the methods at the highest severity with that on the clean views."""
    rows = []
    for ladder, errors in stressed.errors.items():
        if len(errors) > 1:
            values = np.stack(list(errors.values()))[:, [0, -1]]
            tau = scipy.stats.kendalltau(*values.T).statistic
            best = [label(list(errors)[k]) for k in values.argmin(0)]
            rows.append([stressed.title(ladder), *best, _number(tau, ".2f")])
    columns = ["best, clean", "best at the highest severity", "Kendall's τ of the two orders"]
    return Table("Ranks", "", columns, rows, first="ladder")


def _flicker(stressed: Stressed) -> Table:
    rows = []
    for method in stressed.methods if any(row["suite"] == FLICKER for row in stressed.rows) else ():
        draws = [_number(100 * stressed.flicker(method, kind), ".2f") for kind in _FLICKERS]
        rows.append([label(method), *draws, *(_number(stressed.flicker(method, kind)) for kind in PATHS)])
    note = (
        "Standard deviation of a pixel over draws in a fixed scene, in % of the image's root mean square; and the mean "
        "square change from frame to frame on a smooth path, over the reference's."
    )
    return Table("Flicker", note, [*_FLICKERS.values(), *(f"path of the {kind}" for kind in PATHS)], rows)


def _training(stressed: Stressed) -> Table:
    rows, trained = [], stressed.trainings
    kinds = list(dict.fromkeys((r["variation"], str(r["value"])) for r in trained if r["variation"] != "seed"))
    content = stressed.suites["training"]
    for method in dict.fromkeys(row["method"] for row in trained):
        own = [row for row in trained if row["method"] == method]
        seeds = np.array([row["error"] for row in own if row["variation"] == "seed" and row["status"] == OK])
        lost = sum(row["status"] != OK for row in own if row["variation"] == "seed")
        spread = f"{seeds.mean():.3g} ± {seeds.std(ddof=1):.2g}" if len(seeds) > 1 else _number(seeds.sum() or math.nan)
        cells = [spread + (f", {lost} lost" if lost else "")]
        for kind in kinds:
            row = next((row for row in own if (row["variation"], str(row["value"])) == kind), None)
            cells.append(_NONE if row is None else row["status"] if row["status"] != OK else _number(row["error"]))
        rows.append([label(method), *cells])
    note = (
        f"Trained anew for {content['share']:.0%} of the steps: the error over {content['seeds']} seeds "
        "(mean ± standard deviation), and that of one seed with a change."
    )
    return Table("Training", note, ["seeds", *(f"{a} {b}" for a, b in kinds)], rows)


def _number(value: float, form: str = ".3g") -> str:
    return format(value, form) if math.isfinite(value) else _NONE
