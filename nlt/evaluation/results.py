"""The results of a comparison on disk, and functions to read and write them without dataset, renderer or method.

results/NAME/ holds

- `manifest.json`: command, commit, device, versions, configs; `methods` in the table's order; `table` (the paper's,
  or null); `n_test`, `seeds`, `scenes`; `shown`, the indices of the test views whose images are stored; `floor`, the
  metrics of the reference's half A judged as a prediction against its half B; `references`, by scene: the samples per
  pixel of a half (`spp`), the MSE between the halves as predicted from pilot views and as measured on the test split;
- `runs.csv`: a row per method and seed with every measured number, unrounded, by the keys of `QUANTITIES`; `status` is
  ok, diverged or failed, and `message` gives the reason; `family` is the method's class, `spp` and `pixel_fraction`
  describe the path tracing of a frame, and `run` is the directory of its training;
- `timings.csv`: a row per method, seed and device with the clock's measurements in seconds, by the same names. When
  a comparison is repeated, the rows of other devices are kept if they are of the same dataset, and used if they are of
  the same training (`run`). runs.csv, and thus the tables, are of the manifest's `device`;
- `views.csv`: a row per method, seed and test view with the metrics of that image. `fid_without` and `kid_without` are
  the metrics of the test set without the view's jackknife group, which give the uncertainty of FID and KID;
- `history.csv`: the validation metrics along each training, with `step`, `images_seen` and `train_s` so far;
- `training_images.csv`, if requested: the test metrics of each method and seed after training for as many steps on
  only the first `train_images` of each scene, and those after training on all images;
- `images/METHOD.npz`, not in git: `radiance` (V, 3, H, W), float16, linear, of the first seed, for the shown views.
  `images/reference.npz` also has `exposure` (V,) and `view` (V,); `images/noisy.npz` has the noisy training images, and
  `images/gbuffer.npz` has `albedo` and `normal` (V, 3, H, W), `depth` (V, 1, H, W), `transmits` (V, H, W)
  bool, `light_in_view` (V,) bool.

Tables, figures (nlt/report) and claims are made from these files alone.
"""

from __future__ import annotations

import csv
import dataclasses
import io
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import scipy.stats

from nlt.data.files import write_bytes
from nlt.errors import UserError
from nlt.metrics.quantities import QUANTITIES, STAGES

MANIFEST, RUNS, TIMINGS, VIEWS, IMAGES = "manifest.json", "runs.csv", "timings.csv", "views.csv", "images"
HISTORY, TRAINING_IMAGES = "history.csv", "training_images.csv"
OK, DIVERGED, FAILED = "ok", "diverged", "failed"
LEVEL, _RESAMPLES = 0.95, 2000
# Times that the clock measures.
TIMES = tuple(f"{name}{part}_s" for name in (*STAGES, "time_per_frame") for part in ("", "_p95", "_error"))


@dataclass(frozen=True)
class Results:
    """A comparison's results as read by `load`; `runs`, `views` and `timings` are rows of the files."""

    directory: Path
    manifest: Mapping[str, Any]
    runs: list[dict[str, Any]]
    views: list[dict[str, Any]]
    timings: list[dict[str, Any]] = field(default_factory=list)

    @cached_property
    def methods(self) -> list[str]:
        """The methods that were run, in the table's order, including those that diverged or failed."""
        return list(dict.fromkeys(run["method"] for run in self.runs))

    @property
    def floor(self) -> Mapping[str, float]:
        """The metrics of the reference's half A, judged as a prediction against half B; empty in older results."""
        return self.manifest.get("floor", {})

    def is_below_floor(self, key: str, difference: float) -> bool:
        """Return whether a difference in a metric is smaller than that between the reference's halves."""
        perfect = QUANTITIES[key].perfect
        return key in self.floor and perfect is not None and abs(difference) < abs(self.floor[key] - perfect)

    def best(self, key: str) -> str | None:
        """Return the method with the best mean; None if nothing was measured."""
        means = {method: self.mean(method, key) for method in self.methods}
        means = {method: mean for method, mean in means.items() if math.isfinite(mean)}
        choose = min if QUANTITIES[key].direction == "lower" else max
        return choose(means, key=means.__getitem__, default=None)

    def runs_of(self, method: str) -> list[dict[str, Any]]:
        """Return a method's runs that finished without error."""
        return [run for run in self.runs if run["method"] == method and run["status"] == OK]

    def status(self, method: str) -> str:
        """Return "ok", or how many runs diverged or failed, e.g. "1 of 3 diverged"."""
        runs = [run for run in self.runs if run["method"] == method]
        bad = [run["status"] for run in runs if run["status"] != OK]
        return ", ".join(f"{bad.count(s)} of {len(runs)} {s}" for s in dict.fromkeys(bad)) or OK

    def values(self, method: str, key: str) -> np.ndarray:
        """Return the values (S,) of the finished seeds; empty if not measured."""
        values = np.array([run.get(key, math.nan) for run in self.runs_of(method)], float)
        return values[np.isfinite(values)]

    def mean(self, method: str, key: str) -> float:
        """Return the mean over seeds; NaN if not measured."""
        values = self.values(method, key)
        return float(values.mean()) if len(values) else math.nan

    def std(self, method: str, key: str) -> float:
        """Return the sample standard deviation over seeds; NaN for fewer than two."""
        values = self.values(method, key)
        return float(values.std(ddof=1)) if len(values) > 1 else math.nan

    def per_view(self, method: str, key: str) -> np.ndarray:
        """Return the values (N,) of the test views in order, means over seeds; empty if not measured."""
        by_view: dict[int, list[float]] = {}
        for row in self._views_by_method.get(method, []):
            by_view.setdefault(row["view"], []).append(row.get(key, math.nan))
        values = np.array([np.mean(by_view[view]) for view in sorted(by_view)])
        return values if np.isfinite(values).all() else np.zeros(0)

    @cached_property
    def _views_by_method(self) -> dict[str, list[dict[str, Any]]]:
        rows: dict[str, list[dict[str, Any]]] = {}
        for row in self.views:
            rows.setdefault(row["method"], []).append(row)
        return rows

    def interval(self, method: str, key: str) -> tuple[float, float]:
        """Return a per-image metric's 95% bootstrap interval over test images; NaN for fewer than two images."""
        if (method, key) not in self._known_intervals:
            self._known_intervals[method, key] = self._bootstrap(method, key)
        return self._known_intervals[method, key]

    @cached_property
    def _known_intervals(self) -> dict[tuple[str, str], tuple[float, float]]:
        return {}

    def _bootstrap(self, method: str, key: str) -> tuple[float, float]:
        values = self.per_view(method, key) if QUANTITIES[key].per_image else np.zeros(0)
        if len(values) < 2:
            return math.nan, math.nan
        interval = scipy.stats.bootstrap(
            (values,), np.mean, confidence_level=LEVEL, n_resamples=_RESAMPLES, method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        return float(interval.low), float(interval.high)

    @cached_property
    def devices(self) -> list[str]:
        """The devices that the methods were timed on; the tables' device comes first."""
        known = {_training_key(run) for run in self.runs}
        timed = [row["device"] for row in self.timings if _training_key(row) in known]
        return list(dict.fromkeys([self.manifest.get("device", ""), *timed]))

    def on(self, device: str) -> Results:
        """Return these results with the times of one of `devices`; a run that was not timed there has none."""
        if device == self.devices[0]:
            return self
        timed_rows = {_training_key(row): row for row in self.timings if row["device"] == device}
        runs = [
            {key: value for key, value in run.items() if key not in TIMES}
            | {key: value for key, value in timed_rows.get(_training_key(run), {}).items() if key in TIMES}
            for run in self.runs
        ]
        commit = next(row["commit"] for row in timed_rows.values())
        manifest = {**self.manifest, "device": device, "commit": commit, "uncommitted_changes": False}
        return dataclasses.replace(self, manifest=manifest, runs=runs, timings=[])

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Return the rows of history.csv or training_images.csv; empty if this comparison wrote no such file."""
        path = self.directory / name
        stale = name == TRAINING_IMAGES and not self.manifest.get("train_images")
        return read_rows(path) if path.exists() and not stale else []

    def images(self, name: str) -> dict[str, np.ndarray] | None:
        """Return the arrays of images/`name`.npz (a method, "reference", "noisy", "gbuffer"); None if missing."""
        path = self.directory / IMAGES / f"{name}.npz"
        if not path.exists():
            return None
        with np.load(path) as file:
            return dict(file)


def load(directory: str | Path) -> Results:
    """Read the results of a comparison.

    Raises:
        UserError: a file is missing or cannot be read.
    """
    directory = Path(directory)
    try:
        manifest = json.loads((directory / MANIFEST).read_text())
        runs, views = (read_rows(directory / name) for name in (RUNS, VIEWS))
        timings = read_rows(directory / TIMINGS) if (directory / TIMINGS).exists() else []
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: missing; give a directory that `nlt compare` has written") from None
    except ValueError as error:
        raise UserError(f"{directory / MANIFEST}: damaged ({error}); run `nlt compare` again") from None
    return Results(directory, manifest, runs, views, timings)


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Write rows as CSV with a column for every key; NaN and missing values are left empty."""
    rows = list(rows)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval="")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()})
    write_bytes(path, text.getvalue().encode())


def write_timings(directory: Path, manifest: Mapping[str, Any], runs: list[dict[str, Any]]) -> None:
    """Write these runs' times to timings.csv; keep its rows of the same dataset on other devices."""
    path, shared = directory / TIMINGS, {key: manifest[key] for key in ("device", "dataset", "commit")}
    others = [
        row
        for row in (read_rows(path) if path.exists() else [])
        if row["device"] != shared["device"] and row["dataset"] == shared["dataset"]
    ]
    own = [
        {**{key: run.get(key) for key in ("method", "seed", "run")}, **shared, **{k: run[k] for k in TIMES if k in run}}
        for run in runs
        if run["status"] == OK
    ]
    write_rows(path, own + others)


def _training_key(row: Mapping[str, Any]) -> tuple[str, ...]:
    """Return what identifies a run's training: method, seed and, unless untrained, the training's directory."""
    run = row.get("run")
    return (row["method"], str(row["seed"]), run if isinstance(run, str) else "")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Return the rows of a CSV file, with numbers converted and NaN for empty cells."""
    with path.open(newline="") as file:
        return [{key: _value(text) for key, text in row.items()} for row in csv.DictReader(file)]


def _value(text: str) -> Any:
    for kind in (int, float):
        try:
            return kind(text)
        except ValueError:
            continue
    return text or math.nan


def write_manifest(directory: Path, manifest: Mapping[str, Any]) -> None:
    """Write manifest.json."""
    write_bytes(directory / MANIFEST, (json.dumps(manifest, indent=1, default=str) + "\n").encode())


def write_images(directory: Path, name: str, **arrays: np.ndarray) -> None:
    """Write images/`name`.npz; arrays of images are stored as float16, clamped to its range."""
    limit = float(np.finfo(np.float16).max)
    half_floats = {
        key: np.clip(array, -limit, limit).astype(np.float16) if array.ndim == 4 else array
        for key, array in arrays.items()
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **half_floats)  # type: ignore[arg-type]
    write_bytes(directory / IMAGES / f"{name}.npz", buffer.getvalue())
