"""Base class of layouts: the files of one published data set, made from a sequence directory."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import h5py
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.io.atomic import output_errors
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


def forward_flow(source: Source) -> Missing | None:
    """Require forward flow, as nearly every layout does."""
    return None if source.flow_times("forward") else Missing("forward flow", "labels: {flow: [forward]}")


def events_before(source: Source) -> Missing | None:
    """Require events of an interval before the first label, where loaders begin."""
    times = source.flow_times("forward")
    if not times or source.start_us <= 2 * times[0][0] - times[0][1]:
        return None
    return Missing("a recording that begins a label interval before the first label", "time: {start: 0}")


def images(source: Source) -> Missing | None:
    """Require images of the event camera."""
    return None if source.image_times else Missing("images", "labels: {images: true}")


# ---------------------------------------------------------------------------------------------------------------------
# Writing below an export's folder.

_ROWS = 1 << 16


def copy(source: Path, target: Path) -> None:
    """Copy ``source``, byte for byte. Raises OutputError."""
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, target)


def write_bytes(target: Path, data: bytes) -> None:
    """Write bytes. Raises OutputError."""
    with output_errors(target):
        target.parent.mkdir(parents=True, exist_ok=True)
        target.write_bytes(data)


def write_lines(target: Path, lines: Sequence[Any]) -> None:
    """Write one value per line, UTF-8. Raises OutputError."""
    write_bytes(target, ("\n".join(map(str, lines)) + "\n").encode())


def growing(
    file: h5py.File, name: str, dtype: DTypeLike, shape: tuple[int, ...] = (), rows: int = _ROWS
) -> h5py.Dataset:
    """Return an empty data set of rows of ``shape``, for :func:`append`: gzip, which every HDF5 reads without a
    plugin."""
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
    """Append ``rows``."""
    start = len(data)
    data.resize(start + len(rows), axis=0)
    data[start:] = rows
