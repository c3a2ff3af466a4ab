"""MVSEC's ``*_data.hdf5``: ``davis/left/events`` (N, 4) float64 = x, y, t[s], ±1 (346x260)."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.events.types import Events
from blinkgl.io.dsec import hdf5_errors, open_hdf5

DATASET = "davis/left/events"


class MvsecReader:
    """Events of the left camera (or another ``davis/*/events``); times rounded to int64 µs since 1970."""

    height, width = 260, 346

    def __init__(self, path: str | os.PathLike, dataset: str = DATASET):
        self.path, self._dataset = Path(path), dataset
        with open_hdf5(self.path) as file, hdf5_errors(self.path):
            if dataset not in file or file[dataset].ndim != 2 or file[dataset].shape[1] != 4:
                raise AssetError(f"no (N, 4) dataset '{dataset}'", where=str(path))

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        with open_hdf5(self.path) as file:
            table = file[self._dataset]
            for i in range(0, len(table), size):
                with hdf5_errors(self.path):
                    rows = table[i:i + size]
                yield Events(rows[:, 0].astype(np.uint16), rows[:, 1].astype(np.uint16), np.rint(rows[:, 2] * 1e6).astype(np.int64),
                             (rows[:, 3] > 0).astype(np.uint8))
