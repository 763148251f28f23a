"""Make a model that comes with nlt from a finished comparison: safetensors, and a card of its origin and metrics.

nlt compare --config front --scale pretrained --data demo --methods guided_1spp nlt_photons --out runs/pretrained
python scripts/pretrained.py runs/pretrained guided_1spp
python scripts/pretrained.py runs/pretrained nlt_photons
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path

from nlt.data.files import write_bytes
from nlt.evaluation.export import load_trained, save_trained
from nlt.evaluation.render import PRETRAINED
from nlt.evaluation.results import load
from nlt.evaluation.trainings import newest_checkpoint
from nlt.metrics.quantities import METRICS

_ORIGIN = ("commit", "uncommitted_changes", "started", "device", "platform", "python", "versions", "mitsuba_variant")


def main(directory: str, method: str) -> None:
    """Write the first training of a method in a results directory into the package, by its name."""
    results = load(directory)
    run = results.runs_of(method)[0]
    checkpoint = newest_checkpoint(Path(run["run"]))
    trained, spec, points = load_trained(str(checkpoint))
    file = PRETRAINED / f"{method}.safetensors"
    save_trained(trained, spec, points, str(file))
    model = results.manifest["configs"][method]
    card = {
        "command": results.manifest["command"],
        **{name: results.manifest[name] for name in _ORIGIN},
        "trained_at_commit": run["trained_at_commit"],
        "minutes": round(run["train_s"] / 60, 1),
        "threads": run["threads"],
        "seed": run["seed"],
        "model": model["model"],
        "batch_size": model["data"]["batch_size"],
        "precision": model["trainer"].get("precision"),
        "steps": run["steps"],
        "dataset": dataclasses.asdict(spec),
        "parameters": run["parameters"],
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "tested_in": results.manifest["dataset"],
        "test": {name: run[name] for name in METRICS if name in run},
    }
    write_bytes(file.with_suffix(".json"), (json.dumps(card, indent=1) + "\n").encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
