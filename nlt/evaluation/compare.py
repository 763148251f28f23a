"""`nlt compare`: generate data, train, evaluate and time all methods, and write the results behind the tables."""

import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from nlt.data.dataset import LightTransportDataset
from nlt.data.engines import Died
from nlt.data.files import AnyPath
from nlt.data.store import references
from nlt.errors import DivergedError, UserError
from nlt.evaluation.clock import Clock
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.frames import Frames
from nlt.evaluation.judge import Evaluation
from nlt.evaluation.paper import COLUMNS, FLOOR, label
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import (
    DIVERGED,
    FAILED,
    HISTORY,
    OK,
    RUNS,
    TRAINING_IMAGES,
    VIEWS,
    write_images,
    write_manifest,
    write_rows,
    write_timings,
)
from nlt.evaluation.trainings import Training, train
from nlt.metrics.quantities import METRICS, heading, text
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device

JUDGED = "judged.npz"  # the cached evaluation in a run's directory
_HEADINGS = f"{'method':22}" + "".join(f"{heading(key):>18}" for key in COLUMNS)
_ROW = ("method", "seed", "train_images", "status", "message")  # columns of training_images.csv before its metrics


def compare(
    comparison: Comparison,
    dataset: AnyPath,
    out: str | None = None,
    workers: int | None = None,
    scheduler: str = "local",
    slurm: Mapping[str, str] | None = None,
    after_row: Callable[[Path], None] = lambda directory: None,
) -> Path:
    """Run a comparison, reusing what is already finished, and return the directory of its results.

    Args:
        dataset: the directory that `nlt.data.generate.generate` returned.
        workers: number of trainings that run side by side (default: one per core, or one on a GPU).
        scheduler, slurm: as for `nlt.data.engines.find_engine`, for the trainings; the rest runs here.
        after_row: called with the directory after each row is written.

    Raises:
        UserError: a config, an option or the dataset is wrong, or the disk is full.
    """
    start, provenance = time.time(), origin()
    directory, spec = Path(out or Path("results") / comparison.name), comparison.spec
    trainings = {
        (method, seed, count): Training.of(comparison, method, seed, comparison.runs(method), count)
        for count in (None, *sorted({*comparison.train_images} - {spec.train}))
        for method, seed in comparison.rows
        if method in comparison.trained
    }
    failures = train(list(trainings.values()), scheduler, workers, slurm or {})
    if history := [row for key, training in trainings.items() if key[2] is None for row in _history(training)]:
        write_rows(directory / HISTORY, history)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    frames = Frames(LightTransportDataset(dataset, spec, "test"))
    test, clock = Evaluation(frames, device, policy), Clock(frames, device, policy=policy)
    test.write_references(directory)
    record = {**provenance, **surroundings(device, policy), **_describe(comparison, test)}
    runs: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    for number, (method, seed) in enumerate(comparison.rows, 1):
        print(f"\n[{number}/{len(comparison.rows)}] {method}, seed {seed}", flush=True)
        run: dict[str, Any] = {"method": method, "seed": seed}
        with _record_failure(run):
            if method in comparison.untrained:
                module, facts = comparison.untrained[method], dict[str, Any]()
                folder = Path("runs") / dataset.name / method
            else:
                training = trainings[method, seed, None]
                (module, facts), folder = _load_trained(training, failures, device), training.run
            key = _evaluation_cache_key(record, method, facts)
            metrics, view_rows, radiance = test.evaluate_once(module, folder / JUDGED, key)
            run |= clock.time(module) | metrics | clock.size(module) | facts
            run |= {"family": type(module).__name__, "pixel_fraction": module.pixel_fraction}
            run["spp"] = (module.spp or spec.samples(module.fields)) if "path_tracing" in module.stages else 0
            views += [{"method": method, "seed": seed, **row} for row in view_rows]
            if seed == comparison.seeds[0]:
                write_images(directory, method, radiance=radiance)
        runs.append(run)
        if number == 1:
            print(_HEADINGS)
        print(_line(run), flush=True)
        write_rows(directory / RUNS, runs)
        write_timings(directory, record, runs)
        write_rows(directory / VIEWS, views)
        write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
        after_row(directory)
    floor = {"method": FLOOR, "status": OK, **record["floor"]}
    print("\n" + "\n".join([_HEADINGS, *(_line(run) for run in (*runs, floor))]))
    if comparison.train_images and comparison.trained:
        # The curve also has the trainings on all images.
        rows = [run | {"train_images": spec.train} for run in runs if run["method"] in comparison.trained]
        for (method, seed, images), training in trainings.items():
            if images:
                row: dict[str, Any] = {"method": method, "seed": seed, "train_images": images}
                with _record_failure(row):
                    module, facts = _load_trained(training, failures, device)
                    key = _evaluation_cache_key(record, method, facts)
                    row |= test.evaluate_once(module, training.run / JUDGED, key)[0]
                print(f"{training.name}: {row['status']} {row['message']}", flush=True)
                rows.append(row)
        columns = (*_ROW, *METRICS)
        write_rows(directory / TRAINING_IMAGES, [{key: row[key] for key in columns if key in row} for row in rows])
    return directory


def _describe(comparison: Comparison, test: Evaluation) -> dict[str, Any]:
    """Return the manifest's entries on what is compared, on which data, and how accurate the references are."""
    floor, measured = test.floor()
    scenes = zip(measured.items(), references(test.directory, test.spec), strict=True)
    return {
        "comparison": comparison.name,
        "table": comparison.table,
        "variant": comparison.variant,
        "methods": comparison.methods,
        "seeds": comparison.seeds,
        "dataset": test.directory.name,
        "scenes": [description.name for description in test.spec.descriptions],
        "integrators": test.frames.integrators(),
        "n_test": len(test),
        "shown": test.shown,
        "configs": comparison.configs,
        "train_images": comparison.train_images,
        "floor": floor,
        "references": {scene: {**entry, "measured_mse": mse} for (scene, mse), entry in scenes},
    }


def _evaluation_cache_key(record: Mapping[str, Any], method: str, facts: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the cache key of a method's evaluation; None if the code is not exactly a commit."""
    if not record["commit"] or record["uncommitted_changes"]:
        return None
    names = ("commit", "versions", "device", "policy", "inception_weights")
    return {**{name: record[name] for name in names}, "config": record["configs"][method], **facts}


@contextmanager
def _record_failure(row: dict[str, Any]) -> Iterator[None]:
    """Record an error in the row, so that the other rows go on; user errors and a full disk are raised."""
    row |= {"status": OK, "message": ""}
    try:
        yield
    except (DivergedError, Died) as error:
        row |= {"status": FAILED if isinstance(error, Died) else DIVERGED, "message": str(error)}
    except (UserError, OSError):
        raise
    except Exception as error:
        row |= {"status": FAILED, "message": " ".join(f"{type(error).__name__}: {error}".split())}


def _load_trained(
    training: Training, failures: Mapping[Training, str], device: torch.device
) -> tuple[RenderingModule, dict[str, Any]]:
    if training in failures:
        raise Died(failures[training])
    return training.load(device)


def _line(run: Mapping[str, Any]) -> str:
    """Return the line of a run that is printed while the comparison runs."""
    if run["status"] != OK:
        return f"{label(run['method']):22} {run['status']}: {run['message']}"
    return f"{label(run['method']):22}" + "".join(f"{text(key, run.get(key)):>18}" for key in COLUMNS)


def _history(training: Training) -> list[dict[str, Any]]:
    """Return a training's rows of history.csv."""
    return [
        {"method": training.method, "seed": training.seed, **row} for row in (training.outcome or {}).get("history", [])
    ]
