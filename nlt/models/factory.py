"""From configs and checkpoints to methods."""

import inspect
import pydoc
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from nlt.config import merge
from nlt.errors import UserError
from nlt.models.clouds import CloudMethod
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


def without_unused(config: Mapping[str, Any], kind: type[Method]) -> dict[str, Any]:
    """Return a config without the settings of points and photons if a method of this class uses neither.

    Configs of a scale or variant are for all methods alike.
    """
    if issubclass(kind, CloudMethod):
        return dict(config)
    unused = set(inspect.signature(CloudMethod).parameters) - set(inspect.signature(RenderingModule).parameters)
    model = dict(config.get("model", {}))
    model["init_args"] = {key: value for key, value in model.get("init_args", {}).items() if key not in unused}
    return {**config, "model": model}


def build(config: Mapping[str, Any], place: object, **sizes: Any) -> Method:
    """Return a config's method with random weights; `sizes` override the init_args of a trained method.

    Raises:
        UserError: the config names no method, or its init_args do not fit.
    """
    kind = method_class(config, place)
    sized = merge(config, {"model": {"init_args": sizes if issubclass(kind, RenderingModule) else {}}})
    try:
        return kind(**without_unused(sized, kind)["model"]["init_args"])
    except TypeError as error:
        raise UserError(f"{place}: model.init_args: {error}") from None


def read_checkpoint(path: str | Path) -> dict[str, Any]:
    """Load a checkpoint without running code from it; a file that is not one can raise any exception."""
    return dict(torch.load(path, map_location="cpu", weights_only=True))


def load_method(path: str, place: str) -> RenderingModule:
    """Load the method of a checkpoint; `place`, for example an option, begins the error messages.

    Raises:
        UserError: the file cannot be read or is not a checkpoint.
    """
    try:
        return RenderingModule.load_from_checkpoint(path, map_location="cpu")
    except OSError as error:
        raise UserError(f"{place}: {path}: cannot be read: {error.strerror}") from None
    except UserError:
        raise
    except Exception:  # a damaged file can make the unpickler raise anything
        raise UserError(f"{place}: {path}: not a checkpoint, or damaged; give another one") from None
