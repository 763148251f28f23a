"""TensorBoard images during training: 1-spp image, prediction, reference and error of a few samples."""

from typing import Any

import lightning as L
import torch
from lightning.pytorch.loggers import TensorBoardLogger
from torch import Tensor

from nlt.display import display


class ImageGrid(L.Callback):
    """Logs the image "val/images", with one row for each of the first `images` samples.

    The image is drawn at the first validation, then at the first validation that is at least `every_n_epochs` epochs
    after the last image. The columns, after the display transform: 1-spp image, prediction, reference, and the
    absolute difference of the last two. Does nothing without a TensorBoard logger and on ranks other than 0.
    """

    def __init__(self, every_n_epochs: int = 5, images: int = 4) -> None:
        self.every_n_epochs = every_n_epochs
        self.images = images
        self._rows: list[Tensor] = []
        self._drawn: int | None = None  # epoch of the last image

    def _active(self, trainer: L.Trainer) -> bool:
        # Counted from the last image: validation may never fall on a multiple of every_n_epochs.
        due = self._drawn is None or trainer.current_epoch - self._drawn >= self.every_n_epochs
        return due and trainer.is_global_zero and not trainer.sanity_checking

    def on_validation_epoch_start(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        self._rows = []

    def on_validation_batch_end(
        self,
        trainer: L.Trainer,
        pl_module: L.LightningModule,
        outputs: Any,
        batch: dict[str, Tensor],
        batch_idx: int,
        dataloader_idx: int = 0,
    ) -> None:
        if not self._active(trainer) or len(self._rows) >= self.images:
            return
        reference = (batch["reference_a"] + batch["reference_b"]) / 2
        columns = [batch["noisy"], outputs, reference, (outputs - reference).abs()]
        rows = torch.cat([display(x, batch["exposure"]) for x in columns], dim=-1)
        self._rows += rows[: self.images - len(self._rows)].cpu()

    def on_validation_epoch_end(self, trainer: L.Trainer, pl_module: L.LightningModule) -> None:
        if not self._active(trainer) or not self._rows:
            return
        self._drawn = trainer.current_epoch
        grid = torch.cat(self._rows, dim=-2)
        for logger in trainer.loggers:
            if isinstance(logger, TensorBoardLogger):
                logger.experiment.add_image("val/images", grid, trainer.global_step)
