"""Multi-layer OpenEXR files, whose layers have the names that Cycles gives its passes."""

from collections.abc import Mapping

import mitsuba as mi
import numpy as np

from nlt.rendering.variant import use_variant

# Channels without a layer's name are the picture itself, in any program; Blender calls them the pass "Combined".
CHANNELS = {
    "radiance": ("R", "G", "B"),
    "albedo": ("Denoising Albedo.R", "Denoising Albedo.G", "Denoising Albedo.B"),
    "normal": ("Denoising Normal.X", "Denoising Normal.Y", "Denoising Normal.Z"),
    "depth": ("Depth.Z",),
    "emission": ("Emit.R", "Emit.G", "Emit.B"),
    "path_tracing": ("Noisy Image.R", "Noisy Image.G", "Noisy Image.B"),
    "reference": ("Reference.R", "Reference.G", "Reference.B"),
}


def exr(layers: Mapping[str, np.ndarray]) -> bytes:
    """Return the content of an EXR file of 32-bit floats.

    Args:
        layers: arrays (C, H, W) by the keys of `CHANNELS`, in the units of `nlt.data.sample.FIELDS`. Radiance is
            linear and without exposure, normals are in world space, and depth is along the camera's axis.
    """
    use_variant()  # Mitsuba has no Bitmap before
    names = [channel for layer in layers for channel in CHANNELS[layer]]
    pixels = np.concatenate([np.asarray(layer, np.float32) for layer in layers.values()])
    image = np.ascontiguousarray(pixels.transpose(1, 2, 0))
    stream = mi.MemoryStream()
    mi.Bitmap(image, mi.Bitmap.PixelFormat.MultiChannel, names).write(stream, mi.Bitmap.FileFormat.OpenEXR)
    return bytes(stream.raw_buffer())
