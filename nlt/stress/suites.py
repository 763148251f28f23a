"""The stress suites of a manifest in configs/stress: ladders of changes, each at severities 1 to 5."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from nlt.config import read_configs
from nlt.data.files import AnyPath, open_path
from nlt.data.spec import DatasetSpec, check_keys
from nlt.errors import UserError
from nlt.paths import find_config

CLEAN, FLICKER, TRAINING = "clean", "flicker", "training"
RENDERED = ("light", "geometry", "materials", "camera")  # suites whose views are rendered
COMPUTED = ("budget", "frame")  # suites that change a rendered view's inputs
PATHS = ("camera", "light", "object")  # of the suite flicker, by the thing that moves
SUITES = (*RENDERED, *COMPUTED, FLICKER, TRAINING)
_KEYS = {
    "": ("version", "seed", "views", "reference", "traced", *SUITES),
    FLICKER: ("draws", "frames", *PATHS),
    TRAINING: ("share", "seeds", "learning_rate", "precision", "corrupted"),
}
_LADDER = ("change", "values", "says")


@dataclass(frozen=True)
class Ladder:
    """One change at growing severity; `values[k]` belongs to severity k + 1."""

    suite: str
    name: str
    change: str
    values: tuple[float, ...]
    says: str


@dataclass(frozen=True)
class Suites:
    """A manifest; `ladders` are those of the rendered and computed suites."""

    file: Path
    content: Mapping[str, Any]
    ladders: tuple[Ladder, ...]

    @property
    def views(self) -> int:
        return int(self.content["views"])

    def directory(self, spec: DatasetSpec, root: str | AnyPath) -> AnyPath:
        """Return the directory of a dataset's rendered suites, named by the dataset and a hash of the manifest."""
        relevant = {key: value for key, value in self.content.items() if key not in (*COMPUTED, TRAINING)}
        digest = hashlib.sha256(json.dumps(relevant, sort_keys=True).encode()).hexdigest()[:8]
        return open_path(root) / f"{spec.directory(root).name}-stress-{digest}"


def load_suites(config: str, views: int | None = None) -> Suites:
    """Read a manifest by name or path; `views` overrides its number of views per scene.

    Raises:
        UserError: a key is unknown or missing, or a value is wrong.
    """
    file = find_config("stress", config)
    content = read_configs([str(file)]) | ({} if views is None else {"views": views})
    ladders = []
    for section, known in _KEYS.items():
        _check(file, section, content.get(section, {}) if section else content, known)
    for suite in (*RENDERED, *COMPUTED):
        if not isinstance(content[suite], Mapping):
            raise UserError(f"{file}: {suite}: must be a mapping from names to ladders, is {content[suite]!r}")
        for name, ladder in content[suite].items():
            _check(file, f"{suite}.{name}", ladder, _LADDER)
            values = ladder["values"]
            if (
                not isinstance(values, list)
                or not 1 <= len(values) <= 5
                or any(type(v) not in (int, float) for v in values)
            ):
                raise UserError(f"{file}: {suite}.{name}.values: must be a list of one to five numbers, is {values!r}")
            ladders.append(Ladder(suite, name, ladder["change"], tuple(map(float, values)), ladder["says"]))
    for key in ("version", "views", "reference"):
        if not isinstance(content[key], int) or content[key] < 1:
            raise UserError(f"{file}: {key}: must be a whole number of at least 1, is {content[key]!r}")
    return Suites(file, content, tuple(ladders))


def _check(file: Path, section: str, content: Any, known: tuple[str, ...]) -> None:
    place = f"{file}: {section + ': ' if section else ''}"
    if not isinstance(content, Mapping):
        raise UserError(f"{place}must be a mapping with the keys {', '.join(known)}, is {content!r}")
    check_keys(place, content, known, known)
