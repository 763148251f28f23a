"""Training samples rendered during training. Each is used for one step only, so no noise is seen twice."""

from collections.abc import Iterable

import numpy as np

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import AnyPath
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.rendering.variant import choose_variant


class OnlineDataset(LightTransportDataset):
    """An endless sequence of training samples that alternates between the scenes; reading an index renders its sample.

    With one scene, it begins with the samples of a stored dataset with the same seed.

    Only the fields in `inputs`, or all if it is None, are rendered. The samples avoid the states of the val and test
    samples of `spec`. An epoch has `length` samples, and each rendering process has `threads` threads.
    """

    def __init__(
        self, directory: AnyPath, spec: DatasetSpec, inputs: Iterable[str] | None, length: int, threads: int
    ) -> None:
        super().__init__(directory, spec, "train", inputs)
        self._length, self._threads = length, threads
        self._renderers: list[SampleRenderer] = []
        choose_variant()  # here, so that all rendering processes inherit it

    def __len__(self) -> int:
        return self._length

    def _sample(self, index: int) -> tuple[int, dict[str, np.ndarray]]:
        count = len(self.spec.scenes)
        if not self._renderers:  # created in the rendering process
            # Only the last renderer sets the thread count, because loading a scene with one thread deadlocks.
            threads = [*[None] * (count - 1), self._threads]
            self._renderers = [SampleRenderer(self.spec, k, threads[k]) for k in range(count)]
        number, scene = divmod(index, count)
        return scene, self._renderers[scene].sample("train", number, only=self._stored)
