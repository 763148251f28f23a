"""`nlt scenes list`: all descriptions in configs/scenes and in the user's ./scenes, read without a renderer."""

from __future__ import annotations

from pathlib import Path

from nlt.errors import UserError
from nlt.paths import config_names
from nlt.scenes.description import load_description


def listing() -> str:
    """Return a table with one line per description; the line of a broken description holds its error."""
    rows = [("scene", "source", "objects", "moving light", "integrator")]
    broken = []
    for name in config_names("scenes"):
        try:
            scene = load_description(name, need_source=False)
        except UserError as error:
            broken.append(f"{name}  broken: {error}")
            continue
        location = "built in" if scene.path is None else "here" if Path(scene.path).is_file() else "not here"
        rows.append((name, location, str(len(scene.objects)), "yes" if scene.light else "no", scene.integrator))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ["  ".join(cell.ljust(w) for cell, w in zip(row, widths, strict=True)).rstrip() for row in rows]
    return "\n".join(lines + broken)
