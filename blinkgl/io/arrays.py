"""Events as NumPy files: .npz with x, y, t, p (and cause, where known), or .npy with a structured array; read also
MATLAB's .mat with such variables. Whole recordings in memory, unlike the others."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, microseconds
from blinkgl.io.images import NpzReader, numpy_errors, read_npy
from blinkgl.io.mat import read_mat
from blinkgl.types.events import Events

DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
_NAMES = {
    "t": ("t", "ts", "timestamp", "timestamps", "t_us", "ts_us", "timestamps_us"),
    "x": ("x",),
    "y": ("y",),
    "p": ("p", "polarity", "polarities", "pol", "on"),
}


class ArrayReader:
    """``.npz`` with four columns or ``.npy`` structured. Integer times are µs, float
    times seconds; p is 0/1, -1/1 or bool.

    A plain (N, 4) array is refused: files in the wild disagree about the order of its columns."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.height = self.width = None
        columns, in_seconds = self._columns(path)
        check_size(self.height, self.width, str(path))
        t = columns["t"]
        if in_seconds and t.dtype.kind == "f" and t.ndim == 1:
            columns["t"] = microseconds(t, str(path))
        self._events = events_of(*(columns[k] for k in "xytp"), str(path), cause=columns.get("cause"), signed=True)
        self.causes = self._events.cause is not None

    def _columns(self, path: str | os.PathLike) -> tuple[dict[str, np.ndarray], bool]:
        """The columns of the file, and whether times that are floats are seconds."""
        with numpy_errors(path):
            if self.path.suffix.lower() == ".npy":
                table = read_npy(path)
                named = _named(table.dtype.names or (), path)
                columns = {k: table[name] for k, name in named.items()}
            else:
                with NpzReader(path) as arrays:
                    named = _named(arrays.names, path)
                    columns = {k: arrays[name] for k, name in named.items()}
                    if "height" in arrays and "width" in arrays:
                        self.height, self.width = (_declared(arrays[k], k, path) for k in ("height", "width"))
        return columns, not named["t"].endswith("_us")

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        for i in range(0, len(self._events), size):
            yield self._events.part(slice(i, i + size))


class MatReader(ArrayReader):
    """``.mat`` of version 7 or older with variables, or one struct, of such names. MATLAB's numbers are floats unless
    somebody said otherwise: times are seconds where one of them has a fraction, else µs. y is as the file has it."""

    def _columns(self, path: str | os.PathLike) -> tuple[dict[str, np.ndarray], bool]:
        found = read_mat(path)
        structs = [one for one in found.values() if isinstance(one, dict)]
        arrays = structs[0] if len(structs) == 1 else found
        named = _named(arrays, path)
        columns = {k: np.asarray(arrays[name]) for k, name in named.items()}
        t = columns["t"]
        whole = t.dtype.kind != "f" or bool((np.floor(t) == t).all())
        return columns, not whole and not named["t"].endswith("_us")


class ArrayWriter:
    """Collects events, writes on close."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        self.path, self._size, self._chunks = Path(path), (height, width), []
        self._count, self._last = 0, None

    def append(self, events: Events) -> None:
        self._last = check_events(
            events, str(self.path), self._count, height=self._size[0], width=self._size[1], after=self._last
        )
        self._count += len(events)
        self._chunks.append(events.copy())

    def close(self, t_end_us: int | None = None) -> None:
        e = Events.concatenate(self._chunks)
        with output_errors(self.path), open(self.path, "wb") as file:
            if self.path.suffix == ".npz":
                columns = {k: getattr(e, k) for k in e.columns}
                np.savez_compressed(file, **columns, height=self._size[0], width=self._size[1])
            else:
                table = np.empty(len(e), DTYPE if e.cause is None else [*DTYPE.descr, ("cause", "u1")])
                for k in table.dtype.names:
                    table[k] = getattr(e, k)
                np.save(file, table, allow_pickle=False)

    def abort(self) -> None:
        self._chunks = []


def _named(names: Iterable[str], path) -> dict[str, str]:
    """Column -> its name in the file; AssetError when one is missing."""
    found = {k: next((n for n in options if n in names), None) for k, options in _NAMES.items()}
    if "cause" in names:
        found["cause"] = "cause"
    if missing := [k for k, name in found.items() if name is None]:
        raise AssetError(
            f"no column '{missing[0]}'",
            where=str(path),
            value=list(names) or "a plain array",
            accepted="x, y, t, p in an .npz, a .mat or a structured .npy",
        )
    return found


def _declared(value: np.ndarray, name: str, path) -> int:
    if value.size != 1 or value.dtype.kind not in "iu":
        raise AssetError(f"'{name}' is no integer", where=str(path), value=f"{value.dtype} {value.shape}")
    return int(value.item())
