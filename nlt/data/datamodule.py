"""The one DataModule: batches of samples, of several scenes at once, for every method."""

from __future__ import annotations

import dataclasses
from functools import partial
from typing import Any

import lightning as L
import torch
from torch.utils.data import DataLoader, Sampler

from nlt.data.dataset import EpochSampler, LightTransportDataset, OnlineSampler, identity_collate
from nlt.data.engines import available_cpus
from nlt.data.files import AnyPath
from nlt.data.loader import ThreadLoader
from nlt.data.spec import DatasetSpec
from nlt.data.store import check_dataset, points_crc, points_name, read_points
from nlt.errors import UserError


class LightTransportDataModule(L.LightningDataModule):
    """Loads a generated dataset.

    Args:
        dataset: what it holds; `nlt generate` makes it.
        root: directory or fsspec URL of datasets.
        batch_size: samples per step and process (paper: 32, static scenes 128).
        workers: threads that load; online, processes that render.
        seed: of the shuffling; online, of which samples there are.
        online: render the training samples while training, each for one step alone, and store none. An epoch is
            as many as `dataset.train` says; validation and test samples are generated and stored as ever.
        train_images: train on the first so many of each scene's samples alone; an epoch has as many steps as with all.
    """

    def __init__(
        self,
        dataset: DatasetSpec,
        root: str = "datasets",
        batch_size: int = 32,
        workers: int = 1,
        seed: int = 0,
        online: bool = False,
        train_images: int | None = None,
    ) -> None:
        super().__init__()
        if online and workers < 1:
            raise UserError(f"data.workers: must be at least 1, is {workers}: with data.online, they render")
        if batch_size < 1:
            raise UserError(f"data.batch_size: must be at least 1, is {batch_size}")
        if train_images is not None and (online or not 1 <= train_images <= dataset.train):
            raise UserError(
                f"data.train_images: must be 1 to data.dataset.train ({dataset.train}), and not with data.online, "
                f"is {train_images}"
            )
        self.spec, self.root, self.batch_size, self.workers, self.seed = dataset, root, batch_size, workers, seed
        self.online, self.passes, self.train_images = online, 0, train_images
        self.stored = dataset.without_train() if online else dataset
        self.directory: AnyPath | None = None
        self.points: list[int] = []

    def next_pass(self) -> int:
        """Which pass over the online samples begins; each comes once."""
        self.passes += 1
        return self.passes - 1

    def state_dict(self) -> dict[str, Any]:
        """For checkpoints: of which points the embeddings are, a CRC of each scene's; how many passes over online
        samples were begun, behind which a resumed run goes on."""
        return {"points": self.points, "passes": self.passes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Go on where a checkpoint's run was.

        Raises:
            UserError: the method has embeddings, of other points than the dataset's.
        """
        self.passes = state_dict.get("passes", 0)
        points, method = state_dict.get("points"), getattr(self.trainer, "lightning_module", None)
        if getattr(method, "has_point_embeddings", False) and points and self.points and points != self.points:
            raise UserError(
                f"{self.directory}: has other points than those that the checkpoint's embeddings are of, as when it is "
                "rendered with another NLT_VARIANT; give --data.root with the checkpoint's own dataset, or train anew"
            )

    @property
    def num_scenes(self) -> int:
        """Scenes in the dataset: each has its own embeddings."""
        return len(self.spec.scenes)

    @property
    def num_points(self) -> int:
        """Points per scene."""
        return self.spec.points

    def setup(self, stage: str) -> None:
        """Check the manifest.

        Raises:
            UserError: the dataset is missing, incomplete, or another one.
        """
        if self.directory is None:
            directory = self.stored.directory(self.root)
            check_dataset(directory, self.stored)
            self.directory = directory
            self.points = [points_crc(read_points(directory / points_name(k))) for k in range(self.num_scenes)]

    def split(self, name: str) -> LightTransportDataset:
        """The dataset of a split, with the fields that the trainer's method needs; all without a trainer."""
        assert self.directory is not None, "call setup first"
        module = getattr(self.trainer, "lightning_module", None)
        fields = getattr(module, "fields", None)
        if self.online and name == "train":
            from nlt.data.online import OnlineDataset  # which needs Mitsuba

            devices = self.trainer.num_devices if self.trainer else 1
            threads = max(1, available_cpus() // (self.workers * devices))
            return OnlineDataset(self.directory, self.stored, fields, self.num_scenes * self.spec.train, threads)
        few = name == "train" and self.train_images
        spec = dataclasses.replace(self.stored, train=few) if few else self.stored
        return LightTransportDataset(self.directory, spec, name, fields)

    def _loader(self, name: str) -> DataLoader:
        dataset, training = self.split(name), name == "train"
        rank, processes = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        if len(dataset) == 0:
            raise UserError(f"data.dataset.{name}: is 0; this command needs {name} samples")
        length = self.num_scenes * self.spec.train if training else len(dataset)
        if training and length // processes < self.batch_size:
            raise UserError(f"data.batch_size: {self.batch_size} is more than the {length} training samples")
        online = training and self.online
        sampler: Sampler[int] = EpochSampler(length, rank, processes, training, self.seed, len(dataset))
        if online:
            sampler = OnlineSampler(len(dataset), rank, processes, self.seed, self.next_pass)
        # Rendering needs processes, for Mitsuba; it starts threads, which a fork would lose. No leak: the memory of one
        # scene's renderer stays.
        kind = partial(DataLoader, multiprocessing_context="spawn", persistent_workers=True) if online else ThreadLoader
        return kind(
            dataset,
            batch_size=self.batch_size,
            sampler=sampler,
            drop_last=training,
            collate_fn=identity_collate,
            num_workers=self.workers,
            pin_memory=torch.cuda.is_available(),
        )

    def train_dataloader(self) -> DataLoader:
        """Shuffled training samples."""
        return self._loader("train")

    def val_dataloader(self) -> DataLoader:
        """Validation samples, in order."""
        return self._loader("val")

    def test_dataloader(self) -> DataLoader:
        """Test samples, in order."""
        return self._loader("test")

    def predict_dataloader(self) -> DataLoader:
        """Test samples, in order."""
        return self._loader("test")
