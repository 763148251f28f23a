"""The spec of a dataset: its content, its directory and the states in its splits."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

import numpy as np

from nlt.config import read_configs
from nlt.data.files import AnyPath, open_path
from nlt.data.sample import FIELDS, SPLITS, Field
from nlt.errors import UserError
from nlt.scenes.description import EXPERIMENTS, TEACHERS, Experiment, SceneDescription, Teacher, load_description
from nlt.scenes.state import SceneState, sample_state

FORMAT = 3  # version of the files on disk
# Keys of a config file, and of its `data` section, which has the arguments of LightTransportDataModule.
SECTIONS = ("data", "model", "trainer", "seed_everything")
DATA = ("dataset", "root", "batch_size", "workers", "seed", "online", "train_images")
_DRAWS = 1000  # attempts to find a state that no other split has


@dataclass
class DatasetSpec:
    """The scenes, the experiment and the size of a dataset. Sample counts are per scene.

    Args:
        scenes: names in configs/scenes, or paths of scene.yaml files.
        experiment: static, fixed_lights (Table 1) or moving_lights (Table 2).
        resolution: height and width of the images in pixels.
        train: training samples per scene; with online training, per scene and epoch.
        val: validation samples per scene.
        test: test samples per scene.
        points: surface points per scene.
        photons: photons per sample.
        noisy_spp: samples per pixel of the training target.
        input_spp: samples per pixel of the denoisers' input.
        reference_spp: samples per pixel of each of the reference's two halves; with `reference_mse`, the maximum.
        reference_mse: target MSE between the two halves as displayed (sRGB at the scene's exposure). A few pilot views
            of each scene determine the samples per pixel that reach it. With 0, `reference_spp` is used.
        seed: seed of everything random in the dataset.
        shard_size: samples per file.
        teacher: integrator of noisy, noisy_input and reference; "scene" uses the one that scene.yaml names.
    """

    scenes: list[str]
    experiment: Experiment = "moving_lights"
    resolution: int = 64
    train: int = 1000
    val: int = 16
    test: int = 64
    points: int = 10_000
    photons: int = 10_000
    noisy_spp: int = 1
    input_spp: int = 4
    reference_spp: int = 64
    reference_mse: float = 0.0
    seed: int = 0
    shard_size: int = 64
    teacher: Literal["scene", Teacher] = "scene"

    def __post_init__(self) -> None:
        at = "data.dataset"
        if not isinstance(self.scenes, list) or not self.scenes:
            raise UserError(f"{at}.scenes: must be a list of scene names, is {self.scenes!r}")
        if self.experiment not in EXPERIMENTS:
            raise UserError(f"{at}.experiment: must be one of {', '.join(EXPERIMENTS)}, is {self.experiment!r}")
        if self.teacher not in ("scene", *TEACHERS):
            raise UserError(f"{at}.teacher: must be one of scene, {', '.join(TEACHERS)}, is {self.teacher!r}")
        least = {"resolution": 8, "seed": 0, **dict.fromkeys(SPLITS, 0)}
        for field in dataclasses.fields(self):
            if field.type != "int":
                continue
            value, low = getattr(self, field.name), least.get(field.name, 1)
            if isinstance(value, bool) or not isinstance(value, int) or value < low:
                raise UserError(f"{at}.{field.name}: must be a whole number of at least {low}, is {value!r}")
        mse = self.reference_mse
        if isinstance(mse, bool) or not isinstance(mse, int | float) or not 0 <= mse < math.inf:
            raise UserError(f"{at}.reference_mse: must be a number of at least 0, written as 1.0e-4, is {mse!r}")
        self.reference_mse = float(mse)  # so that 0 and 0.0 give the same directory

    @cached_property
    def descriptions(self) -> list[SceneDescription]:
        """The descriptions of the scenes, in order."""
        return [load_description(name) for name in self.scenes]

    @property
    def sizes(self) -> dict[str, int]:
        """The sizes that the symbols in the shapes of `FIELDS` stand for."""
        most = max(len(d.movables(self.experiment)) for d in self.descriptions)
        return {"H": self.resolution, "W": self.resolution, "P": self.photons, "N": self.points, "M": most}

    def fields(self, split: str) -> dict[str, Field]:
        """Return the fields that a sample of this split stores."""
        return {name: f for name, f in FIELDS.items() if split != "train" or not f.reference_only}

    def count(self, split: str) -> int:
        """Return the number of samples per scene in a split."""
        return int(getattr(self, split))

    def nbytes(self, split: str) -> int:
        """Return the size of one sample on disk in bytes."""
        sizes = self.sizes
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
            for start in range(0, self.count(split), self.shard_size)
        ]

    def shard(self, split: str, scene: int, row: int) -> Shard:
        """Return the shard that contains sample `row` of a scene."""
        start = row - row % self.shard_size
        return Shard(split, scene, start, min(start + self.shard_size, self.count(split)))

    def seeds(self, split: str, scene: int, index: int) -> np.random.SeedSequence:
        """Return the seeds of one sample."""
        return np.random.SeedSequence([self.seed, SPLITS.index(split), scene, index])

    def states(self, scene: int) -> dict[str, list[SceneState]]:
        """Return the states of a scene's samples by split. No state is in two splits, unless nothing can move."""
        taken: set[bytes] = set()
        states: dict[str, list[SceneState]] = {}
        for split in reversed(SPLITS):
            states[split] = [self.state(split, scene, index, taken) for index in range(self.count(split))]
            taken |= {state.key for state in states[split]}
        return states

    def state(self, split: str, scene: int, index: int, taken: Collection[bytes]) -> SceneState:
        """Return the state of one sample, also beyond the spec's count, avoiding the states `taken` by other splits.

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
    def name(self) -> str:
        """The file's name, relative to the dataset's directory."""
        return f"{self.split}/{self.scene:03d}-{self.start:07d}.safetensors"


def check_keys(place: str, content: Mapping[str, Any], known: Collection[str], needed: Collection[str] = ()) -> None:
    """Raise UserError if a config section has an unknown key or lacks a required one."""
    for key in content:
        if key not in known:
            raise UserError(f"{place}{key}: unknown key; known are {', '.join(known)}")
    for key in needed:
        if key not in content:
            raise UserError(f"{place}{key}: missing")


def load_spec(files: list[str]) -> tuple[DatasetSpec, AnyPath]:
    """Return the dataset in config files, without training samples that are rendered online, and the root of datasets.

    Raises:
        UserError: a file cannot be read, or has an unknown, missing or invalid key.
    """
    where = " + ".join(files)
    merged = read_configs(files)
    data = merged.get("data")
    if not isinstance(data, Mapping) or not isinstance(data.get("dataset"), Mapping):
        raise UserError(f"{where}: data.dataset: missing; add a config from configs/data")
    dataset = tuple(field.name for field in dataclasses.fields(DatasetSpec))
    sections = (("", merged, SECTIONS), ("data.", data, DATA), ("data.dataset.", data["dataset"], dataset))
    for section, content, known in sections:
        check_keys(f"{where}: {section}", content, known)
    if "scenes" not in data["dataset"]:
        raise UserError(f"{where}: data.dataset.scenes: missing; add a config from configs/data")
    spec, online = DatasetSpec(**data["dataset"]), data.get("online", False)
    if not isinstance(online, bool):
        raise UserError(f"{where}: data.online: must be true or false, is {online!r}")
    return spec.without_train() if online else spec, open_path(data.get("root", "datasets"))
