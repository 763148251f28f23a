"""What a dataset is made of, where it lies, and which states its splits hold."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
import yaml

from nlt.data.files import AnyPath, open_path
from nlt.data.sample import FIELDS, SPLITS, Field
from nlt.errors import UserError
from nlt.scenes.description import EXPERIMENTS, TEACHERS, Experiment, SceneDescription, Teacher, load_description
from nlt.scenes.state import SceneState, sample_state

FORMAT = 3  # of the files on disk
# Keys of a config file, and of its section `data`: the arguments of LightTransportDataModule.
SECTIONS = ("data", "model", "trainer", "seed_everything")
DATA = ("dataset", "root", "batch_size", "workers", "seed", "online", "train_images")
_DRAWS = 1000  # of a state that no other split has


@dataclass
class DatasetSpec:
    """A dataset: of which scenes, in which experiment, how large. Counts of samples are per scene.

    Args:
        scenes: names in configs/scenes, or paths of scene.yaml files.
        experiment: static, fixed_lights (Table 1) or moving_lights (Table 2).
        resolution: height and width of the images in pixels.
        train: training samples per scene; of online training, in an epoch.
        val: validation samples per scene.
        test: test samples per scene.
        points: surface points per scene.
        photons: photons per sample.
        noisy_spp: samples per pixel of the training target.
        input_spp: samples per pixel of the denoisers' input.
        reference_spp: samples per pixel of each of the reference's two halves; with `reference_mse`, the most.
        reference_mse: how large the MSE between the two halves may be, as displayed (sRGB at the scene's exposure).
            A few pilot views of each scene choose the samples per pixel that reach it. With 0, it is `reference_spp`.
        seed: of everything random in it.
        shard_size: samples per file.
        teacher: the integrator of noisy, noisy_input and reference; "scene": the one that scene.yaml names.
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
        self.reference_mse = float(mse)  # 0 and 0.0 name the same directory

    @cached_property
    def descriptions(self) -> list[SceneDescription]:
        """Of the scenes, in order."""
        return [load_description(name) for name in self.scenes]

    @property
    def sizes(self) -> dict[str, int]:
        """The numbers behind the symbols in the shapes of `FIELDS`."""
        most = max(len(d.movables(self.experiment)) for d in self.descriptions)
        return {"H": self.resolution, "W": self.resolution, "P": self.photons, "N": self.points, "M": most}

    def fields(self, split: str) -> dict[str, Field]:
        """What a sample of this split stores."""
        return {name: f for name, f in FIELDS.items() if split != "train" or not f.reference_only}

    def count(self, split: str) -> int:
        """Samples per scene."""
        return int(getattr(self, split))

    def nbytes(self, split: str) -> int:
        """Bytes on disk of one sample."""
        sizes = self.sizes
        return sum(field.nbytes(sizes) for field in self.fields(split).values())

    @property
    def has_pilots(self) -> bool:
        """Whether pilot views choose how many samples per pixel the references have."""
        return self.reference_mse > 0 and self.val + self.test > 0

    @property
    def manifest(self) -> dict[str, Any]:
        """Everything that decides the dataset's content."""
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
        """Where the dataset lies: a name that says what it is, and a hash of the spec and the scenes' files."""
        content = {k: v for k, v in self.manifest.items() if k in ("format", "spec", "scenes")}
        digest = hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:8]
        names = "+".join(d.name for d in self.descriptions[:4])
        return open_path(root) / f"{self.experiment}-{names}-{self.resolution}-{digest}"

    def without_train(self) -> DatasetSpec:
        """What online training stores of it: its samples for validation and test, and its points."""
        return dataclasses.replace(self, train=0)

    def shards(self) -> list[Shard]:
        """Every shard of the dataset, the evaluated splits first."""
        return [
            self.shard(split, scene, start)
            for split in reversed(SPLITS)
            for scene in range(len(self.scenes))
            for start in range(0, self.count(split), self.shard_size)
        ]

    def shard(self, split: str, scene: int, row: int) -> Shard:
        """The shard that holds a scene's sample `row`."""
        start = row - row % self.shard_size
        return Shard(split, scene, start, min(start + self.shard_size, self.count(split)))

    def seeds(self, split: str, scene: int, index: int) -> np.random.SeedSequence:
        """The seeds of one sample."""
        return np.random.SeedSequence([self.seed, SPLITS.index(split), scene, index])

    def states(self, scene: int) -> dict[str, list[SceneState]]:
        """The state of every sample of a scene. No state is in two splits, unless nothing can move."""
        taken: set[bytes] = set()
        states: dict[str, list[SceneState]] = {}
        for split in reversed(SPLITS):
            states[split] = [self.state(split, scene, index, taken) for index in range(self.count(split))]
            taken |= {state.key for state in states[split]}
        return states

    def state(self, split: str, scene: int, index: int, taken: Collection[bytes]) -> SceneState:
        """The state of one sample, of whatever index, that is none of those `taken` by other splits."""
        description = self.descriptions[scene]
        rng = np.random.default_rng(self.seeds(split, scene, index).spawn(1)[0])
        # With every object removed, two states are equal.
        for _ in range(_DRAWS):
            state = sample_state(description, self.experiment, rng)
            if not len(state.present) or state.key not in taken:
                return state
        raise UserError(f"{description.file}: objects: too few states for three splits; widen a box")


@dataclass(frozen=True)
class Shard:
    """Samples start..stop of one scene in one split, in one file."""

    split: str
    scene: int
    start: int
    stop: int

    @property
    def name(self) -> str:
        """File name, relative to the dataset's directory."""
        return f"{self.split}/{self.scene:03d}-{self.start:07d}.safetensors"


def read_configs(files: list[str]) -> dict[str, Any]:
    """Merge YAML configs, later ones over earlier ones.

    Raises:
        UserError: a file is missing or is not YAML.
    """
    merged: dict[str, Any] = {}
    for file in files:
        try:
            data = yaml.safe_load(Path(file).read_text()) or {}
        except OSError as error:
            raise UserError(f"{file}: cannot be read: {error.strerror}") from None
        except yaml.YAMLError as error:
            raise UserError(f"{file}: not valid YAML: {' '.join(str(error).split())}") from None
        if not isinstance(data, Mapping):
            raise UserError(f"{file}: must be a mapping, is a {type(data).__name__}")
        merged = merge(merged, data)
    return merged


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`over` upon `base`, mapping by mapping."""
    both = {
        k: merge(base[k], v) for k, v in over.items() if isinstance(v, Mapping) and isinstance(base.get(k), Mapping)
    }
    return {**base, **over, **both}


def check_keys(place: str, content: Mapping[str, Any], known: Collection[str], needed: Collection[str] = ()) -> None:
    """Raises UserError if a key of a config's section is not known, or one that is needed is missing."""
    for key in content:
        if key not in known:
            raise UserError(f"{place}{key}: unknown key; known are {', '.join(known)}")
    for key in needed:
        if key not in content:
            raise UserError(f"{place}{key}: missing")


def load_spec(files: list[str]) -> tuple[DatasetSpec, AnyPath]:
    """The dataset that config files describe, without what is rendered online; the root directory of datasets."""
    where = " + ".join(files)
    merged = read_configs(files)
    data = merged.get("data")
    if not isinstance(data, Mapping) or not isinstance(data.get("dataset"), Mapping):
        raise UserError(f"{where}: data.dataset: missing; add a config of configs/data")
    dataset = tuple(field.name for field in dataclasses.fields(DatasetSpec))
    sections = (("", merged, SECTIONS), ("data.", data, DATA), ("data.dataset.", data["dataset"], dataset))
    for section, content, known in sections:
        check_keys(f"{where}: {section}", content, known)
    if "scenes" not in data["dataset"]:
        raise UserError(f"{where}: data.dataset.scenes: missing; add a config of configs/data")
    spec, online = DatasetSpec(**data["dataset"]), data.get("online", False)
    if not isinstance(online, bool):
        raise UserError(f"{where}: data.online: must be true or false, is {online!r}")
    return spec.without_train() if online else spec, open_path(data.get("root", "datasets"))
