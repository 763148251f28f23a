"""The views of the stress suites as batches, and the evaluation of methods on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlt.data.files import AnyPath
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, read_points
from nlt.display import expose
from nlt.errors import UserError
from nlt.evaluation.evaluate import evaluate
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule
from nlt.models.transport import PointEmbedding
from nlt.stress.inputs import BUDGET, FRAME
from nlt.stress.rendering import DRAWS, ViewSet, read_views, view_sets
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, PATHS, Suites


class SuiteViews:
    """The rendered suites as batches, and the evaluation of methods on them."""

    def __init__(
        self,
        directory: AnyPath,
        spec: DatasetSpec,
        suites: Suites,
        wanted: list[str],
        device: torch.device,
    ) -> None:
        self.directory, self.spec, self.suites, self.device = directory, spec, suites, device
        self.view_sets = view_sets(spec, suites, wanted)
        self.batches = cache(self._batches)

    def _batches(self, suite: str) -> dict[tuple[str, int], list[Batch]]:
        """Return a batch per scene for each ladder and severity of a rendered suite."""
        batches: dict[tuple[str, int], list[Batch]] = {}
        for view_set in self.view_sets:
            if view_set.suite == suite:
                batches.setdefault((view_set.ladder, view_set.severity), []).append(self._batch(view_set))
        return batches

    def _batch(self, view_set: ViewSet) -> Batch:
        batch = read_views(self.directory, self.spec, self.suites, view_set)
        return {name: value.to(self.device) for name, value in batch.items()}

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
            view_rows, radiance = self.rows(method, batches)
            rows += [{"ladder": ladder, "severity": severity, **row} for row in view_rows]
            images[ladder] = radiance
        return rows, images

    def _changed(self, suite: str, method: Method | None) -> Iterator[tuple[str, int, list[Batch]]]:
        if suite not in COMPUTED:
            for (ladder, severity), batches in self.batches(suite).items():
                yield ladder, severity, batches
            return
        clean = self.batches(CLEAN)["views", 0]
        for one in self.suites.ladders:
            if one.suite == suite and (method is None or _reads(method, one.change)):
                for severity, value in enumerate(one.values, 1):
                    with _fewer_pixels(method, value if one.change == "pixels" else None):
                        yield one.name, severity, [self._compute(batch, one.change, value) for batch in clean]

    def _compute(self, batch: Batch, change: str, value: float) -> Batch:
        if change in BUDGET:
            return BUDGET[change](batch, value)
        description = self.spec.descriptions[int(batch["scene"][0])]
        up, middle = (torch.tensor(v, device=self.device) for v in (description.up, description.camera.mean(0)))
        return FRAME[change](batch, value, up, middle)

    def rows(self, method: Method, batches: list[Batch]) -> tuple[list[dict[str, Any]], np.ndarray]:
        """Return a row per view, and the radiance (V, 3, H, W), 0 where it is not finite."""
        rows, images = [], []
        metrics = ImageMetrics(perceptual=False).to(self.device)
        for judged in evaluate(method, [self._with_traced(method, batch) for batch in batches], metrics):
            batch = judged.batch
            error = relative_error(judged.radiance, batch["reference_a"], batch["reference_b"], batch["exposure"])
            columns = {"error": error, "nonfinite": judged.nonfinite}
            columns |= {name: judged.metrics[name] for name in ("unbiased_mse", "mse", "mssim")}
            values = {name: column.tolist() for name, column in columns.items()}
            rows += [
                {"scene": int(batch["scene"][k]), "view": k, **{name: column[k] for name, column in values.items()}}
                for k in range(len(judged.radiance))
            ]
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

    # --- flicker ---

    def _flicker(self, method: Method) -> list[dict[str, Any]]:
        """Return a method's rows of the suite flicker.

        The `value` of draws is the standard deviation of a pixel over the draws, relative to the image. The `value` of
        a path is the mean square change from frame to frame, relative to the reference's.
        """
        rows = []
        for scene, clean in enumerate(self.batches(CLEAN)["views", 0]):
            a, b = (expose(clean[f"reference_{half}"].double(), clean["exposure"]) for half in "ab")
            scale = (a * b).mean().item()
            for kind in ("points", "photons", "noise"):
                if _reads(method, {"noise": "spp"}.get(kind, kind)):
                    images = [expose(p, clean["exposure"]) for p in self._draws(method, scene, clean, kind)]
                    variance = torch.stack(images).var(0).mean().item()
                    rows.append({"ladder": kind, "severity": 0, "scene": scene, "value": (variance / scale) ** 0.5,
                                 "nonfinite": sum(int((~d.isfinite()).sum()) for d in images)})  # fmt: skip
            for kind in PATHS:
                if (kind, 0) not in self.batches(FLICKER) or len(self.batches(FLICKER)[kind, 0]) <= scene:
                    continue
                frames = self.batches(FLICKER)[kind, 0][scene]
                own, a, b = (
                    expose(x.double(), frames["exposure"]).diff(dim=0)
                    for x in (self.predict(method, frames), frames["reference_a"], frames["reference_b"])
                )
                value = (own.square().mean() / (a * b).mean()).item()
                rows.append({"ladder": kind, "severity": 0, "scene": scene, "value": value,
                             "nonfinite": int((~own.isfinite()).sum())})  # fmt: skip
        return rows

    def _draws(self, method: Method, scene: int, clean: Batch, kind: str) -> Iterator[Tensor]:
        for view_set in self.view_sets:
            if view_set.suite != FLICKER or view_set.ladder != DRAWS or view_set.scene != scene:
                continue
            if kind == "points":
                yield self._with_points(method, view_set, clean)
                continue
            prefix = {"photons": "photon_", "noise": "noisy_input"}[kind]
            drawn = self.batches(FLICKER)[DRAWS, view_set.severity][scene]
            yield self.predict(method, clean | {name: v for name, v in drawn.items() if name.startswith(prefix)})

    def _with_points(self, method: Method, view_set: ViewSet, clean: Batch) -> Tensor:
        """Predict with another draw of points, each with the embedding of training's nearest point of its object."""
        drawn = read_points(self.directory / view_set.points_name)
        base = next(r for r in self.view_sets if r.suite == CLEAN and r.scene == view_set.scene)
        points = read_points(self.directory / base.points_name)
        moved = read_views(self.directory, self.spec, self.suites, base, drawn)
        fields = {name: value.to(self.device) for name, value in moved.items() if name.startswith("point_")}
        batch = clean | fields
        with _embeddings_of(method, view_set.scene, points, drawn):
            return self.predict(method, batch)


@contextmanager
def _embeddings_of(method: Method, scene: int, points: Points, drawn: Points) -> Iterator[None]:
    tables = [module for module in method.modules() if isinstance(module, PointEmbedding)]
    kept = [module.table.weight.data for module in tables]
    for module, weight in zip(tables, kept, strict=True):
        count = module.num_points
        rows = np.arange(count)
        for owner in np.unique(drawn["object"][:count]):
            mine, theirs = (np.flatnonzero(cloud["object"][:count] == owner) for cloud in (drawn, points))
            if len(theirs):
                rows[mine] = theirs[cKDTree(points["position"][theirs]).query(drawn["position"][mine])[1]]
        changed = weight.clone()
        first = scene * count
        changed[first : first + count] = weight[first + torch.from_numpy(rows).to(weight.device)]
        module.table.weight.data = changed
    try:
        yield
    finally:
        for module, weight in zip(tables, kept, strict=True):
            module.table.weight.data = weight


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
    inputs = {"points": "point_visible", "photons": "photon_flux", "spp": "noisy_input"}
    return change not in inputs or inputs[change] in method.fields


@contextmanager
def _fewer_pixels(method: Method | None, one_in: float | None) -> Iterator[None]:
    if one_in is None or method is None:
        yield
        return
    assert isinstance(method, RenderingModule)
    before = method.hparams["one_in"]
    method.hparams["one_in"] = one_in
    try:
        yield
    finally:
        method.hparams["one_in"] = before
