"""What the stress suites say, made from their rows alone: tables, sentences, curves, heat map, gallery."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from textwrap import fill
from typing import Any

import matplotlib
import numpy as np
import scipy.stats

from nlt.data.files import write_bytes
from nlt.data.suites import CLEAN, COMPUTED, FLICKER, RENDERED
from nlt.evaluation.figures import COLOURS, DASHES, MARKERS, grid, save, shown
from nlt.evaluation.paper import label, order
from nlt.evaluation.results import IMAGES, MANIFEST, OK, read_rows, write_rows

matplotlib.use("Agg")
import matplotlib.pyplot as plt

STRESS, ROWS, TRAININGS, BREAKING, TEXT = "stress", "stress.csv", "training.csv", "breaking.csv", "stress.md"
DOUBLED = 2.0  # times the clean error: broken
_CEILING = 1e3  # where curves end
_WORST = 8  # rows of the gallery
_FLICKERS = {"points": "points", "photons": "photons", "noise": "input noise"}
_MOVES = ("camera", "light", "object")


@dataclass(frozen=True)
class Stressed:
    """Rows of stress.csv and training.csv with the manifest beside them."""

    directory: Path
    manifest: dict[str, Any]
    rows: list[dict[str, Any]]
    trainings: list[dict[str, Any]]

    @cached_property
    def methods(self) -> list[str]:
        return sorted({row["method"] for row in self.rows}, key=order)

    @cached_property
    def ladders(self) -> list[tuple[str, str]]:
        """Suite and name of every ladder that was climbed, in the manifest's order."""
        there = {(row["suite"], row["ladder"]) for row in self.rows}
        known = [(suite, name) for suite in (*RENDERED, *COMPUTED) for name in self.manifest["manifest"][suite]]
        return [key for key in known if key in there]

    def says(self, ladder: tuple[str, str]) -> str:
        return str(self.manifest["manifest"][ladder[0]][ladder[1]]["says"])

    @cached_property
    def _means(self) -> dict[tuple, float]:
        """Of the views' errors."""
        found: dict[tuple, list[float]] = {}
        for row in self.rows:
            if row["suite"] != FLICKER:
                key = (row["method"], row["suite"], row["ladder"], row["severity"])
                found.setdefault(key, []).append(row["error"])
        return {key: float(np.mean(errors)) for key, errors in found.items()}

    def clean(self, method: str) -> float:
        """The error of the views as they are."""
        return self._means.get((method, CLEAN, "views", 0), math.nan)

    def errors(self, method: str, ladder: tuple[str, str]) -> np.ndarray:
        """(S + 1,) errors by severity, that of the clean views first; empty where a method is not concerned.

        An estimate below zero, which one without bias may be, counts as zero.
        """
        keys = [(method, *ladder, severity) for severity in range(1, 6)]
        found = [max(self._means[key], 0.0) for key in keys if key in self._means]
        return np.array([self.clean(method), *found]) if found else np.zeros(0)

    def growth(self, method: str, ladder: tuple[str, str]) -> np.ndarray:
        """(S + 1,) `errors` over the clean error."""
        errors = self.errors(method, ladder)
        return errors / errors[0] if len(errors) else errors

    def nonfinite(self, method: str) -> int:
        """Pixels that are not finite, over all suites."""
        return int(sum(row["nonfinite"] for row in self.rows if row["method"] == method))

    def flicker(self, method: str, kind: str) -> float:
        """Mean over scenes of a kind's value; NaN where the method is not concerned."""
        values = [r["value"] for r in self.rows if (r["method"], r["suite"], r["ladder"]) == (method, FLICKER, kind)]
        return float(np.mean(values)) if values else math.nan


def breaking_point(growth: np.ndarray) -> float:
    """The severity at which the error has doubled, by linear interpolation between severities; infinite if it never
    does."""
    for severity in range(1, len(growth)):
        if growth[severity] >= DOUBLED:
            before, after = growth[severity - 1], growth[severity]
            return float(severity - 1 + (DOUBLED - before) / (after - before))
    return math.inf


def load_stress(directory: Path) -> Stressed | None:
    """What is in a directory; None where nothing is."""
    if not (directory / ROWS).exists() or not (directory / MANIFEST).exists():
        return None
    trainings = directory / TRAININGS
    return Stressed(
        directory,
        json.loads((directory / MANIFEST).read_text()),
        read_rows(directory / ROWS),
        read_rows(trainings) if trainings.exists() else [],
    )


def draw_stress(directory: Path) -> None:
    """breaking.csv, stress.md and the figures, from the rows in a directory; nothing where there are none."""
    stressed = load_stress(directory)
    if stressed is None:
        return
    write_rows(directory / BREAKING, _table(stressed))
    write_bytes(directory / TEXT, _text(stressed).encode())
    if stressed.ladders:
        _curves(stressed)
        _heat_map(stressed)
        _gallery(stressed)


def _table(stressed: Stressed) -> list[dict[str, Any]]:
    """A row per method and ladder: errors and their growth by severity, the breaking point, ranks."""
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
    """(methods, severities) 1 for the lowest error."""
    return scipy.stats.rankdata(np.stack(errors), axis=0, method="min")


# --- in words ---


def _text(stressed: Stressed) -> str:
    manifest = stressed.manifest
    lines = [
        "# Where methods fail",
        "",
        f"`{manifest['command']}`, commit {str(manifest['commit'])[:12]}: {manifest['views']} views of "
        f"{', '.join(manifest['scenes'])} at each severity, suites of version {manifest['manifest']['version']}. "
        "Errors are squared, relative to the reference's square (plus 0.01) at each pixel, without the reference's "
        "noise; a method breaks where its error is twice that of the clean views.",
        "",
        *(_about(stressed, method) for method in stressed.methods),
    ]
    lines += _breaking_table(stressed) + _rank_lines(stressed) + _flicker_table(stressed) + _training_table(stressed)
    if manifest.get("left_out"):
        lines += ["", "Left out: " + "; ".join(manifest["left_out"]) + "."]
    return "\n".join(lines) + "\n"


def _about(stressed: Stressed, method: str) -> str:
    """A paragraph: where a method breaks, by how much, what is better there, what it withstands."""
    points = {ladder: breaking_point(g) for ladder in stressed.ladders if len(g := stressed.growth(method, ladder))}
    broken = sorted((at, ladder) for ladder, at in points.items() if math.isfinite(at))
    held = [stressed.says(ladder) for ladder, at in points.items() if not math.isfinite(at)]
    parts = [f"**{label(method)}** has a clean error of {stressed.clean(method):.3g}."]
    for at, ladder in broken[:5]:
        growth, own = stressed.growth(method, ladder), stressed.errors(method, ladder)[-1]
        rivals = {m: e[-1] for m in stressed.methods if m != method and len(e := stressed.errors(m, ladder))}
        best = min(rivals, key=rivals.__getitem__, default=None)
        advice = ""
        if best is not None and rivals[best] < own:
            advice = f"; there {label(best)} has {rivals[best]:.3g} against its {own:.3g}"
        elif best is not None:
            advice = f"; yet no other method has less than its {own:.3g} there"
        parts.append(
            f"It breaks with {stressed.says(ladder)} at severity {at:.1f} "
            f"({growth[-1]:.3g} times the clean error at severity {len(growth) - 1}{advice})."
        )
    if len(broken) > 5:
        rest = ", ".join(f"{stressed.says(ladder)} ({at:.1f})" for at, ladder in broken[5:])
        parts.append(f"Further, it breaks with {rest}.")
    if held:
        parts.append(f"It withstands: {', '.join(held)}.")
    bad = stressed.nonfinite(method)
    parts.append(f"**{bad} pixels are not finite.**" if bad else "Every output is finite.")
    return " ".join(parts) + "\n"


def _breaking_table(stressed: Stressed) -> list[str]:
    if not stressed.ladders:
        return []
    head = [label(method) for method in stressed.methods]
    lines = ["## Breaking points", "", "Severity at which the error doubles; > where it does not up to the highest; "
             "in brackets the growth there.", "", "| | " + " | ".join(head) + " |",
             "|---|" + "---:|" * len(head)]  # fmt: skip
    for ladder in stressed.ladders:
        cells = []
        for method in stressed.methods:
            growth = stressed.growth(method, ladder)
            at = breaking_point(growth) if len(growth) else math.nan
            cells.append("–" if not len(growth) else f"{_severity(at, len(growth) - 1)} ({growth[-1]:.2g})")
        lines.append(f"| {ladder[0]}: {stressed.says(ladder)} | " + " | ".join(cells) + " |")
    return lines


def _severity(at: float, highest: int) -> str:
    return f"{at:.1f}" if math.isfinite(at) else f"> {highest}"


def _rank_lines(stressed: Stressed) -> list[str]:
    """How the order of the methods at the highest severity compares to that of the clean views."""
    lines = ["", "## Ranks", "", "| | best, clean | best at the highest severity | Kendall's τ of the two orders |",
             "|---|---|---|---:|"]  # fmt: skip
    for ladder in stressed.ladders:
        errors = {m: e for m in stressed.methods if len(e := stressed.errors(m, ladder))}
        if len(errors) > 1:
            names, values = list(errors), np.stack(list(errors.values()))
            tau = scipy.stats.kendalltau(values[:, 0], values[:, -1]).statistic
            first, last = (label(names[int(values[:, k].argmin())]) for k in (0, -1))
            lines.append(f"| {ladder[0]}: {stressed.says(ladder)} | {first} | {last} | {tau:.2f} |")
    return lines if len(lines) > 6 else []


def _flicker_table(stressed: Stressed) -> list[str]:
    if not any(row["suite"] == FLICKER for row in stressed.rows):
        return []
    lines = ["", "## Flicker", "", "Standard deviation of a pixel over draws in a fixed scene, in % of the image's "
             "root mean square; and the mean square change from frame to frame on a smooth path, over the reference's.",
             "", "| | " + " | ".join([*_FLICKERS.values(), *(f"path of the {kind}" for kind in _MOVES)]) + " |",
             "|---|" + "---:|" * 6]  # fmt: skip
    for method in stressed.methods:
        draws = [100 * stressed.flicker(method, kind) for kind in _FLICKERS]
        moves = [stressed.flicker(method, kind) for kind in _MOVES]
        cells = [_number(v, ".2f") for v in draws] + [_number(v, ".3g") for v in moves]
        lines.append(f"| {label(method)} | " + " | ".join(cells) + " |")
    return lines


def _training_table(stressed: Stressed) -> list[str]:
    if not stressed.trainings:
        return []
    rows = stressed.trainings
    kinds = list(dict.fromkeys((row["variation"], str(row["value"])) for row in rows if row["variation"] != "seed"))
    content = stressed.manifest["manifest"]["training"]
    lines = ["", "## Training", "", f"Trained anew for {content['share']:.0%} of the steps: the error over "
             f"{content['seeds']} seeds (mean ± standard deviation), and that of one seed with a change.", "",
             "| | seeds | " + " | ".join(f"{a} {b}" for a, b in kinds) + " |",
             "|---|" + "---:|" * (len(kinds) + 1)]  # fmt: skip
    for method in dict.fromkeys(row["method"] for row in rows):
        own = [row for row in rows if row["method"] == method]
        seeds = np.array([row["error"] for row in own if row["variation"] == "seed" and row["status"] == OK])
        lost = sum(row["status"] != OK for row in own if row["variation"] == "seed")
        spread = f"{seeds.mean():.3g} ± {seeds.std(ddof=1):.2g}" if len(seeds) > 1 else _number(seeds.sum() or math.nan)
        cells = [spread + (f", {lost} lost" if lost else "")]
        for kind in kinds:
            row = next((row for row in own if (row["variation"], str(row["value"])) == kind), None)
            cells.append("–" if row is None else row["status"] if row["status"] != OK else _number(row["error"]))
        lines.append(f"| {label(method)} | " + " | ".join(cells) + " |")
    return lines


def _number(value: float, form: str = ".3g") -> str:
    return format(value, form) if math.isfinite(value) else "–"


# --- in pictures ---


def _curves(stressed: Stressed) -> None:
    """stress_curves: growth of the error over severity, a panel per ladder, on one scale."""
    columns = 6
    count = math.ceil(len(stressed.ladders) / columns)
    figure, axes = plt.subplots(
        count, columns, figsize=(2.4 * columns, 2 * count + 0.6), squeeze=False, sharex=True, sharey=True
    )
    for axis in axes.flat[len(stressed.ladders) :]:
        axis.set_axis_off()
    for axis, ladder in zip(axes.flat, stressed.ladders, strict=False):
        for k, method in enumerate(stressed.methods):
            growth = stressed.growth(method, ladder)
            if len(growth):
                axis.plot(
                    np.clip(growth, 1 / DOUBLED**2, _CEILING), DASHES[k // len(COLOURS) % len(DASHES)], lw=1, ms=3,
                    marker=MARKERS[k % len(MARKERS)], color=COLOURS[k % len(COLOURS)], label=label(method),
                )  # fmt: skip
        axis.axhline(DOUBLED, color="0.6", lw=0.8, ls=":")
        axis.set_yscale("log")
        axis.set_title(f"{ladder[0]}: {stressed.says(ladder)}", fontsize=6.5)
        axis.set_xticks(range(6))
        axis.tick_params(labelsize=7, labelbottom=True)
        axis.grid(alpha=0.3)
    figure.supylabel("error over clean error, by severity", fontsize=8)
    found = {
        label: handle for axis in axes.flat for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)
    }
    figure.legend(found.values(), found.keys(), loc="lower center", ncols=7, fontsize=7, frameon=False)
    figure.tight_layout(rect=(0.01, 0.15 / count + 0.01, 1, 1))
    save(figure, stressed.directory, "stress_curves")


def _heat_map(stressed: Stressed) -> None:
    """stress_map: the breaking point of every method on every ladder; darker is earlier, blank is not concerned."""
    methods, ladders = stressed.methods, stressed.ladders
    points = np.full((len(ladders), len(methods)), np.nan)
    highest = np.full(len(ladders), 5)
    for i, ladder in enumerate(ladders):
        for j, method in enumerate(methods):
            growth = stressed.growth(method, ladder)
            if len(growth):
                points[i, j], highest[i] = breaking_point(growth), len(growth) - 1
    figure, axis = plt.subplots(figsize=(2.6 + 0.55 * len(methods), 1.4 + 0.22 * len(ladders)))
    axis.imshow(np.minimum(points, 5.5), cmap="cividis", vmin=0, vmax=5.5, aspect="auto")
    for (i, j), at in np.ndenumerate(points):
        if not math.isnan(at):
            colour = "white" if min(at, 5.5) < 3 else "black"
            axis.text(j, i, _severity(at, int(highest[i])), ha="center", va="center", fontsize=6.5, color=colour)
    axis.set_xticks(range(len(methods)), [label(m) for m in methods], rotation=40, ha="right", fontsize=7)
    axis.set_yticks(range(len(ladders)), [f"{s}: {stressed.says((s, n))}" for s, n in ladders], fontsize=7)
    axis.set_title("Severity at which the error doubles", fontsize=8)
    figure.tight_layout()
    save(figure, stressed.directory, "stress_map")


def _gallery(stressed: Stressed) -> None:
    """stress_worst: the views whose error grew most at a ladder's highest severity: reference and every method."""
    found = []
    for ladder in stressed.ladders:
        if ladder[0] not in RENDERED:
            continue
        for method in stressed.methods:
            rows = [r for r in stressed.rows if (r["method"], r["suite"], r["ladder"]) == (method, *ladder)]
            top = [row for row in rows if row["severity"] == max(r["severity"] for r in rows)]
            for place, row in enumerate(top):
                found.append((row["error"] / stressed.clean(method), ladder, place, method))
    chosen: dict[tuple[str, str], tuple[float, int]] = {}
    for growth, ladder, place, _ in sorted(found, reverse=True):
        chosen.setdefault(ladder, (growth, place))
    picked = sorted(chosen.items(), key=lambda item: -item[1][0])[:_WORST]
    suites = {ladder[0] for ladder, _ in picked}
    stored = {(s, m): _images(stressed, s, m) for s in suites for m in ("reference", *stressed.methods)}
    if not picked or not all(stored[suite, "reference"] for suite in suites):
        return  # images stay on the machine that made them
    methods = [m for m in stressed.methods if all(stored[suite, m] for suite in suites)]
    figure, axes = grid(len(picked), ["Reference", *(label(m) for m in methods)])
    for row, ((suite, name), (growth, place)) in zip(axes, picked, strict=True):
        exposure = float(stored[suite, "reference"]["exposure"][place])
        for axis, m in zip(row, ("reference", *methods), strict=True):
            axis.imshow(shown(stored[suite, m][name][place], exposure), interpolation="nearest")
        row[0].text(
            0.02, 0.03, f"{fill(stressed.says((suite, name)), 18)}\n{growth:.3g}x", transform=row[0].transAxes,
            fontsize=6, color="white", bbox={"facecolor": "black", "alpha": 0.6, "pad": 1, "lw": 0},
        )  # fmt: skip
    save(figure, stressed.directory, "stress_worst", ("png",))


def _images(stressed: Stressed, suite: str, method: str) -> dict[str, np.ndarray]:
    path = stressed.directory / IMAGES / f"{suite}-{method}.npz"
    if not path.exists():
        return {}
    with np.load(path) as file:
        return dict(file)
