"""Layers of EXR files as another library, OpenEXR's own, reads them."""

import numpy as np
import OpenEXR

from nlt.rendering.exr import CHANNELS, exr


def test_layers_come_back(tmp_path):
    """Every value of every layer, under names that Blender splits into passes; also what is brighter than white."""
    rng = np.random.default_rng(0)
    layers = {name: rng.normal(0, 1e4, (len(channels), 5, 9)).astype(np.float32) for name, channels in CHANNELS.items()}
    path = tmp_path / "layers.exr"
    path.write_bytes(exr(layers))
    with OpenEXR.File(str(path), separate_channels=True) as file:
        found = {name: channel.pixels for name, channel in file.channels().items()}
    expected = {c: layer for name in CHANNELS for c, layer in zip(CHANNELS[name], layers[name], strict=True)}
    assert found.keys() == expected.keys() and {"R", "G", "B", "Denoising Normal.X", "Depth.Z"} <= found.keys()
    for name, channel in expected.items():
        np.testing.assert_array_equal(found[name], channel)
