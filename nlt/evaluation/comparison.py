"""A comparison as a config of configs/compare describes it: methods, seeds, data, scale."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from nlt.config import read_configs
from nlt.data.spec import check_keys
from nlt.errors import UserError
from nlt.evaluation.paper import order, tables
from nlt.models.factory import build, method_class
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.paths import config_names, find_config

_KEYS = ("table", "data", "scale", "variant", "methods", "seed")


@dataclass
class Comparison:
    """A comparison as a config of configs/compare describes it.

    `variant` is a config of configs/variant that changes every trained method; METHOD@VARIANT applies a further one to
    a single method. `name` includes the scale or the data if they differ from the config's.
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
        content = read_configs([str(file)])
        check_keys(f"{file}: ", content, _KEYS)
        names = [file.stem]
        for key, value in (("scale", scale), ("data", data)):
            if value and value != content.get(key):
                names.append(find_config(key, value).stem if Path(value).suffix else value.replace("/", "-"))
            content[key] = value or content.get(key)
            if not isinstance(content[key], str):
                raise UserError(f"{file}: {key}: missing; name a config of configs/{key}")
        table, seed = content.get("table"), content.get("seed", 0)
        if table is not None and table not in tables():
            raise UserError(f"{file}: table: must be one of {', '.join(tables())}, is {table!r}")
        if isinstance(seed, bool) or not isinstance(seed, int) or seed < 0:
            raise UserError(f"{file}: seed: must be an integer of at least 0, is {seed!r}")
        variants = config_names("variant")
        shared = content.get("variant")
        if shared is not None and shared not in variants:
            raise UserError(f"{file}: variant: no variant {shared!r} in configs/variant; known: {', '.join(variants)}")
        known = sorted(config_names("model"), key=order)
        # Methods in subfolders take part only where a comparison names them.
        chosen = methods or content.get("methods") or [name for name in known if "/" not in name]
        for method in chosen:
            name, _, variant = method.partition("@")
            if name not in known:
                raise UserError(f"{file}: methods: no method {name!r} in configs/model; known: {', '.join(known)}")
            if "@" in method and variant not in variants:
                raise UserError(
                    f"{file}: methods: no variant {variant!r} in configs/variant; known: {', '.join(variants)}"
                )
        return cls(
            name="-".join(names),
            data=find_config("data", content["data"]),
            scale=find_config("scale", content["scale"]),
            variant=find_config("variant", shared) if shared else None,
            table=table,
            methods=sorted(chosen, key=order),
            seeds=list(range(seed, seed + seeds)),
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


def build_if_untrained(method: str) -> Method | None:
    """Return the method if its class needs no training, else None.

    Raises:
        UserError: its init_args do not fit the class.
    """
    file = find_config("model", method.partition("@")[0])
    config = read_configs([file])
    return None if issubclass(method_class(config, file), RenderingModule) else build(config, file)
