"""Config files: read, merged, and checked against a class with pydantic. Every error is one line."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, TypeAdapter, ValidationError

from nlt.errors import UserError

T = TypeVar("T")


class Settings(BaseModel):
    """A section of a config file: its fields are the allowed keys, and their types and bounds are checked.

    Nothing is converted ("3" is not a number), except whole numbers to floats and lists to tuples.
    """

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, arbitrary_types_allowed=True)


def read_configs(files: Sequence[str | Path]) -> dict[str, Any]:
    """Merge YAML configs; later files override earlier ones.

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
        return TypeAdapter(kind).validate_json(json.dumps(content, default=str))
    except ValidationError as error:
        # An unknown key explains more than the missing one that it was meant to be.
        first = min(error.errors(), key=lambda e: e["type"] != "extra_forbidden")
        field = ".".join(str(part) for part in (section, *_fields(first["loc"])) if part != "")
        raise UserError(f"{place}: {field + ': ' if field else ''}{_problem(kind, first)}") from None


def _fields(location: Sequence[int | str]) -> list[int | str]:
    """Return the keys of an error's location, without the names that pydantic gives to the members of a union."""
    return [part for part in location if isinstance(part, int) or part.replace("_", "").replace("-", "").isalnum()]


def _problem(kind: Any, error: Mapping[str, Any]) -> str:
    """Return what is wrong, as "must be ..., is ..."."""
    name, context, value = error["type"], error.get("ctx", {}), error["input"]
    if name == "missing":
        return "missing" if isinstance(error["loc"][-1], str) else "missing; the list is too short"
    if name == "extra_forbidden":
        return f"unknown key; known are {', '.join(_known_keys(kind, error['loc'][:-1]))}"
    if name in ("value_error", "assertion_error"):
        return str(context["error"])
    if name == "literal_error":
        return f"must be one of {context['expected'].replace(' or ', ', ').replace(chr(39), '')}, is {value!r}"
    return f"must be {_EXPECTED.get(name, lambda c: error['msg'].lower())(context)}, is {value!r}"


_EXPECTED = {
    "int_type": lambda c: "a whole number",
    "int_from_float": lambda c: "a whole number",
    "float_type": lambda c: "a number",
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
