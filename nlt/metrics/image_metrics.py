"""The metrics of a predicted image against its two reference halves, and the table that describes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn
from torchmetrics import MeanSquaredError, Metric
from torchmetrics.functional.image import structural_similarity_index_measure
from torchmetrics.image import StructuralSimilarityIndexMeasure
from torchmetrics.image.fid import FrechetInceptionDistance

from nlt.metrics.display import display, expose
from nlt.metrics.inception import STAGES, load_inception


@dataclass(frozen=True)
class MetricInfo:
    """How a metric is named, ordered and printed."""

    label: str
    direction: str  # "lower" or "higher" is better
    format: str  # for str.format's specification
    unit: str
    domain: str  # what it is computed on


_DISPLAY = "sRGB in [0, 1] at the scene's exposure"
_LINEAR = "radiance × exposure"
_FEATURES = "Inception features of sRGB"

METRICS: dict[str, MetricInfo] = {
    "mse": MetricInfo("MSE", "lower", ".5f", "1", _DISPLAY),
    "unbiased_mse": MetricInfo("Unbiased MSE", "lower", ".3e", "1", _LINEAR),
    "reference_noise": MetricInfo("Reference noise", "lower", ".3e", "1", _LINEAR),
    "mssim": MetricInfo("MSSIM", "higher", ".4f", "1", _DISPLAY),
    "fid": MetricInfo("FID", "lower", ".2f", "1", _FEATURES),
    "feature_l1": MetricInfo("Feature L1", "lower", ".4f", "1", f"{_FEATURES}, final pooling"),
    **{
        f"feature_l1_{stage}": MetricInfo(
            f"Feature L1, layer {stage[-1]}", "lower", ".4f", "1", f"{_FEATURES}, {stage}"
        )
        for stage in STAGES
    },
}
PERCEPTUAL = ("fid", "feature_l1", *(f"feature_l1_{stage}" for stage in STAGES))

# MSSIM as in Wang et al. 2004, with the paper's uniform 7 x 7 window and the image mirrored at its border.
_SSIM: dict[str, Any] = {"gaussian_kernel": False, "kernel_size": 7, "data_range": 1.0}


class RunningMean(Metric):
    """Mean over all elements of all updates, summed in float64."""

    full_state_update = False
    total: Tensor
    count: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros((), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros((), dtype=torch.long), dist_reduce_fx="sum")

    def _add(self, values: Tensor) -> None:
        self.total += values.sum(dtype=torch.float64)
        self.count += values.numel()

    def compute(self) -> Tensor:
        """Scalar."""
        return self.total / self.count


class UnbiasedMSE(RunningMean):
    """Mean of (f - A)(f - B), in radiance times exposure; A and B are independent halves of the reference.

    The noise of A and that of B are independent, of mean 0 and independent of f, so the expectation is the
    MSE against the noise-free image, whereas that against (A + B) / 2 also contains its variance. As an
    estimate it may be negative.
    """

    def update(self, prediction: Tensor, a: Tensor, b: Tensor) -> None:
        """Of three tensors of one shape."""
        self._add((prediction - a) * (prediction - b))


class ReferenceNoise(RunningMean):
    """Mean of (A - B)² / 4, in radiance times exposure: the variance of the reference (A + B) / 2."""

    def update(self, a: Tensor, b: Tensor) -> None:
        """Of two tensors of one shape."""
        self._add((a - b).square() / 4)


class FeatureL1(Metric):
    """Mean absolute difference of Inception's features between prediction and reference.

    "feature_l1", on the final average pooling, is the paper's Feature L1; the others are on the maps of the
    four stages, before pooling.
    """

    full_state_update = False
    total: Tensor
    count: Tensor

    LAYERS = ("pool", *STAGES)
    KEYS = ("feature_l1", *(f"feature_l1_{stage}" for stage in STAGES))

    def __init__(self) -> None:
        super().__init__()
        self.add_state("total", torch.zeros(len(self.LAYERS), dtype=torch.float64), dist_reduce_fx="sum")
        self.add_state("count", torch.zeros(len(self.LAYERS), dtype=torch.long), dist_reduce_fx="sum")

    def update(self, prediction: dict[str, Tensor], reference: dict[str, Tensor]) -> None:
        """Of two outputs of `Inception`."""
        for i, layer in enumerate(self.LAYERS):
            self.total[i] += (prediction[layer] - reference[layer]).abs().sum(dtype=torch.float64)
            self.count[i] += prediction[layer].numel()

    def compute(self) -> dict[str, Tensor]:
        """Scalars by the keys of `METRICS`."""
        return dict(zip(self.KEYS, (self.total / self.count).unbind(), strict=True))


class _PooledFeatures(nn.Identity):
    """Stands in for the network in torchmetrics' FID, which here receives features."""

    num_features = 2048


class FID(FrechetInceptionDistance):
    """Fréchet distance of Gaussians fitted to the pooled features (N, 2048), in float64.

    NaN below two samples. Small N biases it upwards, and below 2049 the covariances are singular: compare
    only values of the same N and the same reference images.
    """

    def __init__(self) -> None:
        super().__init__(feature=_PooledFeatures())
        self.orig_dtype = torch.float64  # unset, compute fails on a DDP rank that had no sample

    def compute(self) -> Tensor:
        """Scalar."""
        if min(self.real_features_num_samples, self.fake_features_num_samples) < 2:
            return torch.full((), torch.nan, dtype=torch.float64, device=self.real_features_sum.device)
        threads = torch.get_num_threads()
        torch.set_num_threads(1)  # on busy cores LAPACK's eigenvalues take many times as long with several
        try:
            return super().compute()
        finally:
            torch.set_num_threads(threads)


class ImageMetrics(nn.Module):
    """All metrics of `METRICS`; without `perceptual` only those that need no Inception.

    The metrics are submodules, so they move and synchronise with the module that owns this one. Inception
    is not: it must not end up in checkpoints. Without its weights the perceptual metrics are NaN.
    """

    def __init__(self, perceptual: bool) -> None:
        super().__init__()
        self.perceptual = perceptual
        self.mse = MeanSquaredError().set_dtype(torch.float64)
        self.unbiased_mse = UnbiasedMSE()
        self.reference_noise = ReferenceNoise()
        self.mssim = StructuralSimilarityIndexMeasure(**_SSIM).set_dtype(torch.float64)
        if perceptual:
            self.fid = FID()
            self.feature_l1 = FeatureL1()

    @torch.no_grad()
    def update(
        self,
        prediction: Tensor,
        reference_a: Tensor,
        reference_b: Tensor,
        exposure: Tensor,
        of_reference: dict[str, Tensor] | None = None,
    ) -> None:
        """Add a batch: linear radiance (B, 3, H, W), W·sr⁻¹·m⁻², and the scenes' exposure (B,) or scalar.

        `of_reference`: what `reference_features` gave for it, when several methods share a reference.
        """
        f, a, b, shown, target = _domains(prediction, reference_a, reference_b, exposure)
        self.mse.update(shown, target)
        self.unbiased_mse.update(f, a, b)
        self.reference_noise.update(a, b)
        self.mssim.update(shown, target)
        if self.perceptual and (inception := load_inception(f.device)):
            # One pass for all perceptual metrics; prediction and reference apart to halve the memory.
            of_prediction, of_reference = inception(shown), of_reference or inception(target)
            self.feature_l1.update(of_prediction, of_reference)
            self.fid.update(of_prediction["pool"].double(), real=False)
            self.fid.update(of_reference["pool"].double(), real=True)

    @staticmethod
    @torch.no_grad()
    def reference_features(reference_a: Tensor, reference_b: Tensor, exposure: Tensor) -> dict[str, Tensor] | None:
        """Inception's features of a reference, for `update`; None without the weights."""
        target = _domains(reference_a, reference_a, reference_b, exposure)[-1]
        inception = load_inception(target.device)
        return inception(target) if inception else None

    def compute(self) -> dict[str, Tensor]:
        """Scalars over all updates, of all processes, by the keys of `METRICS`."""
        values = {
            "mse": self.mse.compute(),
            "unbiased_mse": self.unbiased_mse.compute(),
            "reference_noise": self.reference_noise.compute(),
            "mssim": self.mssim.compute(),
        }
        if self.perceptual and load_inception(values["mse"].device):
            values |= {"fid": self.fid.compute(), **self.feature_l1.compute()}
        elif self.perceptual:
            values |= dict.fromkeys(PERCEPTUAL, torch.full_like(values["mse"], torch.nan))
        return values

    @staticmethod
    @torch.no_grad()
    def per_image(prediction: Tensor, reference_a: Tensor, reference_b: Tensor, exposure: Tensor) -> dict[str, Tensor]:
        """mse, mssim and unbiased_mse of every image, (B,) each; arguments as of `update`."""
        f, a, b, shown, target = _domains(prediction, reference_a, reference_b, exposure)
        mssim = structural_similarity_index_measure(shown, target, reduction="none", **_SSIM)
        assert isinstance(mssim, Tensor)
        return {
            "mse": (shown - target).square().mean((1, 2, 3)),
            "mssim": mssim,
            "unbiased_mse": ((f - a) * (f - b)).mean((1, 2, 3)),
        }

    def reset(self) -> None:
        """Forget all updates."""
        for metric in self.children():
            if isinstance(metric, Metric):
                metric.reset()


def _domains(
    prediction: Tensor, reference_a: Tensor, reference_b: Tensor, exposure: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """f, A and B times exposure, and prediction and reference for display.

    In float64, which neither autocast nor TF32 touches: SSIM's variances are small differences.
    """
    f, a, b = prediction.double(), reference_a.double(), reference_b.double()
    shown, target = display(f, exposure), display((a + b) / 2, exposure)
    return expose(f, exposure), expose(a, exposure), expose(b, exposure), shown, target
