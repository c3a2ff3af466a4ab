"""Rows of MVSEC's ``*_data.hdf5``: ``davis/left/events`` (N, 4) float64 = x, y, t[s], ±1 (346x260)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from blinkgl.io.columns import events_of, microseconds
from blinkgl.io.hdf5 import Data, Group, dataset
from blinkgl.types.events import Events

DATASET = "davis/left/events"
EVENTS = (DATASET, "davis/right/events")
"""Of both cameras: x, y, t, p; t in s."""


def event_table(file: Group, path: Path) -> Data:
    """Return the (N, 4) float64 data set of events. Raises AssetError."""
    return dataset(file, DATASET, path, shape=(None, 4), kinds="f")


def events_of_rows(rows: np.ndarray, where: str, first: int, t0_s: float = 0.0) -> Events:
    """Return rows x, y, t[s], ±1 as events; ``t0_s`` is subtracted from the times. first : index of the first row in
    the file. Raises EventDataError, naming event and value."""
    x, y, t, p = np.ascontiguousarray(rows.T)  # contiguous columns, because each is read several times
    return events_of(x, y, microseconds(t - t0_s, where, first), p, where, first, signed=True)
