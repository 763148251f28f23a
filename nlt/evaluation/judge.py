"""Evaluation of a method's images of the test split by one set of metrics."""

import io
import json
import math
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, default_collate

from nlt.baselines.path_tracing import PathTracing
from nlt.data.dataset import LightTransportDataset, identity_collate
from nlt.data.files import write_bytes
from nlt.errors import DivergedError
from nlt.evaluation.evaluate import evaluate
from nlt.evaluation.frames import Frames
from nlt.evaluation.results import write_images
from nlt.metrics.image_metrics import ImageMetrics
from nlt.metrics.jackknife import fid_and_kid_without
from nlt.metrics.quantities import OF_HALVES
from nlt.models.method import Batch, Method
from nlt.models.module import PROJECTION
from nlt.models.policy import Policy, accelerate
from nlt.models.projection import visible_pixels

_SHOWN = 32  # test views whose images are stored
_BATCH = 16
_MAX_CACHED = 512  # test images at most whose reference features (4 MB each) are cached in memory and on disk


class Evaluation:
    """Evaluates methods on the test split; reference features are computed once for all methods."""

    def __init__(self, frames: Frames, device: torch.device, policy: Policy) -> None:
        self.frames, self.device, self.policy = frames, device, policy
        self.directory, self.spec = frames.dataset.directory, frames.dataset.spec
        self._features: dict[int, dict[str, Tensor] | None] = {}
        self.shown = list(range(0, len(self), max(1, len(self) // _SHOWN)))[:_SHOWN]

    def __len__(self) -> int:
        return self.spec.test * len(self.spec.scenes)

    def write_references(self, directory: Path) -> None:
        """Write images/reference.npz, noisy.npz and gbuffer.npz of the shown views."""
        samples = [self.frames.dataset[k] for k in self.shown]
        stack = {name: np.stack([sample[name].numpy() for sample in samples]) for name in samples[0]}
        reference = (stack["reference_a"] + stack["reference_b"]) / 2
        view = np.array(self.shown)
        write_images(directory, "reference", radiance=reference, exposure=stack["exposure"], view=view)
        write_images(directory, "noisy", radiance=stack["noisy"])
        buffers = {name: stack[name] for name in ("albedo", "normal", "depth")}
        renderers = (self.frames.place(k) for k in self.shown)
        transmits = np.stack([renderer.transmits(camera) for renderer, camera in renderers])
        light_in_view = self._light_in_view(samples)
        write_images(directory, "gbuffer", **buffers, transmits=transmits, light_in_view=light_in_view)

    @staticmethod
    def _light_in_view(samples: list[Batch]) -> np.ndarray:
        """Return (V,) bool: whether a point that emits light is visible in each sample's image."""
        batch = default_collate(samples)
        camera = {name: batch[name] for name in PROJECTION}
        emits = batch["point_visible"] & (batch["point_emission"] > 0).any(-1)
        pixels = visible_pixels(batch["point_position"], emits, **camera)
        return (pixels < batch["depth"][0].numel()).any(1).numpy()

    def floor(self) -> tuple[dict[str, float], dict[str, float]]:
        """Return the metrics of the reference's half A, judged as a prediction against half B, and each scene's MSE.

        Metrics that need two independent halves of a reference and metrics that are not finite are left out.
        """
        metrics, mse = ImageMetrics(perceptual=True).to(self.device), list[float]()
        halves = (
            {**batch, "traced": batch["reference_a"], "reference_a": batch["reference_b"]}
            for batch in self._batches(())
        )
        for judged in evaluate(PathTracing(), halves, metrics):
            mse += judged.metrics["mse"].tolist()
        values = {name: float(value) for name, value in metrics.compute().items() if name not in OF_HALVES}
        by_scene = np.reshape(mse, (-1, self.spec.test)).mean(1).tolist()
        names = [description.name for description in self.spec.descriptions]
        return {k: v for k, v in values.items() if math.isfinite(v)}, dict(zip(names, by_scene, strict=True))

    def evaluate(self, method: Method) -> tuple[dict[str, float], list[dict[str, Any]], np.ndarray]:
        """Return a method's metrics, its metrics for each view, and its radiance (V, 3, H, W) of the shown views.

        Raises:
            DivergedError: a prediction is not finite.
        """
        method = accelerate(method, self.policy, self.device)
        metrics = ImageMetrics(perceptual=True).to(self.device)
        shown, rows = [], []
        pools: list[tuple[Tensor, Tensor]] = []
        batches = self._batches(method.fields, method.spp if "traced" in method.fields else None)
        for judged in evaluate(method, batches, metrics, self._reference_features):
            indices = judged.batch["index"].tolist()
            if judged.nonfinite.any():
                raise DivergedError(f"a prediction is not finite in test samples {indices}")
            if judged.reference_features:
                pools.append((judged.metrics.pop("pool"), judged.reference_features["pool"]))
            columns = {name: values.tolist() for name, values in judged.metrics.items()}
            rows += [{"view": index, **{n: c[i] for n, c in columns.items()}} for i, index in enumerate(indices)]
            shown.append(judged.radiance[[i for i, index in enumerate(indices) if index in self.shown]].cpu())
        if pools:
            without = fid_and_kid_without(*(torch.cat(part) for part in zip(*pools, strict=True)))
            for key, column in without.items():
                for row, value in zip(rows, column.tolist(), strict=True):
                    row[key] = value
        values = {name: float(value) for name, value in metrics.compute().items()}
        return values, rows, torch.cat(shown).numpy()

    def evaluate_once(
        self, method: Method, kept: Path, key: Mapping[str, Any] | None
    ) -> tuple[dict[str, float], list[dict[str, Any]], np.ndarray]:
        """Return the result of `evaluate`, read from the file `kept` if stored there under the same key.

        A new result is stored there, so a killed comparison resumes where it was, and a repeated one only measures
        times. Nothing is stored if `key` is None.
        """
        key_text = json.dumps(key, sort_keys=True)
        if key and kept.exists():
            with np.load(kept) as stored:
                if str(stored["of"]) == key_text:
                    return json.loads(str(stored["metrics"])), json.loads(str(stored["views"])), stored["radiance"]
        metrics, views, radiance = self.evaluate(method)
        if key:
            file = io.BytesIO()
            np.savez(file, of=key_text, metrics=json.dumps(metrics), views=json.dumps(views), radiance=radiance)
            write_bytes(kept, file.getvalue())
        return metrics, views, radiance

    def _batches(self, fields: tuple[str, ...], spp: int | None = None) -> Iterator[Batch]:
        """Yield the test split's batches with the `fields` and, with `spp`, "traced" rendered at as many samples."""
        dataset = LightTransportDataset(self.directory, self.spec, "test", fields)
        for batch in DataLoader(dataset, batch_size=_BATCH, collate_fn=identity_collate):
            if spp:
                batch["traced"] = torch.stack([self.frames.traced(index, spp) for index in batch["index"].tolist()])
            yield batch

    def _reference_features(self, k: int, batch: Batch) -> dict[str, Tensor] | None:
        reference = (batch["reference_a"], batch["reference_b"], batch["exposure"])
        if len(self) > _MAX_CACHED:
            return ImageMetrics.reference_features(*reference, cached=False)
        if k not in self._features:
            self._features[k] = ImageMetrics.reference_features(*reference, cached=True)
        return self._features[k]
