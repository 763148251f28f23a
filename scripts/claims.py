"""Prints the verdicts on the paper's claims by scale: `python scripts/claims.py`.

A row per claim, a column per folder of results/ whose methods were trained with the recipe's learning rate.
"""

import json
import re
from pathlib import Path
from typing import Any

from nlt.evaluation import paper
from nlt.evaluation.claims import claims_of
from nlt.report.claims import BELOW_FLOOR
from nlt.report.table_writer import grid

COMMON = {"64x64", "width 16", "demodulated", "25,600 images", "1 trainings"}  # docs/paper-tables.md names them
RESULTS = Path(__file__).resolve().parents[1] / "results"


def tables() -> str:
    """Return a table for each of the paper's tables, in Markdown."""
    text = []
    for table in paper.tables():
        folders = [folder for folder in sorted(RESULTS.iterdir()) if _is_current(folder, table) and _verdicts(folder)]
        verdicts = {folder: _verdicts(folder) for folder in folders}
        claims = [claim["id"] for claim in claims_of(table)]
        rows = [[claim, *(verdicts[folder].get(claim, "") for folder in folders)] for claim in claims]
        holding = [f"{sum('holds' in v for v in verdicts[f].values())} of {len(verdicts[f])}" for f in folders]
        rows.append(["**hold**", *holding])
        text += grid([f"Claims: {paper.paper()[table]['title']}", *map(_heading, folders)], rows, numbers=False)
    return "\n".join(text).strip()


def _manifest(folder: Path) -> dict[str, Any]:
    return json.loads((folder / "manifest.json").read_text())  # type: ignore[no-any-return]


def _config(folder: Path) -> dict[str, Any]:
    """Return the config of one method; the settings read here are those of all of them."""
    return next(config for config in _manifest(folder)["configs"].values() if "trainer" in config)


def _is_current(folder: Path, table: str) -> bool:
    if not (folder / "claims.md").exists() or _manifest(folder)["table"] != table:
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
    rooms = ", ".join(manifest["scenes"]).replace("_", " ")
    room = rooms.replace("-", " ") if rooms.startswith("real-") else f"built-in {rooms}"
    settings = [f"{size}x{size}", f"width {config['model']['init_args']['width']}"]
    settings += [manifest["variant"] or "radiance", f"{images:,} images", f"{len(manifest['seeds'])} trainings"]
    return f"[{', '.join([room, *(s for s in settings if s not in COMMON)])}](../results/{folder.name}/claims.md)"


if __name__ == "__main__":
    print(tables())
