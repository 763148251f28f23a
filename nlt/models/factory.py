"""From configs and checkpoints to methods."""

from __future__ import annotations

import pydoc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from nlt.errors import UserError
from nlt.models.method import Method
from nlt.models.module import RenderingModule


def method_class(config: Mapping[str, Any], place: object) -> type[Method]:
    """Return the class that a config's `model.class_path` names; `place` begins the error messages.

    Raises:
        UserError: it names no method.
    """
    path = config.get("model", {}).get("class_path")
    kind = pydoc.locate(str(path))
    if not (isinstance(kind, type) and issubclass(kind, Method)):
        raise UserError(f"{place}: model.class_path: {path!r} is not a method; name a class derived from Method")
    return kind


def build(config: Mapping[str, Any], place: object, **sizes: Any) -> Method:
    """Return a config's method with random weights; `sizes` override the init_args of a trained method.

    Raises:
        UserError: the config names no method, or its init_args do not fit.
    """
    kind = method_class(config, place)
    arguments = {**config["model"].get("init_args", {}), **(sizes if issubclass(kind, RenderingModule) else {})}
    try:
        return kind(**arguments)
    except TypeError as error:
        raise UserError(f"{place}: model.init_args: {error}") from None


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Load a checkpoint without running code from it; a file that is not one can raise any exception."""
    return dict(torch.load(path, map_location="cpu", weights_only=True))


def load_method(path: str, place: str, device: torch.device | str = "cpu") -> RenderingModule:
    """Load the method of a checkpoint; `place`, for example an option, begins the error messages.

    Raises:
        UserError: the file cannot be read or is not a checkpoint.
    """
    try:
        return RenderingModule.load_from_checkpoint(path, map_location=device)
    except OSError as error:
        raise UserError(f"{place}: {path}: cannot be read: {error.strerror}") from None
    except UserError:
        raise
    except Exception:  # a damaged file can make the unpickler raise anything
        raise UserError(f"{place}: {path}: not a checkpoint, or damaged; give another one") from None
