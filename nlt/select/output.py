"""The output of a selection: its table, and the front of accuracy against time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from nlt.evaluation.paper import label
from nlt.metrics.quantities import QUANTITIES, heading, text
from nlt.report import plots
from nlt.report.table_writer import line

_SCORES = ("unbiased_mse", "mssim")
_COSTS = ("time_per_frame_s", "parameters", "peak_memory_bytes")
_HEADINGS = [heading(key) for key in (*_COSTS, *_SCORES)]
Row = Mapping[str, Any]


def markdown(name: str, rows: Sequence[Row], confirmed: Sequence[Row], record: Mapping[str, Any]) -> str:
    """Return the table of a selection: the choice, its claims on the test split, and every candidate."""
    chosen = next(row for row in rows if row["chosen"])
    by = [key for key in _SCORES if chosen[f"{key}_behind"] <= chosen[f"{key}_behind_error"]]
    rule = "the fastest within one paired standard error of the best on the validation split, by "
    rule += " and ".join(QUANTITIES[key].label for key in by)
    if len(by) < len(_SCORES):
        rule += " alone, because no candidate is by both"
    tried, rest = [row for row in rows if row.get("steps")], [row for row in rows if not row.get("steps")]
    tried.sort(key=lambda row: (-row["steps"], row.get("time_per_frame_s", math.inf)))
    lines = [
        f"# The model that {name} needs",
        "",
        f"**{row_of(confirmed, 'chosen')['candidate']}**: {rule}.",
        "",
        *(f"- {verdict}: {claim}" for claim, verdict in claims(confirmed)),
        f"- {_by_parameters(confirmed)}",
        "",
        f"On the test split ({record['n_test']} views, {len(record['seeds'])} seeds); in brackets, how much worse than "
        "the full model, ± the paired standard error:",
        "",
        *_confirmed({name: confirmed}),
        "",
        f"Every candidate, on the validation split ({record['n_val']} views); in brackets, how far behind the best:",
        "",
        line(["candidate", "steps", *_HEADINGS, ""]),
        line(["---", "---:", *["---:"] * len(_HEADINGS), "---"]),
        *(line([row["candidate"], row["steps"], *_numbers(row, "behind"), _status(row)]) for row in tried),
        "",
    ]
    if rest:
        lines += [f"Not tried for lack of time: {'; '.join(row['candidate'] for row in rest)}.", ""]
    return "\n".join([*lines, "Where the numbers come from: manifest.json, table.csv, confirmed.csv, views.csv.", ""])


def claims(confirmed: Sequence[Row]) -> list[tuple[str, str]]:
    """Return the claims of a choice over always taking the full model, with numbers, and whether each holds.

    There are none if the full model is not among the rows of confirmed.csv.
    """
    if all(row["role"] != "full model" for row in confirmed):
        return []
    chosen, full = row_of(confirmed, "chosen"), row_of(confirmed, "full model")
    tested = []
    for key in _SCORES:
        worse, error = chosen[f"{key}_worse"], chosen[f"{key}_worse_error"]
        claim = f"within one standard error of the full model in {QUANTITIES[key].label} on the test split"
        tested.append((f"{claim}: worse by {_plus_minus(key, worse, error)}", worse <= error))
    ratio = full["time_per_frame_s"] / chosen["time_per_frame_s"]
    tested.append((f"at least 2x cheaper per frame: {ratio:.2f}x", ratio >= 2))
    saved = ", ".join(f"{QUANTITIES[key].label} {_saved(key, chosen, full)}" for key in _COSTS)
    return [*((claim, "holds" if holds else "FAILS") for claim, holds in tested), (saved, "saved")]


def _saved(key: str, chosen: Row, full: Row) -> str:
    unit = f" {QUANTITIES[key].unit}" if QUANTITIES[key].unit != "1" else ""
    return f"{text(key, full[key] - chosen[key])} of {text(key, full[key])}{unit}"


def _by_parameters(rows: Sequence[Row]) -> str:
    """Return what the number of parameters would have chosen instead of the time per frame."""
    chosen, fewest = row_of(rows, "chosen"), row_of(rows, "by parameters")
    if chosen["candidate"] == fewest["candidate"]:
        return "compared: picking by the number of parameters gives the same model"
    ratio = fewest["time_per_frame_s"] / chosen["time_per_frame_s"]
    scores = ", ".join(f"{heading(key)} {text(key, fewest[key])} for {text(key, chosen[key])}" for key in _SCORES)
    return f"compared: picking by the number of parameters gives {fewest['candidate']}: {ratio:.2f}x the time, {scores}"


def _numbers(row: Row, than: str) -> list[str]:
    """Return the cells of the costs and the scores; in brackets, how far a score is `than`: "behind" or "worse"."""
    cells = [text(key, row.get(key)) for key in (*_COSTS, *_SCORES)]
    for k, key in enumerate(_SCORES, len(_COSTS)):
        if f"{key}_{than}" in row:
            cells[k] += f" ({_plus_minus(key, row[f'{key}_{than}'], row[f'{key}_{than}_error'])})"
    return cells


def _plus_minus(key: str, value: float, error: float) -> str:
    form = QUANTITIES[key].format
    return f"{value:{form}} ± {error:{form}}"


def _status(row: Row) -> str:
    return ", ".join([row["status"], *(role for role in ("chosen", "full") if row[role])])


def draw_front(directory: Path, rows: Sequence[Row]) -> None:
    """Draw front.png and .svg: accuracy against time per frame, one panel per score, with the chosen and full model.

    Faint candidates were dropped after fewer steps. Bars are paired standard errors of the difference from the best.
    """
    figure, axes = plt.subplots(1, len(_SCORES), figsize=(11, 4.8), layout="constrained")
    scored = [row for row in rows if _SCORES[0] in row]
    methods = list(dict.fromkeys(row["method"] for row in rows))[::-1]
    for axis, key in zip(axes, _SCORES, strict=True):
        finals = [row for row in scored if f"{key}_behind" in row]
        plots.draw_front(axis, {row["candidate"]: _point(row, key) for row in finals}, QUANTITIES[key].direction)
        for k, method in enumerate(methods):
            for row in (row for row in scored if row["method"] == method):
                _draw_candidate(axis, row, key, **plots.style(k))
            axis.plot([], [], label=label(method), ls="", **plots.style(k))
        for number, row in enumerate(sorted(finals, key=lambda row: methods.index(row["method"])), 1):
            setting = row["candidate"].partition("@")[2].replace(" points", "").replace(" photons", "")
            plots.annotate(axis, setting, _point(row, key), -18 - 9 * (number % 2), fontsize=6, zorder=5)
        axis.margins(0.15, 0.15)
        plots.set_time_axis(axis)
        if key == "unbiased_mse" and min(row[key] for row in scored) > 0:
            axis.set_yscale("log")
        axis.set_title(f"{heading(key)}, validation split", fontsize=10)
        axis.grid(True, which="both")
    steps = max(row["steps"] for row in scored)
    figure.suptitle(
        f"filled: {steps} steps, labelled with size, points and photons; faint: dropped earlier", fontsize=9
    )
    axes[0].legend(frameon=True)
    plots.save(figure, directory, "front")


def _point(row: Row, key: str) -> tuple[float, float]:
    return 1e3 * row["time_per_frame_s"], row[key]


def _draw_candidate(axis: plt.Axes, row: Row, key: str, **style: Any) -> None:
    """Draw a candidate's point; rings mark the chosen and the full model."""
    x, y = at = _point(row, key)
    look: dict[str, Any] = {"ms": 8} if f"{key}_behind" in row else {"ms": 5, "alpha": 0.35, "mfc": "none"}
    axis.errorbar(x, y, yerr=row.get(f"{key}_behind_error"), capsize=2, lw=1, ls="", **style, **look)
    for role, ring, colour in (("chosen", 19, "black"), ("full", 14, "0.4")):
        if row[role]:
            axis.plot(*at, "o", ms=ring, mfc="none", mec=colour, mew=1.8)
            plots.annotate(axis, role, at, 13, fontsize=8, weight="bold", color=colour, zorder=5)


def row_of(rows: Sequence[Row], role: str) -> Row:
    """Return the row of confirmed.csv with a role: "chosen", "full model", "best" or "by parameters"."""
    return next(row for row in rows if row["role"] == role)


def summary(selections: Mapping[str, Sequence[Row]]) -> str:
    """Return a summary of several selections, from their rows of confirmed.csv by name: picks and claims."""
    picked = {row_of(rows, "chosen")["candidate"] for rows in selections.values()}
    verdict = "holds" if len(picked) == len(selections) else "FAILS"
    lines = ["# Selections", "", f"- {verdict}: different models are picked: {len(picked)} in {len(selections)} cases"]
    for case, rows in selections.items():
        lines += [f"- {verdict}: {case}: {claim}" for claim, verdict in claims(rows)]
        lines.append(f"- {case}: {_by_parameters(rows)}")
    lines += ["", "On the test split; in brackets how much worse than the full model, ± the paired standard error.", ""]
    return "\n".join([*lines, *_confirmed(selections), ""])


def _confirmed(selections: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return a Markdown table of rows of confirmed.csv, by case."""
    rows = [
        [case, row["role"], row["candidate"], *_numbers(row, "worse")]
        for case in selections
        for row in selections[case]
    ]
    return [line(["", "", "candidate", *_HEADINGS]), line([*["---"] * 3, *["---:"] * len(_HEADINGS)]), *map(line, rows)]
