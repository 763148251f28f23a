"""Configs of a tiny dataset and training, and stand-ins. The fixtures over them are in training_fixtures.py."""

from __future__ import annotations

import shutil
from pathlib import Path

import lightning as L
import yaml
from torch.nn import functional as F

from nlt.config import merge
from nlt.metrics import image_metrics
from nlt.metrics.inception import STAGES

DATASET = {
    "scenes": ["living_room"], "experiment": "moving_lights", "resolution": 16, "train": 8, "val": 3, "test": 3,
    "num_points": 64, "num_photons": 64, "reference_spp": 2, "shard_size": 4,
}  # fmt: skip
TRAINER = {
    "max_epochs": 1, "accelerator": "cpu", "devices": 1, "enable_progress_bar": False, "enable_model_summary": False,
    "log_every_n_steps": 1,
}  # fmt: skip
SCALE = {"model": {"init_args": {"width": 2}}, "trainer": TRAINER}


def write(path, content):
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


def copy_dataset(tiny, folder):
    """The tiny dataset under another root, to be harmed; its directory and its config."""
    directory = Path(shutil.copytree(tiny.dataset, folder / "datasets" / tiny.dataset.name))
    content = merge(yaml.safe_load(tiny.data.read_text()), {"data": {"root": str(folder / "datasets")}})
    return directory, write(folder / "harmed.yaml", content)


def tiny_inception(images):
    """In Inception's place where its numbers do not matter: colours as features."""
    return {"pool": F.adaptive_avg_pool2d(images.float(), 2).flatten(1), **dict.fromkeys(STAGES, images.float())}


tiny_inception.definition = "colours"


def use_tiny_inception(monkeypatch):
    monkeypatch.setattr(image_metrics, "load_inception", lambda device: tiny_inception)


class Recorder(L.Callback):
    """Writes down the samples that each rank trains on, by epoch."""

    def __init__(self, directory: str) -> None:
        self.directory = Path(directory)

    def on_train_batch_start(self, trainer, pl_module, batch, batch_idx):
        with (self.directory / f"{trainer.current_epoch}-{trainer.global_rank}").open("a") as file:
            file.writelines(f"{index}\n" for index in batch["index"].tolist())
