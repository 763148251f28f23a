"""Config files: read, merged, and checked against a class with pydantic. Every error is one line."""

import json
from collections.abc import Iterable, Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from nlt import paths
from nlt.errors import UserError

T = TypeVar("T")


class Settings(BaseModel):
    """A section of a config file: its fields are the allowed keys, and their types and bounds are checked.

    Nothing is converted ("3" is not a number), except whole numbers to floats and lists to tuples.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


def known(kind: str, name: str) -> str:
    """Return a name or path in configs/`kind` if there is such a config, for pydantic's validators."""
    names = paths.config_names(kind)
    if name not in names and not paths.find_config(kind, name).is_file():
        raise ValueError(f"no {kind} {name!r}; known are {', '.join(names)}")
    return name


def known_method(method: str) -> str:
    """Return METHOD, or METHOD@VARIANT, if there is a config of each, for pydantic's validators."""
    model, *variants = method.split("@", 1)
    return "@".join([known("model", model), *(known("variant", variant) for variant in variants)])


def method_files(data: str, method: str, scale: str, variant: str | None) -> list[Path]:
    """Return the configs of METHOD or METHOD@VARIANT, to be read in this order; `variant` is one that methods share."""
    model, _, own_variant = method.partition("@")
    kinds = (("data", data), ("model", model), ("scale", scale), ("variant", variant), ("variant", own_variant))
    return [paths.find_config(kind, name) for kind, name in kinds if name]


def read_configs(files: Sequence[str | Path], settings: Iterable[tuple[str, str]] = ()) -> dict[str, Any]:
    """Merge YAML configs, given by path or by name, for example "data/demo"; later ones override earlier ones.

    A config with the key `base` overrides the config of that name in its own folder. `settings` are dotted keys with
    values in YAML; they override all configs.

    Raises:
        UserError: a file is missing or is not YAML.
    """
    return reduce(merge, [*(_read(paths.find_config("", file)) for file in files), *map(_nested, settings)], {})


def _nested(setting: tuple[str, str]) -> dict[str, Any]:
    """Return a setting such as ("data.dataset.train", "8") as nested mappings."""
    key, text = setting
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise UserError(f"{key}={text}: not valid YAML: {' '.join(str(error).split())}") from None
    return reduce(lambda inner, part: {part: inner}, reversed(key.split(".")), value)


def _read(file: Path, above: Sequence[Path] = ()) -> dict[str, Any]:
    """Return the content of a config, merged with its base; `above` are the configs that build on it."""
    try:
        content = yaml.safe_load(file.read_text()) or {}
    except FileNotFoundError:
        raise UserError(f"{file}: No such file{_known_files(file)}") from None
    except OSError as error:
        raise UserError(f"{file}: cannot be read: {error.strerror}") from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise UserError(f"{file}: not valid YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, Mapping):
        raise UserError(f"{file}: must be a mapping, is a {type(content).__name__}")
    if "base" not in content:
        return dict(content)
    base = file.with_name(f"{content['base']}.yaml")
    if base in (file, *above):
        raise UserError(f"{file}: base: {content['base']} builds on this config; name another one")
    return merge(_read(base, (file, *above)), {key: value for key, value in content.items() if key != "base"})


def _known_files(missing: Path) -> str:
    """Return the names that are known where a config is missing; nothing outside the project's configs."""
    if paths.CONFIGS not in missing.parents:
        return ""
    folder = missing.parent if missing.parent.is_dir() else paths.CONFIGS
    names = sorted(f"{entry.name}/NAME" if entry.is_dir() else entry.stem for entry in folder.iterdir())
    return f"; known are {', '.join(names)}"


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Return `base` overridden by `over`, merging nested mappings."""
    both = {
        k: merge(base[k], v) for k, v in over.items() if isinstance(v, Mapping) and isinstance(base.get(k), Mapping)
    }
    return {**base, **over, **both}


def parse(kind: type[T], content: Any, place: object, section: str = "") -> T:
    """Check `content` against a type, for example a subclass of `Settings`, and return it as that type.

    Args:
        place: the file or option that begins the message of an error.
        section: the key under which the content stands in that file, for example "data.dataset".

    Raises:
        UserError: the content does not fit; the message names the first wrong field and what it must be.
    """
    try:
        # As JSON, because in its strict mode a list may become a tuple.
        return TypeAdapter(kind).validate_json(json.dumps(content, default=str), strict=True)
    except ValidationError as error:
        # An unknown key explains more than the missing one that it was meant to be.
        first = min(error.errors(), key=lambda e: e["type"] not in _UNKNOWN_KEY)
        field = ".".join(str(part) for part in (section, *_fields(first["loc"])) if part != "")
        raise UserError(f"{place}: {field + ': ' if field else ''}{_problem(kind, first)}") from None


def _fields(location: Sequence[int | str]) -> list[int | str]:
    """Return the keys of an error's location, without the names that pydantic gives to the members of a union."""
    keys = [part for part in location if part not in ("float", "int", "str", "bool")]
    return [key for key in keys if isinstance(key, int) or key.replace("_", "").replace("-", "").isalnum()]


def _problem(kind: Any, error: Mapping[str, Any]) -> str:
    """Return what is wrong, as "must be ..., is ..."."""
    name, context, value = error["type"], error.get("ctx", {}), error["input"]
    if name == "missing":
        return "missing" if isinstance(error["loc"][-1], str) else "missing; the list is too short"
    if name in _UNKNOWN_KEY:
        return f"unknown key; known are {', '.join(_known_keys(kind, error['loc'][:-1]))}"
    if name in ("value_error", "assertion_error"):
        return str(context["error"])
    if name == "literal_error":
        return f"must be one of {context['expected'].replace(' or ', ', ').replace(chr(39), '')}, is {value!r}"
    return f"must be {_EXPECTED.get(name, lambda c: error['msg'].lower())(context)}, is {value!r}"


_UNKNOWN_KEY = ("extra_forbidden", "unexpected_keyword_argument")  # in a model and in a dataclass
_EXPECTED = {
    "int_type": lambda c: "a whole number",
    "int_from_float": lambda c: "a whole number",
    "float_type": lambda c: "a number such as 0.5 or 1.0e-4",
    "finite_number": lambda c: "a finite number",
    "bool_type": lambda c: "true or false",
    "string_type": lambda c: "a text",
    "list_type": lambda c: "a list",
    "tuple_type": lambda c: "a list",
    "dict_type": lambda c: "a mapping",
    "model_type": lambda c: "a mapping",
    "model_attributes_type": lambda c: "a mapping",
    "dataclass_type": lambda c: "a mapping",
    "greater_than": lambda c: f"above {c['gt']}",
    "greater_than_equal": lambda c: f"at least {c['ge']}",
    "less_than": lambda c: f"below {c['lt']}",
    "less_than_equal": lambda c: f"at most {c['le']}",
    "too_short": lambda c: f"a list of at least {c['min_length']}",
    "too_long": lambda c: f"a list of at most {c['max_length']}",
}


def _known_keys(kind: Any, location: Sequence[int | str]) -> list[str]:
    """Return the allowed keys of the section at `location` in a schema of nested sections."""
    schema = TypeAdapter(kind).json_schema()
    node: Mapping[str, Any] = schema
    definitions = schema.get("$defs", {})
    for part in location:
        node = _resolve(node, definitions)
        members = node.get("items", {}) if isinstance(part, int) else node.get("properties", {}).get(part)
        node = dict(members or node.get("additionalProperties", {}))
    return list(_resolve(node, definitions).get("properties", {}))


def _resolve(node: Mapping[str, Any], definitions: Mapping[str, Any]) -> Mapping[str, Any]:
    for option in (node, *node.get("anyOf", ())):
        if "$ref" in option:
            return definitions[option["$ref"].rpartition("/")[2]]
    return node
