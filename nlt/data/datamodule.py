"""The one DataModule: batches of samples, of several scenes at once, for every method."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import lightning as L
import numpy as np
import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from nlt.data.files import AnyPath
from nlt.data.sample import BATCH_FIELDS
from nlt.data.spec import DatasetSpec
from nlt.data.store import ShardReader, check_dataset, points_name, read_points
from nlt.errors import UserError
from nlt.scenes.camera import Camera

_TARGETS = {"train": ("noisy",), "val": ("noisy", "reference_a", "reference_b")}
_TARGETS["test"] = _TARGETS["val"]


class LightTransportDataset(Dataset[dict[str, Tensor]]):
    """The samples of one split, as the fields of `FIELDS` and `BATCH_FIELDS` that `inputs` names.

    Args:
        directory: of the dataset.
        spec: what it holds.
        split: train, val or test.
        inputs: fields that the method reads; None for all. The split's target fields come along.
    """

    def __init__(self, directory: AnyPath, spec: DatasetSpec, split: str, inputs: Iterable[str] | None = None) -> None:
        self.directory, self.spec, self.split = directory, spec, split
        self._reader = ShardReader()
        self._points = [read_points(directory / points_name(k)) for k in range(len(spec.scenes))]
        stored = spec.fields(split)
        self._wanted = None if inputs is None else {*inputs, *_TARGETS[split]}
        needed = set(stored) if self._wanted is None else self._wanted & set(stored)
        if self._wants("view_direction"):
            needed |= {"camera_matrix", "world_to_view"}
        if any(self._wants(name) for name in BATCH_FIELDS if name.startswith("point_")):
            needed |= {"translation", "present"}
        self._stored = [name for name in stored if name in needed]

    def _wants(self, name: str) -> bool:
        return self._wanted is None or name in self._wanted

    def __len__(self) -> int:
        return len(self.spec.scenes) * self.spec.count(self.split)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """One sample; floats are float32."""
        scene, row = divmod(index, self.spec.count(self.split))
        shard = self.spec.shard(self.split, scene, row)
        stored = self._reader.read(self.directory / shard.name, row - shard.start, self._stored)
        sample = {name: _tensor(array) for name, array in stored.items()}
        if self._wants("view_direction"):
            size = self.spec.resolution
            camera = Camera(stored["camera_matrix"], stored["world_to_view"], size, size)
            sample["view_direction"] = torch.from_numpy(camera.view_directions())
        sample |= {k: v for k, v in self._point_fields(scene, stored).items() if self._wants(k)}
        sample["scene"], sample["index"] = torch.tensor(scene), torch.tensor(index)
        sample["exposure"] = torch.tensor(self.spec.descriptions[scene].exposure, dtype=torch.float32)
        return sample

    def _point_fields(self, scene: int, stored: dict[str, np.ndarray]) -> dict[str, Tensor]:
        """The static points, moved and hidden as the sample's state says (supplementary, Sec. Datasets)."""
        if "present" not in stored:
            return {}
        points = self._points[scene]
        # Row -1, for what never moves, stays where it is.
        translation = np.concatenate([stored["translation"], np.zeros((1, 3), np.float32)])
        present = np.concatenate([stored["present"], [True]])
        return {
            "point_position": torch.from_numpy(points["position"] + translation[points["object"]]),
            "point_visible": torch.from_numpy(present[points["object"]]),
            "point_material": torch.from_numpy(points["material"].astype(np.int64)),
            "point_albedo": torch.from_numpy(points["albedo"]),
            "point_emission": torch.from_numpy(points["emission"]),
        }


def _tensor(array: np.ndarray) -> Tensor:
    return torch.from_numpy(array.astype(np.float32) if array.dtype == np.float16 else np.array(array))


class EpochSampler(Sampler[int]):
    """This process's part of the dataset: shuffled by (seed, epoch) alone, so that a resumed run continues it.

    While training, every process gets equally many samples and what is left over is dropped; at evaluation,
    each sample is seen once by exactly one process.
    """

    def __init__(self, length: int, rank: int, processes: int, shuffle: bool, seed: int) -> None:
        self.length, self.rank, self.processes, self.shuffle, self.seed = length, rank, processes, shuffle, seed
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Called by Lightning before each epoch."""
        self.epoch = epoch

    def __len__(self) -> int:
        if self.shuffle:
            return self.length // self.processes
        return len(range(self.rank, self.length, self.processes))

    def __iter__(self) -> Iterator[int]:
        order = np.arange(self.length)
        if self.shuffle:
            order = np.random.default_rng([self.seed, self.epoch]).permutation(self.length)
        return iter(order[self.rank :: self.processes][: len(self)].tolist())


class LightTransportDataModule(L.LightningDataModule):
    """Loads a generated dataset.

    Args:
        dataset: what it holds; `nlt generate` makes it.
        root: directory or fsspec URL of datasets.
        batch_size: samples per step and process (paper: 32, static scenes 128).
        workers: processes that load.
        seed: of the shuffling.
    """

    def __init__(
        self,
        dataset: DatasetSpec,
        root: str = "datasets",
        batch_size: int = 32,
        workers: int = 1,
        seed: int = 0,
    ) -> None:
        super().__init__()
        if batch_size < 1:
            raise UserError(f"data.batch_size: must be at least 1, is {batch_size}")
        self.spec, self.root, self.batch_size, self.workers, self.seed = dataset, root, batch_size, workers, seed
        self.directory: AnyPath | None = None

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
            directory = self.spec.directory(self.root)
            check_dataset(directory, self.spec)
            self.directory = directory

    def split(self, name: str) -> LightTransportDataset:
        """The dataset of a split, with the fields that the trainer's method needs; all without a trainer."""
        assert self.directory is not None, "call setup first"
        module = getattr(self.trainer, "lightning_module", None)
        return LightTransportDataset(self.directory, self.spec, name, getattr(module, "inputs", None))

    def _loader(self, name: str) -> DataLoader:
        dataset, training = self.split(name), name == "train"
        rank, processes = (self.trainer.global_rank, self.trainer.world_size) if self.trainer else (0, 1)
        if len(dataset) == 0:
            raise UserError(f"data.dataset.{name}: is 0; this command needs {name} samples")
        if training and len(dataset) // processes < self.batch_size:
            raise UserError(f"data.batch_size: {self.batch_size} is more than the {len(dataset)} training samples")
        return DataLoader(
            dataset,
            batch_size=self.batch_size,
            sampler=EpochSampler(len(dataset), rank, processes, training, self.seed),
            drop_last=training,
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
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
