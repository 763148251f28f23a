"""The search space of a config in configs/select: models from the leanest to the full one."""

from __future__ import annotations

import itertools
import pydoc
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from nlt.config import merge, read_configs
from nlt.data.files import AnyPath
from nlt.data.spec import DatasetSpec, check_keys, load_spec
from nlt.errors import UserError
from nlt.models.module import RenderingModule
from nlt.paths import config_names, find_config

_KEYS = ("data", "scale", "methods", "sizes", "points", "photons", "minutes", "seeds")


@dataclass(frozen=True)
class Candidate:
    """A model of the space; `points` and `photons` are None where the method reads none."""

    method: str
    size: str
    points: int | None
    photons: int | None

    @property
    def name(self) -> str:
        """The candidate's name, for example "nlt@small, 1,024 points"."""
        counts = ((self.points, "points"), (self.photons, "photons"))
        return ", ".join([f"{self.method}@{Path(self.size).stem}", *(f"{n:,} {what}" for n, what in counts if n)])

    @property
    def slug(self) -> str:
        """The candidate's name as a directory name."""
        parts = (self.method.replace("/", "-"), Path(self.size).stem, self.points, self.photons)
        return "-".join(str(part) for part in parts if part)


@dataclass(frozen=True)
class SearchSpace:
    """The candidates: every method in every size, with every number of points and of photons that it reads.

    `methods` and `sizes` keep the config's order, `points` and `photons` ascend. The last ones make the full model.
    """

    name: str
    data: Path
    scale: Path
    methods: tuple[str, ...]
    sizes: tuple[str, ...]
    points: tuple[int, ...]
    photons: tuple[int, ...]
    minutes: float
    seeds: int

    @classmethod
    def load(cls, config: str, minutes: float | None = None) -> SearchSpace:
        """Read a config by name or path; `minutes` overrides the config's.

        Raises:
            UserError: a key is unknown, missing or wrong.
        """
        file = find_config("select", config)
        content = {"seeds": 1} | read_configs([str(file)]) | ({} if minutes is None else {"minutes": minutes})
        check_keys(f"{file}: ", content, _KEYS, _KEYS)
        for key in ("data", "scale"):
            if not isinstance(content[key], str):
                raise UserError(f"{file}: {key}: must be the name of a config in configs/{key}, is {content[key]!r}")
        for key, kind in (("methods", "model"), ("sizes", "variant")):
            known = config_names(kind)
            for name in _list(file, key, content[key], str):
                if name not in known and not find_config(kind, name).is_file():
                    raise UserError(f"{file}: {key}: no {name!r} in configs/{kind}; known are {', '.join(known)}")
        for key in ("points", "photons"):
            if min(_list(file, key, content[key], int)) < 1:
                raise UserError(f"{file}: {key}: must be at least 1, is {content[key]}")
        if not isinstance(content["minutes"], int | float) or content["minutes"] <= 0:
            raise UserError(f"{file}: minutes: must be a number above 0, is {content['minutes']!r}")
        if type(content["seeds"]) is not int or content["seeds"] < 1:
            raise UserError(f"{file}: seeds: must be a whole number of at least 1, is {content['seeds']!r}")
        space = cls(
            file.stem,
            find_config("data", content["data"]),
            find_config("scale", content["scale"]),
            tuple(content["methods"]),
            tuple(content["sizes"]),
            tuple(sorted(content["points"])),
            tuple(sorted(content["photons"])),
            content["minutes"],
            content["seeds"],
        )
        space._check(file)
        return space

    def _check(self, file: Path) -> None:
        for key in ("points", "photons"):
            has, most = getattr(self.spec, key), max(getattr(self, key))
            if most > has:
                raise UserError(f"{file}: {key}: {most} is more than the {has} of the dataset")
        for split in ("train", "val", "test"):
            if self.spec.count(split) * len(self.spec.scenes) < 2:
                raise UserError(f"{self.scale}: data.dataset.{split}: must give at least 2 samples, gives fewer")
        steps = read_configs([str(self.scale)]).get("trainer", {}).get("max_steps")
        if not isinstance(steps, int) or steps < 1:
            raise UserError(f"{self.scale}: trainer.max_steps: must be a whole number of at least 1, is {steps!r}")
        for method in self.methods:
            kind = pydoc.locate(str(self._config(method, self.sizes[0])["model"].get("class_path")))
            if not (isinstance(kind, type) and issubclass(kind, RenderingModule)):
                raise UserError(f"{file}: methods: {method} is not trained; give a trained method")

    @cached_property
    def _loaded(self) -> tuple[DatasetSpec, AnyPath]:
        return load_spec([str(self.data), str(self.scale)])

    @property
    def spec(self) -> DatasetSpec:
        """The spec of the dataset."""
        return self._loaded[0]

    @property
    def root(self) -> AnyPath:
        """The root directory of datasets."""
        return self._loaded[1]

    @cached_property
    def candidates(self) -> list[Candidate]:
        """All candidates, the full model first; any first few are spread over methods, sizes and counts."""
        columns = []
        for method in reversed(self.methods):
            inputs = self.build(Candidate(method, self.sizes[-1], None, None)).fields
            reads = lambda prefix, names=inputs: any(name.startswith(prefix) for name in names)
            points = self.points if reads("point_") else (None,)
            photons = self.photons if reads("photon_") else (None,)
            combinations = list(itertools.product([method], self.sizes, points, photons))[::-1]
            order = sorted(range(len(combinations)), key=lambda k: _van_der_corput(k, len(combinations)))
            columns.append([Candidate(*combinations[k]) for k in order])
        rows = itertools.zip_longest(*columns)
        return [candidate for row in rows for candidate in row if candidate]

    @property
    def full(self) -> Candidate:
        """The largest candidate."""
        return self.candidates[0]

    def config(self, candidate: Candidate) -> dict[str, Any]:
        """Return the config with which `nlt fit` trains a candidate."""
        limits = {}
        if candidate.points not in (None, self.spec.points):
            limits["max_points"] = candidate.points
        if candidate.photons not in (None, self.spec.photons):
            limits["max_photons"] = candidate.photons
        return merge(self._config(candidate.method, candidate.size), {"model": {"init_args": limits}})

    def _config(self, method: str, size: str) -> dict[str, Any]:
        files = (self.data, find_config("model", method), self.scale, find_config("variant", size))
        return read_configs([str(file) for file in files])

    def build(self, candidate: Candidate) -> RenderingModule:
        """Return the candidate's untrained model."""
        model = self.config(candidate)["model"]
        kind: Any = pydoc.locate(model["class_path"])
        sizes = {"num_scenes": len(self.spec.scenes), "num_points": self.spec.points}
        try:
            module = kind(**{**model.get("init_args", {}), **sizes})
        except TypeError as error:
            raise UserError(f"{find_config('model', candidate.method)}: model.init_args: {error}") from None
        assert isinstance(module, RenderingModule)
        return module


def _list(file: Path, key: str, value: Any, kind: type) -> list[Any]:
    if not isinstance(value, list) or not value or any(type(item) is not kind for item in value):
        expected = "names" if kind is str else "whole numbers"
        raise UserError(f"{file}: {key}: must be a list of {expected}, is {value!r}")
    if len(set(value)) < len(value):
        raise UserError(f"{file}: {key}: must not have duplicates, is {value}")
    return value


def _van_der_corput(k: int, count: int) -> int:
    """Return a sort key that puts the ends of 0..count-1 first, then the middle, the quarters, and so on."""
    if k in (0, count - 1):
        return -2 if k == 0 else -1
    bits = (count - 1).bit_length()
    return int(format(k, f"0{bits}b")[::-1], 2)
