"""Packing of HDR images for report.html; page_parts/report.js unpacks them.

A value, radiance × exposure, is divided by 16 and stored as a half float, which makes it linear below 2^-10 and
logarithmic above. The half's bits, as a signed integer, are rounded to `dropped` fewer bits. Red and blue are stored
minus green, and every plane minus its prediction from the left and upper neighbours (LOCO-I, Weinberger et al. 2000);
the result is deflated. Every value is recovered to within `max_error`.
"""

from __future__ import annotations

import zlib

import numpy as np

_SCALE = 2.0**-4
_LARGEST = 0x7BFF  # the bits of the largest finite half
COARSEST = 6


def max_error(dropped: int) -> float:
    """Return the largest error of a packed value x, relative to max(|x|, 2^-10), for |x| up to 2^19."""
    return 2.0**-11 * (2**dropped + (dropped > 0))


def pack(images: np.ndarray, dropped: int) -> bytes:
    """Return finite images (K, 3, H, W), clamped to ±2^20, as packed bytes."""
    limit = float(np.finfo(np.float16).max)
    bits = np.clip(images.astype(np.float32) * _SCALE, -limit, limit).astype(np.float16).view(np.int16).astype(np.int32)
    ordered = np.where(bits < 0, -(bits & 0x7FFF), bits)
    code = (ordered + ((1 << dropped) >> 1)) >> dropped
    code = np.clip(code, -(_LARGEST >> dropped), _LARGEST >> dropped)
    code[:, 0::2] = _wrap(code[:, 0::2] - code[:, 1:2])
    around = np.pad(code, ((0, 0), (0, 0), (1, 0), (1, 0)))
    left, up, corner = around[..., 1:, :-1], around[..., :-1, 1:], around[..., :-1, :-1]
    low, high = np.minimum(left, up), np.maximum(left, up)
    residual = _wrap(code - np.clip(left + up - corner, low, high))
    unsigned = ((residual << 1) ^ (residual >> 31)).astype("<u2")
    planes = unsigned.reshape(-1, 1).view(np.uint8).T.tobytes()  # all low bytes, then all high bytes
    deflate = zlib.compressobj(6, memLevel=9, strategy=zlib.Z_FILTERED)
    return deflate.compress(planes) + deflate.flush()


def _wrap(value: np.ndarray) -> np.ndarray:
    return value.astype(np.int16).astype(np.int32)


def pack_to_fit(views: list[np.ndarray], size: int) -> tuple[list[bytes], int]:
    """Return as many of the views, each (K, 3, H, W), as fit into `size` bytes, and the number of bits dropped.

    Precision is reduced before views are left out. The first view's size predicts that of the others.
    """
    first_sizes = [len(pack(views[0], dropped)) for dropped in range(COARSEST + 1)]
    count = len(views)
    while count > 1:
        for dropped, expected in enumerate(first_sizes):
            if count * expected <= 1.1 * size:
                packed = [pack(view, dropped) for view in views[:count]]
                if sum(map(len, packed)) <= size:
                    return packed, dropped
        count //= 2
    return [pack(views[0], COARSEST)], COARSEST
