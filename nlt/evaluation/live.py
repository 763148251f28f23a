"""The rows of a comparison as printed in the terminal while it runs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from nlt.evaluation.paper import label, paper
from nlt.evaluation.results import OK
from nlt.metrics.quantities import heading, text

COLUMNS = tuple(paper()["columns"])  # columns of the paper's tables, in its order
FLOOR = "reference (its halves)"  # the row that judges one half of the reference against the other


def header() -> str:
    """Return the column headings for `row`."""
    return f"{'method':22}" + "".join(f"{heading(key):>18}" for key in COLUMNS)


def floor(floor: Mapping[str, float]) -> str:
    """Return the line of one half of the reference, judged against the other."""
    return f"{FLOOR:22}" + "".join(f"{text(key, floor.get(key)):>18}" for key in COLUMNS)


def row(run: dict[str, Any]) -> str:
    """Return the line of one run."""
    if run["status"] != OK:
        return f"{label(run['method']):22} {run['status']}: {run['message']}"
    return f"{label(run['method']):22}" + "".join(f"{text(key, run.get(key)):>18}" for key in COLUMNS)
