"""Images of high dynamic range packed for report.html, whose script (page/report.js) unpacks them.

A value, radiance × exposure, becomes a half float of 1/16 of it, so that halves are linear below 2^-10 and
logarithmic above; the half's bits as a signed integer are rounded to `dropped` bits less. Red and blue are stored
less green; every plane less the prediction from its left and upper neighbours (LOCO-I, Weinberger et al. 2000); then
deflated. Every value comes back to within `max_error`.
"""

from __future__ import annotations

import zlib

import numpy as np

_SCALE = 2.0**-4
_LARGEST = 0x7BFF  # the bits of the largest finite half
COARSEST = 6


def max_error(dropped: int) -> float:
    """Largest error of a packed value x, relative to max(|x|, 2^-10), for |x| up to 2^19: of two roundings."""
    return 2.0**-11 * (2**dropped + (dropped > 0))


def pack(images: np.ndarray, dropped: int) -> bytes:
    """Images (K, 3, H, W), finite; what is beyond ±2^20 is clamped to it."""
    most = float(np.finfo(np.float16).max)
    bits = np.clip(images.astype(np.float32) * _SCALE, -most, most).astype(np.float16).view(np.int16).astype(np.int32)
    ordered = np.where(bits < 0, -(bits & 0x7FFF), bits)
    code = (ordered + ((1 << dropped) >> 1)) >> dropped
    code = np.clip(code, -(_LARGEST >> dropped), _LARGEST >> dropped)
    code[:, 0::2] = _wrap(code[:, 0::2] - code[:, 1:2])
    around = np.pad(code, ((0, 0), (0, 0), (1, 0), (1, 0)))
    left, up, corner = around[..., 1:, :-1], around[..., :-1, 1:], around[..., :-1, :-1]
    low, high = np.minimum(left, up), np.maximum(left, up)
    rest = _wrap(code - np.clip(left + up - corner, low, high))
    unsigned = ((rest << 1) ^ (rest >> 31)).astype("<u2")
    planes = unsigned.reshape(-1, 1).view(np.uint8).T.tobytes()  # all low bytes, then all high ones
    deflate = zlib.compressobj(6, memLevel=9, strategy=zlib.Z_FILTERED)
    return deflate.compress(planes) + deflate.flush()


def _wrap(value: np.ndarray) -> np.ndarray:
    return value.astype(np.int16).astype(np.int32)


def pack_to_fit(views: list[np.ndarray], size: int) -> tuple[list[bytes], int]:
    """As many of the views, each (K, 3, H, W), as precisely as `size` bytes hold; and the bits dropped.

    Coarser before fewer. The first view tells about how large the others get.
    """
    of_first = [len(pack(views[0], dropped)) for dropped in range(COARSEST + 1)]
    count = len(views)
    while count > 1:
        for dropped, expected in enumerate(of_first):
            if count * expected <= 1.1 * size:
                packed = [pack(view, dropped) for view in views[:count]]
                if sum(map(len, packed)) <= size:
                    return packed, dropped
        count //= 2
    return [pack(views[0], COARSEST)], COARSEST
