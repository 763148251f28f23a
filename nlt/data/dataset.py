"""Datasets that return samples as tensors, and their samplers. Rendering processes import this, so keep it light."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.utils.data import Dataset, Sampler

from nlt.data.files import AnyPath
from nlt.data.sample import BATCH_FIELDS
from nlt.data.spec import DatasetSpec
from nlt.data.store import Points, ShardReader, points_name, read_points
from nlt.scenes.camera import Camera

_TARGETS = {"train": ("noisy",), "val": ("noisy", "reference_a", "reference_b")}
_TARGETS["test"] = _TARGETS["val"]


class SampleTensors:
    """Converts stored samples to tensors; adds those of `BATCH_FIELDS` that are `wanted`, or all if it is None.

    `points` has the point cloud of each scene, by the scene's index.
    """

    def __init__(self, spec: DatasetSpec, points: Mapping[int, Points], wanted: Set[str] | None = None) -> None:
        self._spec, self._points, self._wanted = spec, points, wanted
        self._static = {
            scene: {
                "point_material": torch.from_numpy(cloud["material"].astype(np.int64)),
                "point_albedo": torch.from_numpy(cloud["albedo"]),
                "point_emission": torch.from_numpy(cloud["emission"]),
            }
            for scene, cloud in points.items()
        }

    def wants(self, name: str) -> bool:
        """Return whether a field is wanted."""
        return self._wanted is None or name in self._wanted

    def __call__(self, scene: int, stored: Mapping[str, np.ndarray], index: int = 0) -> dict[str, Tensor]:
        """Return a sample of a scene as tensors; `index` is its index in the split."""
        sample = {name: torch.from_numpy(array) for name, array in stored.items()}
        if self.wants("view_direction"):
            height, width = stored["noisy"].shape[-2:]
            camera = Camera(stored["camera_matrix"], stored["world_to_view"], width, height)
            sample["view_direction"] = torch.from_numpy(camera.view_directions())
        if "present" in stored:
            position, visible = place_points(self._points[scene], stored["translation"], stored["present"])
            moved = {"point_position": torch.from_numpy(position), "point_visible": torch.from_numpy(visible)}
            sample |= {k: v for k, v in (moved | self._static[scene]).items() if self.wants(k)}
        sample["scene"], sample["index"] = torch.tensor(scene), torch.tensor(index)
        sample["exposure"] = torch.tensor(self._spec.descriptions[scene].exposure, dtype=torch.float32)
        return sample


class LightTransportDataset(Dataset[dict[str, Tensor]]):
    """The samples of a split (train, val or test), as the fields of `FIELDS` and `BATCH_FIELDS` that `inputs` names.

    If `inputs` is None, they have all fields. The split's target fields are always added.
    """

    def __init__(self, directory: AnyPath, spec: DatasetSpec, split: str, inputs: Iterable[str] | None = None) -> None:
        self.directory, self.spec, self.split = directory, spec, split
        self._reader = ShardReader()
        points = {k: read_points(directory / points_name(k)) for k in range(len(spec.scenes))}
        stored = spec.fields(split)
        wanted = None if inputs is None else {*inputs, *_TARGETS[split]}
        self._tensors = SampleTensors(spec, points, wanted)
        needed = set(stored) if wanted is None else wanted & set(stored)
        if self._tensors.wants("view_direction"):
            needed |= {"camera_matrix", "world_to_view"}
        if any(self._tensors.wants(name) for name in BATCH_FIELDS if name.startswith("point_")):
            needed |= {"translation", "present"}
        self._stored = [name for name in stored if name in needed]

    def __len__(self) -> int:
        return len(self.spec.scenes) * self.spec.count(self.split)

    def __getitem__(self, index: int) -> dict[str, Tensor]:
        """Return one sample; floats are float32."""
        return {name: tensor[0] for name, tensor in self.__getitems__([index]).items()}

    def __getitems__(self, indices: list[int]) -> dict[str, Tensor]:
        """Return a collated batch, copying each value once; a `DataLoader` needs `identity_collate` for it."""
        return collate([self._tensors(*self._sample(index), index) for index in indices])

    def _sample(self, index: int) -> tuple[int, dict[str, np.ndarray]]:
        """Return the scene of a sample and its stored arrays."""
        scene, row = divmod(index, self.spec.count(self.split))
        shard = self.spec.shard(self.split, scene, row)
        return scene, self._reader.read(self.directory / shard.name, row - shard.start, self._stored)


def place_points(
    points: dict[str, np.ndarray], translation: np.ndarray, present: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return positions (N, 3), metres, and visibility (N,) of a scene's points in a state (supplementary, Datasets).

    `translation` (M, 3), metres, and `present` (M,) are those of the movable objects.
    """
    # Static points have object index -1 and so select the appended row, which leaves them in place.
    translation, present = np.concatenate([translation, np.zeros((1, 3), np.float32)]), np.append(present, True)
    return points["position"] + translation[points["object"]], present[points["object"]]


def collate(samples: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Collate samples into a batch; float16 becomes float32."""
    return {name: stack([sample[name] for sample in samples]) for name in samples[0]}


def identity_collate(batch: Any) -> Any:
    """Return the batch unchanged; a `DataLoader` needs it as its collate_fn because the dataset already collates."""
    return batch


def contiguous_collate(batch: Any) -> Any:
    """Return the batch with memory of its own for every tensor, without which a tensor cannot be pinned."""
    return {name: tensor.contiguous() for name, tensor in batch.items()}


def stack(tensors: list[Tensor]) -> Tensor:
    """Stack tensors, float16 as float32. A tensor shared by all samples, such as a scene's points, is not copied."""
    dtype = tensors[0].dtype
    if dtype != torch.float16 and all(tensor is tensors[0] for tensor in tensors):
        return tensors[0].expand(len(tensors), *tensors[0].shape)
    out = torch.empty(len(tensors), *tensors[0].shape, dtype=torch.float32 if dtype == torch.float16 else dtype)
    for row, tensor in zip(out, tensors, strict=True):
        row.copy_(tensor)
    return out


class EpochSampler(Sampler[int]):
    """This process's indices, shuffled by (seed, epoch) only so that a resumed run continues in the same order.

    In training, every process gets the same number of samples and the remainder is dropped. In evaluation, each sample
    is read once, by exactly one process. If `distinct`, the number of samples in the dataset, is smaller than the
    epoch's `length`, all samples are repeated in new orders until the epoch is full.
    """

    def __init__(
        self, length: int, rank: int, processes: int, shuffle: bool, seed: int, distinct: int | None = None
    ) -> None:
        self.length, self.rank, self.processes, self.shuffle, self.seed = length, rank, processes, shuffle, seed
        self.distinct = distinct or length
        self.epoch = 0

    def set_epoch(self, epoch: int) -> None:
        """Set the epoch; Lightning calls this before each one."""
        self.epoch = epoch

    def __len__(self) -> int:
        if self.shuffle:
            return self.length // self.processes
        return len(range(self.rank, self.length, self.processes))

    def __iter__(self) -> Iterator[int]:
        order = np.arange(self.length)
        if self.shuffle:
            rng = np.random.default_rng([self.seed, self.epoch])
            rounds = [rng.permutation(self.distinct) for _ in range(0, self.length, self.distinct)]
            order = np.concatenate(rounds)[: self.length]
        return iter(order[self.rank :: self.processes][: len(self)].tolist())


class OnlineSampler(EpochSampler):
    """This process's indices in an endless sequence of samples; each pass takes the next `length` of them.

    `next_pass` counts the passes. Lightning's epochs cannot: a run that stopped within an epoch resumes that epoch and
    would repeat its samples.
    """

    def __init__(self, length: int, rank: int, processes: int, seed: int, next_pass: Callable[[], int]) -> None:
        super().__init__(length, rank, processes, shuffle=True, seed=seed)
        self.next_pass = next_pass

    def __iter__(self) -> Iterator[int]:
        first = (self.seed << 32) + self.next_pass() * self.length  # different seeds share no index
        return iter(range(first + self.rank, first + self.length, self.processes)[: len(self)])
