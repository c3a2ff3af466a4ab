"""Events as NumPy files: .npz with x, y, t, p (and cause, where known), or .npy with a structured array; also reads
MATLAB's .mat with such variables. Unlike the other formats, whole recordings are in memory."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import check_events, check_size, events_of, microseconds
from blinkgl.io.images import NpzReader, numpy_errors, read_npy
from blinkgl.types.events import Events

# ---------------------------------------------------------------------------------------------------------------------
# MATLAB's .mat of level 5 (-v7 or older): arrays of numbers, and structs of them. (MAT-File Format, MathWorks.)
#
# scipy's parser of the same ends the process on damaged files, so this one checks every length against the file.

_NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_MATRIX, _COMPRESSED, _STRUCT, _ARRAYS = 14, 15, 2, range(6, 16)
_MOST_BYTES = 1 << 32
_DAMAGE = (ValueError, LookupError, RuntimeError, StopIteration, struct.error, zlib.error)


def read_mat(path: str | os.PathLike) -> dict[str, Any]:
    """Return arrays (N,) by the names of their variables, a struct as a table of arrays; None for anything else. Raises
    AssetError: version 7.3, which is HDF5; damaged."""
    data = memoryview(Path(path).read_bytes())
    if data[124:128] in (b"\0\2IM", b"\2\0MI") or data[:8] == b"\x89HDF\r\n\x1a\n":
        raise AssetError("a .mat of version 7.3", where=os.fspath(path), accepted="save(…, '-v7') in MATLAB")
    if data[124:128] != b"\0\1IM":
        raise AssetError("not a little-endian .mat of version 5 to 7", where=os.fspath(path))
    try:
        return dict(_matrix(body) for kind, body in _unpacked(data[128:]) if kind == _MATRIX)
    except _DAMAGE as error:
        raise AssetError("damaged .mat", where=os.fspath(path), value=str(error)) from None


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of each element. One of up to four bytes has its size in the upper half of the first
    word."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        start, following = at + 8, at + 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if kind >> 16:
            kind, size, start, following = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if start + size > len(data):
            raise ValueError("an element is longer than the file")
        yield kind, data[start : start + size]
        at = following


def _unpacked(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    for kind, body in _elements(data):
        if kind == _COMPRESSED:
            yield from _elements(memoryview(zlib.decompressobj().decompress(body, _MOST_BYTES)))
        else:
            yield kind, body


def _matrix(body: memoryview) -> tuple[str, Any]:
    """Return name and value. A struct's fields follow each other as matrices without names."""
    parts = _elements(body)
    flags, _, called = next(parts)[1], next(parts), next(parts)[1]
    name = bytes(called).decode("latin-1")
    if flags[0] == _STRUCT:
        width, names = int.from_bytes(next(parts)[1], "little"), bytes(next(parts)[1])
        fields = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), width)]
        return name, {field: _matrix(one)[1] for field, (_, one) in zip(fields, parts, strict=False)}
    if flags[0] in _ARRAYS:
        kind, numbers = next(parts)
        return name, np.frombuffer(numbers, _NUMBERS[kind])
    return name, None


DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
_NAMES = {
    "t": ("t", "ts", "timestamp", "timestamps", "t_us", "ts_us", "timestamps_us"),
    "x": ("x",),
    "y": ("y",),
    "p": ("p", "polarity", "polarities", "pol", "on"),
}


class ArrayReader:
    """Reads ``.npz`` with four columns or structured ``.npy``. Integer times are µs, float times seconds; p is 0/1,
    -1/1 or bool.

    A plain (N, 4) array is refused: existing files disagree about the order of its columns."""

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
        """Return the columns of the file, and whether float times are seconds."""
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
    """Reads ``.mat`` of version 7 or older with variables, or one struct, of such names. MATLAB's numbers are floats by
    default: times are seconds where one of them has a fraction, else µs. y is as in the file."""

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
    """Collects events and writes on close."""

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
    """Return column -> its name in the file. Raises AssetError when one is missing."""
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
