"""The report section of the stress suites: sentences, tables and figures, made from their rows alone."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from textwrap import fill
from typing import Any, TypeVar

import matplotlib.pyplot as plt
import numpy as np
import scipy.stats

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label, order
from nlt.evaluation.results import MANIFEST, OK, Results, read_rows, write_rows
from nlt.report import plots
from nlt.report.page import Section
from nlt.report.table_writer import Table, section
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, PATHS, RENDERED, ROWS, STEADY, STRESS, TRAININGS

BREAKING, TEXT = "breaking.csv", "stress.md"
DOUBLED = 2.0  # growth over the clean error at which a method breaks
_CEILING = 1e3  # growth at which curves are clipped
_ACROSS = 6  # panels of curves in a row
_WORST = 8  # rows of the gallery
_RESAMPLES = 1000  # of the views, for intervals
_DENOISER = "oidn_1"  # what a method must not be worse than
_WORSE = 1.1  # ratio of errors above which it is
_FLICKERS = {"points": "points", "photons": "photons", "noise": "input noise"}
_NONE = "–"
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
        _draw_curves(stressed)
        _draw_map(stressed)
        _draw_worst(stressed)
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


def _draw_curves(stressed: Stressed) -> None:
    """Draw stress_curves: the growth of the error over severity, one panel per ladder, on one scale."""
    rows = math.ceil(len(stressed.errors) / _ACROSS)
    size = (2.4 * _ACROSS, 2 * rows + 0.6)
    figure, axes = plt.subplots(
        rows, _ACROSS, figsize=size, squeeze=False, sharex=True, sharey=True, layout="constrained"
    )
    for axis, (ladder, errors) in zip(axes.flat, stressed.errors.items(), strict=False):
        for method, own in errors.items():
            k = stressed.methods.index(method)
            look = {**plots.style(k), "ls": plots.DASHES[k // len(plots.COLOURS) % len(plots.DASHES)]}
            axis.plot(np.clip(own / own[0], 1 / DOUBLED**2, _CEILING), lw=1, ms=3, label=label(method), **look)
        axis.axhline(DOUBLED, color="0.6", lw=0.8, ls=":")
        axis.set_title(stressed.title(ladder), fontsize=6.5)
        axis.set(yscale="log", xticks=range(6))
        axis.tick_params(labelsize=7, labelbottom=True)
    figure.supylabel("error over clean error, by severity", fontsize=8)
    plots.add_legend(figure, 7, "outside lower center")
    plots.save(figure, stressed.directory, "stress_curves")


def _draw_map(stressed: Stressed) -> None:
    """Draw stress_map: each method's breaking point on each ladder; darker is earlier, blank is not affected."""
    ladders, methods = list(stressed.breaks), stressed.methods
    size = (2.6 + 0.55 * len(methods), 1.4 + 0.22 * len(ladders))
    figure, axis = plt.subplots(figsize=size, layout="constrained")
    points = np.full((len(ladders), len(methods)), np.nan)
    for row, ladder in enumerate(ladders):
        for method, at in stressed.breaks[ladder].items():
            column, text = methods.index(method), stressed.break_text(ladder, method)
            points[row, column] = min(at, 5.5)
            axis.text(column, row, text, ha="center", va="center", fontsize=6.5, color="white" if at < 3 else "black")
    axis.imshow(points, cmap="cividis", vmin=0, vmax=5.5, aspect="auto")
    axis.set_xticks(range(len(methods)), map(label, methods), rotation=40, ha="right", fontsize=7)
    axis.set_yticks(range(len(ladders)), map(stressed.title, ladders), fontsize=7)
    axis.set_title("Severity at which the error doubles", fontsize=8)
    axis.grid(False)
    plots.save(figure, stressed.directory, "stress_map")


def _draw_worst(stressed: Stressed) -> None:
    """Draw stress_worst: the views whose error grew most at a ladder's highest severity, by reference and every method.

    The method whose error grew most is framed.
    """
    worst_of_ladders = [
        max(
            (row["error"] / own[0], ladder, place, method)
            for method, own in errors.items()
            for place, row in enumerate(stressed.views(method, ladder, len(own) - 1))
        )
        for ladder, errors in stressed.errors.items()
        if ladder[0] in RENDERED
    ]
    picked = sorted(worst_of_ladders, reverse=True)[:_WORST]
    suites, names = {suite for _, (suite, _), _, _ in picked}, ("reference", *stressed.methods)
    results = Results(stressed.directory, stressed.manifest, [], [])
    stored = {(suite, name): results.images(f"{suite}-{name}") or {} for suite in suites for name in names}
    columns = [name for name in names if all(stored[suite, name] for suite in suites)]
    if not picked or "reference" not in columns:
        return  # images exist only on the machine that made them
    figure, axes = plots.grid(len(picked), ["Reference", *map(label, columns[1:])])
    for row, (growth, (suite, ladder), place, worst) in zip(axes, picked, strict=True):
        exposure = stored[suite, "reference"]["exposure"][place]
        for axis, name in zip(row, columns, strict=True):
            axis.imshow(plots.shown(stored[suite, name][ladder][place], exposure))
            if name == worst:
                frame = {"fill": False, "ec": plots.COLOURS[1], "lw": 4, "transform": axis.transAxes}
                axis.add_patch(plt.Rectangle((0, 0), 1, 1, **frame))
        row[0].text(
            0.02, 0.03, f"{fill(stressed.says((suite, ladder)), 18)}\n{growth:.3g}x", transform=row[0].transAxes,
            fontsize=6, color="white", bbox={"facecolor": "black", "alpha": 0.6, "pad": 1, "lw": 0},
        )  # fmt: skip
    plots.save(figure, stressed.directory, "stress_worst", plots.PICTURE)
