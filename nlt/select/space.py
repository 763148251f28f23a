"""The search space of a config in configs/select: models from the leanest to the full one."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any

from pydantic import AfterValidator, Field, PositiveFloat, PositiveInt, field_validator
from scipy.stats.qmc import Halton

from nlt.config import Settings, known, known_method, merge, method_files, parse, read_configs
from nlt.data.files import AnyPath
from nlt.data.spec import DatasetSpec, load_spec
from nlt.errors import UserError
from nlt.models.factory import build, method_class
from nlt.models.module import RenderingModule
from nlt.paths import find_config


@dataclass(frozen=True)
class Candidate:
    """A model of the space; `num_points` and `num_photons` are None where the method reads none."""

    method: str
    size: str
    num_points: int | None
    num_photons: int | None

    @property
    def name(self) -> str:
        """The candidate's name, for example "nlt@small, 1,024 points"."""
        counts = ((self.num_points, "points"), (self.num_photons, "photons"))
        return ", ".join([f"{self.method}@{Path(self.size).stem}", *(f"{n:,} {what}" for n, what in counts if n)])

    @property
    def slug(self) -> str:
        """The candidate's name as a directory name."""
        method = re.sub("[/@]", "-", self.method)
        parts = (method, Path(self.size).stem, self.num_points, self.num_photons)
        return "-".join(str(part) for part in parts if part)


class SearchSpace(Settings):
    """The candidates: every method in every size, with every number of points and of photons that it reads.

    A method is METHOD, or METHOD@VARIANT, and `variant` is one more that all methods share, as in a comparison.

    `methods` and `sizes` go from the leanest to the largest, `point_counts` and `photon_counts` ascend; the last ones
    make the full model. `data` and `scale` are configs, and `name` is the file's unless it is given.
    """

    name: str
    data: str
    scale: str
    variant: Annotated[str, AfterValidator(partial(known, "variant"))] | None = None
    methods: tuple[Annotated[str, AfterValidator(known_method)], ...] = Field(min_length=1)
    sizes: tuple[Annotated[str, AfterValidator(partial(known, "variant"))], ...] = Field(min_length=1)
    point_counts: tuple[PositiveInt, ...] = Field(min_length=1)
    photon_counts: tuple[PositiveInt, ...] = Field(min_length=1)
    minutes: PositiveFloat
    seeds: PositiveInt = 1

    @field_validator("methods", "sizes", "point_counts", "photon_counts")
    @classmethod
    def _unique(cls, values: tuple) -> tuple:
        if len(set(values)) < len(values):
            raise ValueError(f"must not have duplicates, is {list(values)}")
        return values if isinstance(values[0], str) else tuple(sorted(values))

    @classmethod
    def load(cls, config: str, minutes: float | None = None) -> SearchSpace:
        """Read a config by name or path; `minutes` overrides the config's.

        Raises:
            UserError: a key is unknown, missing or wrong, or does not fit the configs of the data or the scale.
        """
        file = find_config("select", config)
        given = {} if minutes is None else {"minutes": minutes}
        space = parse(cls, {"name": file.stem, **read_configs([file]), **given}, file)
        for key, has in (("point_counts", space.spec.num_points), ("photon_counts", space.spec.num_photons)):
            most = getattr(space, key)[-1]
            if most > has:
                raise UserError(f"{file}: {key}: {most} is more than the {has} of the dataset")
        scale = find_config("scale", space.scale)
        for split in ("train", "val", "test"):
            if space.spec.count(split) * len(space.spec.scenes) < 2:
                raise UserError(f"{scale}: data.dataset.{split}: must give at least 2 samples, gives fewer")
        parse(PositiveInt, read_configs([scale]).get("trainer", {}).get("max_steps"), scale, "trainer.max_steps")
        for method in space.methods:
            if not issubclass(method_class(space._config(method, space.sizes[0]), file), RenderingModule):
                raise UserError(f"{file}: methods: {method} is not trained; give a trained method")
        return space

    @cached_property
    def _loaded(self) -> tuple[DatasetSpec, AnyPath]:
        return load_spec([str(find_config("data", self.data)), str(find_config("scale", self.scale))])

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
            points = self.point_counts if reads("point_") else (None,)
            photons = self.photon_counts if reads("photon_") else (None,)
            combinations = list(itertools.product([method], self.sizes, points, photons))[::-1]
            # The first, the last, the middle one, the quarters, and so on: the order of a van der Corput sequence.
            place = Halton(1, scramble=False).random(len(combinations))[:, 0]
            place[-1], place[0] = -1, -2
            columns.append([Candidate(*combinations[k]) for k in place.argsort()])
        rows = itertools.zip_longest(*columns)
        return [candidate for row in rows for candidate in row if candidate]

    @property
    def full(self) -> Candidate:
        """The largest candidate."""
        return self.candidates[0]

    def config(self, candidate: Candidate) -> dict[str, Any]:
        """Return the config with which `nlt fit` trains a candidate."""
        limits = {}
        if candidate.num_points not in (None, self.spec.num_points):
            limits["max_points"] = candidate.num_points
        if candidate.num_photons not in (None, self.spec.num_photons):
            limits["max_photons"] = candidate.num_photons
        return merge(self._config(candidate.method, candidate.size), {"model": {"init_args": limits}})

    def _config(self, method: str, size: str) -> dict[str, Any]:
        files = method_files(self.data, method, self.scale, self.variant)
        return read_configs([*files, find_config("variant", size)])

    def build(self, candidate: Candidate) -> RenderingModule:
        """Return the candidate's untrained model."""
        sizes = {"num_scenes": len(self.spec.scenes), "num_points": self.spec.num_points}
        module = build(self.config(candidate), find_config("model", candidate.method.partition("@")[0]), **sizes)
        assert isinstance(module, RenderingModule)
        return module
