"""The one definition of a sample: every field's name, shape, dtype, unit and meaning.

Three groups: what is stored per sample (`FIELDS`), what is stored once per scene (`POINT_FIELDS`), and
what a batch adds to both (`BATCH_FIELDS`). Everything is in metres, world coordinates, linear RGB.

Conventions. Images are channels first. Pixel (i, j), column i and row j, covers [i, i+1) x [j, j+1) of the
continuous image plane, so its centre is (i + 0.5, j + 0.5). View space has x to the right, y down and z
forward; a world point p is seen at K T p, and its pixel is the floor of that.

Photons are those that arrive in the room: that cross `room`, if the scene has one, before they first meet a surface.
Most of a sky's do not, and are cast until P have arrived.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from nlt.scenes.description import MATERIALS

__all__ = ["BATCH_FIELDS", "FIELDS", "MATERIALS", "POINT_FIELDS", "SPLITS", "Field"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Field:
    """One array: `shape` in symbols (H, W image, P photons, N points, M movable objects) or numbers."""

    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    meaning: str
    reference_only: bool = False  # only in splits that are evaluated: val and test

    def resolve(self, sizes: dict[str, int]) -> tuple[int, ...]:
        """The shape in numbers."""
        return tuple(sizes[s] if isinstance(s, str) else s for s in self.shape)

    def nbytes(self, sizes: dict[str, int]) -> int:
        """Bytes of one sample's array."""
        return int(np.prod(self.resolve(sizes), dtype=np.int64)) * np.dtype(self.dtype).itemsize


_RADIANCE = "W·sr⁻¹·m⁻²"

FIELDS: dict[str, Field] = {
    "noisy": Field((3, "H", "W"), "float32", _RADIANCE, "path-traced radiance at 1 spp, unclamped: the target"),
    "noisy_input": Field(
        (3, "H", "W"), "float32", _RADIANCE, "path-traced radiance at 4 spp, other seeds: the denoisers' input"
    ),
    "reference_a": Field((3, "H", "W"), "float32", _RADIANCE, "first half of the reference", True),
    "reference_b": Field((3, "H", "W"), "float32", _RADIANCE, "second, independent half", True),
    "depth": Field((1, "H", "W"), "float32", "m", "camera-space depth z at the pixel centre, 0 where no hit"),
    "normal": Field((3, "H", "W"), "float16", "1", "shading normal, world, 0 where no hit"),
    "albedo": Field((3, "H", "W"), "float16", "1", "diffuse reflectance in [0, 1]; 0 for mirrors and glass"),
    "emission": Field(
        (3, "H", "W"), "float32", _RADIANCE, "radiance seen directly from lamps and the environment, the pixel's mean"
    ),
    "camera_matrix": Field((3, 3), "float32", "px", "K, view space to pixels"),
    "world_to_view": Field((4, 4), "float32", "m", "T, rigid"),
    "photon_origin": Field(("P", 3), "float32", "m", "where the photon left its emitter"),
    "photon_direction": Field(("P", 3), "float16", "1", "unit direction of emission"),
    "photon_flux": Field(("P", 3), "float32", "W", "RGB flux carried; those of a sample sum to the power that arrives"),
    "photon_hit": Field(("P", 3), "float32", "m", "first intersection with the scene"),
    "photon_valid": Field(("P",), "bool", "", "it arrived; 0 in all fields is what did not before the bound"),
    "translation": Field(("M", 3), "float32", "m", "of each movable object, from its place in the scene file"),
    "present": Field(("M",), "bool", "", "the movable object is in the scene"),
}

POINT_FIELDS: dict[str, Field] = {
    "position": Field(("N", 3), "float32", "m", "with every object in its place in the scene file"),
    "material": Field(("N",), "uint8", "", "index into MATERIALS"),
    "albedo": Field(("N", 3), "float32", "1", "diffuse reflectance, textures sampled"),
    "emission": Field(("N", 3), "float32", _RADIANCE, "emitted radiance"),
    "shape": Field(("N",), "int32", "", "index of the shape in the scene"),
    "object": Field(("N",), "int32", "", "index of the movable object, -1 for what never moves"),
    "area_share": Field((), "float32", "1", "of the scene's surface: what may come to be seen, where the points lie"),
}

BATCH_FIELDS: dict[str, Field] = {
    "view_direction": Field((3, "H", "W"), "float32", "1", "world, unit, from the camera through pixel centres"),
    "point_position": Field(("N", 3), "float32", "m", "with the sample's translations applied"),
    "point_visible": Field(("N",), "bool", "", "the point's object is present in the state"),
    "point_material": Field(("N",), "int64", "", "as POINT_FIELDS"),
    "point_albedo": Field(("N", 3), "float32", "1", "as POINT_FIELDS"),
    "point_emission": Field(("N", 3), "float32", _RADIANCE, "as POINT_FIELDS"),
    "scene": Field((), "int64", "", "index of the scene in the dataset"),
    "index": Field((), "int64", "", "index of the sample in its split"),
    "exposure": Field((), "float32", "1", "the scene's fixed exposure: radiance times this is shown"),
}
