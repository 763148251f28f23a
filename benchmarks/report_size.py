"""How large is report.html, and how precise are its images? Of results with images, at their size and at twice it.

    python benchmarks/report_size.py results/demo          # writes results/benchmarks/report_size.json

Twice the size: every image becomes four of them, of four views, side by side. A rendering of twice the resolution is
smoother from pixel to pixel, so packs better.
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
    """Measure, print and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--out", type=Path, default=PROJECT / "results/benchmarks/report_size.json")
    options = parser.parse_args()
    results = load(options.directory).manifest
    record = {**origin(), **surroundings(torch.device("cpu"))}
    record["results"] = {key: results[key] for key in ("command", "commit", "n_test", "methods")}
    record["sizes"] = [measure(options.directory, factor) for factor in (1, 2)]
    write_bytes(options.out, (json.dumps(record, indent=1) + "\n").encode())


def measure(directory: Path, factor: int) -> dict[str, str | int]:
    """Bytes of the report, and what it says of its images."""
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
        found = {"resolution": int(re.findall(r'"width":(\d+)', text)[0]), "bytes": len(text.encode())}
        print(found, says and says[1])
        return found | {"says": says[1] if says else ""}


def tiled(array: np.ndarray, factor: int) -> np.ndarray:
    """Images (V, ..., H, W) beside those of the next views, (V, ..., factor H, factor W); other arrays as they are."""
    if array.ndim < 3:
        return array
    rows = [[np.roll(array, factor * i + j, axis=0) for j in range(factor)] for i in range(factor)]
    return np.concatenate([np.concatenate(row, axis=-1) for row in rows], axis=-2)


if __name__ == "__main__":
    main()
