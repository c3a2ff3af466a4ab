"""MATLAB's .mat of level 5 (-v7 or older): arrays of numbers, and structs of them. (MAT-File Format, MathWorks.)

scipy's parser of the same ends the process on damaged files, so this one checks every length against the file."""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import AssetError

_NUMBERS = {1: "i1", 2: "u1", 3: "<i2", 4: "<u2", 5: "<i4", 6: "<u4", 7: "<f4", 9: "<f8", 12: "<i8", 13: "<u8"}
_MATRIX, _COMPRESSED, _STRUCT, _ARRAYS = 14, 15, 2, range(6, 16)
_MOST_BYTES = 1 << 32
_DAMAGE = (ValueError, LookupError, RuntimeError, StopIteration, struct.error, zlib.error)


def read_mat(path: str | os.PathLike) -> dict[str, Any]:
    """Arrays (N,) by the names of their variables, a struct as a table of arrays; None for what is neither. Raises
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
    """Type and content of each element. One of up to four bytes has its size in the upper half of the first word."""
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
    """Name and value. A struct's fields follow each other as matrices without names."""
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
