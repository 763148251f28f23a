"""Where the project's own configs and the user's scenes lie."""

import os
from pathlib import Path

PROJECT = Path(__file__).resolve().parents[1]
# An installed package has them within itself.
CONFIGS = next(folder for folder in (PROJECT / "configs", Path(__file__).with_name("configs")) if folder.is_dir())


def scenes_root() -> Path:
    """The folder of downloaded scenes: `NLT_SCENES`, else `../shared/scenes` beside the project."""
    return Path(os.environ.get("NLT_SCENES", PROJECT.parent / "shared" / "scenes"))


def cache_root() -> Path:
    """What may be deleted, for it can be had again: `NLT_CACHE`, else `$XDG_CACHE_HOME/nlt`, else `~/.cache/nlt`."""
    return Path(
        os.environ.get("NLT_CACHE") or Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache") / "nlt"
    ).expanduser()


def find_config(kind: str, name: str) -> Path:
    """A config by name (`configs/<kind>/<name>.yaml`, the name may hold folders) or by path."""
    return Path(name) if name.endswith((".yaml", ".yml")) else CONFIGS / kind / f"{name}.yaml"


def config_names(kind: str) -> list[str]:
    """Every name that `find_config` knows of a kind, such as "kitchen" and "real/kitchen"."""
    folder = CONFIGS / kind
    return sorted(path.relative_to(folder).with_suffix("").as_posix() for path in folder.rglob("*.yaml"))
