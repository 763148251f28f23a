"""Measures the size of report.html and the precision of its images, at the images' own size and at twice that.

    python benchmarks/report_size.py results/demo          # writes results/bench/report_size.json

Twice the size: every image becomes four images, of four views, in a square. A real rendering at twice the resolution is
smoother from pixel to pixel, so it compresses better.
"""

from __future__ import annotations

import argparse
import json
import re
import tempfile
from pathlib import Path

import numpy as np
import torch

from nlt.data.files import write_bytes
from nlt.evaluation.provenance import origin, surroundings
from nlt.evaluation.results import IMAGES, MANIFEST, RUNS, VIEWS, load, write_images
from nlt.paths import PROJECT
from nlt.report.draw import draw
from nlt.report.page import PAGE


def main() -> None:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--out", type=Path, default=PROJECT / "results/bench/report_size.json")
    options = parser.parse_args()
    results = load(options.directory).manifest
    record = {**origin(), **surroundings(torch.device("cpu"))}
    record["results"] = {key: results[key] for key in ("command", "commit", "n_test", "methods")}
    record["sizes"] = [measure(options.directory, factor) for factor in (1, 2)]
    write_bytes(options.out, (json.dumps(record, indent=1) + "\n").encode())


def measure(directory: Path, factor: int) -> dict[str, str | int]:
    """Return the report's bytes, its images' resolution, and its note on their precision."""
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder)
        for name in (MANIFEST, RUNS, VIEWS):
            write_bytes(copy / name, (directory / name).read_bytes())
        for path in (directory / IMAGES).rglob("*.npz"):
            with np.load(path) as file:
                arrays = {name: tiled(array, factor) for name, array in file.items()}
            write_images(copy, path.relative_to(directory / IMAGES).with_suffix("").as_posix(), **arrays)
        draw(copy)
        text = (copy / PAGE).read_text()
        says = re.search(r'<p class="note">([^<]*linear radiance[^<]*)', text)
        size = {"resolution": int(re.findall(r'"width":(\d+)', text)[0]), "bytes": len(text.encode())}
        print(size, says and says[1])
        return size | {"says": says[1] if says else ""}


def tiled(array: np.ndarray, factor: int) -> np.ndarray:
    """Tile images (V, ..., H, W) with those of the next views to (V, ..., factor H, factor W), but no other arrays."""
    if array.ndim < 3:
        return array
    rows = [[np.roll(array, factor * i + j, axis=0) for j in range(factor)] for i in range(factor)]
    return np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)


if __name__ == "__main__":
    main()
