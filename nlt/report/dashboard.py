"""`nlt report DIR --dashboard`: a comparison in TensorBoard, with a run per method and seed.

The log directory DIR/tensorboard is rebuilt from the results; curves and image grids are links to the trainings' own
logs, where these still exist. No histograms are logged.
"""

import math
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tensorboard import program
from tensorboard.plugins.hparams import summary_v2 as hp  # hparams.api would import TensorFlow
from torch.utils.tensorboard import SummaryWriter

from nlt.errors import UserError
from nlt.evaluation.paper import COLUMNS, label
from nlt.evaluation.results import OK, Results, load
from nlt.metrics.quantities import METRICS, heading

LOGS = "tensorboard"
# The hyperparameters besides method and seed: name, and keys in a method's config.
_HPARAMS = {
    "width": ("model", "init_args", "width"),
    "loss": ("model", "init_args", "loss"),
    "learning rate": ("model", "init_args", "learning_rate"),
    "batch": ("data", "batch_size"),
    "steps": ("trainer", "max_steps"),
    "training images": ("data", "dataset", "train"),
}
# The charts, each for all methods: title -> tags.
_CURVES = {
    "Loss against noisy images": {"training": ["train/loss"], "validation": ["val/loss"]},
    "Validation against the reference": {
        heading(key): [f"val/{key}"] for key in ("mse", "unbiased_mse", "psnr", "mssim")
    },
}


def write_logs(results: Results) -> Path:
    """Write and return DIR/tensorboard: METHOD/seed_N for each run; `comparison` for the layout and the figures."""
    logs = results.directory / LOGS
    shutil.rmtree(logs, ignore_errors=True)
    with SummaryWriter(str(logs / "comparison")) as writer:
        writer.add_custom_scalars({title: {k: ["Multiline", v] for k, v in c.items()} for title, c in _CURVES.items()})
        # The names of hyperparameters and final metrics are declared once for all runs.
        writer._get_file_writer().add_summary(
            hp.hparams_config_pb(
                hparams=[hp.HParam(name) for name in ("method", "seed", *_HPARAMS)],
                metrics=[
                    hp.Metric(f"final/{key}", display_name=heading(key))
                    for key in dict.fromkeys((*COLUMNS, *METRICS))
                    if any(len(results.values(method, key)) for method in results.methods)
                ],
            )
        )
        for path in sorted(p for p in results.directory.iterdir() if p.suffix in (".png", ".webp")):
            writer.add_image(path.stem, np.asarray(Image.open(path).convert("RGB")), dataformats="HWC")
    for run in results.runs:
        run_logs = logs / run["method"] / f"seed_{run['seed']}"
        with SummaryWriter(str(run_logs)) as writer:
            given = _hparams(results, run)
            writer._get_file_writer().add_summary(hp.hparams_pb(given, trial_id=f"{run['method']}, seed {run['seed']}"))
            for key in (*COLUMNS, *METRICS):
                if math.isfinite(run.get(key, math.nan)):
                    writer.add_scalar(f"final/{key}", run[key])
            if run["status"] != OK:
                writer.add_text("status", f"{run['status']}: {run['message']}")
        training = Path(str(run.get("run")))
        for events in sorted(training.glob("events.out.tfevents.*")) if training.is_dir() else ():
            (run_logs / events.name).symlink_to(events.resolve())
    return logs


def _hparams(results: Results, run: dict[str, Any]) -> dict[str, Any]:
    hparams: dict[str, Any] = {"method": label(run["method"]), "seed": run["seed"]}
    for name, keys in _HPARAMS.items() if isinstance(run.get("run"), str) else ():  # an untrained method has none
        value: Any = results.manifest.get("configs", {}).get(run["method"], {})
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            hparams[name] = value
    return hparams


def dashboard(directory: str, port: int) -> None:
    """Show results in TensorBoard until interrupted; raise UserError if there are none or the port is in use."""
    logs = write_logs(load(directory))
    board = program.TensorBoard()
    board.configure(logdir=str(logs), port=port, reload_interval=30)
    try:
        url = board.launch()
    except (program.TensorBoardServerException, OverflowError) as error:  # OverflowError: above 65535
        raise UserError(f"--port {port}: {' '.join(str(error).split())}; give another one") from None
    print(f"{url} shows {directory}; press Ctrl+C to stop", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print()
