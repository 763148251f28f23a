"""HDR images as WebP pictures for report.html, which a browser decodes; page_parts/report.js reads the values back.

A value x, radiance × exposure, becomes the integer steps · asinh(x / SMALLEST), which is linear below SMALLEST and
logarithmic above. The picture holds these integers without loss: the high bytes in its upper half, the low bytes below.
"""

import base64
import io
import json

import numpy as np
from PIL import Image

SMALLEST = 2.0**-10
LARGEST = 2.0**19
STEPS = (1024, 512, 256, 128, 64, 32, 16)  # the finest is as precise as half floats


def max_error(steps: int) -> float:
    """Return the largest error of a packed value x, relative to (x² + SMALLEST²)^½, for |x| up to LARGEST."""
    return 0.5 / steps


def pack(image: np.ndarray, steps: int) -> str:
    """Return a finite image (3, H, W), clamped to ±LARGEST, as the data URL of a picture of W × 2 H pixels."""
    values = np.clip(image.astype(np.float64), -LARGEST, LARGEST)
    codes = np.rint(steps * np.arcsinh(values / SMALLEST)).astype(int) + 0x8000
    planes = np.concatenate([codes >> 8, codes & 0xFF], axis=1).astype(np.uint8)
    file = io.BytesIO()
    Image.fromarray(planes.transpose(1, 2, 0)).save(file, "WEBP", lossless=True, method=1)
    return data_url(file.getvalue(), "image/webp")


def data_url(content: bytes, mime: str) -> str:
    """Return a file's content as a URL that a page embeds."""
    return f"data:{mime};base64,{base64.b64encode(content).decode()}"


def pack_to_fit(views: list[np.ndarray], size: int) -> tuple[list[list[str]], int]:
    """Return the packed images of as many views, each (K, 3, H, W), as fit into `size` characters, and the steps.

    Precision is reduced before views are left out. The first view always stays; its size predicts that of the others.
    """
    first = {steps: [pack(image, steps) for image in views[0]] for steps in STEPS}
    count = len(views)
    while count:
        for steps, images in first.items():
            if count * len(json.dumps(images)) <= 1.1 * size:
                packed = [images, *([pack(image, steps) for image in view] for view in views[1:count])]
                if len(json.dumps(packed)) <= size:
                    return packed, steps
        count //= 2
    return [first[STEPS[-1]]], STEPS[-1]
