"""Metrics of a predicted image against its two reference halves; `METRICS` in quantities.py describes them."""

from typing import Any

import flip_evaluator
import numpy as np
import torch
from torch import Tensor, nn
from torchmetrics import MeanMetric, Metric, MetricCollection
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.utilities import dim_zero_cat

from nlt.display import display, expose
from nlt.metrics.inception import STAGES, cached_features, load_inception
from nlt.metrics.jackknife import frechet_distance, kernel_distance
from nlt.metrics.quantities import METRICS, PERCEPTUAL

SLOW = ("flip", *PERCEPTUAL)

# MSSIM as in Wang et al. 2004, with the paper's uniform 7 x 7 window and mirrored borders.
_SSIM: dict[str, Any] = {"gaussian_kernel": False, "kernel_size": 7, "data_range": 1.0}


def unbiased_mse(prediction: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of (f - A)(f - B) over each image (B, 3, H, W), in radiance times exposure: (B,).

    The noise of the reference halves A and B has mean 0 and is independent of the other half and of f. The expectation
    is therefore the MSE against the noise-free image, whereas the MSE against (A + B) / 2 also contains the variance of
    that mean. The estimate can be negative.
    """
    return ((prediction - a) * (prediction - b)).mean((1, 2, 3))


def reference_noise(a: Tensor, b: Tensor) -> Tensor:
    """Return the mean of (A - B)² / 4 over each image, (B,): the variance of the reference (A + B) / 2."""
    return (a - b).square().mean((1, 2, 3)) / 4


def flip(shown: Tensor, target: Tensor) -> Tensor:
    """Return the mean LDR-FLIP (Andersson et al. 2020) of each pair of sRGB images (B, 3, H, W): (B,).

    It assumes 67 pixels per degree. The result is NaN if an image is not finite, which the library does not check.
    """
    values = []
    for pair in zip(target, shown, strict=True):
        images = [image.permute(1, 2, 0).float().contiguous().cpu().numpy() for image in pair]
        finite = all(np.isfinite(image).all() for image in images)
        values.append(flip_evaluator.evaluate(*images, "LDR", applyMagma=False)[1] if finite else np.nan)
    return torch.tensor(values, dtype=torch.float64, device=shown.device)


def feature_l1(prediction: dict[str, Tensor], reference: dict[str, Tensor]) -> dict[str, Tensor]:
    """Return the mean absolute difference of Inception's features of each image, by the keys of `METRICS`: (B,) each.

    "feature_l1" compares the final average pooling and is the paper's Feature L1; the others compare the maps of the
    four stages before pooling.
    """
    layers = {"feature_l1": "pool", **{f"feature_l1_{stage}": stage for stage in STAGES}}
    difference = lambda layer: (prediction[layer] - reference[layer]).abs()
    mean = lambda x: x.mean(tuple(range(1, x.ndim)), dtype=torch.float64)
    return {key: mean(difference(layer)) for key, layer in layers.items()}


class FeatureDistances(Metric):
    """FID and KID of the pooled Inception features (N, 2048) of all predictions and references."""

    predictions: list[Tensor]
    references: list[Tensor]

    def __init__(self) -> None:
        super().__init__()
        for name in ("predictions", "references"):  # "cat" allows different numbers of batches per process
            self.add_state(name, [], dist_reduce_fx="cat")

    def update(self, prediction: Tensor, reference: Tensor) -> None:  # type: ignore[override]
        """Add the features (B, 2048) of a batch."""
        self.predictions.append(prediction.double())
        self.references.append(reference.double())

    def compute(self) -> dict[str, Tensor]:  # type: ignore[override]
        """Return scalars by the keys "fid" and "kid"."""
        features = dim_zero_cat(self.predictions), dim_zero_cat(self.references)
        return {"fid": frechet_distance(*features), "kid": kernel_distance(*features)}


class ImageMetrics(nn.Module):
    """All of `METRICS` or, without `perceptual`, only those that are fast.

    The metrics are submodules, so they move and synchronise with the module that owns this one. Inception is not a
    submodule, so checkpoints do not contain it. Without its weights, the metrics that need it are NaN.
    """

    def __init__(self, perceptual: bool) -> None:
        super().__init__()
        self.perceptual = perceptual
        keys = [key for key, metric in METRICS.items() if metric.per_image and (perceptual or key not in SLOW)]
        means: dict[str, Metric | MetricCollection] = {
            key: MeanMetric(nan_strategy="disable").set_dtype(torch.float64) for key in keys
        }
        self.means = MetricCollection(means, compute_groups=False)
        if perceptual:
            self.distances = FeatureDistances()

    @torch.no_grad()
    def update(
        self,
        prediction: Tensor,
        reference_a: Tensor,
        reference_b: Tensor,
        exposure: Tensor,
        of_reference: dict[str, Tensor] | None = None,
    ) -> dict[str, Tensor]:
        """Add a batch and return the metrics of each image (B,), by the keys of `METRICS`.

        Images are linear radiance (B, 3, H, W), W·sr⁻¹·m⁻²; the scenes' exposure is (B,) or scalar. `of_reference` is
        the result of `reference_features` if several methods share a reference. If Inception was run, its pooled
        features (B, 2048) of the prediction are returned as "pool".
        """
        f, a, b, shown, target = _domains(prediction, reference_a, reference_b, exposure)
        mssim = structural_similarity_index_measure(shown, target, reduction="none", **_SSIM)
        assert isinstance(mssim, Tensor)
        mse = (shown - target).square().mean((1, 2, 3))
        values = {
            "mse": mse,
            "unbiased_mse": unbiased_mse(f, a, b),
            "reference_noise": reference_noise(a, b),
            "psnr": -10 * mse.log10(),
            "mssim": mssim,
        }
        if self.perceptual:
            values["flip"] = flip(shown, target)
            if inception := load_inception(f.device):
                # One pass serves all perceptual metrics; prediction and reference are separate to halve the memory.
                shown_features, of_reference = inception(shown), of_reference or inception(target)
                values |= feature_l1(shown_features, of_reference)
                self.distances.update(shown_features["pool"], of_reference["pool"])
                values["pool"] = shown_features["pool"]
            else:
                values |= {key: torch.full_like(mse, torch.nan) for key in PERCEPTUAL if METRICS[key].per_image}
        for key, mean in self.means.items():
            mean.update(values[key])
        return values

    @staticmethod
    @torch.no_grad()
    def reference_features(
        reference_a: Tensor, reference_b: Tensor, exposure: Tensor, cached: bool
    ) -> dict[str, Tensor] | None:
        """Return Inception's features of a reference for `update`, `cached` on disk, or None without the weights."""
        target = _domains(reference_a, reference_a, reference_b, exposure)[-1]
        inception = load_inception(target.device)
        if inception is None:
            return None
        return cached_features(inception, target) if cached else inception(target)

    def compute(self) -> dict[str, Tensor]:
        """Return scalars over all updates in all processes, by the keys of `METRICS`."""
        values = self.means.compute()
        if self.perceptual:
            nan = torch.full_like(values["mse"], torch.nan)
            values |= self.distances.compute() if load_inception(nan.device) else {"fid": nan, "kid": nan}
        return {key: values[key] for key in METRICS if key in values}

    def reset(self) -> None:
        """Discard all updates."""
        for metric in self.modules():
            if isinstance(metric, Metric):
                metric.reset()


def _domains(
    prediction: Tensor, reference_a: Tensor, reference_b: Tensor, exposure: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Return f, A and B times exposure, and prediction and reference as displayed.

    All are float64, which neither autocast nor TF32 affects, because SSIM's variances are small differences.
    """
    f, a, b = prediction.double(), reference_a.double(), reference_b.double()
    shown, target = display(f, exposure), display((a + b) / 2, exposure)
    return expose(f, exposure), expose(a, exposure), expose(b, exposure), shown, target
