"""The paper's published numbers and its names for the methods."""

from functools import cache
from pathlib import Path
from typing import Any

import yaml


@cache
def paper() -> dict[str, Any]:
    """Return the content of paper.yaml."""
    return yaml.safe_load(Path(__file__).with_name("paper.yaml").read_text())


COLUMNS = tuple(paper()["columns"])  # columns of the paper's tables, in its order
FLOOR = "reference (its halves)"  # the row that judges one half of the reference against the other


def tables() -> tuple[str, ...]:
    """Return the names of the paper's tables."""
    return tuple(name for name, content in paper().items() if "title" in content)


def label(method: str) -> str:
    """Return the paper's name of a method, or its own if the paper lacks it; METHOD@VARIANT adds the variant."""
    name, at, variant = method.partition("@")
    return paper()["labels"].get(name, name) + f", {variant}" * bool(at)


def order(method: str) -> tuple[int, str]:
    """Return a sort key: the paper's order, then other methods by name; variants of a method compare equal."""
    known, name = list(paper()["labels"]), method.partition("@")[0]
    return (known.index(name) if name in known else len(known), name)


def published(table: str | None, method: str) -> dict[str, float]:
    """Return the paper's numbers of a method in one of `tables()`, by column; empty if it has none."""
    content = paper().get(table or "", {})
    row = content.get(method)
    return dict(zip(content.get("columns", paper()["columns"]), row, strict=True)) if row else {}
