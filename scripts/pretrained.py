"""Make a model of `nlt render --demo` from a finished training: safetensors, and a card of its origin and metrics.

    nlt generate --config data/demo --config scale/pretrained
    nlt fit --config data/demo --config model/guided_1spp --config scale/pretrained --config variant/direct_corrected \
        --trainer.default_root_dir runs/pretrained/guided_1spp@direct_corrected
    nlt fit --config data/demo --config model/nlt_photons --config scale/pretrained \
        --trainer.default_root_dir runs/pretrained/nlt_photons
    for run in runs/pretrained/*; do
        python scripts/pretrained.py $run/lightning_logs/version_0/checkpoints/*.ckpt $(git rev-parse HEAD)
    done
"""

import dataclasses
import hashlib
import json
import sys
from pathlib import Path

from nlt.config import read_configs
from nlt.data.files import write_bytes
from nlt.evaluation.export import load_trained, save_trained
from nlt.evaluation.provenance import origin, surroundings
from nlt.models.factory import read_checkpoint
from nlt.models.policy import default_device
from nlt.training import run_lightning
from nlt.view.drawing import PRETRAINED


def main(checkpoint: str, commit: str) -> None:
    """Evaluate a checkpoint that was trained at `commit` and write it to where `nlt render --demo` finds it."""
    run_folder = Path(checkpoint).absolute().parents[1]
    name = run_folder.parents[1].name
    file = PRETRAINED / f"{name}.safetensors"
    model, _, variant = name.partition("@")
    used = ["data/demo", f"model/{model}", "scale/pretrained", *([f"variant/{variant}"] if variant else [])]
    begun, configs = origin(), [f"--config={config}" for config in used]
    run = read_configs([str(run_folder / "config.yaml")])
    seconds = Path(checkpoint).stat().st_mtime - (run_folder / "config.yaml").stat().st_mtime
    trainer = run_lightning(["test", *configs, f"--ckpt_path={checkpoint}", "--trainer.logger=false"]).trainer
    method, spec, points = load_trained(checkpoint)
    save_trained(method, spec, points, str(file))
    card = {
        **begun,
        "command": f"python scripts/pretrained.py {Path(checkpoint).name} {commit}",
        "training_command": "nlt fit " + " ".join(f"--config {config}" for config in used),
        "trained_at_commit": commit,
        "minutes": round(seconds / 60, 1),
        **{name: value for name, value in surroundings(default_device()).items() if name != "clock"},
        "seed": run["seed_everything"],
        "model": run["model"],
        "batch_size": run["data"]["batch_size"],
        "precision": run["trainer"]["precision"],
        "steps": read_checkpoint(checkpoint)["global_step"],
        "dataset": dataclasses.asdict(spec),
        "parameters": sum(p.numel() for p in method.parameters()),
        "sha256": hashlib.sha256(file.read_bytes()).hexdigest(),
        "test": {name.removeprefix("test/"): float(value) for name, value in trainer.callback_metrics.items()},
    }
    write_bytes(file.with_suffix(".json"), (json.dumps(card, indent=1) + "\n").encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
