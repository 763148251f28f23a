"""The views of the stress suites as batches, and the evaluation of methods on them."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlt.data.dataset import SampleTensors, collate
from nlt.data.files import AnyPath
from nlt.data.sample import TRACED
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, ShardReader, read_points
from nlt.display import expose
from nlt.errors import UserError
from nlt.evaluation.evaluate import evaluate
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.method import Batch, Method
from nlt.models.steady import Steady
from nlt.models.transport import PointEmbedding
from nlt.stress.inputs import INPUTS
from nlt.stress.rendering import DRAWS, ViewSet
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, STEADY, Suites


@dataclass
class SuiteViews:
    """The rendered suites as batches, and the evaluation of methods on them."""

    directory: AnyPath
    spec: DatasetSpec
    suites: Suites
    view_sets: list[ViewSet]
    device: torch.device

    def __post_init__(self) -> None:
        self.batch = cache(self._batch)

    def _batch(self, view_set: ViewSet, points: Points | None = None) -> Batch:
        """Return the views of a set, with its `path_traced` images and with its own points or with others."""
        names, reader = [*view_set.fields(self.spec), *view_set.path_traced(self.suites)], ShardReader()
        stored = [reader.read(self.directory / view_set.name, k, names) for k in range(view_set.views)]
        if view_set.ladder == DRAWS:
            views = [{name: torch.from_numpy(array) for name, array in view.items()} for view in stored]
        else:
            points = points or read_points(self.directory / view_set.points_name)
            tensors = SampleTensors(self.spec, {view_set.scene: points})
            views = [tensors(view_set.scene, view, k) for k, view in enumerate(stored)]
        return {name: value.to(self.device) for name, value in collate(views).items()}

    @property
    def clean(self) -> list[Batch]:
        """The unchanged test views of each scene."""
        return [self.batch(view_set) for view_set in self.view_sets if view_set.suite == CLEAN]

    def references(self, suite: str) -> dict[str, np.ndarray]:
        """Return the radiance (V, 3, H, W) at the highest severity, by ladder, and the exposure (V,)."""
        images = {}
        for ladder, _, batches in self._changed(suite, None):
            images[ladder] = torch.cat([(b["reference_a"] + b["reference_b"]) / 2 for b in batches]).cpu().numpy()
            images["exposure"] = torch.cat([b["exposure"] for b in batches]).cpu().numpy()
        return images

    @torch.inference_mode()
    def judge(self, method: Method, suite: str) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
        """Return rows for every ladder and severity of a suite, and the radiance at each ladder's highest severity."""
        if suite == FLICKER:
            return self._flicker(method), {}
        rows, images = [], {}
        for ladder, severity, batches in self._changed(suite, method):
            view_rows, images[ladder] = self.rows(method, batches)
            rows += [{"ladder": ladder, "severity": severity, **row} for row in view_rows]
        return rows, images

    def _changed(self, suite: str, method: Method | None) -> Iterator[tuple[str, int, list[Batch]]]:
        """Yield each ladder and severity of a suite that can affect the method, with a batch per scene."""
        if suite not in COMPUTED:
            mine = [view_set for view_set in self.view_sets if view_set.suite == suite]
            for name, severity in dict.fromkeys((view_set.ladder, view_set.severity) for view_set in mine):
                yield name, severity, [self.batch(s) for s in mine if (s.ladder, s.severity) == (name, severity)]
            return
        frames = [(scene.up, scene.camera.mean(0)) for scene in self.spec.descriptions]
        hparams: dict[str, Any] = getattr(method, "hparams", {})
        own = dict(hparams)  # to be restored after the denoisers are given another number of pixels
        for (owner, name), ladder in self.suites.ladders.items():
            if owner == suite and (method is None or _reads(method, ladder.change)):
                change = INPUTS[ladder.change]
                try:
                    for severity, value in enumerate(ladder.values, 1):
                        if ladder.change == "pixels":
                            hparams["one_in"] = value
                        scenes = zip(self.clean, frames, strict=True)
                        yield name, severity, [change(batch, value, *frame) for batch, frame in scenes]
                finally:
                    hparams.update(own)

    def rows(self, method: Method, batches: list[Batch]) -> tuple[list[dict[str, Any]], np.ndarray]:
        """Return a row per view, and the radiance (V, 3, H, W), 0 where it is not finite."""
        rows, images = [], []
        metrics = ImageMetrics(perceptual=False).to(self.device)
        for judged in evaluate(method, [self._with_traced(method, batch) for batch in batches], metrics):
            batch = judged.batch
            error = relative_error(judged.radiance, batch["reference_a"], batch["reference_b"], batch["exposure"])
            columns = {"scene": batch["scene"], "view": torch.arange(len(error)), "error": error}
            columns |= {"nonfinite": judged.nonfinite}
            columns |= {name: judged.metrics[name] for name in ("unbiased_mse", "mse", "mssim")}
            views = zip(*(column.tolist() for column in columns.values()), strict=True)
            rows += [dict(zip(columns, values, strict=True)) for values in views]
            images.append(judged.radiance.float().cpu().numpy())
        return rows, np.concatenate(images)

    def predict(self, method: Method, batch: Batch) -> Tensor:
        """Return the radiance of a batch."""
        return method(self._with_traced(method, batch))

    def _with_traced(self, method: Method, batch: Batch) -> Batch:
        """Return the batch with the path-traced input at the method's samples per pixel, if it reads one."""
        if "traced" in method.fields:
            name = f"traced_{method.spp}"
            if name not in batch:
                place = f"{self.suites.file}: traced"
                raise UserError(f"{place}: must contain {method.spp}, the samples per pixel of {type(method).__name__}")
            batch = batch | {"traced": batch[name]}
        return batch

    def _flicker(self, method: Method) -> list[dict[str, Any]]:
        """Return a method's rows of the suite flicker.

        The `value` of draws is the standard deviation of a pixel over the draws, relative to the image. The `value` of
        a path is the mean square change from frame to frame, relative to the reference's. Paths have two rows, one for
        the frames as they are and one for the blended ones, and their `error` is that of all frames.
        """
        rows = []
        for clean_set in (view_set for view_set in self.view_sets if view_set.suite == CLEAN):
            scene, clean = clean_set.scene, self.batch(clean_set)
            mine = [view_set for view_set in self.view_sets if (view_set.suite, view_set.scene) == (FLICKER, scene)]
            a, b = (expose(clean[f"reference_{half}"].double(), clean["exposure"]) for half in "ab")
            scale = (a * b).mean().item()
            row = lambda kind, value, images, scene=scene: {
                "ladder": kind, "severity": 0, "scene": scene, "value": value,
                "nonfinite": int((~images.isfinite()).sum()),
            }  # fmt: skip
            for kind in (kind for kind in ("points", "photons", "noise") if _reads(method, kind)):
                predictions = []
                for draw in (view_set for view_set in mine if view_set.ladder == DRAWS):
                    if kind == "points":
                        before, after = (read_points(self.directory / s.points_name) for s in (clean_set, draw))
                        with nearest_embeddings(method, scene, before, after):
                            predictions.append(self.predict(method, self._batch(clean_set, after)))
                    else:
                        prefix = {"photons": "photon_", "noise": "noisy"}[kind]
                        drawn = {name: value for name, value in self.batch(draw).items() if name.startswith(prefix)}
                        predictions.append(self.predict(method, clean | drawn))
                images = torch.stack([expose(prediction, clean["exposure"]) for prediction in predictions])
                rows.append(row(kind, (images.var(0).mean().item() / scale) ** 0.5, images))
            for view_set in (view_set for view_set in mine if view_set.is_path):
                frames = self.batch(view_set)
                references, exposure = (frames["reference_a"], frames["reference_b"]), frames["exposure"]
                a, b = (expose(x.double(), exposure).diff(dim=0) for x in references)
                alone = self.predict(method, frames)
                for name, images in (("", alone), (STEADY, _blended(alone, frames))):
                    own = expose(images.double(), exposure).diff(dim=0)
                    change = (own.square().mean() / (a * b).mean()).item()
                    error = relative_error(images, *references, exposure).mean().item()
                    rows.append(row(view_set.ladder + name, change, own) | {"error": error})
        return rows


def _blended(radiance: Tensor, frames: Batch) -> Tensor:
    """Return the radiance (V, 3, H, W) of consecutive frames, each blended with those before it."""
    steady = Steady()
    each = [{name: frames[name][k : k + 1] for name in Steady.fields} for k in range(len(radiance))]
    return torch.cat([steady(radiance[k : k + 1], frame) for k, frame in enumerate(each)])


@contextmanager
def nearest_embeddings(method: Method, scene: int, before: Points, after: Points) -> Iterator[None]:
    """Give a scene's points the embedding of the nearest former point of the same object, within the context.

    The method itself is changed, because a method with 8-bit weights cannot be copied.
    """
    embeddings = [module for module in method.modules() if isinstance(module, PointEmbedding)]
    own = [embedding.table.weight.data.clone() for embedding in embeddings]
    try:
        for embedding in embeddings:
            count = embedding.num_points
            # The objects are so far apart that the nearest point is of the same object.
            before_at, after_at = (
                np.column_stack([points["position"], 1e6 * points["object"]])[:count] for points in (before, after)
            )
            distance, nearest = cKDTree(before_at).query(after_at)
            nearest = np.where(distance < 1e6, nearest, np.arange(count))  # objects without former points keep rows
            rows = embedding.table.weight.data[scene * count : (scene + 1) * count]
            rows[:] = rows[torch.from_numpy(nearest).to(rows.device)]
        yield
    finally:
        for embedding, weight in zip(embeddings, own, strict=True):
            embedding.table.weight.data.copy_(weight)


def relative_error(prediction: Tensor, a: Tensor, b: Tensor, exposure: Tensor) -> Tensor:
    """Return the mean (B,) of (f - A)(f - B) / (((A + B) / 2)² + 0.01), in radiance times exposure.

    The numerator is that of the unbiased MSE. Each pixel's error is relative to its brightness; otherwise a lamp in
    view or one bright view would dominate, and a brighter light alone would raise the error.
    """
    f, a, b = (expose(x.double(), exposure) for x in (prediction, a, b))
    return ((f - a) * (f - b) / (((a + b) / 2).square() + 0.01)).mean((1, 2, 3))


def _reads(method: Method, change: str) -> bool:
    """Return whether a change of the inputs can affect a method."""
    if change == "pixels":
        return "one_in" in getattr(method, "hparams", ())
    inputs = {"points": {"point_visible"}, "photons": {"photon_flux"}, "spp": {"noisy_input"}, "noise": {*TRACED}}
    return change not in inputs or not inputs[change].isdisjoint(method.fields)
