"""`nlt select`: the smallest model that a scene needs, from what varies in the scene and from short trainings."""

import itertools
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from nlt.data.files import write_bytes
from nlt.data.generate import generate
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import write_manifest, write_rows
from nlt.metrics.quantities import COSTS
from nlt.select import advice
from nlt.select.choice import best, choose, paired_difference
from nlt.select.output import draw_front, markdown
from nlt.select.search import SCORES, Search, as_errors
from nlt.select.space import Candidate, SearchSpace
from nlt.waiting import wait_passively

Row = dict[str, Any]
# The roles of the rows of confirmed.csv.
CHOSEN, FULL, BEST, FEWEST = "chosen", "full model", "best", "by parameters"


def select(config: str, minutes: float | None = None, out: str | None = None, only_advice: bool = False) -> Path | None:
    """Print what varies in a dataset's scenes, then search the space and write the results to a directory.

    Returns:
        The directory; None with `only_advice`.

    Raises:
        UserError: the config is wrong, or the minutes are too few.
    """
    start, begun = time.time(), origin()
    wait_passively()  # in the process that times frames; this one has already loaded torch, so its threads still spin
    space = SearchSpace.load(config, minutes)
    facts = advice.measure_facts(space.spec)
    advised = advice.advise(space.spec, facts)
    for item in advised:
        print(f"{item.subject}: {item.verdict}\n    {item.reason}", flush=True)
    if only_advice:
        return None
    directory = Path(out or Path("results/select") / space.name)
    write_bytes(directory / "advice.md", advice.table(advised, facts).encode())
    dataset = generate(space.spec, space.root)
    methods = [method for item in advised for method in item.methods]
    search = Search(space, dataset, Path("runs") / dataset.name / "select" / Path(space.variant or "").stem, methods)
    finals = search.run()
    times = {c: float(search.entries[c].cost["time_per_frame_s"]) for c in finals}
    parameters = {c: float(search.entries[c].cost["parameters"]) for c in finals}
    errors = [search.errors(finals, key) for key in SCORES]
    picks = {CHOSEN: choose(errors, times), FULL: space.full}
    picks |= {BEST: best(errors[0]), FEWEST: choose(errors, parameters)}
    if space.full not in finals:
        print("the full model was not trained to the end, so nothing is compared with it", flush=True)
        del picks[FULL]
    confirmed = _confirm(search, picks)
    rows = _rows(search, finals, picks[CHOSEN])
    head = f"# {picks[CHOSEN].name}: chosen by `nlt select --config {space.name}`, ready for `nlt fit --config`.\n"
    config = yaml.safe_dump(space.config(picks[CHOSEN]), sort_keys=False)
    write_bytes(directory / "chosen.yaml", (head + config).encode())
    write_rows(directory / "table.csv", rows)
    write_rows(directory / "confirmed.csv", confirmed)
    views = []
    for c, seed in itertools.product(finals, search.seeds):
        for view, values in enumerate(zip(*(search.entries[c].scores[seed][key] for key in SCORES), strict=True)):
            views.append({"candidate": c.name, "seed": seed, "view": view, **dict(zip(SCORES, values, strict=True))})
    write_rows(directory / "views.csv", views)
    record = {
        **begun,
        **surroundings(search.device, search.policy),
        "select": space.name,
        **space.model_dump(include={"variant", "methods", "sizes", "point_counts", "photon_counts", "minutes"}),
        "seeds": search.seeds,
        "rungs": search.rounds,
        "budget_spent_min": round(search.spent / 60, 2),
        "dataset": dataset.name,
        "n_val": space.spec.val * len(space.spec.scenes),
        "n_test": space.spec.test * len(space.spec.scenes),
        "facts": [asdict(fact) for fact in facts],
        "advice": [asdict(item) for item in advised],
        "configs": {c.name: space.config(c) for c in finals},
        "wall_time_s": round(time.time() - start, 1),
    }
    write_manifest(directory, record)
    text = markdown(space.name, rows, confirmed, record)
    write_bytes(directory / "table.md", text.encode())
    draw_front(directory, rows)
    print(f"\n{text}\nwritten to {directory}; train with: nlt fit --config {directory}/chosen.yaml", flush=True)
    return directory


def _rows(search: Search, finals: list[Candidate], chosen: Candidate) -> list[Row]:
    """Return a row per candidate of the space: validation scores, and paired differences from the best."""
    errors = {key: search.errors(finals, key) for key in SCORES}
    rows = []
    for candidate in search.space.candidates:
        row: Row = {"candidate": candidate.name, **asdict(candidate), "chosen": int(candidate == chosen)}
        row |= {"full": int(candidate == search.space.full), "status": "did not fit"}
        if entry := search.entries.get(candidate):
            seeds = search.seeds if candidate in finals else [0]
            row |= {"status": entry.status, "steps": entry.steps, "seeds": len(seeds)}
            row |= {key: entry.cost[key] for key in ("step_s", *COSTS, "time_per_frame_error_s") if key in entry.cost}
            for key in SCORES if entry.steps else ():
                row[key] = np.mean([entry.scores[seed][key] for seed in seeds])
                if candidate in finals:
                    behind = paired_difference(errors[key][candidate], errors[key][best(errors[key])])
                    row[f"{key}_behind"], row[f"{key}_behind_error"] = behind
        rows.append(row)
    return rows


def _confirm(search: Search, picks: dict[str, Candidate]) -> list[Row]:
    """Return the picks' scores on the unused test split, and paired differences from the full model."""
    scores = {candidate: search.test_scores(candidate) for candidate in set(picks.values())}
    rows = []
    for role, candidate in picks.items():
        row: Row = {"role": role, "candidate": candidate.name} | search.entries[candidate].cost
        for key in SCORES:
            row[key] = float(np.mean([of_seed[key] for of_seed in scores[candidate]]))
            if FULL in picks:
                errors = [as_errors(key, scores[c]) for c in (candidate, picks[FULL])]
                row[f"{key}_worse"], row[f"{key}_worse_error"] = paired_difference(*errors)
        rows.append(row)
    return rows
