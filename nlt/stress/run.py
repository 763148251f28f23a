"""`nlt stress`: evaluates trained methods on suites of growing severity, to find where each breaks.

results/NAME/stress/ holds `stress.csv`, with a row per method, suite, ladder, severity and view; `manifest.json`, which
includes the manifest of the suites; and, outside git, `images/SUITE-METHOD.npz`, with the radiance at a suite's highest
severities. nlt/stress/tables.py makes everything else there from these.
"""

from __future__ import annotations

import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
from tqdm import tqdm

from nlt.data.generate import generate
from nlt.data.spec import DatasetSpec, load_spec
from nlt.errors import DivergedError, UserError
from nlt.evaluation.claims import write_claims
from nlt.evaluation.comparison import Comparison, build_if_untrained
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import IMAGES, RUNS, load, read_rows, write_images, write_manifest, write_rows
from nlt.evaluation.trainings import Training, check, train
from nlt.models.policy import Policy, accelerate, default_device
from nlt.report.page import write_page
from nlt.stress.changed_scene import MESHES
from nlt.stress.figures import stress_section
from nlt.stress.inputs import BUDGET, FRAME
from nlt.stress.perturber import PLACES, lacks
from nlt.stress.rendering import render_suites
from nlt.stress.suites import CLEAN, COMPUTED, FLICKER, SUITES, TRAINING, Suites, load_suites
from nlt.stress.tables import ROWS, STRESS, TRAININGS
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
        config: a config in configs/compare, by name or path.
        out: the results' directory; None for results/ and the config's name.
        scale: a config in configs/scale in place of the comparison's.
        data: a config in configs/data in place of the comparison's.
        methods: the methods, in place of the comparison's.
        suites: names out of `SUITES`; None for all.
        manifest: the manifest of the suites in configs/stress, by name or path.
        views: the number of views of each scene, in place of the manifest's.

    Returns:
        The directory of the stress results.

    Raises:
        UserError: a config is wrong, or an output is not finite; even then, everything is written.
    """
    start, begun = time.time(), origin()
    comparison, content = Comparison.load(config, scale, data, methods), load_suites(manifest, views)
    wanted = list(suites or SUITES)
    spec, root = load_spec([str(comparison.data), str(comparison.scale)])
    if not spec.test:
        raise UserError(f"{comparison.scale}: data.dataset.test: must be at least 1: the suites change test samples")
    check(comparison)
    _check_changes(content)
    dataset = generate(spec, root)
    runs, seed = Path("runs") / dataset.name, comparison.seeds[0]
    trainings = {
        name: Training.of(comparison, name, seed, runs) for name in comparison.methods if not build_if_untrained(name)
    }
    failures = train(list(trainings.values()), "local", None, {})
    rendered = render_suites(spec, dataset, content, wanted, root)
    device = default_device()
    policy = Policy.for_device(device, comparison.precision)
    directory = Path(out or Path("results") / comparison.name) / STRESS
    suite_views = SuiteViews(rendered, spec, content, wanted, device)
    record = {
        **begun, **surroundings(device, policy), "comparison": comparison.name, "dataset": dataset.name,
        "suites": rendered.name, "views": min(content.views, spec.test), "scenes": [d.name for d in spec.descriptions],
        "manifest": dict(content.content), "left_out": _left_out(spec, content),
    }  # fmt: skip
    print("".join(f"left out: {reason}\n" for reason in record["left_out"]), end="", flush=True)
    rows = [row for row in _stored_rows(directory / ROWS) if row["suites"] == rendered.name]
    before = _measured(directory)
    shown = set[str]()  # suites whose references have been written
    judged = [CLEAN, *(suite for suite in SUITES if suite in wanted and suite != TRAINING)]
    bar = tqdm(total=len(comparison.methods) * len(judged), unit="suite", file=sys.stderr, mininterval=1.0)
    for name in comparison.methods:
        bar.set_description(f"judging {name}")
        method, outcome = build_if_untrained(name), dict[str, Any]()
        try:
            if method is None and trainings[name] in failures:
                raise DivergedError(failures[trainings[name]])
            if method is None:
                method, outcome = trainings[name].load(device)
        except DivergedError as problem:
            record["left_out"].append(f"{name}: {problem}")
            bar.write(f"left out: {record['left_out'][-1]}")
            bar.update(len(judged))
            continue
        method = accelerate(method, policy, device)
        label = {"method": name, "suites": rendered.name, "run": Path(outcome.get("run", name)).name}
        rows = [row for row in rows if row["method"] != name or row["run"] == label["run"]]
        for suite in judged:
            count = sum((row["method"], row["suite"]) == (name, suite) for row in rows)
            images = directory / IMAGES / f"{suite}-{name}.npz"
            mark = f"{rendered.name} {label['run']} {content.content.get(suite)}"
            if not _is_complete(images, mark, count):
                judged_views, radiance = suite_views.judge(method, suite)
                rows = [row for row in rows if (row["method"], row["suite"]) != (name, suite)]
                rows += [{**label, "suite": suite, **row} for row in judged_views]
                write_rows(directory / ROWS, rows)
                write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
                if suite not in (FLICKER, *shown):
                    write_images(directory, f"{suite}-reference", **suite_views.references(suite))
                    shown.add(suite)
                # Written last: it marks the suite as complete.
                write_images(directory, images.stem, **radiance, mark=np.array(mark), rows=np.array(len(judged_views)))
            bar.update()
    bar.close()
    write_rows(directory / ROWS, rows)
    if TRAINING in wanted:
        clean = suite_views.batches(CLEAN)["views", 0]
        rows_of = lambda method: suite_views.rows(accelerate(method, policy, device), clean)[0]
        error = lambda method: float(np.mean([row["error"] for row in rows_of(method)]))
        train_suite(directory, comparison, content.content[TRAINING], runs, error, device)
    if _measured(directory) != before:  # otherwise keep the manifest of the run that measured them
        write_manifest(directory, record | {"wall_time_s": round(time.time() - start, 1)})
    section = stress_section(directory.parent)
    if (directory.parent / RUNS).exists():  # the results of `nlt compare`, whose report shows this section too
        results = load(directory.parent)
        write_page(results, write_claims(results), sections=[section])
    print(f"written to {directory}: {', '.join(sorted(path.name for path in directory.iterdir()))}")
    if broken := sum(row["nonfinite"] for row in rows):
        raise UserError(f"{directory / ROWS}: nonfinite: {broken:.0f} pixels are not finite; see the rows above 0")
    return directory


def _check_changes(suites: Suites) -> None:
    for ladder in suites.ladders:
        known = {**BUDGET, **FRAME} if ladder.suite in COMPUTED else {**MESHES, **PLACES}
        if ladder.change not in known:
            place = f"{suites.file}: {ladder.suite}.{ladder.name}.change"
            raise UserError(f"{place}: must be one of {', '.join(known)}, is {ladder.change!r}")


def _is_complete(images: Path, mark: str, rows: int) -> bool:
    """Return whether a suite was fully judged, on the same views and method, and no row was lost since."""
    if not images.exists():
        return False
    with np.load(images) as file:
        return "rows" in file and (str(file["mark"]), int(file["rows"])) == (mark, rows)


def _measured(directory: Path) -> list[bytes]:
    return [path.read_bytes() for name in (ROWS, TRAININGS) if (path := directory / name).exists()]


def _stored_rows(path: Path) -> list[dict[str, Any]]:
    return read_rows(path) if path.exists() else []


def _left_out(spec: DatasetSpec, suites: Suites) -> list[str]:
    return [
        f"{ladder.suite}/{ladder.name} in {spec.descriptions[scene].name}: needs {need}"
        for ladder in suites.ladders
        for scene in range(len(spec.scenes))
        if (need := lacks(spec, scene, ladder.change))
    ]
