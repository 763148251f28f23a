"""The output of a selection: its table, and the front of accuracy against time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

from nlt.evaluation.paper import label
from nlt.metrics.quantities import QUANTITIES, heading, text
from nlt.report.figures import COLOURS, HALO, MARKERS, pareto_front, save

matplotlib.use("Agg")
import matplotlib.pyplot as plt

_SCORES = ("unbiased_mse", "mssim")
_COSTS = ("time_per_frame_s", "parameters", "peak_memory_bytes")
Row = Mapping[str, Any]


def markdown(name: str, rows: Sequence[Row], confirmed: Sequence[Row], record: Mapping[str, Any]) -> str:
    """Return the table of a selection: the choice, its claims on the test split, and every candidate."""
    picks = {row["role"]: row for row in confirmed}
    chosen, full = picks["chosen"], picks.get("full model")
    row = next(row for row in rows if row["chosen"])
    by = [key for key in _SCORES if row[f"{key}_behind"] <= row[f"{key}_behind_error"]]
    rule = f"the fastest within one paired standard error of the best on the validation split, by {_names(by)}"
    if len(by) < len(_SCORES):
        rule += " alone, because no candidate is by both"
    lines = [f"# The model that {name} needs", "", f"**{chosen['candidate']}**: {rule}."]
    against = claims(chosen, full) if full else []
    lines += ["", *(f"- {verdict}: {claim}" for claim, verdict in against), f"- {_by_parameters(confirmed)}"]
    size = f"{record['n_test']} views, {len(record['seeds'])} seeds"
    how = "in brackets, how much worse than the full model, ± the paired standard error"
    lines += ["", f"On the test split ({size}); {how}:", ""]
    lines += _confirmed({name: confirmed})
    lines += ["", f"Every candidate, on the validation split ({record['n_val']} views); in brackets, how far behind "
              "the best:", ""]  # fmt: skip
    lines += [_line(["candidate", "steps", *(heading(key) for key in (*_COSTS, *_SCORES)), ""])]
    lines += [_line(["---", *["---:"] * (1 + len(_COSTS) + len(_SCORES)), "---"])]
    tried, rest = [row for row in rows if row.get("steps")], [row for row in rows if not row.get("steps")]
    for row in sorted(tried, key=lambda row: (-row.get("steps", -1), row.get("time_per_frame_s", math.inf))):
        cells = [row["candidate"], row.get("steps", "–"), *(text(key, row.get(key)) for key in _COSTS)]
        status = ", ".join([row["status"], *(role for role in ("chosen", "full") if row[role])])
        lines.append(_line([*cells, *(_score(row, key, "behind") for key in _SCORES), status]))
    if rest:
        lines += ["", f"Not tried for lack of time: {'; '.join(row['candidate'] for row in rest)}."]
    lines += ["", "Where the numbers come from: manifest.json, table.csv, confirmed.csv, views.csv.", ""]
    return "\n".join(lines)


def claims(chosen: Row, full: Row) -> list[tuple[str, str]]:
    """Return the claims of a choice over always taking the full model, with numbers, and whether each holds."""
    tested = []
    for key in _SCORES:
        worse, error = chosen[f"{key}_worse"], chosen[f"{key}_worse_error"]
        claim = f"within one standard error of the full model in {QUANTITIES[key].label} on the test split"
        tested.append((f"{claim}: worse by {_number(key, worse)} ± {_number(key, error)}", worse <= error))
    ratio = full["time_per_frame_s"] / chosen["time_per_frame_s"]
    tested.append((f"at least 2x cheaper per frame: {ratio:.2f}x", ratio >= 2))
    saved = ", ".join(f"{QUANTITIES[key].label} {_saved(key, chosen, full)}" for key in _COSTS)
    verdicts = [(claim, "holds" if holds else "FAILS") for claim, holds in tested]
    return [*verdicts, (saved, "saved")]


def _by_parameters(rows: Sequence[Row]) -> str:
    """Return what the number of parameters would have chosen instead of the time per frame."""
    chosen, fewest = row_of(rows, "chosen"), row_of(rows, "by parameters")
    if chosen["candidate"] == fewest["candidate"]:
        return "compared: picking by the number of parameters gives the same model"
    ratio = fewest["time_per_frame_s"] / chosen["time_per_frame_s"]
    scores = ", ".join(f"{heading(key)} {text(key, fewest[key])} for {text(key, chosen[key])}" for key in _SCORES)
    return f"compared: picking by the number of parameters gives {fewest['candidate']}: {ratio:.2f}x the time, {scores}"


def _names(keys: Sequence[str]) -> str:
    return " and ".join(QUANTITIES[key].label for key in keys)


def _saved(key: str, chosen: Row, full: Row) -> str:
    return f"{text(key, full[key] - chosen[key])} of {text(key, full[key])}" + (
        f" {QUANTITIES[key].unit}" if QUANTITIES[key].unit != "1" else ""
    )


def _score(row: Row, key: str, than: str) -> str:
    if key not in row:
        return "–"
    name = f"{key}_{than}"
    more = f" ({_number(key, row[name])} ± {_number(key, row[f'{name}_error'])})" if name in row else ""
    return text(key, row[key]) + more


def _number(key: str, value: float) -> str:
    return format(value, QUANTITIES[key].format)


def _line(cells: list[Any]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def draw_front(directory: Path, rows: Sequence[Row]) -> None:
    """Draw front.png and .svg: accuracy against time per frame, one panel per score, with the chosen and full model.

    Faint candidates were dropped after fewer steps. Bars are paired standard errors of the difference from the best.
    """
    figure, axes = plt.subplots(1, len(_SCORES), figsize=(11, 4.8))
    methods = list(dict.fromkeys(row["method"] for row in rows))[::-1]
    scored = [row for row in rows if _SCORES[0] in row]
    for axis, key in zip(axes, _SCORES, strict=True):
        labelled = 0
        finals = {
            row["candidate"]: (1e3 * row["time_per_frame_s"], row[key]) for row in scored if f"{key}_behind" in row
        }
        front = pareto_front(finals, QUANTITIES[key].direction)
        axis.step(*zip(*front, strict=True), where="post", color="0.8", lw=5, zorder=0, label="Pareto front")
        for k, method in enumerate(methods):
            style = {"color": COLOURS[k % len(COLOURS)], "marker": MARKERS[k % len(MARKERS)], "ls": ""}
            for row in (row for row in scored if row["method"] == method):
                final = f"{key}_behind" in row
                at = (1e3 * row["time_per_frame_s"], row[key])
                bar = row.get(f"{key}_behind_error") if final else None
                more = {"ms": 8, "alpha": 1.0} if final else {"ms": 5, "alpha": 0.35, "mfc": "none"}
                axis.errorbar(*at, yerr=bar, capsize=2, lw=1, **style, **more)
                for role, ring, colour in (("chosen", 19, "black"), ("full", 14, "0.4")):
                    if row[role]:
                        axis.plot(*at, "o", ms=ring, mfc="none", mec=colour, mew=1.8)
                        axis.annotate(role, at, (0, 13), textcoords="offset points", ha="center", fontsize=8,
                                      weight="bold", color=colour, path_effects=HALO, zorder=5)  # fmt: skip
                if final:
                    setting = row["candidate"].partition("@")[2].replace(" points", "").replace(" photons", "")
                    labelled += 1
                    below = (0, -18 - 9 * (labelled % 2))
                    axis.annotate(setting, at, below, textcoords="offset points", ha="center", fontsize=6,
                                  path_effects=HALO, zorder=5)  # fmt: skip
            axis.plot([], [], label=label(method), **style)
        axis.set_xscale("log")
        if key == "unbiased_mse" and min(row[key] for row in scored) > 0:
            axis.set_yscale("log")
        axis.xaxis.set_major_locator(matplotlib.ticker.LogLocator(subs=(1, 2, 5)))
        axis.xaxis.set_major_formatter(matplotlib.ticker.FormatStrFormatter("%g"))
        axis.xaxis.set_minor_formatter(matplotlib.ticker.NullFormatter())
        axis.set_xlabel("time per frame (ms)")
        axis.set_title(f"{heading(key)}, validation split", fontsize=10)
        axis.grid(alpha=0.3, which="both")
        axis.margins(0.15, 0.15)
    steps = sorted({row["steps"] for row in scored})
    title = f"filled: {steps[-1]} steps, labelled with size, points and photons; faint: dropped earlier"
    figure.suptitle(title, fontsize=9)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    save(figure, directory, "front")


def row_of(rows: Sequence[Row], role: str) -> Row:
    """Return the row of confirmed.csv with a role: "chosen", "full model", "best" or "by parameters"."""
    return next(row for row in rows if row["role"] == role)


def summary(selections: Mapping[str, Sequence[Row]]) -> str:
    """Return a summary of several selections, from their rows of confirmed.csv by name: picks and claims."""
    picked = {row_of(rows, "chosen")["candidate"] for rows in selections.values()}
    verdict = "holds" if len(picked) == len(selections) else "FAILS"
    lines = ["# Selections", "", f"- {verdict}: different models are picked: {len(picked)} in {len(selections)} cases"]
    for case, rows in selections.items():
        if any(row["role"] == "full model" for row in rows):
            pairs = claims(row_of(rows, "chosen"), row_of(rows, "full model"))
            lines += [f"- {verdict}: {case}: {claim}" for claim, verdict in pairs]
        lines.append(f"- {case}: {_by_parameters(rows)}")
    lines += ["", "On the test split; in brackets how much worse than the full model, ± the paired standard error.", ""]
    return "\n".join([*lines, *_confirmed(selections), ""])


def _confirmed(selections: Mapping[str, Sequence[Row]]) -> list[str]:
    """Return a Markdown table of rows of confirmed.csv, by case."""
    lines = [_line(["", "", "candidate", *(heading(key) for key in (*_COSTS, *_SCORES))])]
    lines += [_line([*["---"] * 3, *["---:"] * (len(_COSTS) + len(_SCORES))])]
    for case, rows in selections.items():
        for row in rows:
            cells = [case, row["role"], row["candidate"], *(text(key, row.get(key)) for key in _COSTS)]
            lines.append(_line([*cells, *(_score(row, key, "worse") for key in _SCORES)]))
    return lines
