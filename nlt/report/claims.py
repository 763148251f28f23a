"""The verdicts on the paper's claims, written as claims.json and claims.md."""

import dataclasses
import json
import math
from typing import Any

from nlt.data.files import write_bytes
from nlt.evaluation.claims import Claim, judge
from nlt.evaluation.paper import label
from nlt.evaluation.results import Results
from nlt.metrics.quantities import QUANTITIES
from nlt.report.table_writer import Table, section

BELOW_FLOOR = "the difference is smaller than the reference's own error"


def text(claim: Claim) -> str:
    """Return the comparison that decides a claim, in words and numbers."""
    c = claim.weakest
    name = f"{QUANTITIES[c.metric].label}, {label(c.method)} against {label(c.other)}"
    if not math.isfinite(c.margin):
        return name
    below = f"; {BELOW_FLOOR}" if c.below_floor else ""
    return f"{name}: {c.margin:+.3g} [{c.low:+.3g}, {c.high:+.3g}]{below}"


def write_claims(results: Results) -> list[Claim]:
    """Write claims.json with every comparison and claims.md with the deciding ones; return the claims."""
    claims = judge(results)
    if not claims:
        return claims
    content = [dataclasses.asdict(claim) for claim in claims]
    write_bytes(results.directory / "claims.json", (json.dumps(_without_nan(content), indent=1) + "\n").encode())
    seeds = len(results.manifest["seeds"])
    over = f"test images and {seeds} seeds" if seeds > 1 else "test images, not over seeds, because there is only one"
    note = (
        f"A positive margin supports the claim; in brackets is its 95% interval over {over}. "
        "Each row shows the comparison that decides the verdict; claims.json has all comparisons."
    )
    columns = ["verdict", "deciding comparison", "the paper says", "where"]
    rows = [[c.id, f"**{c.verdict}**", text(c), c.says, c.where] for c in claims]
    lines = section(Table("Claims of the paper", note, columns, rows, first="claim"), level=1, numbers=False)
    write_bytes(results.directory / "claims.md", "\n".join(lines).encode())
    return claims


def _without_nan(value: Any) -> Any:
    """Return a copy with None for NaN, which JSON does not have."""
    if isinstance(value, dict):
        return {key: _without_nan(item) for key, item in value.items()}
    if isinstance(value, list):
        return [_without_nan(item) for item in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
