"""Baseline "Feature Projection": learned point features are projected without light transport."""

from typing import Any

from nlt.models.clouds import CloudMethod
from nlt.models.module import PROJECTION, Batch, Features
from nlt.models.transport import PointEmbedding


class FeatureProjection(CloudMethod):
    """Sec. "Baselines" (3), similar to Aliev et al. 2019: G-buffer and projected point embeddings."""

    architecture = (*CloudMethod.architecture, "num_scenes", "num_points", "embedding")

    def __init__(self, embedding: int = 64, **kwargs: Any) -> None:
        """The keyword arguments are those of the base class.

        Args:
            embedding: channels of the learned feature of each point.
        """
        super().__init__(**kwargs)
        hparams = self.hparams
        self.embedding = PointEmbedding(hparams["num_scenes"], hparams["num_points"], embedding)

    @property
    def feature_channels(self) -> int:
        return self.gbuffer_channels + self.hparams["embedding"]

    @property
    def inputs(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys((*self.gbuffer_inputs, *PROJECTION, "point_position", "point_visible")))

    def features(self, batch: Batch, transported: Any = None) -> Features:
        points = (self.embedding(batch["scene"]), batch["point_position"], batch["point_visible"])
        return self.gbuffer_and(batch, [points])
