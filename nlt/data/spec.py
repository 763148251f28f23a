"""The spec of a dataset: its content, its directory and the states in its splits."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, get_type_hints

import numpy as np
from pydantic import AfterValidator, NonNegativeInt, PositiveInt
from pydantic import Field as Bound

from nlt.config import Settings, merge, parse, read_configs
from nlt.data.files import AnyPath, open_path
from nlt.data.sample import FIELDS, POINT_FIELDS, SPLITS, Field
from nlt.errors import UserError
from nlt.scenes.description import Experiment, Integrator, SceneDescription, load_description
from nlt.scenes.state import SceneState, sample_state

FORMAT = 15  # version of the files on disk
_MOST_EVALUATED = 8  # samples in a shard of val or test
_LEAST_SIDE = 8  # of an image, in pixels
_DRAWS = 1000  # attempts to find a state that no other split has


def _not_empty(scenes: list[str]) -> list[str]:
    if not scenes:
        raise ValueError("must be a list of scene names; add a config from configs/data")
    return scenes


@dataclass
class DatasetSpec:
    """The scenes, the experiment and the size of a dataset. Sample counts are per scene.

    Args:
        scenes: names in configs/scenes, or paths of scene.yaml files.
        experiment: static, fixed_lights (Table 1) or moving_lights (Table 2).
        resolution: height and width of the images in pixels.
        crop: height and width of the windows of such images, at random places, that training samples are; 0 for whole
            images. Validation and test samples are whole images.
        train: training samples per scene; with online training, per scene and epoch.
        val: validation samples per scene.
        test: test samples per scene.
        num_points: surface points per scene.
        num_photons: photons per sample.
        noisy_spp: samples per pixel of the paper's training target.
        input_spp: samples per pixel of the denoisers' input.
        target_spp: samples per pixel of the `target`, towards which some methods train that are not in the paper.
        reference_spp: samples per pixel of each of the reference's two halves; with `reference_mse`, the maximum.
        reference_mse: target MSE between the two halves as displayed (sRGB at the scene's exposure). A few pilot views
            of each scene determine the samples per pixel that reach it. With 0, `reference_spp` is used.
        seed: seed of everything random in the dataset.
        shard_size: samples per file; at most 8 in val and test, whose references take a thousand times as long.
        integrator: integrator of noisy, noisy_input, target and reference; "scene" uses the one that scene.yaml names.

    Raises:
        UserError: a value has the wrong type or is out of bounds.
    """

    scenes: Annotated[list[str], AfterValidator(_not_empty)]
    experiment: Experiment = "moving_lights"
    resolution: Annotated[int, Bound(ge=_LEAST_SIDE)] = 64
    crop: NonNegativeInt = 0
    train: NonNegativeInt = 1000
    val: NonNegativeInt = 16
    test: NonNegativeInt = 64
    num_points: PositiveInt = 10_000
    num_photons: PositiveInt = 10_000
    noisy_spp: PositiveInt = 1
    input_spp: PositiveInt = 4
    target_spp: PositiveInt = 16
    reference_spp: PositiveInt = 64
    reference_mse: Annotated[float, Bound(ge=0, allow_inf_nan=False)] = 0.0
    seed: NonNegativeInt = 0
    shard_size: PositiveInt = 64
    integrator: Literal["scene", Integrator] = "scene"

    __pydantic_config__ = Settings.model_config  # in a config file, unknown keys are refused and nothing is converted

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(DatasetSpec, include_extras=True).items():
            setattr(self, name, parse(kind, getattr(self, name), f"data.dataset.{name}"))
        if self.crop and not _LEAST_SIDE <= self.crop <= self.resolution:
            bounds = f"{_LEAST_SIDE} to data.dataset.resolution ({self.resolution})"
            raise UserError(f"data.dataset.crop: must be 0 for whole images, or {bounds}, is {self.crop}")

    @cached_property
    def descriptions(self) -> list[SceneDescription]:
        """The descriptions of the scenes, in order."""
        return [load_description(name) for name in self.scenes]

    def sizes(self, split: str) -> dict[str, int]:
        """Return the sizes that the symbols in the shapes of `FIELDS` stand for in a split."""
        most = max(len(d.movables(self.experiment)) for d in self.descriptions)
        side = self.crop if self.crop and split == "train" else self.resolution
        return {"H": side, "W": side, "P": self.num_photons, "N": self.num_points, "M": most}

    def fields(self, split: str) -> dict[str, Field]:
        """Return the fields that a sample of this split stores."""
        return {name: f for name, f in FIELDS.items() if split in f.splits}

    def count(self, split: str) -> int:
        """Return the number of samples per scene in a split."""
        return int(getattr(self, split))

    def samples(self, fields: Collection[str]) -> int:
        """Return the samples per pixel of the path-traced image that is among a method's `fields`."""
        return self.noisy_spp if "noisy" in fields else self.input_spp

    def has_points_of(self, other: DatasetSpec) -> bool:
        """Whether the points of both datasets are the same, whatever their samples are."""
        origin = lambda spec: (spec.scenes, spec.experiment, spec.num_points, spec.seed)
        return origin(self) == origin(other)

    @property
    def points_nbytes(self) -> int:
        """The size of one scene's points on disk in bytes."""
        sizes = self.sizes("test")
        return sum(field.nbytes(sizes) for field in POINT_FIELDS.values())

    def nbytes(self, split: str) -> int:
        """Return the size of one sample on disk in bytes."""
        sizes = self.sizes(split)
        return sum(field.nbytes(sizes) for field in self.fields(split).values())

    @property
    def has_pilots(self) -> bool:
        """Whether pilot views determine the samples per pixel of the references."""
        return self.reference_mse > 0 and self.val + self.test > 0

    @property
    def manifest(self) -> dict[str, Any]:
        """Everything that determines the dataset's content."""
        from nlt import __version__

        return {
            "format": FORMAT,
            "nlt": __version__,
            "spec": dataclasses.asdict(self),
            "scenes": {d.name: d.digest for d in self.descriptions},
            "exposure": [d.exposure for d in self.descriptions],
            "shards": [shard.name for shard in self.shards()],
        }

    def directory(self, root: str | AnyPath) -> AnyPath:
        """Return the dataset's directory, named by its main properties and a hash of the spec and the scene files."""
        content = {k: v for k, v in self.manifest.items() if k in ("format", "spec", "scenes")}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
        names = "+".join(d.name for d in self.descriptions[:4])
        return open_path(root) / f"{self.experiment}-{names}-{self.resolution}-{digest}"

    def without_train(self) -> DatasetSpec:
        """Return the spec of what online training stores: points, validation and test samples."""
        return dataclasses.replace(self, train=0)

    def shards(self) -> list[Shard]:
        """Return every shard of the dataset, the evaluated splits first."""
        return [
            self.shard(split, scene, start)
            for split in reversed(SPLITS)
            for scene in range(len(self.scenes))
            for start in range(0, self.count(split), self._shard_size(split))
        ]

    def shard(self, split: str, scene: int, row: int) -> Shard:
        """Return the shard that contains sample `row` of a scene."""
        size = self._shard_size(split)
        start = row - row % size
        return Shard(split, scene, start, min(start + size, self.count(split)))

    def _shard_size(self, split: str) -> int:
        return self.shard_size if split == "train" else min(self.shard_size, _MOST_EVALUATED)

    def seeds(self, split: str, scene: int, index: int) -> np.random.SeedSequence:
        """Return the seeds of one sample."""
        return np.random.SeedSequence([self.seed, SPLITS.index(split), scene, index])

    def taken(self, split: str, scene: int) -> set[bytes]:
        """Return the keys of the states that a split avoids: train those of val and test, val those of test."""
        taken: set[bytes] = set()
        for other in reversed(SPLITS[SPLITS.index(split) + 1 :]):
            taken |= {self.state(other, scene, index, taken).key for index in range(self.count(other))}
        return taken

    def state(self, split: str, scene: int, index: int, taken: Collection[bytes]) -> SceneState:
        """Return the state of one sample, also beyond the spec's count, avoiding `taken`, unless nothing can move.

        Raises:
            UserError: no free state was found; the boxes of the scene's objects are too small.
        """
        description = self.descriptions[scene]
        rng = np.random.default_rng(self.seeds(split, scene, index).spawn(1)[0])
        # States can coincide, for example if every object is removed.
        for _ in range(_DRAWS):
            state = sample_state(description, self.experiment, rng)
            if not len(state.present) or state.key not in taken:
                return state
        raise UserError(f"{description.file}: objects: too few different states for three splits; enlarge a box")


@dataclass(frozen=True)
class Shard:
    """A file with the samples from `start` to before `stop` of one scene in one split."""

    split: str
    scene: int
    start: int
    stop: int

    @property
    def size(self) -> int:
        """Number of samples."""
        return self.stop - self.start

    @property
    def name(self) -> str:
        """The file's name, relative to the dataset's directory."""
        return f"{self.split}/{self.scene:03d}-{self.start:07d}.safetensors"


class DataSection(Settings):
    """The section `data` of a config file; generation reads three of the arguments of LightTransportDataModule."""

    dataset: DatasetSpec
    root: str = "datasets"
    online: bool = False
    batch_size: Any = None
    workers: Any = None
    seed: Any = None
    train_images: Any = None
    uses: Any = None


class _Config(Settings):
    data: DataSection
    model: Any = None
    trainer: Any = None
    seed_everything: Any = None
    start_from: Any = None


def load_spec(files: list[str], settings: Collection[tuple[str, str]] = ()) -> tuple[DatasetSpec, AnyPath]:
    """Return the dataset in config files, without training samples that are rendered online, and the root of datasets.

    `settings` are dotted keys with values in YAML, which override the files. Raise UserError if a file cannot be read,
    or if a key is unknown, missing or has an invalid value.
    """
    content = merge({"data": {"dataset": {"scenes": []}}}, read_configs(files, settings))
    places = [*files, *("=".join(setting) for setting in settings)]
    data = parse(_Config, content, " + ".join(places)).data
    return data.dataset.without_train() if data.online else data.dataset, open_path(data.root)
