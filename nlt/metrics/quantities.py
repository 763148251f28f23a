"""All quantities that are measured: name, direction, unit and print format. This module imports nothing heavy."""

import math
from dataclasses import dataclass
from functools import partial
from typing import Literal

# The stages of a frame, first rendered, then computed. A method's time includes only the stages that it needs.
RENDERED_STAGES = ("gbuffer", "photons", "path_tracing")
NETWORK_STAGES = ("transport", "projection", "synthesis")
STATE_STAGES = ("photons", "transport")  # independent of the camera
STAGES = (*RENDERED_STAGES, *NETWORK_STAGES, "denoise")
INCEPTION_STAGES = ("layer0", "layer1", "layer2", "layer3")


@dataclass(frozen=True)
class Quantity:
    """The name, order and print format of a measured number."""

    label: str
    direction: Literal["lower", "higher"]  # which is better
    format: str  # format specification for value * scale
    unit: str = "1"  # unit of value * scale
    scale: float = 1.0  # from the stored SI unit to the printed unit
    domain: str = ""  # the values it is computed from
    per_image: bool = False  # whether it is the mean of one value per image
    perfect: float | None = None  # the value of a perfect image, if it is finite


_DISPLAY = "sRGB in [0, 1] at the scene's exposure"
_LINEAR = "radiance × exposure"
_FEATURES = "Inception features of sRGB"

_image = partial(Quantity, per_image=True, perfect=0.0)

METRICS: dict[str, Quantity] = {
    "mse": _image("MSE", "lower", ".5f", domain=_DISPLAY),
    "unbiased_mse": _image("Unbiased MSE", "lower", ".3e", domain=_LINEAR),
    "reference_noise": _image("Reference noise", "lower", ".3e", domain=_LINEAR),
    "psnr": _image("PSNR", "higher", ".2f", "dB", domain=_DISPLAY, perfect=None),
    "mssim": _image("MSSIM", "higher", ".4f", domain=_DISPLAY, perfect=1.0),
    "flip": _image("FLIP", "lower", ".4f", domain=_DISPLAY),
    "fid": _image("FID", "lower", ".2f", domain=_FEATURES, per_image=False),
    "kid": _image("KID", "lower", ".4f", domain=_FEATURES, per_image=False),
    "feature_l1": _image("Feature L1", "lower", ".4f", domain=f"{_FEATURES}, final pooling"),
    **{
        f"feature_l1_{stage}": _image(f"Feature L1, layer {stage[-1]}", "lower", ".4f", domain=f"{_FEATURES}, {stage}")
        for stage in INCEPTION_STAGES
    },
}
OF_HALVES = ("unbiased_mse", "reference_noise")  # need two independent halves of a reference
PERCEPTUAL = tuple(key for key, metric in METRICS.items() if metric.domain.startswith(_FEATURES))

COSTS: dict[str, Quantity] = {
    "time_per_frame_s": Quantity("time / frame", "lower", ".4f", "s"),
    **{f"{stage}_s": Quantity(stage.replace("_", " "), "lower", ".2f", "ms", 1e3) for stage in STAGES},
    "time_per_frame_p95_s": Quantity("p95 of a frame", "lower", ".2f", "ms", 1e3),
    "moving_camera_s": Quantity("time / frame, moving camera", "lower", ".2f", "ms", 1e3),
    "parameters": Quantity("parameters", "lower", ",.0f"),
    "flops": Quantity("FLOPs / frame", "lower", ".2f", "G", 1e-9),
    "peak_memory_bytes": Quantity("peak memory", "lower", ".1f", "MiB", 2**-20),
    "train_s": Quantity("training", "lower", ".1f", "min", 1 / 60),
    "images_seen": Quantity("images seen", "lower", ",.0f"),
}
QUANTITIES: dict[str, Quantity] = METRICS | COSTS


def text(key: str, value: float | None) -> str:
    """Return a value as text in its quantity's printed unit, or a dash if it is missing or not finite."""
    if value is None or not math.isfinite(value):
        return "–"
    quantity = QUANTITIES[key]
    return format(value * quantity.scale, quantity.format)


def heading(key: str) -> str:
    """Return a column heading: the quantity's label, its unit and, for a metric, an arrow towards better values."""
    quantity = QUANTITIES[key]
    unit = f" ({quantity.unit})" if quantity.unit != "1" else ""
    arrow = {"lower": " ↓", "higher": " ↑"}[quantity.direction] if key in METRICS else ""
    return f"{quantity.label}{unit}{arrow}"
