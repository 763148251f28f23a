"""Count how many of the objects that people marked in the real rooms `nlt scenes add` proposes: a row per room."""

import json
import multiprocessing
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

from nlt.paths import scenes_root
from nlt.rendering.variant import use_variant


def score(folder: Path) -> str:
    """Return a room's row: an object is found if a proposal overlaps half of its surface, exact if all of it.

    The overlap is intersection over union of the surface areas.
    """
    use_variant()
    from nlt.scenes import importer
    from nlt.scenes.assembly import read_shape
    from nlt.scenes.proposal import propose

    imported = importer.read(folder / "scene.xml")
    shapes = {mesh.id(): read_shape(mesh) for mesh in imported.scene.shapes()}
    area = {name: shape.face_areas.sum() for name, shape in shapes.items()}
    proposed = [set(o.shapes) for o in propose(imported.scene, shapes, imported.up).objects]
    marked = [set(o["shapes"]) for o in json.loads((folder / "objects.json").read_text())["objects"].values()]
    total = lambda names: sum(area[n] for n in names)
    best = [max((total(m & p) / total(m | p) for p in proposed), default=0.0) for m in marked]
    overlapping, exact = sum(b >= 0.5 for b in best), sum(b > 0.99 for b in best)
    return f"| {folder.name} | {len(marked)} | {overlapping} | {exact} | {len(proposed)} |"


if __name__ == "__main__":
    print("| room | marked | found | exact | proposed |\n|---|---:|---:|---:|---:|")
    with ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), max_tasks_per_child=1) as pool:
        for row in pool.map(score, sorted(p.parent for p in scenes_root().glob("*/objects.json"))):
            print(row, flush=True)
