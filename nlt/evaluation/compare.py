"""`nlt compare`: generate data, train, evaluate and time all methods, and write the results behind the tables."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch

from nlt.config import read_configs
from nlt.data.dataset import LightTransportDataset
from nlt.data.engines import Died
from nlt.data.generate import generate
from nlt.data.spec import load_spec
from nlt.data.store import references
from nlt.errors import DivergedError, UserError
from nlt.evaluation import live
from nlt.evaluation.clock import Clock
from nlt.evaluation.comparison import Comparison, build_if_untrained
from nlt.evaluation.frames import Frames
from nlt.evaluation.judge import Evaluation
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
from nlt.evaluation.trainings import Training, check, train
from nlt.metrics.quantities import METRICS
from nlt.models.module import RenderingModule
from nlt.models.policy import Policy, default_device

JUDGED = "judged.npz"  # the cached evaluation in a run's directory
_ROW = ("method", "seed", "train_images", "status", "message")  # columns of training_images.csv before its metrics


def compare(
    comparison: Comparison,
    out: str | None = None,
    workers: int | None = None,
    scheduler: str = "local",
    slurm: Mapping[str, str] | None = None,
    train_images: Sequence[int] = (),
    after_row: Callable[[Path], None] = lambda directory: None,
) -> Path:
    """Run a comparison, reusing what is already finished, and return the directory of its results.

    Args:
        workers: number of trainings that run in parallel (default: one on this machine).
        scheduler, slurm: as for `nlt.data.engines.find_engine`, for generation and training; the rest runs here.
        train_images: also train every method on only the first N images of each scene, for each N given.
        after_row: called with the directory after each row is written.

    Raises:
        UserError: a config, an option or the dataset is wrong, or the disk is full.
    """
    start, provenance = time.time(), origin()
    directory = Path(out or Path("results") / comparison.name)
    spec, root = load_spec([str(comparison.data), str(comparison.scale)])
    if not spec.test:
        raise UserError(f"{comparison.scale}: data.dataset.test: must be at least 1 for a comparison, is 0")
    for count in train_images:
        if count > spec.train:
            raise UserError(f"--train-images: {count} is more than data.dataset.train; give at most {spec.train}")
    jobs = comparison.jobs()
    check(comparison)
    dataset = generate(spec, root, workers, scheduler, slurm)
    trainings = {
        (*job, count): Training.of(comparison, *job, Path("runs") / dataset.name, count)
        for count in (None, *sorted({*train_images} - {spec.train}))
        for job in jobs
        if not build_if_untrained(job[0])
    }
    failures = train(list(trainings.values()), scheduler, workers, slurm or {})
    if history := _history(trainings.values()):
        write_rows(directory / HISTORY, history)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    frames = Frames(LightTransportDataset(dataset, spec, "test"))
    test, clock = Evaluation(frames, device, policy), Clock(frames, device, policy=policy)
    test.write_references(directory)
    record = {
        **provenance,
        **surroundings(device, policy),
        **_describe_comparison(comparison, test),
        "train_images": sorted(train_images),
        **_describe_references(test),
    }
    runs: list[dict[str, Any]] = []
    views: list[dict[str, Any]] = []
    for number, (method, seed) in enumerate(jobs, 1):
        print(f"\n[{number}/{len(jobs)}] {method}, seed {seed}", flush=True)
        run: dict[str, Any] = {"method": method, "seed": seed}
        with _record_failure(run):
            module, facts, folder = build_if_untrained(method), dict[str, Any](), Path("runs") / dataset.name / method
            if module is None:
                training = trainings[method, seed, None]
                (module, facts), folder = _load_trained(training, failures, device), training.run
            key = _evaluation_cache_key(record, method, facts)
            metrics, view_rows, radiance = test.evaluate_once(module, folder / JUDGED, key)
            run |= clock.time(module) | metrics | clock.size(module) | facts
            run |= {"family": type(module).__name__, "pixel_fraction": module.pixel_fraction}
            run["spp"] = (module.spp or spec.input_spp) if "path_tracing" in module.stages else 0
            views += [{"method": method, "seed": seed, **row} for row in view_rows]
            if seed == comparison.seeds[0]:
                write_images(directory, method, radiance=radiance)
        runs.append(run)
        if number == 1:
            print(live.header())
        print(live.row(run), flush=True)
        write_rows(directory / RUNS, runs)
        write_timings(directory, record, runs)
        write_rows(directory / VIEWS, views)
        write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
        after_row(directory)
    print("\n" + "\n".join([live.header(), *(live.row(run) for run in runs), live.floor(record["floor"])]))
    # The curve also has the trainings on all images.
    full_trainings = [
        {**run, "train_images": spec.train} for run in runs if train_images and not build_if_untrained(run["method"])
    ]
    rows = [{key: run[key] for key in (*_ROW, *METRICS) if key in run} for run in full_trainings]
    rows += [
        _fewer_images_row(training, failures, test, record) for training in trainings.values() if training.train_images
    ]
    if rows:
        write_rows(directory / TRAINING_IMAGES, rows)
    return directory


def _describe_comparison(comparison: Comparison, test: Evaluation) -> dict[str, Any]:
    """Return the manifest's entries on what is compared and on which data."""
    return {
        "comparison": comparison.name,
        "table": comparison.table,
        "variant": comparison.variant and comparison.variant.stem,
        "methods": comparison.methods,
        "seeds": comparison.seeds,
        "dataset": test.directory.name,
        "scenes": [description.name for description in test.spec.descriptions],
        "integrators": test.frames.integrators(),
        "n_test": len(test),
        "shown": test.shown,
        "configs": {method: read_configs(comparison.configs(method)) for method in comparison.methods},
    }


def _describe_references(test: Evaluation) -> dict[str, Any]:
    """Return the manifest's entries on the accuracy of the references."""
    floor, measured = test.floor()
    scenes = zip(measured.items(), references(test.directory, test.spec), strict=True)
    return {"floor": floor, "references": {scene: {**entry, "measured_mse": mse} for (scene, mse), entry in scenes}}


def _fewer_images_row(
    training: Training, failures: Mapping[Training, str], test: Evaluation, record: Mapping[str, Any]
) -> dict[str, Any]:
    """Evaluate a training on fewer images and return its row of training_images.csv."""
    row: dict[str, Any] = {"method": training.method, "seed": training.seed, "train_images": training.train_images}
    with _record_failure(row):
        module, facts = _load_trained(training, failures, test.device)
        row |= test.evaluate_once(module, training.run / JUDGED, _evaluation_cache_key(record, training.method, facts))[
            0
        ]
    print(f"{training.name}: {row['status']} {row['message']}", flush=True)
    return row


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


def _history(trainings: Iterable[Training]) -> list[dict[str, Any]]:
    """Return the rows of history.csv."""
    return [
        {"method": training.method, "seed": training.seed, **row}
        for training in trainings
        if not training.train_images
        for row in (training.took or {}).get("history", [])
    ]
