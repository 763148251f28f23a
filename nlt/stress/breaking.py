"""What the rows of the stress suites say: mean errors, and where each method breaks."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from nlt.evaluation.paper import order
from nlt.evaluation.results import MANIFEST, read_rows
from nlt.stress.suites import CLEAN, COMPUTED, RENDERED, ROWS, TRAININGS

DOUBLED = 2.0  # growth over the clean error at which a method breaks
_RESAMPLES = 1000  # of the views, for intervals
T = TypeVar("T")
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
        return sorted(dict.fromkeys(row["method"] for row in self.rows), key=order)

    def says(self, ladder: Ladder) -> str:
        """Return what a ladder changes."""
        return str(self.manifest["manifest"][ladder[0]][ladder[1]]["says"])

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
    def _by_view(self) -> dict[Ladder, dict[str, np.ndarray]]:
        """The errors (S + 1, V) by severity, the clean one first, and view, of the methods that each ladder affects.

        Ladders without rows are left out.
        """
        errors: dict[Ladder, dict[str, np.ndarray]] = {}
        ladders = [(suite, name) for suite in (*RENDERED, *COMPUTED) for name in self.manifest["manifest"][suite]]
        for ladder, method in itertools.product(ladders, self.methods):
            changed = [rows for severity in range(1, 6) if (rows := self.views(method, ladder, severity))]
            if changed:
                by_severity = [self.views(method, (CLEAN, "views"), 0), *changed]
                own = np.array([[row["error"] for row in rows] for rows in by_severity])
                errors.setdefault(ladder, {})[method] = own
        return errors

    @cached_property
    def errors(self) -> dict[Ladder, dict[str, np.ndarray]]:
        """The mean errors (S + 1,) by severity, the clean one first, of the methods that each ladder affects.

        A negative estimate, which an unbiased one may be, counts as zero. Ladders without rows are left out.
        """
        return _map(_means, self._by_view)

    @cached_property
    def breaks(self) -> dict[Ladder, dict[str, float]]:
        """The breaking point of each method on each ladder, for the same ones as `errors`."""
        return _map(lambda own: breaking_point(own / own[0]), self.errors)

    @cached_property
    def intervals(self) -> dict[Ladder, dict[str, tuple[float, float]]]:
        """The 95% interval of each of `breaks`, bootstrapped over the views; its ends may be infinite."""
        return _map(_interval, self._by_view)

    def break_text(self, ladder: Ladder, method: str) -> str:
        """Return a breaking point as text: > and the highest severity where the method never breaks."""
        return self._severity_text(ladder, method, self.breaks[ladder][method])

    def break_cell(self, ladder: Ladder, method: str) -> str:
        """Return the same with the interval in brackets, which is left out if no choice of views breaks the method."""
        low, high = self.intervals[ladder][method]
        text = partial(self._severity_text, ladder, method)
        return self.break_text(ladder, method) + (f" [{text(low)}, {text(high)}]" if math.isfinite(low) else "")

    def _severity_text(self, ladder: Ladder, method: str, severity: float) -> str:
        return f"{severity:.1f}" if math.isfinite(severity) else f"> {len(self.errors[ladder][method]) - 1}"


def _map(of: Callable[[np.ndarray], T], table: dict[Ladder, dict[str, np.ndarray]]) -> dict[Ladder, dict[str, T]]:
    """Return the same table with `of` each entry."""
    return {ladder: {method: of(own) for method, own in row.items()} for ladder, row in table.items()}


def breaking_point(growth: np.ndarray) -> float:
    """Return the severity at which the error has doubled, by linear interpolation; infinite if it never does."""
    for severity, (before, after) in enumerate(itertools.pairwise(growth)):
        if after >= DOUBLED:
            return float(severity + (DOUBLED - before) / (after - before))
    return math.inf


def _means(by_view: np.ndarray) -> np.ndarray:
    """Return the mean errors (S + 1,) over views (S + 1, V); a negative one on changed views counts as zero."""
    means = by_view.mean(1)
    return np.append(means[:1], np.maximum(means[1:], 0.0))


def _interval(by_view: np.ndarray) -> tuple[float, float]:
    """Return the 95% interval of the breaking point, bootstrapped over views (S + 1, V)."""
    rng, views = np.random.default_rng(0), by_view.shape[1]
    drawn = (_means(by_view[:, rng.integers(0, views, views)]) for _ in range(_RESAMPLES))
    points = [breaking_point(means / means[0]) if means[0] > 0 else 0.0 for means in drawn]
    # Not interpolated, because the points may be infinite.
    low, high = np.percentile(points, (2.5, 97.5), method="inverted_cdf")
    return float(low), float(high)
