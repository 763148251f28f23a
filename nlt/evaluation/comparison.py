"""A comparison as a config of configs/compare describes it: methods, seeds, data, scale."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path

from pydantic import NonNegativeInt, field_validator

from nlt.config import Settings, parse, read_configs
from nlt.evaluation.paper import order, tables
from nlt.models.factory import build, method_class
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.paths import config_names, find_config


class _Content(Settings):
    """The content of a config of configs/compare."""

    table: str | None = None
    data: str
    scale: str
    variant: str | None = None
    methods: list[str] | None = None
    seed: NonNegativeInt = 0

    @field_validator("table")
    @classmethod
    def _known_table(cls, table: str | None) -> str | None:
        return _known("table", table, tables())

    @field_validator("variant")
    @classmethod
    def _known_variant(cls, variant: str | None) -> str | None:
        return _known("variant", variant, config_names("variant"))

    @field_validator("methods")
    @classmethod
    def _known_methods(cls, methods: list[str] | None) -> list[str] | None:
        for method in methods or ():
            name, *variants = method.split("@", 1)
            _known("method", name, config_names("model"))
            for variant in variants:
                _known("variant", variant, config_names("variant"))
        return methods


def _known(kind: str, name: str | None, names: Collection[str]) -> str | None:
    if name is not None and name not in names:
        raise ValueError(f"no {kind} {name!r}; known are {', '.join(names)}")
    return name


@dataclass
class Comparison:
    """A comparison as a config of configs/compare describes it.

    `variant` is a config of configs/variant that changes every trained method; METHOD@VARIANT applies a further one to
    a single method. `name` includes the scale and the data if they differ from the config's.
    """

    name: str
    data: Path
    scale: Path
    variant: Path | None = None
    table: str | None = None
    methods: list[str] = field(default_factory=list)
    seeds: list[int] = field(default_factory=lambda: [0])
    precision: str = "auto"

    @classmethod
    def load(
        cls,
        config: str,
        scale: str | None,
        data: str | None,
        methods: list[str] | None,
        seeds: int = 1,
        precision: str = "auto",
    ) -> Comparison:
        """Read a config by name or path; the other arguments override it.

        Raises:
            UserError: an unknown key, table, method or file.
        """
        file = find_config("compare", config)
        own = read_configs([file])
        changes = {"scale": scale, "data": data, "methods": methods}
        content = parse(_Content, own | {key: value for key, value in changes.items() if value}, file)
        full_name = file.stem
        for key, value in (("scale", scale), ("data", data)):
            if value and find_config(key, value) != find_config(key, str(own.get(key))):
                name = find_config(key, value).stem
                full_name = name if name.startswith(f"{full_name}_") else f"{full_name}_{name}"
        return cls(
            name=full_name,
            data=find_config("data", content.data),
            scale=find_config("scale", content.scale),
            variant=find_config("variant", content.variant) if content.variant else None,
            table=content.table,
            methods=sorted(content.methods or all_methods(), key=order),
            seeds=list(range(content.seed, content.seed + seeds)),
            precision=precision,
        )

    def jobs(self) -> list[tuple[str, int]]:
        """Return the rows of the comparison as (method, seed); methods without training have one seed."""
        return [(m, seed) for m in self.methods for seed in (self.seeds[:1] if build_if_untrained(m) else self.seeds)]

    def configs(self, method: str) -> list[str]:
        """Return the config files of a method's training, later ones overriding earlier ones."""
        name, _, variant = method.partition("@")
        variants = [self.variant, find_config("variant", variant) if variant else None]
        return [str(path) for path in (self.data, find_config("model", name), self.scale, *filter(None, variants))]


def all_methods() -> list[str]:
    """Return the methods in configs/model except those of the static ablation, compared only with each other."""
    return sorted((name for name in config_names("model") if not name.startswith("ablation_")), key=order)


def build_if_untrained(method: str) -> Method | None:
    """Return the method if its class needs no training, else None.

    Raises:
        UserError: its init_args do not fit the class.
    """
    file = find_config("model", method.partition("@")[0])
    config = read_configs([file])
    return None if issubclass(method_class(config, file), RenderingModule) else build(config, file)
