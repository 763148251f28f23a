"""`nlt stress`: evaluates trained methods on suites of growing severity, to find where each breaks.

results/NAME/stress/ holds `stress.csv`, with a row per method, suite, ladder, severity and view; `manifest.json`, which
includes the manifest of the suites; and, outside git, `images/SUITE-METHOD.npz`, with the radiance at a suite's highest
severities. nlt/stress/report.py makes everything else there from these.
"""

import sys
import time
from collections.abc import Callable, Mapping
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nlt.errors import DivergedError, UserError
from nlt.evaluation.comparison import Comparison
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import IMAGES, VIEWS, load, read_rows, write_images, write_manifest, write_rows
from nlt.evaluation.trainings import Training, generate_datasets, train
from nlt.models.method import Method
from nlt.models.policy import Policy, accelerate, default_device
from nlt.report.claims import write_claims
from nlt.report.page import write_page
from nlt.stress.changed_scene import MESHES
from nlt.stress.inputs import INPUTS
from nlt.stress.perturber import PLACES, lacks
from nlt.stress.rendering import render_suites, view_sets
from nlt.stress.report import stress_section
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, ROWS, STRESS, SUITES, TRAINING, TRAININGS, load_suites
from nlt.stress.trainings import train_suite
from nlt.stress.views import SuiteViews


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
    for (suite, name), ladder in content.ladders.items():
        known = INPUTS if suite in COMPUTED else {**MESHES, **PLACES}
        if ladder.change not in known:
            place = f"{content.file}: {suite}.{name}.change"
            raise UserError(f"{place}: must be one of {', '.join(known)}, is {ladder.change!r}")
    left_out = [
        f"{suite}/{name} in {description.name}: needs {need}"
        for (suite, name), ladder in content.ladders.items()
        for scene, description in enumerate(spec.descriptions)
        if (need := lacks(spec, scene, ladder.change))
    ]
    dataset = generate_datasets(comparison)
    runs = Path("runs") / dataset.name
    trainings = {
        name: Training.of(comparison, name, comparison.seeds[0], comparison.runs(name)) for name in comparison.trained
    }
    failures = train(list(trainings.values()), "local", None, {})
    sets, rendered = view_sets(spec, content, wanted), content.directory(spec, comparison.root)
    render_suites(spec, dataset, content, sets, rendered)
    print("".join(f"left out: {reason}\n" for reason in left_out), end="", flush=True)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    suite_views = SuiteViews(rendered, spec, content, sets, device)
    directory = Path(out or Path("results") / comparison.name) / STRESS
    record = {
        **begun, **surroundings(device, policy), "comparison": comparison.name, "dataset": dataset.name,
        "suites": rendered.name, "views": min(content.views, spec.test), "scenes": [d.name for d in spec.descriptions],
        "manifest": content.model_dump(mode="json"), "left_out": left_out,
    }  # fmt: skip
    write_record = lambda: write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
    measured = lambda: [path.read_bytes() for name in (ROWS, TRAININGS) if (path := directory / name).exists()]
    before = measured()
    judged = [CLEAN, *(suite for suite in SUITES if suite in wanted and suite != TRAINING)]
    labels = {name: trainings[name].run.name if name in trainings else name for name in comparison.methods}

    def build(name: str) -> Method:
        if name in trainings and trainings[name] in failures:
            raise DivergedError(failures[trainings[name]])
        return accelerate(comparison.untrained.get(name) or trainings[name].load(device)[0], policy, device)

    rows = _judge(directory, suite_views, judged, labels, build, left_out, write_record)
    if TRAINING in wanted:
        rows_of = lambda method: suite_views.rows(accelerate(method, policy, device), suite_views.clean)[0]
        error = lambda method: float(np.mean([row["error"] for row in rows_of(method)]))
        train_suite(directory, comparison, content.training, runs, error, device)
    if measured() != before:  # otherwise keep the manifest of the run that measured them
        write_record()
    section = stress_section(directory.parent)
    if (directory.parent / VIEWS).exists():  # which git does not keep; without it there is no report to extend
        results = load(directory.parent)
        write_page(results, write_claims(results), sections=[section])
    print(f"written to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")
    if broken := sum(row["nonfinite"] for row in rows):
        raise UserError(f"{directory / ROWS}: nonfinite: {broken:.0f} pixels are not finite; see the rows above 0")
    return directory


def _judge(
    directory: Path,
    views: SuiteViews,
    suites: list[str],
    labels: Mapping[str, str],
    build: Callable[[str], Method],
    left_out: list[str],
    write_record: Callable[[], None],
) -> list[dict[str, Any]]:
    """Judge methods on suites, write their rows and images, and return all rows of stress.csv.

    `labels` has the name of each method's training; results of that training are kept. A method that has diverged, so
    that `build` raises, is added to `left_out`.
    """
    path, rendered = directory / ROWS, views.directory.name
    rows: dict[tuple[str, str], list[dict[str, Any]]] = {}  # by method and suite
    for row in read_rows(path) if path.exists() else []:
        # Not those of other views, nor of trainings that have been replaced.
        if (row["suites"], row["run"]) == (rendered, labels.get(row["method"], row["run"])):
            rows.setdefault((row["method"], row["suite"]), []).append(row)
    with_references = {FLICKER}  # suites whose references have been written; flicker has none
    with tqdm(total=len(labels) * len(suites), unit="suite", file=sys.stderr, mininterval=1.0) as bar:
        for name, run in labels.items():
            bar.set_description(f"judging {name}")
            try:
                method = build(name)
            except DivergedError as problem:
                left_out.append(f"{name}: {problem}")
                bar.write(f"left out: {left_out[-1]}")
                bar.update(len(suites))
                continue
            for suite in suites:
                images = directory / IMAGES / f"{suite}-{name}.npz"
                mark = f"{rendered} {run} {views.suites.model_dump(mode='json').get(suite)}"
                if not _is_complete(images, mark, len(rows.get((name, suite), []))):
                    label = {"method": name, "suites": rendered, "run": run, "suite": suite}
                    judged, radiance = views.judge(method, suite)
                    rows[name, suite] = [label | row for row in judged]
                    write_rows(path, chain.from_iterable(rows.values()))
                    write_record()
                    if suite not in with_references:
                        write_images(directory, f"{suite}-reference", **views.references(suite))
                        with_references.add(suite)
                    # Written last: it marks the suite as complete.
                    write_images(directory, images.stem, **radiance, mark=np.array(mark), rows=np.array(len(judged)))
                bar.update()
    write_rows(path, chain.from_iterable(rows.values()))
    return list(chain.from_iterable(rows.values()))


def _is_complete(images: Path, mark: str, rows: int) -> bool:
    """Return whether a method's images of a suite have this mark and belong to as many rows."""
    if not images.exists():
        return False
    with np.load(images) as file:
        return "rows" in file and (file["mark"], file["rows"]) == (mark, rows)
