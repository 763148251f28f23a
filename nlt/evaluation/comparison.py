"""A comparison: the dataset, the methods and their configs, as a config of configs/compare names them."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, NonNegativeInt

from nlt.config import Settings, known, known_method, method_files, parse, read_configs
from nlt.data.files import AnyPath
from nlt.data.spec import DatasetSpec, load_spec
from nlt.errors import UserError
from nlt.evaluation.paper import order, tables
from nlt.models.factory import build, method_class
from nlt.models.method import Method
from nlt.models.module import RenderingModule
from nlt.paths import config_names, find_config
from nlt.training import check_configs

_MethodName = Annotated[str, AfterValidator(known_method)]


class _Content(Settings):
    """The content of a config of configs/compare."""

    table: Literal[*tables()] | None = None  # type: ignore[valid-type]
    data: str
    scale: str
    variant: Annotated[str, AfterValidator(partial(known, "variant"))] | None = None
    methods: list[_MethodName] | None = None
    seed: NonNegativeInt = 0


@dataclass
class Comparison:
    """A comparison, read from its config once.

    Attributes:
        name: the config's name, with the scale and the data if they differ from the config's.
        spec, root: the dataset and the directory of datasets.
        files: the config files of each method, later ones overriding earlier ones. `variant` changes every trained
            method; METHOD@VARIANT applies a further config of configs/variant to a single method. A variant may also
            name another dataset to train on, which shows how a method does in rooms that it has never seen, and the
            variant whose weights the training starts from.
        train_images: every method is also trained on only the first N images of each scene, for each N.
    """

    name: str
    spec: DatasetSpec
    root: AnyPath
    files: dict[str, list[Path]]
    seeds: list[int]
    scale: Path
    variant: str | None = None
    table: str | None = None
    precision: str = "auto"
    train_images: tuple[int, ...] = ()

    @classmethod
    def load(
        cls,
        config: str,
        scale: str | None,
        data: str | None,
        methods: list[str] | None,
        seeds: int = 1,
        precision: str = "auto",
        train_images: Collection[int] = (),
    ) -> Comparison:
        """Read a config by name or path; the other arguments override it.

        Raises:
            UserError: an unknown key, table, method or file, or a setting that `nlt fit` would refuse.
        """
        for method in methods or ():
            parse(_MethodName, method, "--methods")
        file = find_config("compare", config)
        own = read_configs([file])
        changes = {"scale": scale, "data": data, "methods": methods}
        content = parse(_Content, own | {key: value for key, value in changes.items() if value}, file)
        full_name = file.stem
        for key, value in (("scale", scale), ("data", data)):
            if value and find_config(key, value) != find_config(key, str(own.get(key))):
                name = find_config(key, value).stem
                full_name = name if name.startswith(f"{full_name}_") else f"{full_name}_{name}"
        data_file, scale_file = find_config("data", content.data), find_config("scale", content.scale)
        spec, root = load_spec([str(data_file), str(scale_file)])
        if not spec.test:
            raise UserError(f"{scale_file}: data.dataset.test: must be at least 1 for a comparison, is 0")
        if train_images and max(train_images) > spec.train:
            most = f"{max(train_images)} is more than data.dataset.train"
            raise UserError(f"--train-images: {most}; give at most {spec.train}")
        files = {}
        for method in sorted(content.methods or all_methods(), key=order):
            files[method] = method_files(content.data, method, content.scale, content.variant)
        seed_list = list(range(content.seed, content.seed + seeds))
        found = cls(
            full_name, spec, root, files, seed_list, scale_file, content.variant, content.table, precision,
            tuple(sorted(train_images)),
        )  # fmt: skip
        for method in found.trained:
            check_configs([str(path) for path in files[method]])
            start = found.starts.get(method)
            if start and (start not in found.trained or start in found.starts):
                known = [name for name in found.trained if name not in found.starts]
                place = f"{files[method][-1]}: start_from"
                raise UserError(
                    f"{place}: {start} must be a method of the comparison that starts from random weights; "
                    f"known are {', '.join(known)}"
                )
            own_points = not found.training_specs[method].has_points_of(spec)
            if own_points and build(found.configs[method], files[method][1]).learns_its_scenes:
                raise UserError(
                    f"{files[method][-1]}: data.dataset: {method} learns its training scenes (embeddings or a field); "
                    "name only methods that do not, such as photons_only"
                )
        return found

    @property
    def methods(self) -> list[str]:
        """The methods in the order of the tables."""
        return list(self.files)

    @cached_property
    def configs(self) -> dict[str, dict[str, Any]]:
        """The merged config of each method."""
        return {method: read_configs(files) for method, files in self.files.items()}

    @cached_property
    def untrained(self) -> dict[str, Method]:
        """The methods that need no training."""
        built = {method: build_if_untrained(method) for method in self.methods}
        return {method: renderer for method, renderer in built.items() if renderer}

    @property
    def trained(self) -> list[str]:
        """The names of the methods that need training."""
        return [method for method in self.methods if method not in self.untrained]

    @cached_property
    def training_specs(self) -> dict[str, DatasetSpec]:
        """The dataset that each trained method is trained on."""
        return {method: load_spec([str(path) for path in self.files[method]])[0] for method in self.trained}

    @cached_property
    def starts(self) -> dict[str, str]:
        """The methods that start from the weights of METHOD@VARIANT, where `start_from` in their config is VARIANT."""
        chosen = {method: self.configs[method].get("start_from") for method in self.trained}
        return {method: f"{method.partition('@')[0]}@{variant}" for method, variant in chosen.items() if variant}

    def runs(self, method: str) -> Path:
        """Return the directory of a method's trainings."""
        return Path("runs") / self.training_specs[method].directory(self.root).name

    @property
    def rows(self) -> list[tuple[str, int]]:
        """The rows of the comparison as (method, seed); methods without training have one seed."""
        return [(m, seed) for m in self.methods for seed in (self.seeds[:1] if m in self.untrained else self.seeds)]


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
