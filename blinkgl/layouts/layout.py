"""Base class of layouts: the files of one published data set, made from a sequence directory."""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import h5py
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.camera import PinHole
from blinkgl.io.atomic import output_errors
from blinkgl.io.hdf5 import growing_dataset, packing, write_rows
from blinkgl.layouts.source import Source


class Missing(NamedTuple):
    """A missing part of a sequence, in words, and the YAML line that makes it."""

    what: str
    yaml: str


Need = Callable[[Source], "Missing | None"]
"""A check of a sequence for what loaders require: None where it is there, or where another check reports it."""


class Layout:
    """One layout; a row of the table is an instance.

    name : as in ``--layout``.   about : what opens it, for tables.   size : (height, width) fixed in its loaders, None:
    any; other sizes are exported with a note.   needs : what its loaders require.
    splits : folders that its loaders require, empty or not.   filled : folders that they require to hold sequences."""

    name: str
    about: str
    size: tuple[int, int] | None = None
    needs: tuple[Need, ...] = ()
    splits: tuple[str, ...] = ()
    filled: tuple[str, ...] = ()

    def opened_by(self, out: Path) -> str:
        """Return what opens the export in the folder ``out``: some loaders need more than the layout does."""
        return self.about

    def missing(self, source: Source) -> list[Missing]:
        """Return the missing parts of ``source`` that its loaders require."""
        return [missing for need in self.needs if (missing := need(source)) is not None]

    def folder(self, source: Source) -> str:
        """Return the folder of its files, below the export."""
        return f"{source.split}/{source.name}"

    def write(self, source: Source, folder: Path) -> list[str]:
        """Write the files of ``source`` into ``folder``, which exists. Return notes for the user, a line each. Raises
        AssetError: a file of the sequence is damaged; OutputError."""
        raise NotImplementedError


def need(what: str, yaml: str, there: Callable[[Source], object]) -> Need:
    """Return a check for what is always called the same.   there : whether a sequence has it, or another check reports
    it."""
    return lambda source: None if there(source) else Missing(what, yaml)


forward_flow = need("forward flow", "labels: {flow: [forward]}", lambda source: source.flow_times("forward"))
images = need("images", "labels: {images: true}", lambda source: source.image_times)
sensor_pixels = need(
    "labels in the sensor's pixels, as its events are",
    "labels: {pixels: sensor}",
    lambda source: source.camera is None or isinstance(source.camera, PinHole) or not source.rectified,
)
BEFORE = "a recording that begins a label interval before the first label", "time: {start: 0}"
events_before = need(
    *BEFORE, lambda source: not (t := source.flow_times("forward")) or source.start_us <= 2 * t[0][0] - t[0][1]
)


# ---------------------------------------------------------------------------------------------------------------------
# Writing below an export's folder.

_ROWS = 1 << 16
GZIP = packing("gzip", 0)


def write_bytes(target: Path, data: bytes) -> None:
    """Write bytes. Raises OutputError."""
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)


def write_lines(target: Path, lines: Sequence[object]) -> None:
    """Write one value per line, UTF-8. Raises OutputError."""
    write_bytes(target, ("\n".join(map(str, lines)) + "\n").encode())


def growing(
    file: h5py.File, name: str, dtype: DTypeLike, shape: tuple[int, ...] = (), rows: int = _ROWS
) -> h5py.Dataset:
    """Return an empty data set of rows of ``shape``, for :func:`append`: gzip, which every HDF5 reads without a
    plugin."""
    return growing_dataset(file, name, (0, *shape), dtype, (rows, *shape), "gzip")


_SPARE_BYTES = 1 << 24
"""What HDF5 keeps in memory of a file: a megabyte of each data set, and its tables."""


@contextmanager
def new_hdf5(path: Path) -> Iterator[h5py.File]:
    """Give a new HDF5 file, for :func:`growing`, :func:`append` and :func:`keep`. Raises OutputError, also where less
    than 16 MB would stay free."""
    with output_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        _check_space(path.parent, 0)
        with h5py.File(path, "w") as file:
            yield file


def _check_space(place: Path, size: int) -> None:
    """Raise OSError where ``size`` bytes and what HDF5 has not yet written have no space: HDF5 that meets a full disk
    leaves a damaged file without an error, or ends the process."""
    if shutil.disk_usage(place).free < size + _SPARE_BYTES:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def keep(file: h5py.File, name: str, array: np.ndarray, **packed: object) -> None:
    """Store a whole array. packed : as of :func:`~blinkgl.io.hdf5.packing`."""
    _check_space(Path(file.filename), array.nbytes)
    file.create_dataset(name, data=array, track_times=False, **packed)


def append(data: h5py.Dataset, rows: np.ndarray) -> None:
    """Append ``rows``."""
    _check_space(Path(data.file.filename), rows.nbytes)
    write_rows(data, len(data), rows)
