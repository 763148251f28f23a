"""The tables and sentences of the stress suites, made from their rows alone."""

from __future__ import annotations

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
from nlt.report.tables import Table, as_markdown
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, PATHS, RENDERED

STRESS, ROWS, TRAININGS, BREAKING, TEXT = "stress", "stress.csv", "training.csv", "breaking.csv", "stress.md"
DOUBLED = 2.0  # growth over the clean error at which a method breaks
_FLICKERS = {"points": "points", "photons": "photons", "noise": "input noise"}
_NONE = "–"


@dataclass(frozen=True)
class Stressed:
    """The rows of stress.csv and training.csv, and their manifest."""

    directory: Path
    manifest: dict[str, Any]
    rows: list[dict[str, Any]]
    trainings: list[dict[str, Any]]

    @cached_property
    def methods(self) -> list[str]:
        return sorted({row["method"] for row in self.rows}, key=order)

    @cached_property
    def ladders(self) -> list[tuple[str, str]]:
        """Suite and name of every ladder that has rows, in the manifest's order."""
        present = {(row["suite"], row["ladder"]) for row in self.rows}
        known = [(suite, name) for suite in (*RENDERED, *COMPUTED) for name in self.manifest["manifest"][suite]]
        return [key for key in known if key in present]

    def says(self, ladder: tuple[str, str]) -> str:
        return str(self.manifest["manifest"][ladder[0]][ladder[1]]["says"])

    @cached_property
    def _means(self) -> dict[tuple, float]:
        """Mean error over views, by method, suite, ladder and severity."""
        errors: dict[tuple, list[float]] = {}
        for row in self.rows:
            if row["suite"] != FLICKER:
                key = (row["method"], row["suite"], row["ladder"], row["severity"])
                errors.setdefault(key, []).append(row["error"])
        return {key: float(np.mean(values)) for key, values in errors.items()}

    def clean(self, method: str) -> float:
        """Return the error on the clean views."""
        return self._means.get((method, CLEAN, "views", 0), math.nan)

    def errors(self, method: str, ladder: tuple[str, str]) -> np.ndarray:
        """Return the errors (S + 1,) by severity, the clean one first; empty where a method is not affected.

        A negative estimate, which an unbiased one may be, counts as zero.
        """
        keys = [(method, *ladder, severity) for severity in range(1, 6)]
        means = [max(self._means[key], 0.0) for key in keys if key in self._means]
        return np.array([self.clean(method), *means]) if means else np.zeros(0)

    def error(self, method: str, ladder: tuple[str, str], severity: int) -> float:
        """Return the error at a severity; the clean error where the ladder does not affect the method."""
        errors = self.errors(method, ladder)
        return float(errors[severity]) if len(errors) else self.clean(method)

    def growth(self, method: str, ladder: tuple[str, str]) -> np.ndarray:
        """Return `errors` (S + 1,) over the clean error."""
        errors = self.errors(method, ladder)
        return errors / errors[0] if len(errors) else errors

    def nonfinite(self, method: str) -> int:
        """Return the number of pixels that are not finite, over all suites."""
        return int(sum(row["nonfinite"] for row in self.rows if row["method"] == method))

    def flicker(self, method: str, kind: str) -> float:
        """Return the mean over scenes of a kind's value; NaN where the method is not affected."""
        values = [r["value"] for r in self.rows if (r["method"], r["suite"], r["ladder"]) == (method, FLICKER, kind)]
        return float(np.mean(values)) if values else math.nan


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
    trainings = directory / TRAININGS
    return Stressed(
        directory,
        json.loads((directory / MANIFEST).read_text()),
        read_rows(directory / ROWS),
        read_rows(trainings) if trainings.exists() else [],
    )


def write_stress(stressed: Stressed) -> None:
    """Write breaking.csv and stress.md."""
    write_rows(stressed.directory / BREAKING, _rows(stressed))
    write_bytes(stressed.directory / TEXT, _text(stressed).encode())


def _rows(stressed: Stressed) -> list[dict[str, Any]]:
    """Return a row per method and ladder: errors, their growth and ranks by severity, and the breaking point."""
    rows = []
    for ladder in stressed.ladders:
        errors = {m: e for m in stressed.methods if len(e := stressed.errors(m, ladder))}
        ranks = dict(zip(errors, _ranks(list(errors.values())), strict=True))
        for method, own in errors.items():
            growth = stressed.growth(method, ladder)
            row: dict[str, Any] = {"method": method, "suite": ladder[0], "ladder": ladder[1]}
            row |= {f"error_{k}": value for k, value in enumerate(own)}
            row |= {f"growth_{k}": value for k, value in enumerate(growth)}
            row |= {f"rank_{k}": int(rank) for k, rank in enumerate(ranks[method])}
            rows.append(row | {"breaks_at": breaking_point(growth)})
    columns = list(dict.fromkeys(key for row in rows for key in row))
    return [{key: row[key] for key in columns if key in row} for row in rows]


def _ranks(errors: list[np.ndarray]) -> np.ndarray:
    """Return the ranks (methods, severities), 1 for the lowest error."""
    return scipy.stats.rankdata(np.stack(errors), axis=0, method="min")


# --- in words ---


def _text(stressed: Stressed) -> str:
    lines = ["# Where methods fail", "", introduction(stressed), ""]
    for paragraph in paragraphs(stressed):
        lines += [paragraph, ""]
    for table in tables(stressed):
        lines += as_markdown(table, 2)
    return "\n".join([*lines, f"Where the numbers come from: {MANIFEST}, {ROWS}, {TRAININGS}, {BREAKING}."]) + "\n"


def introduction(stressed: Stressed) -> str:
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


def paragraphs(stressed: Stressed) -> list[str]:
    """Return a Markdown paragraph for each method."""
    return [_about(stressed, method) for method in stressed.methods]


def tables(stressed: Stressed) -> list[Table]:
    """Return the tables of breaking points, ranks, flicker and trainings, without empty ones."""
    all_tables = [_breaking(stressed), _ranking(stressed), _flicker(stressed), _training(stressed)]
    return [table for table in all_tables if table.rows]


def _about(stressed: Stressed, method: str) -> str:
    """Return a paragraph: where a method breaks, by how much, which is better there, and the changes it withstands."""
    points = {ladder: breaking_point(g) for ladder in stressed.ladders if len(g := stressed.growth(method, ladder))}
    broken = sorted((at, ladder) for ladder, at in points.items() if math.isfinite(at))
    held = [stressed.says(ladder) for ladder, at in points.items() if not math.isfinite(at)]
    parts = [f"**{label(method)}** has a clean error of {stressed.clean(method):.3g}."]
    for at, ladder in broken[:5]:
        growth = stressed.growth(method, ladder)
        worst = int(growth.argmax())  # not always the highest severity: a camera very close to a wall sees little
        own = stressed.error(method, ladder, worst)
        rivals = {m: stressed.error(m, ladder, worst) for m in stressed.methods if m != method}
        best = min(rivals, key=rivals.__getitem__, default=None)
        advice = ""
        if best is not None and rivals[best] < own:
            advice = f"; there {label(best)} has {rivals[best]:.3g} against its {own:.3g}"
        elif best is not None:
            advice = f"; yet no other method has less than its {own:.3g} there"
        parts.append(
            f"It breaks with {stressed.says(ladder)} at severity {at:.1f} "
            f"({growth[worst]:.3g} times the clean error at severity {worst}{advice})."
        )
    if len(broken) > 5:
        rest = ", ".join(f"{stressed.says(ladder)} ({at:.1f})" for at, ladder in broken[5:])
        parts.append(f"Further, it breaks with {rest}.")
    if held:
        parts.append(f"It withstands: {', '.join(held)}.")
    bad = stressed.nonfinite(method)
    parts.append(f"**{bad} pixels are not finite.**" if bad else "Every output is finite.")
    return " ".join(parts)


def _breaking(stressed: Stressed) -> Table:
    rows = []
    for ladder in stressed.ladders:
        cells = []
        for method in stressed.methods:
            growth = stressed.growth(method, ladder)
            at = breaking_point(growth)
            cells.append(f"{severity(at, len(growth) - 1)} ({growth[-1]:.2g})" if len(growth) else _NONE)
        rows.append([f"{ladder[0]}: {stressed.says(ladder)}", *cells])
    note = "Severity at which the error doubles; > where it does not up to the highest; in brackets the growth there."
    return Table("Breaking points", note, [label(method) for method in stressed.methods], rows, first="ladder")


def severity(at: float, highest: int) -> str:
    """Return a breaking point as text."""
    return f"{at:.1f}" if math.isfinite(at) else f"> {highest}"


def _ranking(stressed: Stressed) -> Table:
    """Compare the order of the methods at the highest severity with that on the clean views."""
    rows = []
    for ladder in stressed.ladders:
        errors = {m: e for m in stressed.methods if len(e := stressed.errors(m, ladder))}
        if len(errors) > 1:
            names, values = list(errors), np.stack(list(errors.values()))
            tau = scipy.stats.kendalltau(values[:, 0], values[:, -1]).statistic
            first, last = (label(names[int(values[:, k].argmin())]) for k in (0, -1))
            rows.append([f"{ladder[0]}: {stressed.says(ladder)}", first, last, _number(tau, ".2f")])
    columns = ["best, clean", "best at the highest severity", "Kendall's τ of the two orders"]
    return Table("Ranks", "", columns, rows, first="ladder")


def _flicker(stressed: Stressed) -> Table:
    rows = []
    for method in stressed.methods if any(row["suite"] == FLICKER for row in stressed.rows) else ():
        draws = [100 * stressed.flicker(method, kind) for kind in _FLICKERS]
        moves = [stressed.flicker(method, kind) for kind in PATHS]
        cells = [_number(v, ".2f") for v in draws] + [_number(v) for v in moves]
        rows.append([label(method), *cells])
    note = (
        "Standard deviation of a pixel over draws in a fixed scene, in % of the image's root mean square; and the mean "
        "square change from frame to frame on a smooth path, over the reference's."
    )
    return Table("Flicker", note, [*_FLICKERS.values(), *(f"path of the {kind}" for kind in PATHS)], rows)


def _training(stressed: Stressed) -> Table:
    rows, trained = [], stressed.trainings
    kinds = list(dict.fromkeys((r["variation"], str(r["value"])) for r in trained if r["variation"] != "seed"))
    content = stressed.manifest["manifest"]["training"]
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
