"""`nlt stress`: evaluates trained methods on suites of growing severity, to find where each breaks.

results/NAME/stress/ holds `stress.csv`, with a row per method, suite, ladder, severity and view; `manifest.json`, which
includes the manifest of the suites; and, outside git, `images/SUITE-METHOD.npz`, with the radiance at a suite's highest
severities. nlt/stress/tables.py makes everything else there from these.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nlt.data.generate import generate
from nlt.data.spec import DatasetSpec
from nlt.errors import DivergedError, UserError
from nlt.evaluation.claims import write_claims
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import IMAGES, RUNS, load, read_rows, write_images, write_manifest, write_rows
from nlt.evaluation.trainings import Training, train
from nlt.models.method import Method
from nlt.models.policy import Policy, accelerate, default_device
from nlt.report.page import write_page
from nlt.stress.changed_scene import MESHES
from nlt.stress.figures import stress_section
from nlt.stress.inputs import BUDGET, FRAME
from nlt.stress.perturber import PLACES, lacks
from nlt.stress.rendering import render_suites, view_sets
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, SUITES, TRAINING, Suites, load_suites
from nlt.stress.tables import ROWS, STRESS, TRAININGS
from nlt.stress.trainings import train_suite
from nlt.stress.views import SuiteViews

Rows = dict[tuple[str, str], list[dict[str, Any]]]  # of stress.csv, by method and suite


def stress(
    config: str,
    out: str | None = None,
    scale: str | None = None,
    data: str | None = None,
    methods: list[str] | None = None,
    suites: list[str] | None = None,
    manifest: str = "suites",
    views: int | None = None,
) -> Path:
    """Train the methods as `nlt compare` does, render the suites and evaluate; existing results are kept.

    Args:
        config, scale, data, methods: the comparison, as in `Comparison.load`.
        out: the results' directory; None for results/ and the config's name.
        suites: names out of `SUITES`; None for all.
        manifest, views: the manifest of the suites, as in `load_suites`.

    Returns:
        The directory of the stress results.

    Raises:
        UserError: a config is wrong, or an output is not finite; even then, everything is written.
    """
    start, begun = time.time(), origin()
    comparison, content = Comparison.load(config, scale, data, methods), load_suites(manifest, views)
    wanted = suites or list(SUITES)
    spec = comparison.spec
    _check_changes(content)
    dataset = generate(spec, comparison.root)
    runs = Path("runs") / dataset.name
    trainings = {name: Training.of(comparison, name, comparison.seeds[0], runs) for name in comparison.trained}
    failures = train(list(trainings.values()), "local", None, {})
    sets, rendered = view_sets(spec, content, wanted), content.directory(spec, comparison.root)
    render_suites(spec, dataset, content, sets, rendered)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    suite_views = SuiteViews(rendered, spec, content, sets, device)
    directory = Path(out or Path("results") / comparison.name) / STRESS
    record = {
        **begun, **surroundings(device, policy), "comparison": comparison.name, "dataset": dataset.name,
        "suites": rendered.name, "views": min(content.views, spec.test), "scenes": [d.name for d in spec.descriptions],
        "manifest": content.model_dump(mode="json"), "left_out": _left_out(spec, content),
    }  # fmt: skip
    print("".join(f"left out: {reason}\n" for reason in record["left_out"]), end="", flush=True)
    write_record = lambda: write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
    labels = {name: trainings[name].run.name if name in trainings else name for name in comparison.methods}
    judged = [CLEAN, *(suite for suite in SUITES if suite in wanted and suite != TRAINING)]
    before = _measured(directory)
    rows = _stored_rows(directory, rendered.name, labels)
    shown = set[str]()  # suites whose references have been written
    with tqdm(total=len(labels) * len(judged), unit="suite", file=sys.stderr, mininterval=1.0) as bar:
        for name in labels:
            bar.set_description(f"judging {name}")
            try:
                if name in trainings and trainings[name] in failures:
                    raise DivergedError(failures[trainings[name]])
                method = comparison.untrained.get(name) or trainings[name].load(device)[0]
            except DivergedError as problem:
                record["left_out"].append(f"{name}: {problem}")
                bar.write(f"left out: {record['left_out'][-1]}")
                bar.update(len(judged))
                continue
            method = accelerate(method, policy, device)
            for suite in judged:
                label = {"method": name, "suites": rendered.name, "run": labels[name], "suite": suite}
                _judge(directory, suite_views, method, label, rows, shown, write_record)
                bar.update()
    write_rows(directory / ROWS, chain.from_iterable(rows.values()))
    if TRAINING in wanted:
        rows_of = lambda method: suite_views.rows(accelerate(method, policy, device), suite_views.clean)[0]
        error = lambda method: float(np.mean([row["error"] for row in rows_of(method)]))
        train_suite(directory, comparison, content.training.model_dump(), runs, error, device)
    if _measured(directory) != before:  # otherwise keep the manifest of the run that measured them
        write_record()
    section = stress_section(directory.parent)
    if (directory.parent / RUNS).exists():  # the results of `nlt compare`, whose report shows this section too
        results = load(directory.parent)
        write_page(results, write_claims(results), sections=[section])
    print(f"written to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")
    if broken := sum(row["nonfinite"] for row in chain.from_iterable(rows.values())):
        raise UserError(f"{directory / ROWS}: nonfinite: {broken:.0f} pixels are not finite; see the rows above 0")
    return directory


def _stored_rows(directory: Path, suites: str, labels: Mapping[str, str]) -> Rows:
    """Read stress.csv without the rows of other views and of trainings that have been replaced."""
    rows: Rows = {}
    for row in read_rows(directory / ROWS) if (directory / ROWS).exists() else []:
        if (row["suites"], row["run"]) == (suites, labels.get(row["method"], row["run"])):
            rows.setdefault((row["method"], row["suite"]), []).append(row)
    return rows


def _judge(
    directory: Path,
    views: SuiteViews,
    method: Method,
    label: dict[str, str],
    rows: Rows,
    shown: set[str],
    write_record: Callable,
) -> None:
    """Judge a method on a suite and write its rows and images, unless they are complete already."""
    name, suite = label["method"], label["suite"]
    images = directory / IMAGES / f"{suite}-{name}.npz"
    mark = f"{label['suites']} {label['run']} {views.suites.model_dump(mode='json').get(suite)}"
    if images.exists():
        with np.load(images) as file:
            if "rows" in file and (file["mark"], file["rows"]) == (mark, len(rows.get((name, suite), []))):
                return
    judged, radiance = views.judge(method, suite)
    rows[name, suite] = [label | row for row in judged]
    write_rows(directory / ROWS, chain.from_iterable(rows.values()))
    write_record()
    if suite not in (FLICKER, *shown):
        write_images(directory, f"{suite}-reference", **views.references(suite))
        shown.add(suite)
    # Written last: it marks the suite as complete.
    write_images(directory, images.stem, **radiance, mark=np.array(mark), rows=np.array(len(judged)))


def _check_changes(suites: Suites) -> None:
    for (suite, name), ladder in suites.ladders.items():
        known = {**BUDGET, **FRAME} if suite in COMPUTED else {**MESHES, **PLACES}
        if ladder.change not in known:
            place = f"{suites.file}: {suite}.{name}.change"
            raise UserError(f"{place}: must be one of {', '.join(known)}, is {ladder.change!r}")


def _measured(directory: Path) -> list[bytes]:
    return [path.read_bytes() for name in (ROWS, TRAININGS) if (path := directory / name).exists()]


def _left_out(spec: DatasetSpec, suites: Suites) -> list[str]:
    return [
        f"{suite}/{name} in {description.name}: needs {need}"
        for (suite, name), ladder in suites.ladders.items()
        for scene, description in enumerate(spec.descriptions)
        if (need := lacks(spec, scene, ladder.change))
    ]
