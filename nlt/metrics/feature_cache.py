"""A disk cache of Inception's features of reference images, keyed by the images' content."""

from __future__ import annotations

import hashlib
from contextlib import suppress

import numpy as np
import torch
from torch import Tensor

from nlt.data.store import ShardReader, write_shard
from nlt.errors import UserError
from nlt.metrics.inception import STAGES, Inception
from nlt.paths import cache_root


def cached_features(inception: Inception, images: Tensor) -> dict[str, Tensor]:
    """Return `inception(images)` for images (B, 3, H, W), computed once for all runs of this user.

    The cache key is a hash of the images and of everything that affects their features. The file in `cache_root()` has
    a CRC for every array and 4 MB per image. It is written atomically, and replaced if it is damaged.
    """
    images = images.float()
    definition = f"{inception.definition} {torch.__version__} {images.device.type} {tuple(images.shape)}"
    key = hashlib.sha256(definition.encode() + images.contiguous().cpu().numpy().tobytes()).hexdigest()
    path = cache_root() / "features" / f"{key}.safetensors"
    layers = (*STAGES, "pool")
    reader = ShardReader()
    try:
        rows = [reader.read(path, row, layers) for row in range(len(images))]
        return {name: torch.from_numpy(np.stack([row[name] for row in rows])).to(images.device) for name in layers}
    except UserError:  # missing or damaged
        features = inception(images)
    arrays = {name: feature.contiguous().cpu().numpy() for name, feature in features.items()}
    with suppress(UserError, OSError):  # an unwritable cache is not an error
        write_shard(path, [{name: array[row] for name, array in arrays.items()} for row in range(len(images))])
    return features
