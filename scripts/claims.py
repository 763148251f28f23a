"""Prints the verdicts on the paper's claims by scale: `python scripts/claims.py`.

A row per claim, a column per folder of results/ whose methods were trained with the recipe's learning rate; built-in
and real rooms have tables of their own.
"""

import json
import re
from pathlib import Path
from typing import Any

from nlt.evaluation import paper
from nlt.evaluation.claims import claims_of
from nlt.report.claims import BELOW_FLOOR
from nlt.report.table_writer import grid

# docs/paper-tables.md names them.
COMMON = {"64x64", "width 16", "demodulated", "25,600 images", "1 trainings", "64 test views"}
RESULTS = Path(__file__).resolve().parents[1] / "results"


def tables() -> str:
    """Return a table of built-in and one of real rooms for each of the paper's tables, in Markdown."""
    text = []
    for table in paper.tables():
        claims = [claim["id"] for claim in claims_of(table)]
        for kind in "built-in", "real":
            verdicts = {_heading(f): _verdicts(f) for f in sorted(RESULTS.iterdir()) if _is_current(f, table, kind)}
            verdicts = {heading: found for heading, found in verdicts.items() if found}
            if not verdicts:
                continue
            rows = [[claim, *(found.get(claim, "") for found in verdicts.values())] for claim in claims]
            holding = [f"{sum('holds' in v for v in found.values())} of {len(found)}" for found in verdicts.values()]
            rows.append(["**hold**", *holding])
            text += grid([f"{paper.paper()[table]['title']}: {kind} rooms", *verdicts], rows, numbers=False)
    return "\n".join(text).strip()


def _manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())  # type: ignore[no-any-return]


def _rooms(folder: Path) -> str:
    rooms = ", ".join(_manifest(folder)["scenes"]).replace("_", " ")
    return rooms.replace("-", " ") if rooms.startswith("real-") else f"built-in {rooms}"


def _config(folder: Path) -> dict[str, Any]:
    """Return the config of one method; the settings read here are those of all of them."""
    return next(config for config in _manifest(folder)["configs"].values() if "trainer" in config)


def _is_current(folder: Path, table: str, kind: str) -> bool:
    """Tell whether a folder has a paper's table, in rooms of a kind ("built-in" or "real") and by the recipe."""
    if not (folder / "claims.md").exists() or _manifest(folder)["table"] != table:
        return False
    if not _rooms(folder).startswith(kind):
        return False
    return bool(_config(folder)["model"]["init_args"].get("lr_schedule") == "cosine")


def _verdicts(folder: Path) -> dict[str, str]:
    """Return the measured claims' verdicts, by the claims' names; with ≈ if the references may not tell."""
    found = re.findall(r"^\| (\S+) \| \*\*([^*]+)\*\* \|(.*)", (folder / "claims.md").read_text(), re.MULTILINE)
    measured = [(claim, verdict, row) for claim, verdict, row in found if verdict != "not measured"]
    return {claim: f"{verdict} ≈" if BELOW_FLOOR in row else verdict for claim, verdict, row in measured}


def _heading(folder: Path) -> str:
    """Return the table's room, and its settings where they are not the common ones."""
    manifest, config = _manifest(folder), _config(folder)
    size = config["data"]["dataset"]["resolution"]
    images = config["trainer"]["max_steps"] * config["data"]["batch_size"]
    settings = [f"{size}x{size}", f"width {config['model']['init_args']['width']}"]
    settings += [manifest["variant"] or "radiance", f"{images:,} images"]
    settings += [f"{len(manifest['seeds'])} trainings", f"{manifest['n_test']} test views"]
    words = [_rooms(folder), *(s for s in settings if s not in COMMON)]
    return f"[{', '.join(words)}](../results/{folder.name}/claims.md)"


if __name__ == "__main__":
    print(tables())
