"""The definition of a sample: name, shape, dtype, unit and meaning of every field.

There are three groups: fields stored per sample (`FIELDS`), fields stored once per scene (`POINT_FIELDS`) and fields
that a batch adds (`BATCH_FIELDS`). All values are in metres, world coordinates and linear RGB.

Conventions: images are channels first. Pixel (i, j), column i and row j, covers [i, i+1) x [j, j+1) of the continuous
image plane, so its centre is (i + 0.5, j + 0.5). In view space, x points right, y down and z forward. A world point p
projects to K T p, and the floor of the result is its pixel.

Only photons that arrive in the room are stored: if the scene has a `room`, they must cross it before they first hit a
surface. Most photons of a sky do not, so photons are emitted until P have arrived or a limit on emissions is reached.
"""

from dataclasses import dataclass

import numpy as np

from nlt.scenes.description import MATERIALS

__all__ = ["BATCH_FIELDS", "BUFFERS", "DIRECT", "FIELDS", "MATERIALS", "POINT_FIELDS", "SPLITS", "Field"]

SPLITS = ("train", "val", "test")


@dataclass(frozen=True)
class Field:
    """One array; `shape` has numbers and the symbols H, W (image), P (photons), N (points), M (movable objects)."""

    shape: tuple[int | str, ...]
    dtype: str
    unit: str
    meaning: str
    splits: tuple[str, ...] = SPLITS  # in which it is stored

    def resolve(self, sizes: dict[str, int]) -> tuple[int, ...]:
        """Return the shape with the symbols replaced by their sizes."""
        return tuple(sizes[s] if isinstance(s, str) else s for s in self.shape)

    def nbytes(self, sizes: dict[str, int]) -> int:
        """Return the size of one sample's array in bytes."""
        return int(np.prod(self.resolve(sizes), dtype=np.int64)) * np.dtype(self.dtype).itemsize


_RADIANCE = "W·sr⁻¹·m⁻²"

FIELDS: dict[str, Field] = {
    "noisy": Field(
        (3, "H", "W"), "float32", _RADIANCE, "path-traced radiance at 1 spp, unclamped; the paper's training target"
    ),
    "noisy_input": Field(
        (3, "H", "W"), "float32", _RADIANCE, "path-traced radiance at 4 spp with different seeds; denoisers' input"
    ),
    "target": Field(
        (3, "H", "W"),
        "float32",
        _RADIANCE,
        "path-traced radiance at 16 spp with other seeds; training target of some methods that are not in the paper",
        splits=("train", "val"),
    ),
    "reference_a": Field((3, "H", "W"), "float32", _RADIANCE, "first half of the reference", ("val", "test")),
    "reference_b": Field((3, "H", "W"), "float32", _RADIANCE, "second half, independent of the first", ("val", "test")),
    "depth": Field((1, "H", "W"), "float32", "m", "camera-space depth z at the pixel centre; 0 if no surface is hit"),
    "normal": Field((3, "H", "W"), "float16", "1", "shading normal in world space; 0 if no surface is hit"),
    "albedo": Field(
        (3, "H", "W"), "float16", "1", "pixel mean of the diffuse reflectance, in [0, 1]; metal and glass have 0"
    ),
    "emission": Field(
        (3, "H", "W"), "float32", _RADIANCE, "pixel mean of the radiance seen directly from lamps and the environment"
    ),
    "direct": Field(
        (3, "H", "W"),
        "float32",
        _RADIANCE,
        "what the surface, or what metal and glass show, reflects of direct light, over seen_albedo: without a coat, "
        "what a white diffuse surface would; with a coat, the lamp's reflection in it, too; noise-free",
    ),
    "seen_albedo": Field(
        (3, "H", "W"),
        "float16",
        "1",
        "pixel mean of the diffuse reflectance towards the camera, of the surface or of what metal and glass show, "
        "times what these let pass; less than albedo under a coat",
    ),
    "camera_matrix": Field((3, 3), "float32", "px", "K, maps view space to pixels"),
    "world_to_view": Field((4, 4), "float32", "m", "T, maps world space to view space; a rigid transform"),
    "photon_origin": Field(("P", 3), "float32", "m", "point at which the photon left its emitter"),
    "photon_direction": Field(("P", 3), "float16", "1", "unit direction in which the photon was emitted"),
    "photon_flux": Field(("P", 3), "float32", "W", "RGB flux; a sample's photons sum to the power that arrives"),
    "photon_hit": Field(("P", 3), "float32", "m", "the photon's first intersection with the scene"),
    "photon_valid": Field(("P",), "bool", "", "whether a photon arrived in time; if not, its other fields are 0"),
    "translation": Field(("M", 3), "float32", "m", "translation of each object from its place in the scene file"),
    "present": Field(("M",), "bool", "", "whether the movable object is in the scene"),
}

TRACED = ("noisy", "noisy_input")  # fields that path tracing gives and a method may read
BUFFERS = ("depth", "normal", "albedo", "emission")  # fields that one noise-free pass of primary rays gives
DIRECT = ("direct", "seen_albedo")  # fields that shadow rays give

POINT_FIELDS: dict[str, Field] = {
    "position": Field(("N", 3), "float32", "m", "position with every object at its place in the scene file"),
    "material": Field(("N",), "uint8", "", "index into MATERIALS"),
    "albedo": Field(("N", 3), "float32", "1", "diffuse reflectance, sampled from textures"),
    "emission": Field(("N", 3), "float32", _RADIANCE, "emitted radiance"),
    "shape": Field(("N",), "int32", "", "index of the shape in the scene"),
    "object": Field(("N",), "int32", "", "index of the movable object; -1 for static geometry"),
    "area_share": Field((), "float32", "1", "share of the scene's surface that can be seen; points lie there"),
}

BATCH_FIELDS: dict[str, Field] = {
    "view_direction": Field((3, "H", "W"), "float32", "1", "unit, world space, from the camera to the pixel centre"),
    "point_position": Field(("N", 3), "float32", "m", "position with the sample's translations applied"),
    "point_visible": Field(("N",), "bool", "", "whether the point's object is present in the state"),
    "point_material": Field(("N",), "int64", "", "as in POINT_FIELDS"),
    "point_albedo": Field(("N", 3), "float32", "1", "as in POINT_FIELDS"),
    "point_emission": Field(("N", 3), "float32", _RADIANCE, "as in POINT_FIELDS"),
    "scene": Field((), "int64", "", "index of the scene in the dataset"),
    "index": Field((), "int64", "", "index of the sample in its split"),
    "exposure": Field((), "float32", "1", "the scene's fixed exposure, by which radiance is multiplied for display"),
}
