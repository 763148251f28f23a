"""`nlt dashboard DIR`: a comparison in TensorBoard, a run per method and seed.

The log directory DIR/tensorboard is made anew from the results; curves and image grids are links to what the
trainings logged, where these still are. No histograms are logged.
"""

from __future__ import annotations

import math
import shutil
import threading
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tensorboard import program
from tensorboard.plugins.hparams import summary_v2 as hp  # api imports TensorFlow
from torch.utils.tensorboard import SummaryWriter

from nlt.errors import UserError
from nlt.evaluation.live import COLUMNS
from nlt.evaluation.paper import label
from nlt.evaluation.results import OK, Results, load
from nlt.metrics.quantities import METRICS, heading

LOGS = "tensorboard"
# What beside method and seed is a hyperparameter: its name, and where it stands in a method's config.
_HPARAMS = {
    "width": ("model", "init_args", "width"),
    "loss": ("model", "init_args", "loss"),
    "learning rate": ("model", "init_args", "learning_rate"),
    "batch": ("data", "batch_size"),
    "steps": ("trainer", "max_steps"),
    "training images": ("data", "dataset", "train"),
}
# Title -> tags; every chart shows all methods.
_CURVES = {
    "Loss against noisy images": {"training": ["train/loss"], "validation": ["val/loss"]},
    "Validation against the reference": {
        heading(key): [f"val/{key}"] for key in ("mse", "unbiased_mse", "psnr", "mssim")
    },
}


def write_logs(results: Results) -> Path:
    """DIR/tensorboard: METHOD/seed_N of each run, and `comparison` with layout, chart and pictures of all."""
    logs = results.directory / LOGS
    shutil.rmtree(logs, ignore_errors=True)
    with SummaryWriter(str(logs / "comparison")) as writer:
        writer.add_custom_scalars({title: {k: ["Multiline", v] for k, v in c.items()} for title, c in _CURVES.items()})
        writer._get_file_writer().add_summary(_experiment(results))
        for path in sorted(results.directory.glob("*.png")):
            writer.add_image(path.stem, np.asarray(Image.open(path).convert("RGB")), dataformats="HWC")
    for run in results.runs:
        place = logs / run["method"] / f"seed_{run['seed']}"
        with SummaryWriter(str(place)) as writer:
            given = _hparams(results, run)
            writer._get_file_writer().add_summary(hp.hparams_pb(given, trial_id=f"{run['method']}, seed {run['seed']}"))
            for key in (*COLUMNS, *METRICS):
                if math.isfinite(run.get(key, math.nan)):
                    writer.add_scalar(f"final/{key}", run[key])
            if run["status"] != OK:
                writer.add_text("status", f"{run['status']}: {run['message']}")
        training = Path(str(run.get("run")))
        for events in sorted(training.glob("events.out.tfevents.*")) if training.is_dir() else ():
            (place / events.name).symlink_to(events.resolve())
    return logs


def _experiment(results: Results) -> Any:
    """The hyperparameters' and final metrics' names, once for all runs."""
    measured = [
        key for key in dict.fromkeys((*COLUMNS, *METRICS)) if any(len(results.values(m, key)) for m in results.methods)
    ]
    return hp.hparams_config_pb(
        hparams=[hp.HParam(name) for name in ("method", "seed", *_HPARAMS)],
        metrics=[hp.Metric(f"final/{key}", display_name=heading(key)) for key in measured],
    )


def _hparams(results: Results, run: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = {"method": label(run["method"]), "seed": run["seed"]}
    for name, keys in _HPARAMS.items() if isinstance(run.get("run"), str) else ():  # else it was not trained
        value: Any = results.manifest.get("configs", {}).get(run["method"], {})
        for key in keys:
            value = value.get(key) if isinstance(value, dict) else None
        if value is not None:
            found[name] = value
    return found


def dashboard(directory: str, port: int) -> None:
    """Show a comparison's results in TensorBoard until interrupted; prints its address.

    Raises:
        UserError: there are no results, or the port is taken.
    """
    logs = write_logs(load(directory))
    board = program.TensorBoard()
    board.configure(logdir=str(logs), port=port, reload_interval=30)
    try:
        url = board.launch()
    except (program.TensorBoardServerException, OverflowError) as error:  # above 65535
        raise UserError(f"--port {port}: {' '.join(str(error).split())}; give another one") from None
    print(f"{url} shows {directory}; Ctrl+C ends it", flush=True)
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        print()
