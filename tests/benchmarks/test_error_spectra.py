"""benchmarks/error_spectra.py on errors of known wavelength."""

import runpy

import numpy as np
import pytest

from nlt.paths import PROJECT

spectra = runpy.run_path(str(PROJECT / "benchmarks/error_spectra.py"))["spectra"]


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
