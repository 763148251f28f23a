"""The stress suites of a manifest in configs/stress: ladders of changes, each at severities 1 to 5."""

import hashlib
import json
from pathlib import Path

from pydantic import Field
from pydantic.json_schema import SkipJsonSchema

from nlt.config import Settings, parse, read_configs
from nlt.data.files import AnyPath, open_path
from nlt.data.spec import DatasetSpec
from nlt.paths import find_config

CLEAN, FLICKER, TRAINING = "clean", "flicker", "training"
RENDERED = ("light", "geometry", "materials", "camera")  # suites whose views are rendered
COMPUTED = ("budget", "frame")  # suites that change a rendered view's inputs
STRESS, ROWS, TRAININGS = "stress", "stress.csv", "training.csv"  # the directory of the results, and its files
PATHS = ("camera", "light", "object")  # of the suite flicker, by the thing that moves
STEADY = "_steady"  # after a path's name: its frames blended by nlt.models.steady
SUITES = (*RENDERED, *COMPUTED, FLICKER, TRAINING)
Number = float | int  # 2 and 2.0 stay as they are written, because the hash of a manifest names what was rendered


class Ladder(Settings):
    """One change at growing severity; `values[k]` belongs to severity k + 1."""

    change: str
    values: tuple[Number, ...] = Field(min_length=1, max_length=5)
    says: str


class Flicker(Settings):
    """The suite flicker: the number of draws of the inputs, and the frames and lengths of the smooth paths."""

    draws: int = Field(ge=2)
    frames: int = Field(ge=2)
    camera: Number
    light: Number
    object: Number


class Trainings(Settings):
    """The suite training: the share of a scale's steps, and the values of each variation."""

    share: Number = Field(gt=0)
    seeds: int = Field(ge=1)
    learning_rate: tuple[Number, ...]
    precision: str
    corrupted: Number = Field(gt=0, le=1)


class Suites(Settings):
    """A manifest; configs/stress/suites.yaml explains its fields. `file` is where it was read."""

    file: SkipJsonSchema[Path] = Field(exclude=True)
    version: int = Field(ge=1)
    seed: int = Field(ge=0)
    views: int = Field(ge=1)
    reference: int = Field(ge=1)
    traced: tuple[int, ...]
    light: dict[str, Ladder]
    geometry: dict[str, Ladder]
    materials: dict[str, Ladder]
    camera: dict[str, Ladder]
    budget: dict[str, Ladder]
    frame: dict[str, Ladder]
    flicker: Flicker
    training: Trainings

    @property
    def ladders(self) -> dict[tuple[str, str], Ladder]:
        """The ladders of the rendered and computed suites, by suite and name."""
        return {(suite, k): ladder for suite in (*RENDERED, *COMPUTED) for k, ladder in getattr(self, suite).items()}

    def directory(self, spec: DatasetSpec, root: str | AnyPath) -> AnyPath:
        """Return the directory of a dataset's rendered suites, named by the dataset and a hash of the manifest."""
        relevant = self.model_dump(mode="json", exclude={*COMPUTED, TRAINING})
        digest = hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()[:8]
        return open_path(root) / f"{spec.directory(root).name}-stress-{digest}"


def load_suites(config: str, views: int | None = None) -> Suites:
    """Read a manifest by name or path; `views` overrides its number of views per scene.

    Raises:
        UserError: a key is unknown or missing, or a value is wrong.
    """
    file = find_config("stress", config)
    content = read_configs([file]) | {"file": str(file)} | ({} if views is None else {"views": views})
    return parse(Suites, content, file)
