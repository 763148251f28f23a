"""Measures where in an image a method errs.

    python benchmarks/error_spectra.py results/NAME          # after `nlt compare`

In results/NAME it writes error_spectra.md, whether a method errs over large areas or at edges and textures
(supplementary, Sec. D), and linear_errors.md, how much of the error in linear radiance lies in pixels without
albedo (mirrors, glass, black surfaces), and in pixels brighter than white. It needs the comparison's images and, in
--root, its dataset.
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
PARTS = ("without albedo", "MSE elsewhere", "brighter than white", "MSE up to white")


def main() -> None:
    """Measure, print and write the results."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("directory", type=Path)
    parser.add_argument("--root", type=Path, default=Path("datasets"), help="directory of datasets")
    options = parser.parse_args()
    for name, text in tables(load(options.directory), options.root).items():
        write_bytes(options.directory / name, text.encode())
        print(text)


def tables(results: Results, root: Path) -> dict[str, str]:
    """Return the tables of all methods, in Markdown, by the names of their files.

    Raises:
        UserError: the results have no images.
    """
    reference, gbuffer = results.images("reference"), results.images("gbuffer")
    if reference is None or gbuffer is None:
        raise UserError(f"{results.directory}: there are no images; run its nlt compare here")
    directory = root / results.manifest["dataset"]
    test = LightTransportDataset(directory, read_spec(directory), "test", ("emission",))
    views = test.__getitems__(reference["view"].tolist())
    exposure = views["exposure"]
    halves = views["reference_a"], views["reference_b"]
    a, b = (display(half, exposure).numpy() for half in halves)
    scale = exposure[:, None, None, None]
    bright = ((halves[0] + halves[1]) / 2 * scale > 1).any(1).numpy()
    dark = (gbuffer["albedo"] == 0).all(1) & (views["emission"].numpy() == 0).all(1)  # lamps have no albedo either
    of_display, of_radiance = [], []
    for method in results.methods:
        images = results.images(method)
        if images:
            radiance = torch.from_numpy(images["radiance"]).float()
            of_display.append([label(method), *cells(spectra(display(radiance, exposure).numpy(), a, b))])
            in_a, in_b = (scale * (radiance - half).double() for half in halves)
            of_radiance.append([label(method), *linear_cells((in_a * in_b).mean(1).numpy(), dark, bright)])
    source = f"{len(a)} test views. Source: manifest.json; `python benchmarks/error_spectra.py {results.directory}`"
    spectra_note = (
        "MSE without the reference's noise, in thousandths, and the shares of wavelengths with standard errors over "
        + source
    )
    linear_note = (
        "MSE without the reference's noise, in radiance times exposure, and how much of it lies in the "
        f"{100 * dark.mean():.1f} % of the pixels without albedo and lamp (mirrors, glass, black surfaces), and in the "
        f"{100 * bright.mean():.1f} % whose reference is brighter than white. {source}"
    )
    page = lambda title, note, header, rows: "\n".join([f"# {title}", "", note, "", *grid(["method", *header], rows)])
    return {
        "error_spectra.md": page("Where methods err", spectra_note, ["MSE x 1000", *BANDS], of_display),
        "linear_errors.md": page("Where the linear error lies", linear_note, ["unbiased MSE", *PARTS], of_radiance),
    }


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


def linear_cells(errors: np.ndarray, *parts: np.ndarray) -> list[str]:
    """Return a method's MSE and, for each part of the pixels, its share of the error and the MSE outside it.

    `errors`, (V, H, W), are squared errors of pixels; a part, as large, is true in its pixels.
    """
    of_part = lambda part: [f"{100 * errors[part].sum() / errors.sum():.0f} %", f"{errors[~part].mean():.5f}"]
    return [f"{errors.mean():.5f}", *(cell for part in parts for cell in of_part(part))]


if __name__ == "__main__":
    sys.exit(exit_code(main))
