"""Make the model of `nlt render --demo` from a finished training: safetensors, and a manifest of its origin.

    nlt generate --config data/demo --config scale/pretrained
    nlt fit --config data/demo --config model/photon_splat \
        --config scale/pretrained --trainer.default_root_dir runs/pretrained
    python scripts/pretrained.py runs/pretrained/lightning_logs/version_0/checkpoints/*.ckpt $(git rev-parse HEAD)
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
from nlt.evaluation.render import DEMO
from nlt.models.factory import read_checkpoint
from nlt.models.policy import default_device
from nlt.training import run_lightning

CONFIGS = ("data/demo", "model/photon_splat", "scale/pretrained")


def main(checkpoint: str, commit: str) -> None:
    """Evaluate a checkpoint that was trained at `commit` and write it to where `nlt render --demo` finds it."""
    begun, configs = origin(), [f"--config={file}" for file in CONFIGS]
    run = read_configs([str(Path(checkpoint).absolute().parents[1] / "config.yaml")])
    trainer = run_lightning(["test", *configs, f"--ckpt_path={checkpoint}", "--trainer.logger=false"]).trainer
    method, spec, points = load_trained(checkpoint)
    save_trained(method, spec, points, str(DEMO))
    manifest = {
        **begun,
        "command": f"python scripts/pretrained.py {Path(checkpoint).name} {commit}",
        "training_command": "nlt fit " + " ".join(f"--config {file}" for file in CONFIGS),
        "trained_at_commit": commit,
        **{name: value for name, value in surroundings(default_device()).items() if name != "clock"},
        "seed": run["seed_everything"],
        "model": run["model"],
        "batch_size": run["data"]["batch_size"],
        "precision": run["trainer"]["precision"],
        "steps": read_checkpoint(checkpoint)["global_step"],
        "dataset": dataclasses.asdict(spec),
        "parameters": sum(p.numel() for p in method.parameters()),
        "sha256": hashlib.sha256(DEMO.read_bytes()).hexdigest(),
        "test": {name.removeprefix("test/"): float(value) for name, value in trainer.callback_metrics.items()},
    }
    write_bytes(DEMO.with_suffix(".json"), (json.dumps(manifest, indent=1) + "\n").encode())


if __name__ == "__main__":
    main(*sys.argv[1:])
