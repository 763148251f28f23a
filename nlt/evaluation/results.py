"""The results of a comparison on disk, and the one way to read them: no dataset, no renderer, no method needed.

results/NAME/ holds

- `manifest.json`: command, commit, device, versions, configs; `methods` in the table's order, `table` (the paper's,
  or null), `n_test`, `seeds`, `scenes`, `shown` (the indices of the test views whose images are kept); `floor`, the
  metrics of the reference's half A judged as a prediction against its half B; `references`, by scene: the samples per
  pixel of a half (`spp`), the MSE between the halves that pilot views predicted and the one measured on the test split;
- `runs.csv`: a row per method and seed with every number as it was measured, by the keys of `QUANTITIES`; `status`
  is ok, diverged or failed, and `message` says why; `family` is the method's class, `spp` and `pixel_fraction` what
  of a frame it path traces, `run` the directory of its training;
- `timings.csv`: a row per method, seed and device with what the clock measured there, in seconds, by the same names.
  The rows of other devices stay when a comparison is made again, as long as dataset and trainings (`run`) are theirs;
  runs.csv, and with it the tables, are of the manifest's `device`;
- `views.csv`: a row per method, seed and test view with the metrics of that image. `fid_without` and `kid_without`
  are those of the test set without the view's jackknife group: they carry these metrics' uncertainty;
- `history.csv`: the validation metrics along each training, with `step`, `images_seen` and `train_s` so far;
- `training_images.csv`, if it was asked for: the test metrics of each method and seed when it is trained, as long, on
  the first `train_images` of each scene alone; with the table's own;
- `images/METHOD.npz`, not in git: `radiance` (V, 3, H, W), float16, linear, of the first seed, for the shown views.
  `images/reference.npz` also has `exposure` (V,) and `view` (V,); `images/noisy.npz` is the teaching input, and
  `images/gbuffer.npz` has `albedo` and `normal` (V, 3, H, W), `depth` (V, 1, H, W), `transmits` (V, H, W)
  bool, `light_in_view` (V,) bool.

Tables, figures and claims (report.py) are made from these alone.
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
# What the clock measures.
TIMES = tuple(f"{name}{of}_s" for name in (*STAGES, "time_per_frame") for of in ("", "_p95", "_error"))


@dataclass(frozen=True)
class Results:
    """What `load` reads; `runs`, `views` and `timings` are the rows of the files, numbers as numbers."""

    directory: Path
    manifest: Mapping[str, Any]
    runs: list[dict[str, Any]]
    views: list[dict[str, Any]]
    timings: list[dict[str, Any]] = field(default_factory=list)

    @cached_property
    def methods(self) -> list[str]:
        """Those that were run, in the table's order; a method that diverged or failed is among them."""
        return list(dict.fromkeys(run["method"] for run in self.runs))

    @property
    def floor(self) -> Mapping[str, float]:
        """The metrics of the reference's half A, judged as a prediction against half B; empty in older results."""
        return self.manifest.get("floor", {})

    def is_below_floor(self, key: str, difference: float) -> bool:
        """Whether a difference in a metric is smaller than the error of one half of the reference against the other."""
        perfect = QUANTITIES[key].perfect
        return key in self.floor and perfect is not None and abs(difference) < abs(self.floor[key] - perfect)

    def best(self, key: str) -> str | None:
        """The method with the best mean; None where nothing was measured."""
        means = {method: self.mean(method, key) for method in self.methods}
        means = {method: mean for method, mean in means.items() if math.isfinite(mean)}
        choose = min if QUANTITIES[key].direction == "lower" else max
        return choose(means, key=means.__getitem__, default=None)

    def runs_of(self, method: str) -> list[dict[str, Any]]:
        """A method's runs that came to an end."""
        return [run for run in self.runs if run["method"] == method and run["status"] == OK]

    def status(self, method: str) -> str:
        """ "ok", or what became of how many runs, such as "1 of 3 diverged"."""
        runs = [run for run in self.runs if run["method"] == method]
        bad = [run["status"] for run in runs if run["status"] != OK]
        return ", ".join(f"{bad.count(s)} of {len(runs)} {s}" for s in dict.fromkeys(bad)) or OK

    def values(self, method: str, key: str) -> np.ndarray:
        """(S,) of the finished seeds; empty where it was not measured."""
        values = np.array([run.get(key, math.nan) for run in self.runs_of(method)], float)
        return values[np.isfinite(values)]

    def mean(self, method: str, key: str) -> float:
        """Over seeds; NaN where it was not measured."""
        values = self.values(method, key)
        return float(values.mean()) if len(values) else math.nan

    def std(self, method: str, key: str) -> float:
        """Sample standard deviation over seeds; NaN below two."""
        values = self.values(method, key)
        return float(values.std(ddof=1)) if len(values) > 1 else math.nan

    def per_view(self, method: str, key: str) -> np.ndarray:
        """(N,) of the test views in order, means over seeds; empty where it was not measured."""
        by_view: dict[int, list[float]] = {}
        for row in self._views_of.get(method, []):
            by_view.setdefault(row["view"], []).append(row.get(key, math.nan))
        values = np.array([np.mean(by_view[view]) for view in sorted(by_view)])
        return values if np.isfinite(values).all() else np.zeros(0)

    @cached_property
    def _views_of(self) -> dict[str, list[dict[str, Any]]]:
        rows: dict[str, list[dict[str, Any]]] = {}
        for row in self.views:
            rows.setdefault(row["method"], []).append(row)
        return rows

    def interval(self, method: str, key: str) -> tuple[float, float]:
        """95% bootstrap interval over test images of a per-image metric; NaN below two images."""
        if (method, key) not in self._intervals:
            self._intervals[method, key] = self._bootstrap(method, key)
        return self._intervals[method, key]

    @cached_property
    def _intervals(self) -> dict[tuple[str, str], tuple[float, float]]:
        return {}

    def _bootstrap(self, method: str, key: str) -> tuple[float, float]:
        values = self.per_view(method, key) if QUANTITIES[key].per_image else np.zeros(0)
        if len(values) < 2:
            return math.nan, math.nan
        found = scipy.stats.bootstrap(
            (values,), np.mean, confidence_level=LEVEL, n_resamples=_RESAMPLES, method="percentile",
            rng=np.random.default_rng(0),
        ).confidence_interval  # fmt: skip
        return float(found.low), float(found.high)

    @cached_property
    def devices(self) -> list[str]:
        """Those that the methods were timed on, the tables' first."""
        known = {_training(run) for run in self.runs}
        timed = [row["device"] for row in self.timings if _training(row) in known]
        return list(dict.fromkeys([self.manifest.get("device", ""), *timed]))

    def on(self, device: str) -> Results:
        """The same with the times measured on one of `devices`; a run that was not timed there has none."""
        if device == self.devices[0]:
            return self
        rows = {_training(row): row for row in self.timings if row["device"] == device}
        runs = [
            {key: value for key, value in run.items() if key not in TIMES}
            | {key: value for key, value in rows.get(_training(run), {}).items() if key in TIMES}
            for run in self.runs
        ]
        commit = next(row["commit"] for row in rows.values())
        manifest = {**self.manifest, "device": device, "commit": commit, "uncommitted_changes": False}
        return dataclasses.replace(self, manifest=manifest, runs=runs, timings=[])

    def rows(self, name: str) -> list[dict[str, Any]]:
        """Those of history.csv or training_images.csv; none without such a file of this table."""
        path = self.directory / name
        stale = name == TRAINING_IMAGES and not self.manifest.get("train_images")
        return read_rows(path) if path.exists() and not stale else []

    def images(self, name: str) -> dict[str, np.ndarray] | None:
        """The arrays of images/`name`.npz: a method, "reference", "noisy" or "gbuffer"; None where there is none."""
        path = self.directory / IMAGES / f"{name}.npz"
        if not path.exists():
            return None
        with np.load(path) as file:
            return dict(file)


def load(directory: str | Path) -> Results:
    """The results of a comparison.

    Raises:
        UserError: there are none, or they cannot be read.
    """
    directory = Path(directory)
    try:
        manifest = json.loads((directory / MANIFEST).read_text())
        runs, views = (read_rows(directory / name) for name in (RUNS, VIEWS))
        timings = read_rows(directory / TIMINGS) if (directory / TIMINGS).exists() else []
    except FileNotFoundError as error:
        raise UserError(f"{error.filename}: missing; `nlt compare` writes it, in the directory of its --out") from None
    except ValueError as error:
        raise UserError(f"{directory / MANIFEST}: damaged ({error}); run `nlt compare` again") from None
    return Results(directory, manifest, runs, views, timings)


def write_rows(path: Path, rows: Iterable[Mapping[str, Any]]) -> None:
    """Rows as CSV with a column for every key; NaN and what a row lacks are left empty."""
    rows = list(rows)
    text = io.StringIO(newline="")
    writer = csv.DictWriter(text, list(dict.fromkeys(key for row in rows for key in row)), restval="")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: "" if isinstance(v, float) and math.isnan(v) else v for k, v in row.items()})
    write_bytes(path, text.getvalue().encode())


def write_timings(directory: Path, manifest: Mapping[str, Any], runs: list[dict[str, Any]]) -> None:
    """timings.csv: of these runs on the manifest's device, and what it has of the same dataset on others."""
    path, told = directory / TIMINGS, {key: manifest[key] for key in ("device", "dataset", "commit")}
    others = [
        row
        for row in (read_rows(path) if path.exists() else [])
        if row["device"] != told["device"] and row["dataset"] == told["dataset"]
    ]
    own = [
        {**{key: run.get(key) for key in ("method", "seed", "run")}, **told, **{k: run[k] for k in TIMES if k in run}}
        for run in runs
        if run["status"] == OK
    ]
    write_rows(path, own + others)


def _training(row: Mapping[str, Any]) -> tuple[str, ...]:
    """What a run or its times are of: method, seed and, where it was trained, the training's directory."""
    run = row.get("run")
    return (row["method"], str(row["seed"]), run if isinstance(run, str) else "")


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of a CSV, numbers as numbers, NaN where a cell is empty."""
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
    """The manifest, whole."""
    write_bytes(directory / MANIFEST, (json.dumps(manifest, indent=1, default=str) + "\n").encode())


def write_images(directory: Path, name: str, **arrays: np.ndarray) -> None:
    """images/`name`.npz, floats as float16; what is above its range is clamped to it."""
    most = float(np.finfo(np.float16).max)
    half = {
        key: np.clip(array, -most, most).astype(np.float16) if array.ndim == 4 else array
        for key, array in arrays.items()
    }
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **half)  # type: ignore[arg-type]
    write_bytes(directory / IMAGES / f"{name}.npz", buffer.getvalue())
