"""Locations of the project's configs, the downloaded scenes and the cache."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
# The build copies the configs into the package.
CONFIGS = next(folder for folder in (Path(__file__).with_name("configs"), PROJECT / "configs") if folder.is_dir())
# The descriptions that `nlt scenes add` writes into the working directory, found by name like the project's own.
OWN_SCENES = Path("scenes")


def is_checkpoint(argument: str) -> bool:
    """Return whether an argument of the command line names a checkpoint, not a scene."""
    return Path(argument).suffix in {".ckpt", ".safetensors"}


def scenes_root() -> Path:
    """Return the folder of downloaded scenes: `NLT_SCENES`, else `shared/scenes` in the project's parent folder."""
    return Path(os.environ.get("NLT_SCENES", PROJECT.parent / "shared" / "scenes"))


def cache_root() -> Path:
    """Return the cache, which is safe to delete: `NLT_CACHE`, else `$XDG_CACHE_HOME/nlt`, else `~/.cache/nlt`."""
    return Path(
        os.environ.get("NLT_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "nlt"
    ).expanduser()


def find_config(kind: str, name: str | Path) -> Path:
    """Return the file of a config, which need not exist; the config is given by its path or by its name.

    The name may contain or omit `configs/`, the kind and `.yaml`. If the kind is "", the name must contain it, for
    example "data/demo". A scene may also be in the user's own directory, `OWN_SCENES`.
    """
    path = Path(name)
    is_file_name = path.suffix in (".yaml", ".yml")
    if path.is_absolute() or (path.suffix and path.is_file()):
        return path
    short = (path.with_suffix("") if is_file_name else path).as_posix().removeprefix("configs/")
    named = CONFIGS / kind / f"{short.removeprefix(f'{kind}/')}.yaml"
    own = OWN_SCENES / f"{short}.yaml"
    if kind == "scenes" and own.is_file() and not named.is_file():
        return own
    return path if is_file_name and not named.is_file() else named


def config_names(kind: str) -> list[str]:
    """Return the names of all configs of a kind, for example "kitchen" and "real/kitchen"."""
    folder = CONFIGS / kind
    names = {path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml")}
    return sorted(names | {path.stem for path in OWN_SCENES.glob("*.yaml") if kind == "scenes"})
