"""Events as NumPy files: .npz with x, y, t, p (and cause, where known), or .npy with a structured or (N, 4) array; also
reads MATLAB's .mat with such variables. Unlike the other formats, whole recordings are in memory."""

from __future__ import annotations

import math
import os
import struct
import zlib
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors
from blinkgl.io.columns import CheckedWriter
from blinkgl.io.images import NpzReader, check_npy, numpy_errors, read_npy
from blinkgl.io.names import series
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.io.records import check_claim, shown_names
from blinkgl.io.tables import (
    Candidate,
    Table,
    TableReader,
    choose,
    named_columns,
    not_columns,
    not_read,
    table_of_columns,
    table_of_records,
    table_of_rows,
)
from blinkgl.io.times import named_unit
from blinkgl.types.events import Events

# ---------------------------------------------------------------------------------------------------------------------
# MATLAB's .mat of level 5 (-v7 or older): arrays of numbers, and structs of them. (MAT-File Format, MathWorks.)
#
# scipy's parser of the same ends the process on damaged files, so this one checks every length against the file.

# Numbers of the format's data types, miINT8 to miUINT64.
_NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
# miMATRIX and miCOMPRESSED; then classes of arrays, mxSTRUCT_CLASS, and mxDOUBLE_CLASS to mxUINT64_CLASS.
_MATRIX, _COMPRESSED, _STRUCT, _ARRAYS = 14, 15, 2, range(6, 16)
_DAMAGE = (ValueError, LookupError, RuntimeError, StopIteration, struct.error, zlib.error)


def read_mat(path: str | os.PathLike) -> dict[str, object]:
    """Return arrays, (N,) or (N, K), by the names of their variables, a struct (or an array of structs, joined) as a
    table of arrays; None for anything else. Raises AssetError: damaged, or it unpacks to far more than it holds."""
    data = memoryview(Path(path).read_bytes())
    # The version, and the mark of the byte order, which reads IM in a little-endian file.
    if data[124:128] != b"\0\1IM":
        raise AssetError("not a little-endian .mat of version 5 to 7", where=os.fspath(path))
    try:
        return dict(_matrix(body) for kind, body in _unpacked(data[128:], path) if kind == _MATRIX)
    except _DAMAGE as error:
        raise AssetError("damaged .mat", where=os.fspath(path), value=str(error)) from None


def _elements(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """Yield type and content of each element. One of up to four bytes has its size in the upper half of the first
    word."""
    at = 0
    while at < len(data):
        kind, size = struct.unpack_from("<II", data, at)
        # Elements are padded to eight bytes, except for compressed ones.
        start, following = at + 8, at + 8 + (size if kind == _COMPRESSED else -(-size // 8) * 8)
        if kind >> 16:
            kind, size, start, following = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if start + size > len(data):
            raise ValueError("an element is longer than the file")
        yield kind, data[start : start + size]
        at = following


def _unpacked(data: memoryview, path: str | os.PathLike) -> Iterator[tuple[int, memoryview]]:
    total = 0
    for kind, body in _elements(data):
        if kind == _COMPRESSED:
            packed = zlib.decompressobj()
            # The first eight bytes say what the element unpacks to.
            head = packed.decompress(body, 8)
            size = struct.unpack_from("<I", head, 4)[0]
            total += size
            check_claim(total, os.fspath(path), len(data))
            yield from _elements(memoryview(head + packed.decompress(packed.unconsumed_tail, size) if size else head))
        else:
            yield kind, body


def _matrix(body: memoryview) -> tuple[str, object]:
    """Return name and value. The fields of each element of a struct array follow each other as matrices without names;
    the elements' columns are joined."""
    parts = _elements(body)
    # An array begins with its flags, whose first byte is its class, its sides and its name.
    flags, shape, called = next(parts)[1], np.frombuffer(next(parts)[1], "<i4"), next(parts)[1]
    name = bytes(called).decode("latin-1")
    if flags[0] == _STRUCT:
        width, names = int.from_bytes(next(parts)[1], "little"), bytes(next(parts)[1])
        # Names of fields have a fixed width and end with a zero.
        fields = [names[i : i + width].split(b"\0")[0].decode("latin-1") for i in range(0, len(names), width)]
        values = [_matrix(one)[1] for _, one in parts]
        if not fields or len(values) % len(fields):
            raise ValueError(f"a struct of {len(fields)} fields with {len(values)} values")
        return name, {field: _joined(values[k :: len(fields)]) for k, field in enumerate(fields)}
    if flags[0] in _ARRAYS:
        kind, numbers = next(parts)
        values = np.frombuffer(numbers, _NUMBERS[kind])
        # MATLAB stores columns one after another.
        return name, values.reshape(shape, order="F") if len(shape) == 2 and shape.min() > 1 else values
    return name, None


def _joined(values: list[object]) -> Any:
    arrays = [value for value in values if isinstance(value, np.ndarray)]
    return np.concatenate(arrays) if len(arrays) == len(values) > 1 else values[0] if values else None


DTYPE = np.dtype([(("us", "t"), "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
"""Of the .npy files that are written; the title of t says its unit."""


_EVIMO = {"index", "discretization", "K", "D", "meta"}
"""Arrays beside the events of EV-IMO's files: ``events`` and two of these mark the layout, t x y p in seconds."""
_KNOWN = ("height", "width", "time_unit", "t_offset", "cause")
_FEW = 16
"""Values of an array that may state something about the others."""
_LAYOUTS = (
    ("vid2e's arrays: ns", {"x": "i2", "y": "i2", "t": "i8", "p": "i1"}, "ns", 1),
    ("Metavision's records of events: µs", {"x": "u2", "y": "u2", "p": "i2", "t": "i8"}, "us", 1),
    ("eventVision's variables: µs", {"x": "u1", "y": "u1", "ts": "u4", "pol": "u1"}, "us", 1),
    ("BS-ERGB's arrays: µs, 32nds of a pixel", {"x": "u4", "y": "u4", "timestamp": "f8", "polarity": "u1"}, "us", 32),
)
"""Layouts of columns that state no unit, by the names and types that no other known writer has."""


class ArrayReader(TableReader):
    """Reads ``.npz`` with four columns or (N, 4) arrays, of which only the chosen one is loaded, and ``.npy``,
    structured or (N, 4). Raises AssetError: several arrays that may be the events, which it lists; a member that would
    have to be unpickled, if it is the chosen one."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        path, skipped = Path(path), []
        with numpy_errors(path):
            if path.suffix.lower() == ".npy":
                table = _table_of_npy(read_npy(path), str(path), reading)
            else:
                with NpzReader(path) as archive:
                    shapes, skipped = archive.shapes()
                    candidates = _candidates(shapes, archive.__getitem__, str(path), reading, skipped)
                    table = choose(candidates, reading, str(path), archive.names)
            super().__init__(path, reading, table)
        self.notes += [f"left out: {shown_names(skipped)}, which would have to be unpickled"] if skipped else []


FOLDED = (".npz",)
"""Endings of files that are one recording where they fill a folder."""
EVIMO2 = tuple(f"dataset_events_{part}.npy" for part in ("t", "xy", "p"))
"""Arrays of the events of an EVIMO2v2 sequence, files of one folder: seconds, (N, 2) px, 0 or 1."""


class Evimo2Reader(TableReader):
    """Reads the three arrays of a folder, or those beside one of them; they stay on disk until a piece is read. Raises
    AssetError: one is missing, or not of its form."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        folder = Path(path) if Path(path).is_dir() else Path(path).parent
        t, xy, p = (_mapped(folder / name) for name in EVIMO2)
        if xy.ndim != 2 or xy.shape[1] != 2:
            raise AssetError("no rows of x and y", where=str(folder / EVIMO2[1]), value=xy.shape, accepted="(N, 2)")
        known = {"unit": "s", "layout": "EVIMO2's three arrays: seconds"} if t.dtype.kind == "f" else {}
        columns = {"t": t, "x": xy[:, 0], "y": xy[:, 1], "p": p}
        super().__init__(folder, reading, table_of_columns(columns, str(folder), **known))


class NpzFolderReader:
    """Reads the ``.npz`` of a folder, in the order of their numbers, as one recording: BS-ERGB's, EventScape's and
    vid2e's. Raises AssetError, naming the file, as :class:`ArrayReader`; files of different sensors, or whose clocks
    begin again."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        self.path, self._reading, self.unread = Path(path), reading, 0
        numbered = series(self.path, FOLDED)
        self._files, first = numbered.files, ArrayReader(numbered.files[0], reading)
        self.height, self.width, self.unit, self.causes = first.height, first.width, first.unit, first.causes
        self.notes = [*first.notes, *numbered.notes, f"read as one recording: {len(self._files)} files"]

    def chunks(self) -> Iterator[Events]:
        """Yield the events of all files."""
        begun, last, self.unread = 0, 0, 0
        for path in self._files:
            one, count = ArrayReader(path, self._reading), 0
            if (one.height, one.width) != (self.height, self.width):
                size = f"{one.width}x{one.height}"
                raise AssetError("another sensor than in the file before", where=str(path), value=size)
            for events in one.chunks():
                if not count and len(events):
                    # Times that only overlap are refused where their order is checked; a file that begins no later than
                    # the one before it has a clock of its own.
                    if events.t[0] <= begun < last:
                        raise AssetError(
                            "the times begin again in this file",
                            where=str(path),
                            value=int(events.t[0]),
                            accepted=f"one clock: {begun} µs or later; or each file by itself",
                        )
                    begun = int(events.t[0])
                count += len(events)
                last = int(events.t[-1]) if len(events) else last
                yield events
            self.unread += one.unread


def _mapped(path: Path) -> np.ndarray:
    if not path.is_file():
        raise AssetError("no such file", where=str(path), accepted=f"{', '.join(EVIMO2)} in one folder")
    with numpy_errors(path):
        check_npy(path)
        return np.load(path, mmap_mode="r", allow_pickle=False)


def _table_of_npy(array: np.ndarray, where: str, reading: EventReading) -> Table:
    if not array.dtype.names:
        plain: list[Candidate] = [("", lambda: table_of_rows(array, where, reading.columns))]
        return choose(plain if array.ndim == 2 else [], reading, where, ["a plain array"])
    arrays = {name: array[name] for name in array.dtype.names}
    titles = [field[2] for field in (array.dtype.fields or {}).values() if len(field) > 2]
    arrays |= {"time_unit": np.array(titles[0])} if titles else {}
    shapes = {name: (one.shape, one.dtype) for name, one in arrays.items()}
    return choose(_candidates(shapes, arrays.__getitem__, where, reading), reading, where, list(shapes))


def _candidates(
    shapes: Mapping[str, tuple[tuple[int, ...], np.dtype]],
    load: Callable[[str], np.ndarray],
    where: str,
    reading: EventReading,
    others: Collection[str] = (),
) -> list[Candidate]:
    """Return what may be the events among arrays, of which a name may be declared: columns x, y, t, p; else records or
    arrays of four columns, those called "events" before others.   others : names that are in the file beside
    ``shapes``."""
    columns = named_columns(shapes, reading, where)
    beside = {name: load(name) for name in _KNOWN if name in shapes and name != "cause"}
    sides = [_declared(beside[side], side, where) for side in ("height", "width") if side in beside]
    known: dict[str, Any] = {"size": (sides[0], sides[1]) if len(sides) == 2 else None}
    if "t_offset" in beside and beside["t_offset"].size == 1 and beside["t_offset"].dtype.kind in "iuf":
        known["offset"] = beside["t_offset"].item()
    small = [name for name, (shape, _) in shapes.items() if math.prod(shape) <= _FEW]
    known["notes"] = not_read([*small, *others], [k for k in _KNOWN if k != "t_offset" or "offset" in known])
    if "time_unit" in beside:
        known["unit"] = named_unit(f"[{beside['time_unit']}]")

    def table(name: str) -> Table:
        array = load(name)
        if array.dtype.names:
            return table_of_records(array, named_columns(array.dtype.names, reading, where), place=name, **known)
        marks = _EVIMO & {*shapes, *others}
        evimo = name == "events" and len(marks) >= 2 and array.dtype.kind == "f" and not reading.columns
        layout = {"unit": "s", "layout": "EV-IMO's arrays: t x y p, seconds"} if evimo else {}
        order = ("t", "x", "y", "p") if evimo else reading.columns
        return table_of_rows(array, where, order, place=name, **{**known, **layout})

    # What the file itself states overrules a layout.
    for layout, types, unit, per_px in _LAYOUTS:
        if set(columns.values()) == types.keys() and all(shapes[k][1] == np.dtype(kind) for k, kind in types.items()):
            known = {"unit": unit, "layout": layout, "per_px": per_px, **known}
    if set("txyp") <= columns.keys() and reading.stream not in shapes:
        used = [*columns.values(), *(["cause"] if "cause" in shapes else [])]
        count = shapes[columns["t"]][0][:1]
        others = [name for name, (shape, _) in shapes.items() if shape[:1] == count and name not in (*used, *_KNOWN)]
        # Of a single event every lone number in the file is as long as a column, and need not be one.
        known["notes"] = [*known["notes"], *not_columns(others if count != (1,) else ())]
        arrays = {name: load(name) for name in used}
        return [("", lambda: _of_columns(columns, arrays, where, **known))]
    wide = 4 if not reading.columns or reading.named else len(reading.columns)
    rows = [
        name
        for name, (shape, dtype) in shapes.items()
        if (len(shape) == 2 and shape[1] == wide and dtype.kind in "iuf")
        or (len(shape) == 1 and set("txyp") <= named_columns(dtype.names or (), reading, where).keys())
    ]
    # A name may mean any of them; a number counts those that the refusal lists.
    called = (
        [name for name in rows if name.rpartition("/")[2].lower() in ("events", "event")]
        if reading.stream not in rows
        else rows
    )
    return [(name, lambda name=name: table(name)) for name in called or rows]


def _of_columns(columns: Mapping[str, str], arrays: Mapping[str, np.ndarray], where: str, **known: object) -> Table:
    chosen_ = {slot: np.asarray(arrays[name]) for slot, name in columns.items()}
    if isinstance(arrays.get("cause"), np.ndarray):
        chosen_["cause"] = arrays["cause"]
    return table_of_columns(chosen_, where, heading=columns["t"], **known)


class MatReader(TableReader):
    """Reads ``.mat`` of version 7 or older with variables, or structs or arrays of structs, of such names. y is as in
    the file."""

    def __init__(self, path: str | os.PathLike, reading: EventReading = AS_FILE):
        variables, where = read_mat(path), os.fspath(path)
        tables = {"": variables} | {name: one for name, one in variables.items() if isinstance(one, dict)}
        candidates: list[Candidate] = []
        for name, table in tables.items():
            arrays = {key: one for key, one in table.items() if isinstance(one, np.ndarray)}
            shapes = {key: (one.shape, one.dtype) for key, one in arrays.items()}
            inner = _candidates(shapes, arrays.__getitem__, where, replace(reading, stream=None))
            candidates += [("/".join(filter(None, (name, key))), make) for key, make in inner]
        super().__init__(Path(path), reading, choose(candidates, reading, where, list(variables)))


class ArrayWriter(CheckedWriter):
    """Collects events and writes on close."""

    def __init__(self, path: str | os.PathLike, height: int | None, width: int | None):
        super().__init__(path, height, width)
        self._chunks: list[Events] = []

    def _write(self, events: Events) -> None:
        self._chunks.append(events.copy())

    def close(self, t_end_us: int | None = None) -> None:
        e = Events.concatenate(self._chunks)
        with output_errors(self.path), open(self.path, "wb") as file:
            if self.path.suffix.lower() == ".npz":
                columns = {k: getattr(e, k) for k in e.columns}
                if None not in self._size:
                    columns |= {"height": self._size[0], "width": self._size[1]}
                np.savez_compressed(file, **columns, time_unit="us")
            else:
                dtype = DTYPE if e.cause is None else np.dtype([*DTYPE.descr, ("cause", "u1")])
                table = np.empty(len(e), dtype)
                for k in dtype.names or ():
                    table[k] = getattr(e, k)
                np.save(file, table, allow_pickle=False)


def _declared(value: np.ndarray, name: str, path) -> int:
    # MATLAB writes all numbers as floats.
    if value.size != 1 or value.dtype.kind not in "iuf" or not float(value.item()).is_integer():
        raise AssetError(f"'{name}' is no integer", where=str(path), value=f"{value.dtype} {value.shape}")
    return int(value.item())
