"""Training samples that are rendered while training, each for one step alone: their noise is never seen twice."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from nlt.data.dataset import LightTransportDataset
from nlt.data.files import AnyPath
from nlt.data.render import SampleRenderer
from nlt.data.spec import DatasetSpec
from nlt.rendering.variant import choose_variant


class OnlineDataset(LightTransportDataset):
    """An endless sequence of training samples, the scenes in turn; whoever asks for a number renders it.

    With one scene, its beginning is what a stored set of the same seed holds.

    Args:
        directory: of the dataset with the points.
        spec: what it holds; in the states of its val and test samples, no training sample is rendered.
        inputs: fields that the method reads, None for all; no others are rendered.
        length: samples in an epoch.
        threads: of each process that renders.
    """

    def __init__(
        self, directory: AnyPath, spec: DatasetSpec, inputs: Iterable[str] | None, length: int, threads: int
    ) -> None:
        super().__init__(directory, spec, "train", inputs)
        self._length, self._threads = length, threads
        self._renderers: list[SampleRenderer] = []
        choose_variant()  # once; the processes inherit it

    def __len__(self) -> int:
        return self._length

    def _sample(self, index: int) -> tuple[int, dict[str, np.ndarray]]:
        count = len(self.spec.scenes)
        if not self._renderers:  # in the process that renders
            # Threads are set with the last one: with one thread, loading a scene waits for ever.
            threads = [*[None] * (count - 1), self._threads]
            self._renderers = [SampleRenderer(self.spec, k, threads[k]) for k in range(count)]
        number, scene = divmod(index, count)
        return scene, self._renderers[scene].sample("train", number, only=self._stored)
