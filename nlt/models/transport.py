"""The Light Transport Layer: embedding and PointNet for points, a fully connected ResNet for photons."""

import torch
import torch.nn.functional as F
from torch import Tensor, nn


class PointEmbedding(nn.Module):
    """A learned vector for each point of each scene; every scene has `num_points` (N) points."""

    def __init__(self, num_scenes: int, num_points: int, channels: int) -> None:
        super().__init__()
        self.num_points = num_points
        self.table = nn.Embedding(num_scenes * num_points, channels)
        nn.init.normal_(self.table.weight, std=0.01)

    def forward(self, scene: Tensor) -> Tensor:
        """Return the embeddings (B, N, channels) of the scenes with indices (B,)."""
        points = torch.arange(self.num_points, device=scene.device)
        return self.table(scene[:, None] * self.num_points + points)


class ResidualBlock(nn.Module):
    """A pre-activation residual block of two linear layers on the last axis: (..., in) -> (..., out).

    As in Occupancy Networks (Mescheder et al. 2019), the shortcut is linear where the widths differ.
    """

    def __init__(self, in_features: int, hidden: int, out_features: int) -> None:
        super().__init__()
        self.fc_0 = nn.Linear(in_features, hidden)
        self.fc_1 = nn.Linear(hidden, out_features)
        self.shortcut = (
            nn.Identity() if in_features == out_features else nn.Linear(in_features, out_features, bias=False)
        )

    def forward(self, x: Tensor) -> Tensor:
        return self.shortcut(x) + self.fc_1(F.relu(self.fc_0(F.relu(x))))


class ExactLinear(nn.Linear):
    """A linear layer that computes in float32 and, under autocast, rounds afterwards.

    bfloat16 would move a position at 4 to 8 m by up to 1.6 cm before it is used.
    """

    def forward(self, x: Tensor) -> Tensor:
        device = x.device.type
        with torch.autocast(device, enabled=False):
            y = super().forward(x)
        return y.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else y


def masked_max(x: Tensor, mask: Tensor) -> Tensor:
    """Return the maximum (B, C) of x (B, N, C) over the points in mask (B, N) bool, zero where the mask is empty."""
    hide = torch.where(mask, 0.0, -torch.inf).to(x.dtype)
    maximum = (x + hide[..., None]).max(dim=1).values  # not amax, whose gradient reads all of x to find ties
    return torch.where(mask.any(dim=1, keepdim=True), maximum, 0)


class PointNet(nn.Module):
    """Supplementary, "Light Transport Layer": (B, N, in_features), visible (B, N) bool -> (B, N, features).

    A preprocessing layer, then `depth` PointNet blocks, each a residual block to features/2 local features
    concatenated with their maximum over the visible points.
    """

    def __init__(self, in_features: int, features: int = 64, depth: int = 2) -> None:
        super().__init__()
        self.preprocess = ExactLinear(in_features, features)
        half = features // 2
        self.blocks = nn.ModuleList(ResidualBlock(features, half, half) for _ in range(depth))

    def forward(self, points: Tensor, visible: Tensor) -> Tensor:
        x = self.preprocess(points)
        for block in self.blocks:
            local = block(x)
            x = torch.cat([local, masked_max(local, visible)[:, None].expand_as(local)], dim=-1)
        return x


class PhotonNetwork(nn.Sequential):
    """Sec. "Implementation Details": a fully connected ResNet on each photon separately.

    It maps (B, P, in_features) to (B, P, features).
    """

    def __init__(self, in_features: int, features: int = 64, depth: int = 2) -> None:
        super().__init__(
            ExactLinear(in_features, features),
            *(ResidualBlock(features, features // 2, features) for _ in range(depth)),
        )
