"""`nlt stress`: trained methods on suites of growing severity, without retraining; where each breaks.

results/NAME/stress/ holds `stress.csv`, a row per method, suite, ladder, severity and view; `manifest.json`, with the
manifest of the suites in it; and, outside git, `images/SUITE-METHOD.npz`, the radiance of a suite's highest
severities. Everything else there is made from these: nlt/evaluation/stress_report.py.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from nlt.data.files import AnyPath
from nlt.data.generate import generate
from nlt.data.spec import DatasetSpec, load_spec
from nlt.data.store import read_points
from nlt.data.stress import DRAWS, PATHS, Rung, RungViews, render_suites, rungs
from nlt.data.suites import CLEAN, COMPUTED, FLICKER, SUITES, TRAINING, Suites, load_suites
from nlt.data.variants import lacks
from nlt.errors import DivergedError, UserError
from nlt.evaluation.comparison import Comparison, untrained
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import IMAGES, read_rows, write_images, write_manifest, write_rows
from nlt.evaluation.stress_report import ROWS, STRESS, draw_stress
from nlt.evaluation.stress_training import train_suite
from nlt.evaluation.trainings import Training, check, train
from nlt.metrics.display import expose
from nlt.metrics.image_metrics import ImageMetrics
from nlt.models.method import Batch, Method
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device
from nlt.models.transport import PointEmbedding

_IMAGES = ("reference_a", "reference_b", "noisy", "noisy_input", "depth", "normal", "albedo", "view_direction")


def stress(
    config: str,
    out: str | None = None,
    scale: str | None = None,
    data: str | None = None,
    methods: list[str] | None = None,
    suites: list[str] | None = None,
    manifest: str = "suites",
) -> Path:
    """Train what `nlt compare` would have, render the suites, judge; what is there already is kept.

    Raises:
        UserError: a config is wrong, or an output is not finite; then, too, everything is written.
    """
    start, begun = time.time(), origin()
    comparison, content = Comparison.load(config, scale, data, methods), load_suites(manifest)
    wanted = list(suites or SUITES)
    spec, root = load_spec([str(comparison.data), str(comparison.scale)])
    if not spec.test:
        raise UserError(f"{comparison.scale}: data.dataset.test: is 0; the suites change test samples")
    check(comparison)
    dataset = generate(spec, root)
    runs, seed = Path("runs") / dataset.name, comparison.seeds[0]
    trainings = {name: Training.of(comparison, name, seed, runs) for name in comparison.methods if not untrained(name)}
    died = train(list(trainings.values()), "local", None, {})
    rendered = render_suites(spec, dataset, content, wanted, root)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    directory = Path(out or Path("results") / comparison.name) / STRESS
    views = _Views(rendered, spec, content, wanted, device, policy)
    record = {
        **begun, **surroundings(device, policy), "comparison": comparison.name, "dataset": dataset.name,
        "suites": rendered.name, "views": min(content.views, spec.test), "scenes": [d.name for d in spec.descriptions],
        "manifest": dict(content.content), "left_out": _left_out(spec, content),
    }  # fmt: skip
    print("".join(f"left out: {reason}\n" for reason in record["left_out"]), end="", flush=True)
    rows = [row for row in _old(directory / ROWS) if row["suites"] == rendered.name]
    for number, name in enumerate(comparison.methods, 1):
        print(f"[{number}/{len(comparison.methods)}] {name}", flush=True)
        method, took = untrained(name), dict[str, Any]()
        try:
            if method is None and trainings[name] in died:
                raise DivergedError(died[trainings[name]])
            if method is None:
                method, took = trainings[name].load(device)
        except DivergedError as problem:
            record["left_out"].append(f"{name}: {problem}")
            print(f"left out: {record['left_out'][-1]}")
            continue
        label = {"method": name, "suites": rendered.name, "run": Path(took.get("run", name)).name}
        rows = [row for row in rows if row["method"] != name or row["run"] == label["run"]]
        for suite in [CLEAN, *(suite for suite in SUITES if suite in wanted and suite != TRAINING)]:
            images = directory / IMAGES / f"{suite}-{name}.npz"
            mark = f"{rendered.name} {label['run']}"
            if images.exists() and str(np.load(images)["mark"]) == mark:
                continue
            found, radiance = views.judge(method, suite)
            rows = [row for row in rows if (row["method"], row["suite"]) != (name, suite)]
            rows += [{**label, "suite": suite, **row} for row in found]
            write_rows(directory / ROWS, rows)
            write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
            if suite != FLICKER:
                write_images(directory, f"{suite}-reference", **views.references(suite))
            write_images(directory, images.stem, **radiance, mark=np.array(mark))  # the last: all is there
    write_rows(directory / ROWS, rows)
    if TRAINING in wanted:
        clean = views.batches(CLEAN)["views", 0]
        error = lambda method: float(np.mean([row["error"] for row in views.rows(method, clean)[0]]))
        train_suite(directory, comparison, content.content[TRAINING], runs, error, device)
    write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
    draw_stress(directory)
    print(f"written to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")
    if broken := sum(row["nonfinite"] for row in rows):
        raise UserError(f"{directory / ROWS}: nonfinite: {broken:.0f} pixels are not finite; see the rows above zero")
    return directory


def _old(path: Path) -> list[dict[str, Any]]:
    """What an earlier run has judged."""
    return read_rows(path) if path.exists() else []


def _left_out(spec: DatasetSpec, suites: Suites) -> list[str]:
    return [
        f"{ladder.suite}/{ladder.name} in {spec.descriptions[scene].name}: needs {need}"
        for ladder in suites.ladders
        for scene in range(len(spec.scenes))
        if (need := lacks(spec, scene, ladder.change))
    ]


# --- views ---


class _Views:
    """The rendered suites as batches, and what a method makes of them."""

    def __init__(
        self,
        directory: AnyPath,
        spec: DatasetSpec,
        suites: Suites,
        wanted: list[str],
        device: torch.device,
        policy: Policy,
    ) -> None:
        self.directory, self.spec, self.suites, self.device, self.policy = directory, spec, suites, device, policy
        self.rungs = rungs(spec, suites, wanted)
        self.batches = cache(self._batches)

    def _batches(self, suite: str) -> dict[tuple[str, int], list[Batch]]:
        """Of each ladder and severity of a rendered suite: a batch per scene."""
        found: dict[tuple[str, int], list[Batch]] = {}
        for rung in self.rungs:
            if rung.suite == suite:
                found.setdefault((rung.ladder, rung.severity), []).append(self._batch(rung))
        return found

    def _batch(self, rung: Rung) -> Batch:
        batch = RungViews(self.directory, self.spec, self.suites, rung).batch()
        return {name: value.to(self.device) for name, value in batch.items()}

    def references(self, suite: str) -> dict[str, np.ndarray]:
        """By ladder, of the highest severity: (V, 3, H, W) radiance; and the exposure (V,)."""
        images = {}
        for ladder, _, batches in self._changed(suite, None):
            images[ladder] = torch.cat([(b["reference_a"] + b["reference_b"]) / 2 for b in batches]).cpu().numpy()
            images["exposure"] = torch.cat([b["exposure"] for b in batches]).cpu().numpy()
        return images

    @torch.inference_mode()
    def judge(self, method: Method, suite: str) -> tuple[list[dict[str, Any]], dict[str, np.ndarray]]:
        """Rows of every ladder and severity of a suite, and the radiance of each ladder's highest severity."""
        if suite == FLICKER:
            return self._flicker(method), {}
        rows, images = [], {}
        for ladder, severity, batches in self._changed(suite, method):
            found, radiance = self.rows(method, batches)
            rows += [{"ladder": ladder, "severity": severity, **row} for row in found]
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
        if change in _BUDGET:
            return _BUDGET[change](batch, value)
        description = self.spec.descriptions[int(batch["scene"][0])]
        up, middle = (torch.tensor(v, device=self.device) for v in (description.up, description.camera.mean(0)))
        return _FRAME[change](batch, value, up, middle)

    @torch.inference_mode()
    def rows(self, method: Method, batches: list[Batch]) -> tuple[list[dict[str, Any]], np.ndarray]:
        """A row per view, and the radiance."""
        rows, images = [], []
        for batch in batches:
            prediction = self.predict(method, batch)
            reference = (batch["reference_a"], batch["reference_b"], batch["exposure"])
            bad = ~prediction.isfinite()
            finite = prediction.masked_fill(bad, 0)
            each = ImageMetrics(perceptual=False).to(self.device).update(finite, *reference)
            columns = {"error": relative_error(finite, *reference), "nonfinite": bad.any(1).sum((1, 2))}
            columns |= {name: each[name] for name in ("unbiased_mse", "mse", "mssim")}
            values = {name: column.tolist() for name, column in columns.items()}
            rows += [
                {"scene": int(batch["scene"][k]), "view": k, **{name: column[k] for name, column in values.items()}}
                for k in range(len(prediction))
            ]
            images.append(prediction.float().cpu().numpy())
        return rows, np.concatenate(images)

    def predict(self, method: Method, batch: Batch) -> Tensor:
        """The radiance of a batch, as `nlt compare` computes it."""
        if "traced" in method.inputs:
            name = f"traced_{method.spp}"
            if name not in batch:
                place = f"{self.suites.file}: traced"
                raise UserError(f"{place}: lacks {method.spp}, the samples per pixel of {type(method).__name__}")
            batch = batch | {"traced": batch[name]}
        with self.policy.applied(self.device):
            return method.to(self.device).eval()(batch)

    # --- flicker ---

    def _flicker(self, method: Method) -> list[dict[str, Any]]:
        """`value` of a draw's kind: the standard deviation of a pixel over the draws, relative to the image; of a
        path: the frame-to-frame change relative to the reference's own."""
        rows = []
        for scene, clean in enumerate(self.batches(CLEAN)["views", 0]):
            a, b = (expose(clean[f"reference_{half}"].double(), clean["exposure"]) for half in "ab")
            scale = (a * b).mean().item()
            for kind in ("points", "photons", "noise"):
                if _reads(method, {"noise": "spp"}.get(kind, kind)):
                    drawn = [expose(p, clean["exposure"]) for p in self._draws(method, scene, clean, kind)]
                    variance = torch.stack(drawn).var(0).mean().item()
                    rows.append({"ladder": kind, "severity": 0, "scene": scene, "value": (variance / scale) ** 0.5,
                                 "nonfinite": sum(int((~d.isfinite()).sum()) for d in drawn)})  # fmt: skip
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
        for rung in self.rungs:
            if rung.suite != FLICKER or rung.ladder != DRAWS or rung.scene != scene:
                continue
            if kind == "points":
                yield self._with_points(method, rung, clean)
                continue
            prefix = {"photons": "photon_", "noise": "noisy_input"}[kind]
            drawn = self.batches(FLICKER)[DRAWS, rung.severity][scene]
            yield self.predict(method, clean | {name: v for name, v in drawn.items() if name.startswith(prefix)})

    def _with_points(self, method: Method, rung: Rung, clean: Batch) -> Tensor:
        """With another draw of the points; each has what is learned of training's nearest point of its object."""
        drawn = read_points(self.directory / rung.points_name)
        base = next(r for r in self.rungs if r.suite == CLEAN and r.scene == rung.scene)
        points = read_points(self.directory / base.points_name)
        moved = RungViews(self.directory, self.spec, self.suites, base).batch(drawn)
        fields = {name: value.to(self.device) for name, value in moved.items() if name.startswith("point_")}
        batch = clean | fields
        with _embeddings_of(method, rung.scene, points, drawn):
            return self.predict(method, batch)


@contextmanager
def _embeddings_of(
    method: Method, scene: int, points: dict[str, np.ndarray], drawn: dict[str, np.ndarray]
) -> Iterator[None]:
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
    """(B,) mean of (f - A)(f - B) / (((A + B) / 2)² + 0.01), in radiance times exposure.

    The numerator is that of the unbiased MSE. Each pixel counts by how wrong it is for its brightness: else a lamp in
    view, or one view brighter than the others, would be all that counts, and a brighter light would be an error.
    """
    f, a, b = (expose(x.double(), exposure) for x in (prediction, a, b))
    return ((f - a) * (f - b) / (((a + b) / 2).square() + 0.01)).mean((1, 2, 3))


# --- what is computed from the clean views: fewer inputs, another frame of the world ---


def _reads(method: Method, change: str) -> bool:
    """Whether a change of the inputs can reach a method."""
    if change == "pixels":
        return "one_in" in getattr(method, "hparams", ())
    inputs = {"points": "point_visible", "photons": "photon_flux", "spp": "noisy_input"}
    return change not in inputs or inputs[change] in method.inputs


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


def _points(batch: Batch, share: float) -> Batch:
    """The first of the points, which are in random order; the others are not visible."""
    count = batch["point_visible"].shape[1]
    first = torch.arange(count, device=batch["point_visible"].device) < max(1, round(share * count))
    return batch | {"point_visible": batch["point_visible"] & first}


def _photons(batch: Batch, share: float) -> Batch:
    """Photons at equal distances in their list, which goes by emitter; together they carry the power of all."""
    total = batch["photon_flux"].shape[1]
    count = round(share * total)
    chosen = ((torch.arange(count, device=batch["photon_flux"].device) + 0.5) * (total / max(count, 1))).long()
    fewer = {name: value[:, chosen] for name, value in batch.items() if name.startswith("photon_")}
    return batch | fewer | {"photon_flux": fewer["photon_flux"] * (total / max(count, 1))}


def _spp(batch: Batch, spp: float) -> Batch:
    """So many samples per input pixel on average: those pixels that get one more are spread at random."""
    less, more = int(np.floor(spp)), int(np.ceil(spp))
    image = batch["noisy_input"]
    chosen = torch.rand(image.shape[-2:], generator=torch.Generator().manual_seed(0)).to(image.device) < spp - less
    return batch | {"noisy_input": torch.where(chosen, batch[f"input_{more}"], batch[f"input_{less}"])}


def _moved(batch: Batch, rotation: Tensor, translation: Tensor) -> Batch:
    """Scene and camera under the rigid motion x -> R x + t; what the camera sees is the same."""
    back = torch.eye(4, dtype=rotation.dtype, device=rotation.device)
    back[:3, :3], back[:3, 3] = rotation.T, -rotation.T @ translation
    changed = {"world_to_view": batch["world_to_view"].to(back.dtype) @ back}
    for name in ("point_position", "photon_hit", "photon_origin"):
        changed[name] = batch[name].to(back.dtype) @ rotation.T + translation
    changed["photon_direction"] = batch["photon_direction"].to(back.dtype) @ rotation.T
    for name in ("normal", "view_direction"):
        changed[name] = torch.einsum("ij,bjhw->bihw", rotation, batch[name].to(back.dtype))
    return batch | {name: value.to(batch[name].dtype) for name, value in changed.items()}


def _shifted(batch: Batch, metres: float, up: Tensor, middle: Tensor) -> Batch:
    level = (up == 0).to(up.dtype)
    return _moved(batch, torch.diag(torch.ones_like(up)), metres * level / level.norm())


def _turned(batch: Batch, degrees: float, up: Tensor, middle: Tensor) -> Batch:
    """About the vertical through the middle of the camera's box (Rodrigues' formula)."""
    angle = torch.tensor(np.radians(degrees), device=up.device)
    cross = torch.linalg.cross(torch.diag(torch.ones_like(up)), up.expand(3, 3), dim=1)
    rotation = torch.eye(3, dtype=up.dtype, device=up.device) + angle.sin() * cross + (1 - angle.cos()) * cross @ cross
    return _moved(batch, rotation, middle - rotation @ middle)


def _mirrored(batch: Batch, _: float, up: Tensor, middle: Tensor) -> Batch:
    """Every image the other way round, and the camera's matrix so that points fall where they are seen."""
    width = batch["depth"].shape[-1]
    flip = torch.tensor([[-1.0, 0, width], [0, 1, 0], [0, 0, 1]], device=batch["depth"].device)
    images = {name: value.flip(-1) for name, value in batch.items() if name in _IMAGES or "traced_" in name}
    return batch | images | {"camera_matrix": flip @ batch["camera_matrix"]}


_FRAME: dict[str, Callable[[Batch, float, Tensor, Tensor], Batch]] = {
    "shifted": _shifted, "turned": _turned, "mirrored": _mirrored,
}  # fmt: skip
_BUDGET: dict[str, Callable[[Batch, float], Batch]] = {
    "points": _points, "photons": _photons, "pixels": lambda batch, _: batch, "spp": _spp,
}  # fmt: skip
