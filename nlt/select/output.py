"""The output of a selection: its table, and the front of accuracy against time."""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt

from nlt.evaluation.paper import label
from nlt.metrics.quantities import QUANTITIES, heading, text
from nlt.report import plots
from nlt.report.table_writer import Table, grid, section

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
    cells = []
    for row in tried:
        status = ", ".join([row["status"], *(role for role in ("chosen", "full") if row[role])])
        cells.append([row["candidate"], str(row["steps"]), *_numbers(row, "behind"), status])
    note = f"On the validation split ({record['n_val']} views); in brackets, how far behind the best."
    lines = [f"# The model that {name} needs", "", f"**{chosen['candidate']}**: {rule}.", ""]
    lines += _tested(f"On the test split ({record['n_test']} views, {len(record['seeds'])} seeds)", confirmed)
    lines += section(Table("Every candidate", note, ["steps", *_HEADINGS, "status"], cells, first="candidate"))
    if rest:
        lines += [f"Not tried for lack of time: {'; '.join(row['candidate'] for row in rest)}.", ""]
    return "\n".join([*lines, "Where the numbers come from: manifest.json, table.csv, confirmed.csv, views.csv.", ""])


def summary(selections: Mapping[str, Sequence[Row]]) -> str:
    """Return a summary of several selections, from their rows of confirmed.csv by name: picks and claims."""
    picked = {row["candidate"] for rows in selections.values() for row in rows if row["role"] == "chosen"}
    verdict = "holds" if len(picked) == len(selections) else "FAILS"
    lines = ["# Selections", "", f"- {verdict}: different models are picked: {len(picked)} in {len(selections)} cases"]
    return "\n".join([*lines, "", *(line for case, rows in selections.items() for line in _tested(case, rows))])


def _tested(title: str, confirmed: Sequence[Row]) -> list[str]:
    """Return a section on the rows of confirmed.csv: claims over always taking the full model, each with its verdict.

    There are no claims if the full model is not among the rows.
    """
    by_role = {row["role"]: row for row in confirmed}
    chosen, full, fewest = (by_role.get(role) for role in ("chosen", "full model", "by parameters"))
    assert chosen and fewest
    lines = [f"## {title}", ""]
    if full:
        for key in _SCORES:
            verdict = "holds" if chosen[f"{key}_worse"] <= chosen[f"{key}_worse_error"] else "FAILS"
            claim = f"within one standard error of the full model in {QUANTITIES[key].label} on the test split"
            lines.append(f"- {verdict}: {claim}: worse by {_plus_minus(chosen, f'{key}_worse')}")
        ratio = full["time_per_frame_s"] / chosen["time_per_frame_s"]
        lines.append(f"- {'holds' if ratio >= 2 else 'FAILS'}: at least 2x cheaper per frame: {ratio:.2f}x")
        saved = (f"{heading(key)} {text(key, full[key] - chosen[key])} of {text(key, full[key])}" for key in _COSTS)
        lines.append(f"- saved: {', '.join(saved)}")
    same = "the same model"
    if chosen["candidate"] != fewest["candidate"]:
        ratio = fewest["time_per_frame_s"] / chosen["time_per_frame_s"]
        scores = ", ".join(f"{heading(key)} {text(key, fewest[key])} for {text(key, chosen[key])}" for key in _SCORES)
        same = f"{fewest['candidate']}: {ratio:.2f}x the time, {scores}"
    lines += [f"- compared: picking by the number of parameters gives {same}", ""]
    cells = [[f"{row['role']}: {row['candidate']}", *_numbers(row, "worse")] for row in confirmed]
    lines += ["In brackets, how much worse than the full model, ± the paired standard error:", ""]
    return [*lines, *grid(["model", *_HEADINGS], cells)]


def _numbers(row: Row, than: str) -> list[str]:
    """Return the cells of the costs and the scores; in brackets, how far a score is `than`: "behind" or "worse"."""
    brackets = [f" ({_plus_minus(row, f'{key}_{than}')})" if f"{key}_{than}" in row else "" for key in _SCORES]
    scores = (text(key, row.get(key)) + more for key, more in zip(_SCORES, brackets, strict=True))
    return [*(text(key, row.get(key)) for key in _COSTS), *scores]


def _plus_minus(row: Row, column: str) -> str:
    form = QUANTITIES[column.rpartition("_")[0]].format
    return f"{row[column]:{form}} ± {row[f'{column}_error']:{form}}"


def draw_front(directory: Path, rows: Sequence[Row]) -> None:
    """Draw front.png and .svg: accuracy against time per frame, one panel per score, with the chosen and full model.

    Faint candidates were dropped after fewer steps. Bars are paired standard errors of the difference from the best.
    """
    figure, axes = plt.subplots(1, len(_SCORES), figsize=(11, 4.8), layout="constrained")
    methods = list(dict.fromkeys(row["method"] for row in rows))[::-1]
    styles = {method: plots.style(k) for k, method in enumerate(methods)}
    scored = sorted((row for row in rows if _SCORES[0] in row), key=lambda row: methods.index(row["method"]))
    for axis, key in zip(axes, _SCORES, strict=True):
        at = {row["candidate"]: (1e3 * row["time_per_frame_s"], row[key]) for row in scored}
        finals = [row["candidate"] for row in scored if f"{key}_behind" in row]
        plots.draw_front(axis, {name: at[name] for name in finals}, QUANTITIES[key].direction)
        for row in scored:
            x, y = place = at[row["candidate"]]
            look: dict[str, Any] = {"ms": 8} if f"{key}_behind" in row else {"ms": 5, "alpha": 0.35, "mfc": "none"}
            look |= styles[row["method"]]
            axis.errorbar(x, y, yerr=row.get(f"{key}_behind_error"), capsize=2, lw=1, ls="", **look)
            for role, ring, colour in (("chosen", 19, "black"), ("full", 14, "0.4")):
                if row[role]:
                    axis.plot(x, y, "o", ms=ring, mfc="none", mec=colour, mew=1.8)
                    plots.annotate(axis, role, place, 13, fontsize=8, weight="bold", color=colour, zorder=5)
        for method, style in styles.items():
            axis.plot([], [], label=label(method), ls="", **style)
        for number, name in enumerate(finals, 1):
            setting = name.partition("@")[2].replace(" points", "").replace(" photons", "")
            plots.annotate(axis, setting, at[name], -18 - 9 * (number % 2), fontsize=6, zorder=5)
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
