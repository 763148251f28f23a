"""benchmarks/error_spectra.py on errors of known wavelength."""

import runpy

import numpy as np
import pytest

from nlt.paths import PROJECT

script = runpy.run_path(str(PROJECT / "benchmarks/error_spectra.py"))
spectra, linear_cells = script["spectra"], script["linear_cells"]


def noise(seed):
    return np.random.default_rng(seed).normal(0, 0.1, (40, 3, 48, 64))


@pytest.mark.parametrize(("wavelength", "band"), [(64, 0), (16, 1), (4, 2)])
def test_a_wave_is_in_its_band_whatever_the_noise_of_the_reference(wavelength, band):
    wave = np.cos(2 * np.pi * (np.arange(64) + 0.5) / wavelength) * np.ones((40, 3, 48, 64))
    error = spectra(0.3 * wave, noise(0), noise(1))
    assert error.mean(0) == pytest.approx(np.eye(3)[band] * 0.3**2 / 2, abs=4e-4)


def test_the_bands_add_up_to_the_mse():
    shown, reference = noise(2), noise(3)
    mse = np.square(shown - reference).mean((1, 2, 3))
    assert spectra(shown, reference, reference).sum(1) == pytest.approx(mse)


def test_the_linear_error_of_a_mirror_and_of_bright_pixels():
    errors, mirror, bright = np.full((2, 50, 50), 0.5), np.zeros((2, 50, 50), bool), np.zeros((2, 50, 50), bool)
    mirror[0, :10, :10] = bright[1, 0, :5] = True
    errors[mirror], errors[bright] = 20, 400  # 2000 each
    elsewhere = (4895 * 0.5 + 2000) / 4900, (4895 * 0.5 + 2000) / 4995
    cells = [f"{6447.5 / 5000:.5f}", "31 %", f"{elsewhere[0]:.5f}", "31 %", f"{elsewhere[1]:.5f}"]
    assert linear_cells(errors, mirror, bright) == cells
