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

from nlt.evaluation.paper import label, order
from nlt.evaluation.results import MANIFEST, OK, read_rows
from nlt.report.table_writer import Table
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

    @classmethod
    def load(cls, directory: Path) -> Stressed | None:
        """Read the stress results in a directory; None where there are none."""
        if not (directory / ROWS).exists() or not (directory / MANIFEST).exists():
            return None
        trainings = read_rows(directory / TRAININGS) if (directory / TRAININGS).exists() else []
        return cls(directory, json.loads((directory / MANIFEST).read_text()), read_rows(directory / ROWS), trainings)

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
    def _groups(self) -> dict[tuple[str, str, str, int], list[Row]]:
        groups: dict[tuple[str, str, str, int], list[Row]] = {}
        for row in self.rows:
            groups.setdefault((row["method"], row["suite"], row["ladder"], row["severity"]), []).append(row)
        return groups

    def views(self, method: str, ladder: Ladder, severity: int) -> list[Row]:
        """Return the rows of a method's views at a severity; none where the ladder does not affect the method."""
        return self._groups.get((method, *ladder, severity), [])

    def mean(self, method: str, ladder: Ladder, severity: int, key: str = "error") -> float:
        """Return a column's mean over those rows; NaN if there are none."""
        rows = self.views(method, ladder, severity)
        return float(np.mean([row[key] for row in rows])) if rows else math.nan

    def clean(self, method: str) -> float:
        """Return the error on the clean views."""
        return self.mean(method, (CLEAN, "views"), 0)

    @cached_property
    def errors(self) -> dict[Ladder, dict[str, np.ndarray]]:
        """The mean errors (S + 1,) by severity, the clean one first, of the methods that each ladder affects.

        A negative estimate, which an unbiased one may be, counts as zero. Ladders without rows are left out.
        """
        errors: dict[Ladder, dict[str, np.ndarray]] = {}
        ladders = [(suite, name) for suite in (*RENDERED, *COMPUTED) for name in self.suites[suite]]
        for ladder, method in itertools.product(ladders, self.methods):
            severities = [k for k in range(1, 6) if self.views(method, ladder, k)]
            if severities:
                means = [max(self.mean(method, ladder, k), 0.0) for k in severities]
                errors.setdefault(ladder, {})[method] = np.array([self.clean(method), *means])
        return errors

    @cached_property
    def breaks(self) -> dict[Ladder, dict[str, float]]:
        """The breaking point of each method on each ladder, for the same ones as `errors`."""
        errors = self.errors.items()
        return {
            ladder: {m: breaking_point(own / own[0]) for m, own in by_method.items()} for ladder, by_method in errors
        }

    def break_text(self, ladder: Ladder, method: str) -> str:
        """Return a breaking point as text: > and the highest severity where the method never breaks."""
        at = self.breaks[ladder][method]
        return f"{at:.1f}" if math.isfinite(at) else f"> {len(self.errors[ladder][method]) - 1}"


def breaking_point(growth: np.ndarray) -> float:
    """Return the severity at which the error has doubled, by linear interpolation; infinite if it never does."""
    for severity, (before, after) in enumerate(itertools.pairwise(growth)):
        if after >= DOUBLED:
            return float(severity + (DOUBLED - before) / (after - before))
    return math.inf


def breaking_rows(stressed: Stressed) -> list[Row]:
    """Return the rows of breaking.csv, by method and ladder: errors, growth and ranks by severity, breaking point."""
    rows = []
    for ladder, errors in stressed.errors.items():
        ranks = scipy.stats.rankdata(list(errors.values()), axis=0, method="min").astype(int)
        for (method, own), own_ranks in zip(errors.items(), ranks, strict=True):
            row: Row = {"method": method, "suite": ladder[0], "ladder": ladder[1]}
            for column, values in {"error": own, "growth": own / own[0], "rank": own_ranks}.items():
                row |= {f"{column}_{k}": value for k, value in enumerate(values)}
            rows.append(row | {"breaks_at": stressed.breaks[ladder][method]})
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


def tables(stressed: Stressed) -> list[Table]:
    """Return the tables of breaking points, ranks, flicker and trainings, without empty ones."""
    methods = stressed.methods
    points, ranks, flicker = [], [], []
    for ladder, errors in stressed.errors.items():
        growth = {method: f"({own[-1] / own[0]:.2g})" for method, own in errors.items()}
        cells = [f"{stressed.break_text(ladder, m)} {growth[m]}" if m in errors else _NONE for m in methods]
        points.append([stressed.title(ladder), *cells])
        if len(errors) > 1:
            values = np.stack(list(errors.values()))[:, [0, -1]]
            best = [label(list(errors)[k]) for k in values.argmin(0)]
            ranks.append([stressed.title(ladder), *best, _number(scipy.stats.kendalltau(*values.T).statistic, ".2f")])
    for method in methods if any(row["suite"] == FLICKER for row in stressed.rows) else ():
        value = lambda kind, method=method: stressed.mean(method, (FLICKER, kind), 0, "value")
        draws = [_number(100 * value(kind), ".2f") for kind in _FLICKERS]
        flicker.append([label(method), *draws, *(_number(value(kind)) for kind in PATHS)])
    note = "Severity at which the error doubles; > where it does not up to the highest; in brackets the growth there."
    flicker_note = (
        "Standard deviation of a pixel over draws in a fixed scene, in % of the image's root mean square; and the mean "
        "square change from frame to frame on a smooth path, over the reference's."
    )
    best = ["best, clean", "best at the highest severity", "Kendall's τ of the two orders"]
    all_tables = [
        Table("Breaking points", note, [label(method) for method in methods], points, first="ladder"),
        Table("Ranks", "", best, ranks, first="ladder"),
        Table("Flicker", flicker_note, [*_FLICKERS.values(), *(f"path of the {kind}" for kind in PATHS)], flicker),
        _trainings(stressed),
    ]
    return [table for table in all_tables if table.rows]


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
    content = stressed.suites["training"]
    note = (
        f"Trained anew for {content['share']:.0%} of the steps: the error over {content['seeds']} seeds "
        "(mean ± standard deviation), and that of one seed with a change."
    )
    return Table("Training", note, ["seeds", *(f"{a} {b}" for a, b in kinds)], cells)


def _number(value: float, form: str = ".3g") -> str:
    return format(value, form) if math.isfinite(value) else _NONE
