"""The viewer's resolution: it follows the budget, stays within its bounds, and fills the window."""

import pytest

from nlt.view.pace import Pace, size


def settle(pace, cost, budget, frames=20):
    """Return the pixels of each frame on a machine that takes `cost` seconds per pixel."""
    used = []
    for _ in range(frames):
        used.append(pace.pixels)
        pace.measured(cost * pace.pixels, budget)
    return used


def test_pixels_follow_the_budget():
    pace = Pace(256 * 256)
    for cost, within in ((1e-5, True), (1e-6, True), (4e-6, True), (1e-3, False)):
        used = settle(pace, cost, 0.1)
        assert len({*used[-5:]}) == 1, "it must not go back and forth"
        assert (cost * pace.pixels <= 0.1) == within
        # One step finer would not fit, unless this is the finest.
        assert pace.pixels == pace.most or 2 * cost * pace.pixels > 0.8 * 0.1
    assert 32 * 32 <= pace.pixels < 2 * 32 * 32


def test_one_slow_frame_is_forgotten():
    pace = Pace(256 * 256)
    before = settle(pace, 1e-6, 0.1)[-1]
    pace.measured(3.0, 0.1)
    assert pace.pixels < before == settle(pace, 1e-6, 0.1)[-1] == pace.most


@pytest.mark.parametrize("most", [1, 8 * 8, 32 * 32, 100 * 100])
def test_small_pictures(most):
    pace = Pace(most)
    settle(pace, 1.0, 0.1)
    assert 0 < pace.pixels <= most


@pytest.mark.parametrize("aspect", [0.3, 1, 16 / 9, 4])
@pytest.mark.parametrize("pixels", [32 * 32, 128 * 128, 256 * 256])
def test_size_fills_the_window(pixels, aspect):
    width, height = size(pixels, aspect)
    assert width % 8 == 0 and width * height == pytest.approx(pixels, rel=0.5)
    assert abs(width / aspect - height) <= 0.5
