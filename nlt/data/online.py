"""Training samples rendered during training and never stored."""

from collections import deque
from collections.abc import Iterable

import numpy as np

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import AnyPath
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.rendering.variant import choose_variant

_REMEMBERED = 512  # samples that a rendering process keeps to show them again


class OnlineDataset(LightTransportDataset):
    """An endless sequence of training samples that alternates between the scenes; reading an index renders its sample.

    With one scene, it begins with the samples of a stored dataset with the same seed.

    Only the fields in `inputs`, or all if it is None, are rendered. The samples avoid the states of the val and test
    samples of `spec`. An epoch has `length` samples, and each rendering process has `threads` threads.

    Only every `uses`-th sample that a process reads is rendered. The others are drawn from the last 512 that it
    rendered, so that on average each is read `uses` times.
    """

    def __init__(
        self,
        directory: AnyPath,
        spec: DatasetSpec,
        inputs: Iterable[str] | None,
        length: int,
        threads: int,
        uses: int = 1,
    ) -> None:
        super().__init__(directory, spec, "train", inputs)
        self._length, self._threads, self._uses, self._reads = length, threads, uses, 0
        self._remembered: deque[tuple[int, dict[str, np.ndarray]]] = deque(maxlen=_REMEMBERED if uses > 1 else 1)
        self._renderers: list[SampleRenderer] = []
        choose_variant()  # here, so that all rendering processes inherit it

    def __len__(self) -> int:
        return self._length

    def _sample(self, index: int) -> tuple[int, dict[str, np.ndarray]]:
        self._reads += 1
        if (self._reads - 1) % self._uses:
            return self._remembered[np.random.default_rng(index).integers(len(self._remembered))]
        count = len(self.spec.scenes)
        if not self._renderers:  # created in the rendering process
            # Only the last renderer sets the thread count, because loading a scene with one thread deadlocks.
            threads = [*[None] * (count - 1), self._threads]
            self._renderers = [SampleRenderer(self.spec, k, threads[k]) for k in range(count)]
        number, scene = divmod(index, count)
        self._remembered.append((scene, self._renderers[scene].sample("train", number, only=self._stored)))
        return self._remembered[-1]
