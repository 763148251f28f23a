"""The paper's claims (claims.yaml), judged on stored results: holds, does not hold, or undecided at this scale."""

from __future__ import annotations

import dataclasses
import json
import math
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Literal

import scipy.stats
import yaml

from nlt.data.files import write_bytes
from nlt.evaluation.paper import label
from nlt.evaluation.results import LEVEL, Results
from nlt.metrics.jackknife import GROUPS, standard_error
from nlt.metrics.quantities import QUANTITIES

Verdict = Literal["holds", "does not hold", "undecided", "not measured"]

BELOW_FLOOR = "the difference is smaller than the reference's own error"


@dataclass(frozen=True)
class Inequality:
    """One inequality of a claim: `margin` is positive where it is as claimed, in the metric's unit.

    `low` and `high`: 95% interval of the margin over test images and, where there are several, over seeds.
    `below_floor`: the two methods differ by less than the two halves of the reference do.
    """

    metric: str
    method: str
    other: str
    margin: float
    low: float
    high: float
    verdict: Verdict
    below_floor: bool


@dataclass(frozen=True)
class Claim:
    """A claim of the paper and what the results say of it."""

    id: str
    where: str
    says: str
    verdict: Verdict
    comparisons: list[Inequality]

    @property
    def weakest(self) -> Inequality:
        """The comparison that decides the verdict: the one of its kind that is furthest from what is claimed."""
        deciding = [c for c in self.comparisons if c.verdict == self.verdict]
        scale = lambda c: abs(c.high - c.low) or 1.0
        return min(deciding, key=lambda c: c.margin / scale(c) if math.isfinite(c.margin) else -math.inf)


def claims_of(table: str | None) -> list[dict[str, Any]]:
    """The claims that a table of the paper makes, as they stand in claims.yaml."""
    content = yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text())
    return [claim for claim in content["claims"] if claim["table"] == table]


def judge(results: Results) -> list[Claim]:
    """Every claim of the results' table.

    A claim holds if all its comparisons do, and does not if one does not; a comparison is decided when its interval
    does not contain the margin's other sign.
    """
    return [_judge(results, claim) for claim in claims_of(results.manifest["table"])]


def _judge(results: Results, claim: dict[str, Any]) -> Claim:
    if "order" in claim:
        pairs = list(pairwise(claim["order"]))
    else:
        pairs = list(product(claim.get("better") or claim["close"], claim.get("than") or claim["to"]))
    found = [
        _compare(results, metric, method, other, claim.get("by", 0.0), claim.get("within"))
        for metric, (method, other) in product(claim["metrics"], pairs)
    ]
    verdicts = {comparison.verdict for comparison in found}
    order: tuple[Verdict, ...] = ("does not hold", "not measured", "undecided", "holds")
    verdict = next(v for v in order if v in verdicts)
    return Claim(claim["id"], claim["where"], claim["says"], verdict, found)


def _compare(results: Results, metric: str, method: str, other: str, by: float, within: float | None) -> Inequality:
    sign = 1 if QUANTITIES[metric].direction == "lower" else -1
    if within is None:
        margin, error = difference(results, metric, other, method, 1 - sign * by)
        margin, low, high = sign * margin, *sorted((sign * (margin - error), sign * (margin + error)))
    else:
        gap, error = difference(results, metric, method, other)
        allowed = within * abs(results.mean(other, metric))
        margin = allowed - abs(gap)
        # The interval of |gap|, mirrored: its lower end is 0 where the interval of the gap contains 0.
        low, high = allowed - abs(gap) - error, allowed - max(abs(gap) - error, 0)
    if not math.isfinite(margin):
        verdict: Verdict = "not measured"
    else:
        verdict = "holds" if low > 0 else "does not hold" if high < 0 else "undecided"
    below = results.is_below_floor(metric, results.mean(method, metric) - results.mean(other, metric))
    return Inequality(metric, method, other, margin, low, high, verdict, below)


def difference(results: Results, metric: str, a: str, b: str, factor: float = 1.0) -> tuple[float, float]:
    """factor * A - B, means over seeds, and half its 95% interval; NaN where not measured or below two images.

    Variances add: that over test images (of the pairs' differences; for FID and KID by the jackknife; for the time
    per frame over its frames), and those of the seeds of A and of B. Student's t, its degrees of freedom by Welch
    and Satterthwaite.
    """
    value = factor * results.mean(a, metric) - results.mean(b, metric)
    parts = [_image_variance(results, metric, a, b, factor)]
    for method, weight in ((a, factor), (b, 1.0)):
        values = weight * results.values(method, metric)
        if len(values) > 1:
            parts.append((values.var(ddof=1) / len(values), len(values) - 1))
    total = sum(variance for variance, _ in parts)
    if not math.isfinite(value + total):
        return value, math.nan
    if total == 0:
        return value, 0.0
    freedom = total**2 / sum(variance**2 / degrees for variance, degrees in parts)
    return value, float(scipy.stats.t.ppf((1 + LEVEL) / 2, freedom) * math.sqrt(total))


def _image_variance(results: Results, metric: str, a: str, b: str, factor: float) -> tuple[float, int]:
    """Of factor * A - B, over test images, or frames; and its degrees of freedom."""
    if metric == "time_per_frame_s":
        errors = [weight * results.mean(m, "time_per_frame_error_s") for m, weight in ((a, factor), (b, 1.0))]
        return sum(e**2 for e in errors), results.manifest["clock"]["timed_frames"] - 1
    per_image = QUANTITIES[metric].per_image
    x, y = (results.per_view(method, metric if per_image else f"{metric}_without") for method in (a, b))
    if len(x) < 2 or len(x) != len(y):
        return math.nan, 1
    d = factor * x - y
    if per_image:
        return float(d.var(ddof=1)) / len(d), len(d) - 1
    d = d[:GROUPS]  # a value per group: view k is in group k modulo their number
    return standard_error(d) ** 2, len(d) - 1


def text(claim: Claim) -> str:
    """The comparison that decides a claim, in words and numbers."""
    c = claim.weakest
    name = f"{QUANTITIES[c.metric].label}, {label(c.method)} against {label(c.other)}"
    if not math.isfinite(c.margin):
        return name
    below = f"; {BELOW_FLOOR}" if c.below_floor else ""
    return f"{name}: {c.margin:+.3g} [{c.low:+.3g}, {c.high:+.3g}]{below}"


def write_claims(results: Results) -> list[Claim]:
    """claims.json with every comparison, claims.md with the one that decides each claim."""
    claims = judge(results)
    if not claims:
        return claims
    content = [dataclasses.asdict(claim) for claim in claims]
    write_bytes(results.directory / "claims.json", (json.dumps(_without_nan(content), indent=1) + "\n").encode())
    seeds = len(results.manifest["seeds"])
    over = f"test images and {seeds} seeds" if seeds > 1 else "test images; with one seed, that of seeds is not in it"
    lines = [
        "# Claims of the paper", "",
        f"The margin is positive where the comparison is as claimed; in brackets its 95% interval over {over}. "
        "Shown is the comparison that decides; all are in claims.json.", "",
        "| claim | verdict | what decides | the paper says | where |", "|---|---|---|---|---|",
        *(f"| {c.id} | **{c.verdict}** | {text(c)} | {c.says} | {c.where} |" for c in claims), "",
    ]  # fmt: skip
    write_bytes(results.directory / "claims.md", "\n".join(lines).encode())
    return claims


def _without_nan(value: Any) -> Any:
    """JSON has no NaN."""
    if isinstance(value, dict):
        return {key: _without_nan(each) for key, each in value.items()}
    if isinstance(value, list):
        return [_without_nan(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value
