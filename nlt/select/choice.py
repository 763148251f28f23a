"""The statistics of a choice: paired standard errors, and the cheapest candidate that is as good as the best.

Errors are (S, N) arrays of training seeds by validation images, with the same images and number of seeds for all
candidates. Lower is better, so MSSIM is given as 1 - MSSIM.
"""

from collections.abc import Mapping, Sequence
from typing import TypeVar

import numpy as np
from scipy.stats import rankdata

Key = TypeVar("Key")
Errors = Mapping[Key, np.ndarray]


def paired_difference(errors: np.ndarray, others: np.ndarray) -> tuple[float, float]:
    """Return the mean of errors - others (S, N) and its standard error over images and, if there are several, seeds.

    Images and seeds are crossed random effects: var(mean) = images / N + seeds / S + rest / (S N), estimated from the
    mean squares of the two-way layout. With one seed, the error is the standard error of the mean over images.
    """
    difference = errors - others
    seeds, images = difference.shape
    mean = float(difference.mean())
    by_image = difference.mean(0).var(ddof=1) / images
    if seeds == 1:
        return mean, float(np.sqrt(by_image))
    by_seed = difference.mean(1).var(ddof=1) / seeds
    rest = difference - difference.mean(0) - difference.mean(1, keepdims=True) + mean
    # Both contain the rest, so subtract it once. Where chance makes it too large, keep the larger of the two.
    noise = (rest**2).sum() / ((seeds - 1) * (images - 1)) / (seeds * images)
    return mean, float(np.sqrt(max(by_image + by_seed - noise, by_image, by_seed)))


def best(errors: Errors[Key]) -> Key:
    """Return the key with the least mean error."""
    return min(errors, key=lambda key: errors[key].mean())


def within(errors: Errors[Key]) -> list[Key]:
    """Return the keys whose mean error is within one paired standard error of the best mean."""
    least = errors[best(errors)]
    differences = {key: paired_difference(own, least) for key, own in errors.items()}
    return [key for key, (mean, error) in differences.items() if mean <= error]


def choose(metrics: Sequence[Errors[Key]], cost: Mapping[Key, float]) -> Key:
    """Return the cheapest key that is within one paired standard error of the best by every metric.

    If no key is, only the first metric decides.
    """
    good = [within(errors) for errors in metrics]
    agreed = [key for key in good[0] if all(key in others for others in good[1:])]
    return min(agreed or good[0], key=lambda key: cost[key])


def ranked(metrics: Sequence[Errors[Key]], cost: Mapping[Key, float]) -> list[Key]:
    """Return the order in which candidates are worth continuing.

    The first front holds the candidates that no other one beats by being at most as costly and, by every metric, at
    least as good; the next front those that only the first one beats, and so on. Within a front, candidates are ordered
    by the sum of their ranks in the metrics.
    """
    points = {key: (cost[key], *(float(errors[key].mean()) for errors in metrics)) for key in metrics[0]}
    ranks = dict(zip(points, rankdata(list(points.values()), axis=0, method="min")[:, 1:].sum(1), strict=True))
    beats = lambda one, other: one != other and all(a <= b for a, b in zip(one, other, strict=True))
    left, order = list(points), list[Key]()
    while left:
        front = [key for key in left if not any(beats(points[other], points[key]) for other in left)]
        order += sorted(front, key=lambda key: (ranks[key], cost[key]))
        left = [key for key in left if key not in front]
    return order
