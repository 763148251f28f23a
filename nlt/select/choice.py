"""The statistics of a choice: paired standard errors, and the fastest of those that are as good as the best.

Errors are (S, N) arrays: seeds of training by validation images, the same images and as many seeds for all. Lower is
better, so MSSIM goes in as 1 - MSSIM.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np

Key = TypeVar("Key")
Errors = Mapping[Key, np.ndarray]


def paired_difference(errors: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """Mean of errors - others (S, N), and its standard error over images and, if there are several, seeds.

    Images and seeds are crossed random effects: var(mean) = images / N + seeds / S + rest / (S N), estimated from the
    mean squares of the two-way layout. With one seed, the standard error of the mean over images.
    """
    difference = errors - others
    seeds, images = difference.shape
    mean = float(difference.mean())
    by_image = difference.mean(0).var(ddof=1) / images
    if seeds == 1:
        return mean, float(np.sqrt(by_image))
    by_seed = difference.mean(1).var(ddof=1) / seeds
    rest = difference - difference.mean(0) - difference.mean(1, keepdims=True) + mean
    # Both hold the rest once: it is taken out once. Where chance makes that too much, the larger of the two stays.
    noise = (rest**2).sum() / ((seeds - 1) * (images - 1)) / (seeds * images)
    return mean, float(np.sqrt(max(by_image + by_seed - noise, by_image, by_seed)))


def within(errors: Errors[Key], limit: float = 1.0) -> list[Key]:
    """Those whose mean is within `limit` paired standard errors of the best mean."""
    best = min(errors, key=lambda key: errors[key].mean())
    found = []
    for key in errors:
        mean, error = paired_difference(errors[key], errors[best])
        if mean <= limit * error:
            found.append(key)
    return found


def choose(metrics: Sequence[Errors[Key]], cost: Mapping[Key, float]) -> Key:
    """The cheapest of those that are within one paired standard error of the best, by every metric.

    Where the metrics agree on none, by the first metric alone.
    """
    good = [within(errors) for errors in metrics]
    agreed = [key for key in good[0] if all(key in others for others in good[1:])]
    return min(agreed or good[0], key=lambda key: cost[key])


def ranked(metrics: Sequence[Errors[Key]], cost: Mapping[Key, float]) -> list[Key]:
    """The order in which candidates are worth going on with.

    First those that no other one beats, being at most as costly and, by every metric, at least as good; then those
    that only these beat, and so on. Within each of these fronts, by the mean of their ranks in the metrics.
    """
    means = {key: tuple(float(errors[key].mean()) for errors in metrics) for key in metrics[0]}
    ranks = {key: sum(sorted(m[k] for m in means.values()).index(v) for k, v in enumerate(means[key])) for key in means}
    left, order = list(means), list[Key]()
    while left:
        front = [key for key in left if not any(_beats(other, key, means, cost) for other in left)]
        order += sorted(front, key=lambda key: (ranks[key], cost[key]))
        left = [key for key in left if key not in front]
    return order


def _beats(one: Key, other: Key, means: Mapping[Key, tuple[float, ...]], cost: Mapping[Key, float]) -> bool:
    ours, theirs = (cost[one], *means[one]), (cost[other], *means[other])
    return ours != theirs and all(a <= b for a, b in zip(ours, theirs, strict=True))
