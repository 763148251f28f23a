"""The static ablation: the U-Net with any combination of four inputs."""

from typing import Any

import torch
from torch import Tensor

from nlt.errors import UserError
from nlt.models.clouds import CloudMethod
from nlt.models.module import PROJECTION, Batch, join_channels
from nlt.models.transport import PointEmbedding

INPUTS = ("position", "point_features", "normal", "ray_direction")


class InputAblation(CloudMethod):
    """Sec. "Ablation Study on Static Scene": the U-Net on any combination of inputs, without light transport."""

    architecture = (*CloudMethod.architecture, "num_scenes", "num_points", *INPUTS, "embedding")

    def __init__(
        self,
        position: bool = False,
        point_features: bool = False,
        normal: bool = False,
        ray_direction: bool = False,
        embedding: int = 64,
        **kwargs: Any,
    ) -> None:
        """The keyword arguments are those of the base class.

        Args:
            position: use projected point positions.
            point_features: use projected learned features of the points.
            normal: use the normal map.
            ray_direction: use the ray direction map.
            embedding: channels of the learned feature of each point.
        """
        super().__init__(**kwargs)
        hparams = self.hparams
        if not any(hparams[name] for name in INPUTS):
            raise UserError(f"model.init_args: all of {', '.join(INPUTS)} are false; set at least one to true")
        if point_features:
            self.embedding = PointEmbedding(hparams["num_scenes"], hparams["num_points"], embedding)

    @property
    def feature_channels(self) -> int:
        chosen = [self.hparams[name] for name in INPUTS]
        return sum(used * size for used, size in zip(chosen, (3, self.hparams["embedding"], 3, 3), strict=True))

    @property
    def inputs(self) -> tuple[str, ...]:
        points = self.hparams["position"] or self.hparams["point_features"]
        names = (*PROJECTION, "point_position", "point_visible") if points else ()
        maps = {"normal": self.hparams["normal"], "view_direction": self.hparams["ray_direction"]}
        return tuple(dict.fromkeys((*names, *(name for name, used in maps.items() if used))))

    def features(self, batch: Batch, transported: Any = None) -> Tensor:
        points, maps = [], []
        if self.hparams["position"]:
            points.append(batch["point_position"])
        if self.hparams["point_features"]:
            points.append(self.embedding(batch["scene"]))
        if points:
            together = torch.cat(points, dim=-1)
            maps.append(self.project(batch, together, batch["point_position"], batch["point_visible"]))
        if self.hparams["normal"]:
            maps.append(batch["normal"])
        if self.hparams["ray_direction"]:
            maps.append(batch["view_direction"])
        return join_channels(maps)
