"""How many pixels a picture has: fewer while something moves, so that frames keep to a budget of time."""

import math

_LEAST = 32 * 32  # pixels
_SLACK = 0.8  # share of the budget that the finer picture is expected to need at most


class Pace:
    """Chooses the number of pixels while something moves, in steps of a factor of two.

    The few sizes keep the number of kernels small that are compiled for a size. `most` is the number at rest.
    """

    def __init__(self, most: int) -> None:
        self.most = most
        self._last = max(0, math.floor(math.log2(most / _LEAST)))
        self._step = min(2, self._last)

    @property
    def pixels(self) -> int:
        """The number of pixels of the next frame while something moves."""
        return self.most >> self._step

    def measured(self, seconds: float, budget: float) -> None:
        """Choose again, after a frame of `pixels` that took `seconds`, for a budget of seconds per frame."""
        if seconds > budget:
            self._step = min(self._last, self._step + math.ceil(math.log2(seconds / budget)))
        elif 2 * seconds < _SLACK * budget:
            self._step = max(0, self._step - 1)


def size(pixels: int, aspect: float) -> tuple[int, int]:
    """Return the width, a multiple of 8, and the height of a picture of about so many pixels.

    `aspect` is the width over the height of the window, which the picture fills.
    """
    width = 8 * max(1, round(math.sqrt(pixels * aspect) / 8))
    return width, max(8, round(width / aspect))
