"""The Image Synthesis Layer: a U-Net of convolutional ResNet blocks."""

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from nlt.models.projection import SparseMap


class ConvBlock(nn.Module):
    """A pre-activation ResNet block of two 3x3 convolutions: (B, in, H, W) -> (B, out, H, W)."""

    def __init__(self, in_channels: int, out_channels: int) -> None:
        super().__init__()
        self.conv_0 = nn.Conv2d(in_channels, out_channels, 3, padding=1)
        self.conv_1 = nn.Conv2d(out_channels, out_channels, 3, padding=1)
        self.shortcut = (
            nn.Identity() if in_channels == out_channels else nn.Conv2d(in_channels, out_channels, 1, bias=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        return self._add_residual(self.shortcut(x), F.relu(x))

    def _add_residual(self, shortcut: Tensor, activated: Tensor) -> Tensor:
        return shortcut + self.conv_1(F.relu(self.conv_0(activated), inplace=True))


class UpBlock(ConvBlock):
    """The block on the upsampled x joined with skip: (B, C, h, w), (B, in - C, H, W) -> (B, out, H, W)."""

    def forward(self, x: Tensor, skip: Tensor) -> Tensor:  # type: ignore[override]
        up = lambda y: F.interpolate(y, size=skip.shape[-2:], mode="bilinear", align_corners=False)
        x_weight, skip_weight = self.shortcut.get_parameter("weight").split([x.shape[1], skip.shape[1]], dim=1)
        shortcut = up(F.conv2d(x, x_weight)) + F.conv2d(skip, skip_weight)  # 1x1: cheaper before upsampling
        return self._add_residual(shortcut, F.relu(torch.cat([up(x), skip], dim=1), inplace=True))


def sparse_convolution(conv: nn.Conv2d, x: Tensor, sparse: Sequence[SparseMap]) -> Tensor:
    """Return a 3x3 convolution, padded by 1, of x (B, C, H, W) joined with sparse maps of the same images."""
    x_weight, *others = conv.weight.split([x.shape[1], *(rows.shape[1] for rows, _ in sparse)], dim=1)
    padded = F.conv2d(x, x_weight, conv.bias, padding=2)  # one pixel more on each side, to which rows at the border add
    padded = padded.contiguous(memory_format=torch.channels_last)
    _, channels, height, width = padded.shape
    neighbours = torch.arange(3, device=x.device)[:, None] * width + torch.arange(3, device=x.device)
    for (rows, pixels), weight in zip(sparse, others, strict=True):
        line, column = pixels // (width - 2), pixels % (width - 2)
        first = (line + 2 * (line // (height - 2))) * width + column  # first of nine pixels, in the padded images
        # The convolution reads from offset -1, so a row adds to offset +1: hence the flip.
        taps = weight.flip(2, 3).permute(1, 2, 3, 0).flatten(1)  # (C, 9 * out)
        added = (rows @ taps).view(-1, channels)
        at = (first[:, None] + neighbours.flatten()).flatten()
        padded.permute(0, 2, 3, 1).view(-1, channels).index_add_(0, at, added)
    return padded[..., 1:-1, 1:-1]


def sparse_unshuffle(sparse: SparseMap, height: int, width: int, patch: int) -> SparseMap:
    """Return `F.pixel_unshuffle` by `patch` of a sparse map of (B, C, height, width), padded to whole patches."""
    rows, pixels = sparse
    line, column = pixels // width, pixels % width
    image, line = line // height, line % height
    place = F.one_hot(line % patch * patch + column % patch, patch**2).to(rows.dtype)  # within its patch
    first = (image * -(-height // patch) + line // patch) * -(-width // patch) + column // patch
    return SparseMap((rows[:, :, None] * place[:, None]).flatten(1), first)


class UNet(nn.Module):
    """Supplementary, "Image Synthesis Layer": (B, in_channels, H, W) -> (B, out_channels, H, W), any H, W.

    The supplementary's figure reduces the resolution in three steps and the main text names four blocks:
    `depth` counts the steps. The number of features starts at `width` and doubles at each step. The output is not
    bounded. The last of the `in_channels` may be given as sparse maps.

    A `patch` above 1 is not in the paper. The first level then has one pixel for each patch of `patch` x `patch`
    pixels, whose channels it reads and predicts together (sub-pixel convolution, Shi et al. 2016). So no convolution
    runs at full resolution.
    """

    def __init__(
        self, in_channels: int, width: int = 64, depth: int = 3, out_channels: int = 3, patch: int = 1
    ) -> None:
        super().__init__()
        self.patch = patch
        widths = [width * 2**level for level in range(depth + 1)]
        self.conv_in = nn.Conv2d(in_channels * patch**2, width, 3, padding=1)
        self.down = nn.ModuleList(ConvBlock(widths[max(i - 1, 0)], widths[i]) for i in range(depth + 1))
        self.up = nn.ModuleList(UpBlock(widths[i + 1] + widths[i], widths[i]) for i in reversed(range(depth)))
        self.conv_out = nn.Conv2d(width, out_channels * patch**2, 3, padding=1)

    def forward(self, x: Tensor, sparse: Sequence[SparseMap] = ()) -> Tensor:
        height, width = x.shape[-2:]
        if self.patch > 1:
            x = F.pixel_unshuffle(F.pad(x, (0, -width % self.patch, 0, -height % self.patch)), self.patch)
            x = x.contiguous(memory_format=torch.channels_last)
            sparse = [sparse_unshuffle(part, height, width, self.patch) for part in sparse]
        x = self.down[0](sparse_convolution(self.conv_in, x, sparse) if sparse else self.conv_in(x))
        skips = []
        for block in self.down[1:]:
            skips.append(x)
            x = block(F.max_pool2d(x, 2, ceil_mode=True))  # ceil_mode keeps a side of 1
        for block, skip in zip(self.up, reversed(skips), strict=True):
            x = block(x, skip)
        return F.pixel_shuffle(self.conv_out(F.relu(x)), self.patch)[..., :height, :width]
