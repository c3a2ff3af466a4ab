"""Writing below an export's folder."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.io.atomic import output_errors

_ROWS = 1 << 16


def copy(source: Path, target: Path) -> None:
    """``source``, byte for byte. Raises OutputError."""
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)


def write_bytes(target: Path, data: bytes) -> None:
    """Raises OutputError."""
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)


def write_lines(target: Path, lines: Sequence[Any]) -> None:
    """One value a line, UTF-8. Raises OutputError."""
    write_bytes(target, ("\n".join(map(str, lines)) + "\n").encode())


def growing(
    file: h5py.File, name: str, dtype: DTypeLike, shape: tuple[int, ...] = (), rows: int = _ROWS
) -> h5py.Dataset:
    """An empty data set of rows of ``shape``, for :func:`append`: gzip, which every HDF5 reads without a plugin."""
    return file.create_dataset(
        name,
        (0, *shape),
        dtype,
        maxshape=(None, *shape),
        chunks=(rows, *shape),
        compression="gzip",
        compression_opts=1,
        shuffle=True,
        track_times=False,
    )


def append(data: h5py.Dataset, rows: np.ndarray) -> None:
    """``rows`` at its end."""
    start = len(data)
    data.resize(start + len(rows), axis=0)
    data[start:] = rows
