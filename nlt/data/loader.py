"""A DataLoader that reads batches ahead in threads: mapped files need neither processes nor shared memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import torch
from torch.utils.data import DataLoader

_AHEAD = 2  # batches per thread


class ThreadLoader(DataLoader):
    """A DataLoader whose `num_workers` are threads; it returns the same batches in the same order.

    Reading consists of copies, CRCs and arithmetic on whole arrays, all of which run without Python's global
    interpreter lock. The first access to memory shared between processes would cost more than all of them: 0.8 ms per
    MB on a virtual machine.
    """

    def __iter__(self) -> Iterator[Any]:  # type: ignore[override]
        if self.num_workers == 0:
            yield from super().__iter__()
            return
        # With more than one torch thread per reader, the threads would spin while they wait for each other.
        pool = ThreadPoolExecutor(self.num_workers, "reader", torch.set_num_threads, (1,))
        ahead: deque[Future] = deque()
        try:
            for indices in self.batch_sampler or ():
                ahead.append(pool.submit(self._read, indices))
                if len(ahead) > _AHEAD * self.num_workers:
                    yield ahead.popleft().result()
            while ahead:
                yield ahead.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _read(self, indices: list[int]) -> Any:
        batch = self.collate_fn(self.dataset.__getitems__(indices))  # type: ignore[attr-defined]
        return {name: tensor.pin_memory() for name, tensor in batch.items()} if self.pin_memory else batch
