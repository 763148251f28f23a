"""The evaluation loop: every image that a method is judged by is made and measured here."""

from collections.abc import Callable, Iterable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.method import Batch, Method


class Judged(NamedTuple):
    """A batch with a method's image of it."""

    batch: Batch
    radiance: Tensor  # (B, 3, H, W), with zeros in place of values that are not finite
    nonfinite: Tensor  # (B,) int64: pixels of each view that were not finite
    metrics: dict[str, Tensor]  # each (B,)
    reference_features: dict[str, Tensor] | None  # as the callback of `evaluate` returned them


@torch.inference_mode()
def evaluate(
    method: Method,
    batches: Iterable[Batch],
    metrics: ImageMetrics,
    reference_features: Callable[[int, Batch], dict[str, Tensor] | None] = lambda number, batch: None,
) -> Iterator[Judged]:
    """Predict and measure batches, one after the other; `metrics` accumulates them.

    Args:
        method: from `nlt.models.policy.accelerate`, so that the computation is the one that is timed.
        batches: batches of a test or validation split, on any device.
        metrics: on the method's device.
        reference_features: returns the references' Inception features by the number of the batch, to avoid computing
            them again; see `ImageMetrics.update`.
    """
    device = metrics.means["mse"].device
    for number, cpu_batch in enumerate(batches):
        batch = {name: value.to(device) for name, value in cpu_batch.items()}
        prediction = method(batch)
        bad = ~prediction.isfinite()
        radiance = prediction.masked_fill(bad, 0)
        reference = (batch["reference_a"], batch["reference_b"], batch["exposure"])
        features = reference_features(number, batch)
        values = metrics.update(radiance, *reference, of_reference=features)
        yield Judged(batch, radiance, bad.any(1).sum((1, 2)), values, features)
