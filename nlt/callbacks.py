"""What Lightning does besides training: it keeps checkpoints and writes predictions."""

from pathlib import Path
from typing import Any

import lightning as L
from lightning.pytorch.callbacks import BasePredictionWriter, ModelCheckpoint
from PIL import Image

from nlt.data.files import write_bytes
from nlt.data.sample import BUFFERS
from nlt.display import display


class Checkpoints(ModelCheckpoint):
    """Saves the last finished epoch's checkpoint and keeps the previous one until the new one is complete."""

    def __init__(self) -> None:
        super().__init__(filename="{epoch}-{step}", save_top_k=1, save_on_train_epoch_end=True)

    def on_train_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        """Mark the last epoch as completed when a run resumes with max_steps, as Lightning does with max_epochs.

        Otherwise Lightning would end that epoch a second time, after one more batch.
        """
        super().on_train_start(trainer, pl_module)
        loop: Any = trainer.fit_loop
        if loop.restarted_on_epoch_end:
            loop.epoch_progress.increment_completed()
            loop._restarting = loop.epoch_loop.restarting = False
            loop.reset_restart_stage()
            loop.epoch_loop.reset_restart_stage()


class Predictions(BasePredictionWriter):
    """Writes the images of `nlt predict` as displayed to predictions/ in the run's directory, by sample index.

    With `exr`, it also writes multi-layer EXRs, whose reference is the mean of the two halves.
    """

    def __init__(self) -> None:
        super().__init__(write_interval="batch")
        self.exr = False

    def on_predict_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self.directory = Path(trainer.log_dir or trainer.default_root_dir) / "predictions"
        self.directory.mkdir(parents=True, exist_ok=True)

    def write_on_batch_end(
        self, trainer: Any, pl_module: Any, prediction: Any, indices: Any, batch: Any, *_: Any
    ) -> None:
        images = (255 * display(prediction, batch["exposure"])).round().byte().permute(0, 2, 3, 1).cpu().numpy()
        for index, image in zip(batch["index"].tolist(), images, strict=True):
            Image.fromarray(image).save(self.directory / f"{index:07d}.png")
        if self.exr:
            from nlt.rendering.exr import exr  # here, because it needs Mitsuba

            layers = {"radiance": prediction, **{name: batch[name] for name in BUFFERS}}
            layers["reference"] = (batch["reference_a"] + batch["reference_b"]) / 2
            for row, index in enumerate(batch["index"].tolist()):
                content = exr({name: images[row].float().cpu().numpy() for name, images in layers.items()})
                write_bytes(self.directory / f"{index:07d}.exr", content)

    def on_predict_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if trainer.is_global_zero:
            print(self.directory)
