"""Measures whether a method errs over large areas of an image or at its edges and textures (supplementary, Sec. D).

    python benchmarks/error_spectra.py results/NAME          # after `nlt compare`; writes results/NAME/error_spectra.md

It needs the comparison's images and, in --root, its dataset.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import scipy.fft
import torch

from nlt.cli import exit_code
from nlt.data.dataset import LightTransportDataset
from nlt.data.files import write_bytes
from nlt.data.store import read_spec
from nlt.display import display
from nlt.errors import UserError
from nlt.evaluation.paper import label
from nlt.evaluation.results import Results, load
from nlt.metrics.jackknife import standard_error
from nlt.report.table_writer import grid

WAVELENGTHS = (32, 8)  # pixels, the limits between the bands
BANDS = ("areas (over 32 pixels)", "shapes (8 to 32)", "edges and textures (below 8)")


def main() -> None:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--root", type=Path, default=Path("datasets"), help="directory of datasets")
    options = parser.parse_args()
    text = table(load(options.directory), options.root)
    write_bytes(options.directory / "error_spectra.md", text.encode())
    print(text)


def table(results: Results, root: Path) -> str:
    """Return the error of each method in each band, in Markdown.

    Raises:
        UserError: the results have no images.
    """
    reference = results.images("reference")
    if reference is None:
        raise UserError(f"{results.directory}: there are no images; run its nlt compare here")
    directory = root / results.manifest["dataset"]
    views = LightTransportDataset(directory, read_spec(directory), "test", ()).__getitems__(reference["view"].tolist())
    a, b = (display(views[half], views["exposure"]).numpy() for half in ("reference_a", "reference_b"))
    rows = []
    for method in results.methods:
        images = results.images(method)
        if images:
            shown = display(torch.from_numpy(images["radiance"]).float(), views["exposure"]).numpy()
            rows.append([label(method), *cells(spectra(shown, a, b))])
    note = (
        "MSE without the reference's noise, in thousandths, and the shares of wavelengths with standard errors over "
        f"{len(a)} test views. Source: manifest.json; `python benchmarks/error_spectra.py {results.directory}`"
    )
    return "\n".join(["# Where methods err", "", note, "", *grid(["method", "MSE x 1000", *BANDS], rows)])


def spectra(shown: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the part of each image's MSE in each band, (V, bands), of sRGB images (V, 3, H, W).

    The bands are those of the discrete cosine transform, whose mirrored borders add no edges. The noise of the
    reference's halves A and B is independent, so the mean product of both errors is free of it.
    """
    product = np.multiply(*(scipy.fft.dctn(shown - half, axes=(2, 3), norm="ortho") for half in (a, b)))
    height, width = shown.shape[2:]
    y, x = np.arange(height) / (2 * height), np.arange(width) / (2 * width)  # cycles per pixel
    band = np.digitize(np.hypot(*np.meshgrid(y, x, indexing="ij")), [1 / length for length in WAVELENGTHS])
    return np.stack([product[..., band == k].sum((1, 2)) for k in range(len(BANDS))], -1) / shown[0].size


def cells(parts: np.ndarray) -> list[str]:
    """Return the MSE and each band's share of it with its standard error, of parts (V, bands)."""
    shares = lambda parts: parts.sum(0) / parts.sum()
    without = np.stack([shares(np.delete(parts, view, 0)) for view in range(len(parts))])
    errors = [standard_error(column) for column in without.T]
    percent = [f"{100 * share:.0f} ± {100 * error:.0f} %" for share, error in zip(shares(parts), errors, strict=True)]
    return [f"{1000 * parts.sum(1).mean():.2f}", *percent]


if __name__ == "__main__":
    sys.exit(exit_code(main))
