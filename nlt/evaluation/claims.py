"""The paper's claims (claims.yaml), judged on stored results: each holds, does not hold or is undecided."""

import math
from dataclasses import dataclass
from itertools import pairwise, product
from pathlib import Path
from typing import Any, Literal

import scipy.stats
import yaml

from nlt.evaluation.results import LEVEL, Results
from nlt.metrics.jackknife import GROUPS, standard_error
from nlt.metrics.quantities import QUANTITIES

Verdict = Literal["holds", "does not hold", "undecided", "not measured"]


@dataclass(frozen=True)
class Inequality:
    """One comparison of a claim; `margin` is in the metric's unit, and positive if it supports the claim.

    `low` and `high` bound the margin's 95% interval over test images and, with several seeds, over seeds.
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
    """A claim of the paper and its verdict on the results."""

    id: str
    where: str
    says: str
    verdict: Verdict
    comparisons: list[Inequality]

    @property
    def weakest(self) -> Inequality:
        """The comparison that decides the verdict: the least margin, relative to its interval, with this verdict."""
        deciding = [c for c in self.comparisons if c.verdict == self.verdict]
        scale = lambda c: abs(c.high - c.low) or 1.0
        return min(deciding, key=lambda c: c.margin / scale(c) if math.isfinite(c.margin) else -math.inf)


def claims_of(table: str | None) -> list[dict[str, Any]]:
    """Return the claims of one of the paper's tables, as written in claims.yaml."""
    content = yaml.safe_load(Path(__file__).with_name("claims.yaml").read_text())
    return [claim for claim in content["claims"] if claim["table"] == table]


def judge(results: Results) -> list[Claim]:
    """Judge every claim of the results' table.

    A claim holds if all of its comparisons hold, and does not hold if any of them does not. A comparison is undecided
    if the 95% interval of its margin contains 0.
    """
    return [_judge(results, claim) for claim in claims_of(results.manifest["table"])]


def _judge(results: Results, claim: dict[str, Any]) -> Claim:
    if "order" in claim:
        pairs = list(pairwise(claim["order"]))
    else:
        pairs = list(product(claim.get("better") or claim["close"], claim.get("than") or claim["to"]))
    comparisons = [
        _compare(results, metric, method, other, claim.get("by", 0.0), claim.get("within"))
        for metric, (method, other) in product(claim["metrics"], pairs)
    ]
    verdicts = {comparison.verdict for comparison in comparisons}
    priority: tuple[Verdict, ...] = ("does not hold", "not measured", "undecided", "holds")
    verdict = next(v for v in priority if v in verdicts)
    return Claim(claim["id"], claim["where"], claim["says"], verdict, comparisons)


def _compare(results: Results, metric: str, method: str, other: str, by: float, within: float | None) -> Inequality:
    sign = 1 if QUANTITIES[metric].direction == "lower" else -1
    if within is None:
        margin, error = difference(results, metric, other, method, 1 - sign * by)
        margin, low, high = sign * margin, *sorted((sign * (margin - error), sign * (margin + error)))
    else:
        gap, error = difference(results, metric, method, other)
        allowed = within * abs(results.mean(other, metric))
        margin = allowed - abs(gap)
        # If the interval of the gap contains 0, |gap| reaches down to 0.
        low, high = allowed - abs(gap) - error, allowed - max(abs(gap) - error, 0)
    if not math.isfinite(margin):
        verdict: Verdict = "not measured"
    else:
        verdict = "holds" if low > 0 else "does not hold" if high < 0 else "undecided"
    below = results.is_below_floor(metric, results.mean(method, metric) - results.mean(other, metric))
    return Inequality(metric, method, other, margin, low, high, verdict, below)


def difference(results: Results, metric: str, a: str, b: str, factor: float = 1.0) -> tuple[float, float]:
    """Return factor * A - B, of means over seeds, and half the width of its 95% interval.

    Both are NaN if a value was not measured; the interval is NaN with fewer than two test images. Its variance is the
    sum of those over test images (of paired differences; for FID and KID by the jackknife; for the time per frame
    over the timed frames) and over the seeds of A and of B. The interval uses Student's t with degrees of freedom by
    Welch and Satterthwaite.
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
    """Return the variance of factor * A - B over test images or timed frames, and its degrees of freedom."""
    if metric == "time_per_frame_s":
        errors = [weight * results.mean(m, "time_per_frame_error_s") for m, weight in ((a, factor), (b, 1.0))]
        return sum(e**2 for e in errors), results.manifest["clock"]["timed_frames"] - 1
    per_image = QUANTITIES[metric].per_image
    x, y = (results.per_view(method, metric if per_image else f"{metric}_without") for method in (a, b))
    if len(x) < 2 or len(x) != len(y):
        return math.nan, 1
    differences = factor * x - y
    if per_image:
        return float(differences.var(ddof=1)) / len(differences), len(differences) - 1
    differences = differences[:GROUPS]  # one value per jackknife group: view k is in group k % GROUPS
    return standard_error(differences) ** 2, len(differences) - 1
