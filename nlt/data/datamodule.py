"""The DataModule of every method: batches of samples from one or several scenes."""

import dataclasses
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import lightning as L
import numpy as np
import torch
from torch.utils.data import DataLoader, Sampler

from nlt.data.dataset import (
    EpochSampler,
    LightTransportDataset,
    OnlineSampler,
    contiguous_collate,
    identity_collate,
)
from nlt.data.engines import available_cpus
from nlt.data.files import AnyPath
from nlt.data.sample import BUFFERS
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, check_dataset, points_name, read_points
from nlt.errors import UserError

_AHEAD = 2  # batches that each reading thread may be ahead


class ThreadLoader(DataLoader):
    """A DataLoader whose `num_workers` are threads; it returns the same batches in the same order.

    Reading consists of copies, CRCs and arithmetic on whole arrays, all of which run without Python's global
    interpreter lock. The first access to memory shared between processes would cost more than all of them: 0.8 ms per
    MB on a virtual machine.
    """

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        if self.num_workers == 0:
            yield from super().__iter__()
            return
        # With more than one torch thread per reader, the threads would spin while they wait for each other.
        torch.set_num_threads(torch.get_num_threads())  # unless it is set, this thread takes over the readers' number
        pool = ThreadPoolExecutor(self.num_workers, "reader", torch.set_num_threads, (1,))
        ahead: deque[Future] = deque()
        try:
            for indices in self.batch_sampler or ():
                ahead.append(pool.submit(self._read, indices))
                if len(ahead) > _AHEAD * self.num_workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _read(self, indices: list[int]) -> Any:
        batch = self.collate_fn(self.dataset.__getitems__(indices))  # type: ignore[attr-defined]
        return {name: tensor.pin_memory() for name, tensor in batch.items()} if self.pin_memory else batch


class LightTransportDataModule(L.LightningDataModule):
    """Loads a generated dataset.

    Args:
        dataset: the dataset's spec; `nlt generate` renders the dataset.
        root: directory or fsspec URL of datasets.
        batch_size: samples per step and process (paper: 32, or 128 for static scenes).
        workers: threads that load samples; with `online`, processes that render them, on half of the CPUs if the
            method trains on the other half.
        seed: seed of the shuffling; with `online`, of the training samples.
        online: render training samples during training and store none. An epoch has
            `dataset.train` samples per scene. Validation and test samples are still generated and stored.
        uses: with `online`, steps that use each rendered sample, on average.
        train_images: use only this many training samples of each scene; the number of steps per epoch stays the same.
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
        uses: int = 1,
    ) -> None:
        super().__init__()
        if online and workers < 1:
            raise UserError(f"data.workers: must be at least 1, is {workers}: with data.online, they render samples")
        if uses < 1 or (uses > 1 and not online):
            raise UserError(f"data.uses: must be at least 1, and 1 without data.online, is {uses}")
        if batch_size < 1:
            raise UserError(f"data.batch_size: must be at least 1, is {batch_size}")
        if train_images is not None and (online or not 1 <= train_images <= dataset.train):
            raise UserError(
                f"data.train_images: must be 1 to data.dataset.train ({dataset.train}) and not set with data.online, "
                f"is {train_images}"
            )
        self.spec, self.root, self.batch_size, self.workers, self.seed = dataset, root, batch_size, workers, seed
        self.online, self.passes, self.train_images, self.uses = online, 0, train_images, uses
        self.num_scenes = len(dataset.scenes)
        self.stored = dataset.without_train() if online else dataset
        self.gbuffer = False  # whether samples have the whole G-buffer, whatever the method reads
        self.directory: AnyPath | None = None
        self.points: list[Points] = []

    def next_pass(self) -> int:
        """Return the index of the next pass over the online samples and count it."""
        self.passes += 1
        return self.passes - 1

    def state_dict(self) -> dict[str, Any]:
        """Return a checkpoint's state: each scene's points, to which embeddings belong, and online passes so far."""
        points = [{name: torch.from_numpy(array) for name, array in each.items()} for each in self.points]
        return {"points": points, "passes": self.passes}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """Restore a checkpoint's state; raise UserError if its embeddings belong to other points than the dataset's."""
        self.passes = state_dict.get("passes", 0)
        theirs, ours = state_dict.get("points"), self.points
        positions = lambda points: np.concatenate([each["position"] for each in points])
        method = getattr(self.trainer, "lightning_module", None)
        embeds = getattr(method, "has_point_embeddings", False)
        if embeds and theirs and ours and not np.array_equal(positions(theirs), positions(ours)):
            raise UserError(
                f"{self.directory}: its points differ from those of the checkpoint's embeddings, for example because "
                "another NLT_VARIANT rendered it; give --data.root with the checkpoint's own dataset, or train again"
            )

    def setup(self, stage: str) -> None:
        """Read the dataset's points; raise UserError if it is missing, incomplete or has another spec."""
        if self.directory is None:
            directory = self.stored.directory(self.root)
            check_dataset(directory, self.stored)
            self.directory = directory
            self.points = [read_points(directory / points_name(k)) for k in range(self.num_scenes)]

    def _rendering_cpus(self) -> int:
        """Return how many CPUs render online: all, or a half if the method trains on the others.

        Threads that wait for a CPU slow down all others, so the two must not share one.
        """
        cpus = available_cpus()
        return max(1, cpus // 2) if self.trainer and self.trainer.strategy.root_device.type == "cpu" else cpus

    def split(self, name: str) -> LightTransportDataset:
        """Return the dataset of a split with the fields that the trainer's method needs, or all without a trainer."""
        assert self.directory is not None, "call setup first"
        module = getattr(self.trainer, "lightning_module", None)
        fields = getattr(module, "training_fields", None)
        if fields and self.gbuffer:
            fields = (*fields, *BUFFERS)
        if self.online and name == "train":
            from nlt.data.online import OnlineDataset  # here, because it needs Mitsuba

            devices = self.trainer.num_devices if self.trainer else 1
            threads = max(1, self._rendering_cpus() // (self.workers * devices))
            length = self.num_scenes * self.spec.train
            return OnlineDataset(self.directory, self.stored, fields, length, threads, self.uses)
        limit = name == "train" and self.train_images
        spec = dataclasses.replace(self.stored, train=limit) if limit else self.stored
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
            if self.trainer and (rest := available_cpus() - self._rendering_cpus()):
                torch.set_num_threads(min(torch.get_num_threads(), max(1, rest // self.trainer.num_devices)))
        # Mitsuba needs processes of its own, spawned because a fork would lose its threads. They may live long because
        # the memory of a single scene's renderer does not grow.
        pinned = torch.cuda.is_available()
        kind = partial(DataLoader, multiprocessing_context="spawn", persistent_workers=True) if online else ThreadLoader
        return kind(
            dataset,
            batch_size=self.batch_size,
            sampler=sampler,
            drop_last=training,
            collate_fn=contiguous_collate if pinned else identity_collate,
            num_workers=self.workers,
            pin_memory=pinned,
        )

    def train_dataloader(self) -> DataLoader:
        """Return a loader of shuffled training samples."""
        return self._loader("train")

    def val_dataloader(self) -> DataLoader:
        """Return a loader of the validation samples in order."""
        return self._loader("val")

    def test_dataloader(self) -> DataLoader:
        """Return a loader of the test samples in order."""
        return self._loader("test")

    predict_dataloader = test_dataloader
