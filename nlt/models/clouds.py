"""The base class of methods that use clouds: surface points, photons or both."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from nlt.errors import UserError
from nlt.models.method import Batch
from nlt.models.module import PROJECTION, Features, RenderingModule, check_at_least, join_channels
from nlt.models.projection import average_sparsely, project, visible_pixels
from nlt.models.transport import PointEmbedding

Cloud = tuple[Tensor, Tensor, Tensor]  # features (B, N, C), positions (B, N, 3), validity (B, N)


class CloudMethod(RenderingModule):
    """A trained method that uses points or photons: their numbers, the size of their networks, and the projection."""

    projection: Callable[..., Tensor] = staticmethod(project)

    def __init__(
        self,
        point_width: int = 64,
        photon_width: int = 64,
        embedding_lr: float = 1.0,
        embedding_decay: float = 0.0,
        num_scenes: int = 1,
        num_points: int = 1,
        max_points: int | None = None,
        max_photons: int | None = None,
        **kwargs: Any,
    ) -> None:
        """The keyword arguments are those of the base class.

        Args:
            point_width: number of features of a point, even; used by methods with a PointNet.
            photon_width: number of features of a photon; used by methods with a photon network.
            embedding_lr: factor on the learning rate of the point embeddings.
            embedding_decay: decoupled weight decay (Loshchilov and Hutter 2019) of the point embeddings.
            num_scenes: scenes in the dataset; `nlt fit` sets it.
            num_points: points per scene; `nlt fit` sets it.
            max_points: number of points that are used; None for all.
            max_photons: number of a sample's photons that are used, with their total flux kept; None for all.
        """
        check_at_least(2, point_width=point_width)
        check_at_least(1, photon_width=photon_width, max_points=max_points, max_photons=max_photons)
        if point_width % 2:
            raise UserError(f"model.init_args.point_width: must be even, is {point_width}")
        super().__init__(**kwargs)
        self.hparams["num_points"] = min(num_points, max_points or num_points)  # the number of embeddings per scene

    def project(self, batch: Batch, features: Tensor, positions: Tensor, valid: Tensor) -> Tensor:
        """Project features (B, N, C) at positions (B, N, 3) to (B, C, H, W) by Eq. (1), with the batch's camera."""
        camera = (batch["camera_matrix"], batch["world_to_view"])
        return self.projection(features, positions, valid, *camera, batch["depth"], batch["normal"])

    def gbuffer_and(self, batch: Batch, clouds: Sequence[Cloud], maps: Sequence[Tensor] = ()) -> Features:
        """Return the G-buffer followed by one map per cloud; one mean over all would mix their kinds of feature.

        `maps` are appended; they exist only while gradients are wanted, and then no map is sparse.
        """
        gbuffer = self.gbuffer(batch)
        # With more points than pixels, dense maps are faster (docs/performance.md).
        if self.sparse and clouds and gbuffer[0, 0].numel() >= max(len(valid[0]) for *_, valid in clouds):
            view: dict[str, Any] = {name: batch[name] for name in PROJECTION}
            projected = ((features, visible_pixels(places, valid, **view)) for features, places, valid in clouds)
            return gbuffer, [average_sparsely(*pair, *gbuffer.shape[-2:]) for pair in projected]
        return join_channels([gbuffer, *(self.project(batch, *cloud) for cloud in clouds), *maps])

    @property
    def has_point_embeddings(self) -> bool:
        """Whether the method learns embeddings, which are valid for the training scenes' points only."""
        return any(isinstance(part, PointEmbedding) for part in self.modules())

    @property
    def num_photons(self) -> int | None:
        return self.hparams["max_photons"]

    def subsample(self, batch: Batch) -> Batch:
        """Return the batch with at most `max_points` points and `max_photons` photons, whose total flux is kept."""
        points, photons = self.hparams["max_points"], self.hparams["max_photons"]
        if points:  # they are in random order, so the first ones are a uniform sample
            batch = {k: v[:, :points] if k.startswith("point_") else v for k, v in batch.items()}
        total = batch["photon_flux"].shape[1] if "photon_flux" in batch else 0
        if photons and total > photons:  # they are sorted by emitter; equal strides keep each one's share
            chosen = ((torch.arange(photons, device=batch["photon_flux"].device) + 0.5) * (total / photons)).long()
            batch = {k: v[:, chosen] if k.startswith("photon_") else v for k, v in batch.items()}
            batch["photon_flux"] = batch["photon_flux"] * (total / photons)
        return batch

    def parameter_groups(self) -> list[dict[str, Any]]:
        """Return the optimiser's parameter groups: the point embeddings have their own rate and decay."""
        embeddings = [p for part in self.modules() if isinstance(part, PointEmbedding) for p in part.parameters()]
        if not embeddings:
            return super().parameter_groups()
        ids = {id(parameter) for parameter in embeddings}
        chosen = self.hparams
        options = {"lr": chosen["learning_rate"] * chosen["embedding_lr"], "weight_decay": chosen["embedding_decay"]}
        return [{"params": [p for p in self.parameters() if id(p) not in ids]}, {"params": embeddings, **options}]
