"""Batches of a stream for a torch DataLoader."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from typing import Any

from torch.utils.data import IterableDataset, get_worker_info

from blinkgl.online.stream import SampleStream


class Batches(IterableDataset):
    """Batches of a stream. Batch k is ``collate`` of the samples from first + k · size on; ``count`` of them, None:
    endless. A DataLoader takes from its processes in turn, so they divide the batches among them and the order is that
    of one."""

    def __init__(
        self, stream: SampleStream, first: int, size: int, collate: Callable[[list], Any], count: int | None = None
    ):
        self.stream, self.first, self.size, self.collate, self.count = stream, first, size, collate, count

    def __iter__(self) -> Iterator[Any]:
        here = get_worker_info()
        worker, workers = (0, 1) if here is None else (here.id, here.num_workers)
        for k in itertools.count(worker, workers):
            if self.count is not None and k >= self.count:
                return
            begin = self.first + k * self.size
            yield self.collate([self.stream.take(n) for n in range(begin, begin + self.size)])
