"""Untrusted HDF5 files: opened without following references to other files, data sets checked before use.

An HDF5 file may say that its data are in other files (external storage, virtual data sets, external links): read as
root, such a file copies any file into a column. Every file is opened for reading by :func:`open_hdf5`, which refuses
them by name.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import itertools
import math
import re
import zlib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, BinaryIO

import h5py
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.errors import AssetError, ConfigError
from blinkgl.io.records import check_claim
from blinkgl.machine.closing import Closing

_MAX_CHUNK_BYTES = 1 << 28
"""HDF5 unpacks a whole chunk, even for a small part of it."""
_MAX_FILLED_BYTES = 1 << 28
"""Of a data set whose file states a value for what it does not store."""

_LEVEL, SHUFFLE, _BIT_SHUFFLE = 1, 1, 2
"""Blosc's numbers, which hdf5plugin has, too; that is imported only where a filter of its is used."""
CODECS = {"zstd": 5, "lz4": 1}
"""Blosc's codecs -> their numbers in the filter's parameters."""
_NAMES = {number: name.encode() for name, number in CODECS.items()}
_BLOSC_VALUES = 4
"""Parameters that Blosc's filter reads without checking their number; with fewer it crashes."""
_FILTERS = {1: "gzip", 2: "shuffle", 3: "Fletcher32", 32000: "lzf", 32001: "Blosc", 32004: "LZ4", 32015: "zstd"}
"""Filters that are run on files of strangers. Others that HDF5 or hdf5plugin know (szip, SZ, ZFP …) end the process on
a damaged chunk."""
_SHUFFLE, _SUM, _SUM_BYTES = 2, 3, 4
"""Fletcher32 ends the process on chunks shorter than its sum, so it has to be the last filter: their sizes show it."""
_BLOSC, _PLUGGED = 32001, frozenset((32001, 32004, 32015))
"""Blosc, and all filters that hdf5plugin brings."""
_ECF = 0x8ECF
"""Prophesee's filter."""


class _Held:
    """What a name in a file leads to, with the file's path for messages."""

    def __init__(self, held: h5py.HLObject, path: Path):
        self._held, self._path = held, path

    def attribute(self, name: str) -> Any:
        """Return an attribute, numbers or text; None where there is none.

        Raises AssetError: of another type. h5py reads lists of any length without checking the file, and a damaged type
        that is taken for one ends the process."""
        if name not in self._held.attrs:
            return None
        kind = h5py.h5a.open(self._held.id, name.encode()).get_type().get_class()
        if kind not in (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING):
            raise AssetError(f"attribute '{name}' holds neither numbers nor text", where=str(self._path))
        return self._held.attrs[name]

    def attributes(self) -> list[str]:
        """Return the names of all attributes."""
        return list(self._held.attrs)


class Data(_Held):
    """A data set of a file that anybody may have written. What it says of itself is there at once; a value is decoded
    only after its storage was checked.

    name : its place in the file.   shape : None for one without values.   dtype : NumPy's."""

    def __init__(self, data: h5py.Dataset, path: Path):
        super().__init__(data, path)
        self.name, self.shape, self.dtype, self._checked = data.name.strip("/"), data.shape, data.dtype, False

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, place: object) -> np.ndarray:
        """Return the values at ``place``, integers and slices. Raises AssetError: as :meth:`check`; more than fits into
        memory; damaged."""
        self.check()
        with hdf5_errors(self._path):
            # The bytes of the result: an axis without a part is read whole, and an integer takes one of it.
            count, parts = self.dtype.itemsize, place if isinstance(place, tuple) else (place,)
            for size, part in itertools.zip_longest(self.shape, parts[: len(self.shape)], fillvalue=slice(None)):
                count *= len(range(*part.indices(size))) if isinstance(part, slice) else 1
            check_claim(
                count,
                f"{self._path}: '{self.name}'",
                self._held.id.get_storage_size() if self._held.chunks else None,
            )
            return self._held[place]

    def check(self) -> None:
        """Check how it is stored, once. Raises AssetError: a type, a filter that is not run, values that were never
        written, huge chunks, chunks that unpack to more than their values."""
        if not self._checked:
            with hdf5_errors(self._path):
                _check_storage(self._held, f"dataset '{self.name}'", self._path)
            self._checked = True


class Group(_Held):
    """A group of such a file: the names in it, and what they lead to, :class:`Data` or groups."""

    def __contains__(self, name: str) -> bool:
        return self.get(name) is not None

    def get(self, name: str) -> Data | Group | None:
        """Return what a name, or names with ``/`` between them, leads to; None: nothing, or a type alone."""
        with hdf5_errors(self._path):
            kinds = {h5py.Dataset: Data, h5py.Group: Group}
            held = self._held.get(name)
            return kinds[type(held)](held, self._path) if type(held) in kinds else None

    def data(self) -> dict[str, Data]:
        """Return the data sets of this group by name, those of groups in it not."""
        held = {name: self.get(name) for name in self.names()}
        return {name: data for name, data in held.items() if isinstance(data, Data)}

    def names(self) -> list[str]:
        """Return the names in this group."""
        return list(self._held)

    def groups(self) -> dict[str, Group]:
        """Return this group, as "", and all groups below it by their names, with ``/`` between them."""
        below: dict[str, Group] = {"": self}
        self._held.visititems(
            lambda name, held: below.update({name: Group(held, self._path)}) if isinstance(held, h5py.Group) else None
        )
        return below


class Hdf5File(Group, Closing):
    """A file that is open for reading: its first group. Use as a context manager."""

    def close(self) -> None:
        self._held.close()


def open_hdf5(path: Path) -> Hdf5File:
    """Open a file for reading: the only door to HDF5, behind which nothing is decoded unchecked. Raises AssetError with
    the likely cause, also for a file that refers to other files."""
    path = Path(path)
    if not path.is_file():
        raise AssetError("no such file", where=str(path))
    try:
        file = h5py.File(path, "r")
    except (OSError, ValueError) as error:
        text = " ".join(str(error).split())
        problem = (
            "truncated HDF5 file"
            if "truncated" in text
            else "not an HDF5 file"
            if "signature" in text
            else f"cannot be opened: {text}"
        )
        raise AssetError(problem, where=str(path)) from error
    with hdf5_errors(path, file):
        links: list[tuple[bytes, int]] = []
        # The callback may not raise: h5py then ends in a SystemError.
        file.id.links.visit(lambda name, link: links.append((name, link.type)), info=True)
        for name, kind in links:
            if (what := _leads_out(file.id, name, kind)) is not None:
                raise AssetError(
                    f"'{name.decode(errors='replace')}' is {what}, which refers to other files; refused",
                    where=str(path),
                    accepted="a file that holds its own data",
                )
    return Hdf5File(file, path)


def _leads_out(root: h5py.h5f.FileID, name: bytes, kind: int) -> str | None:
    """Return what is under ``name``, when it is stored elsewhere. Soft links stay inside the file: their targets have
    their own links, which are checked."""
    if kind == h5py.h5l.TYPE_SOFT:
        return None
    if kind != h5py.h5l.TYPE_HARD:
        return "an external link" if kind == h5py.h5l.TYPE_EXTERNAL else "a link of an unknown kind"
    if h5py.h5o.get_info(root, name).type != h5py.h5o.TYPE_DATASET:
        return None
    layout = h5py.h5d.open(root, name).get_create_plist()
    if any(layout.get_filter(k)[0] in _PLUGGED for k in range(layout.get_nfilters())):
        with contextlib.suppress(ImportError):  # reading then says which filter is missing
            _plugin()
    if layout.get_external_count():
        return "a data set with external storage"
    if layout.get_layout() == h5py.h5d.VIRTUAL:
        return "a virtual data set"
    return None


@contextlib.contextmanager
def hdf5_errors(path: Path, file: h5py.File | Hdf5File | None = None) -> Iterator[None]:
    """Convert h5py's errors for invalid bytes to AssetError; ``file`` is closed on any exception."""
    try:
        yield
    except BaseException as error:
        if file is not None:
            with contextlib.suppress(Exception):  # a damaged file may refuse that too
                file.close()
        if isinstance(error, (OSError, KeyError, RuntimeError, ValueError, TypeError, OverflowError, MemoryError)):
            text = " ".join(str(error).split())[:160]
            if re.search(r"required filter|plugin|can't open directory", text):
                raise AssetError(
                    f"compressed with an HDF5 filter that is not installed ({text})",
                    where=str(path),
                    accepted="a filter of the package hdf5plugin (Blosc, Zstd, LZ4 …), or gzip",
                ) from error
            raise AssetError(f"damaged HDF5 file: {text}", where=str(path)) from error
        raise


def dataset(file: Group, name: str, path: Path, *, shape: tuple[int | None, ...], kinds: str = "iu") -> Data:
    """Return the data set ``name``, with its shape (None: any length) and NumPy kinds ("iu" integers, "f" floats, "b"
    bools) as requested, and as many values stored as declared.

    Raises AssetError: none of that name (or a group), another shape or type, values that were never written, huge
    chunks."""
    data = file.get(name)
    if not isinstance(data, Data):
        raise AssetError(f"no dataset '{name}'", where=str(path))
    fits = (
        data.shape is not None
        and len(data.shape) == len(shape)
        and all(b in (None, a) for a, b in zip(data.shape, shape))
    )
    if not fits or data.dtype.kind not in kinds or data.dtype.shape:
        wanted = {"iu": "integers", "iub": "integers", "f": "floats"}.get(kinds, "numbers")
        raise AssetError(
            f"dataset '{name}' has the wrong shape or type",
            where=str(path),
            value=f"{data.dtype} {data.shape}",
            accepted=f"{wanted} ({', '.join('N' if n is None else str(n) for n in shape)})",
        )
    data.check()
    return data


def _check_storage(data: h5py.Dataset, name: str, path: Path) -> None:
    """Check how a data set is stored before a value of it is read. Raises AssetError as :meth:`Data.check`."""
    layout = data.id.get_create_plist()
    filters = [layout.get_filter(k) for k in range(layout.get_nfilters())]
    codes = [code for code, *_ in filters]
    packing = [code for code in codes if code not in (_SHUFFLE, _SUM)]
    others = [f"{f[0]} {f[3].decode(errors='replace')}".strip() for f in filters if f[0] not in _FILTERS]
    bare = [code for code, _, values, _ in filters if code == _BLOSC and len(values) < _BLOSC_VALUES]
    raw = math.prod(data.chunks or ()) * data.dtype.itemsize
    # The place and the stored size of each chunk, of which only these filters tell something.
    chunks: list[tuple[int, int, int]] = []
    if data.chunks and {_SUM, *_CLAIMED} & {*codes}:
        data.id.chunk_iter(lambda c: chunks.append((c.byte_offset, c.size, c.filter_mask)))
    if _SUM in codes and (codes[-1] != _SUM or any(size <= _SUM_BYTES for _, size, _ in chunks)):
        others = ["Fletcher32 within others, or over less than its sum"]
    # The number of chunks along each axis is the quotient, rounded up; compact data lie in the object's header.
    missing = (
        data.id.get_num_chunks() < math.prod(-(-n // c) for n, c in zip(data.shape, data.chunks))
        if data.chunks
        else layout.get_layout() != h5py.h5d.COMPACT and data.id.get_storage_size() < data.nbytes
    )
    # A value that the file itself states for what it leaves out is read, up to what a few kilobytes may claim.
    if layout.fill_value_defined() == h5py.h5d.FILL_VALUE_USER_DEFINED and data.nbytes <= _MAX_FILLED_BYTES:
        missing = False
    packs = "the camera's .raw" if _ECF in codes else f"{', '.join(_FILTERS.values())} (h5repack -f GZIP=1)"
    problems: list[tuple[object, str, object, str]] = [
        (not _plain(data.dtype), f"{name} holds neither numbers nor text", str(data.dtype), "numbers or text"),
        (others, f"{name} is packed by an HDF5 filter that is not run here", ", ".join(others), packs),
        (bare, f"damaged HDF5 file: {name} lacks data that Blosc needs", bare, "its parameters"),
        (packing[1:], f"{name} is packed twice", packing, "one filter that packs"),
        (
            raw > _MAX_CHUNK_BYTES,
            f"{name} has chunks that are too large",
            data.chunks,
            f"{_MAX_CHUNK_BYTES} bytes",
        ),
        (missing, f"{name} declares {data.size} values, but stores fewer", data.id.get_storage_size(), "all of them"),
    ]
    for _, problem, value, accepted in (row for row in problems if row[0]):
        raise AssetError(problem, where=str(path), value=value, accepted=accepted)
    # HDF5 unpacks as much as a chunk itself states; Blosc ends at 2 GB, lzf at 88 times.
    if packing and packing[0] in _CLAIMED:
        with open(path, "rb") as file:
            # Bits of the mask are the filters that were left out for a chunk.
            for offset, size, mask in chunks:
                file.seek(offset)
                unpacked = 0 if mask >> codes.index(packing[0]) & 1 else _CLAIMED[packing[0]](file, size, raw)
                # A chunk that cannot be packed may be longer than its values, by a 128th and a few bytes.
                if max(unpacked, size - raw // 128 - 64) > raw + _SUM_BYTES:
                    problem = f"damaged HDF5 file: a chunk of {name} unpacks to more than its values"
                    raise AssetError(problem, where=str(path), value=f"{size} bytes", accepted=f"{raw} bytes of values")


def _inflated(file: BinaryIO, size: int, raw: int) -> int:
    """Return how many bytes a chunk of gzip unpacks to, at most one too many; 0 where its size cannot make a gigabyte,
    of 1,032 a byte, or where reading says what is wrong."""
    with contextlib.suppress(zlib.error):
        if 1032 * size > 1 << 30:
            return len(zlib.decompressobj().decompress(file.read(size), raw + _SUM_BYTES + 1))
    return 0


def _zstd_claim(file: BinaryIO, *_: int) -> int:
    """Return the size of the content that a frame states, 0: none, which the filter refuses. (RFC 8878, 3.1.1.1)"""
    head = file.read(18).ljust(18, b"\0")
    flags, single = head[4], head[4] >> 5 & 1
    # The size follows the window's byte, which a single segment lacks, and the number of a dictionary.
    start, length = 6 - single + (0, 1, 2, 4)[flags & 3], (single, 2, 4, 8)[flags >> 6]
    return int.from_bytes(head[start : start + length], "little") + (256 if length == 2 else 0)


# Filters -> what a chunk unpacks to: of the file, which is at its beginning, its size, and that of its values.
_CLAIMED: dict[int, Callable[[BinaryIO, int, int], int]] = {
    1: _inflated,
    32004: lambda file, *_: int.from_bytes(file.read(8), "big"),
    32015: _zstd_claim,
}


def _plain(dtype: np.dtype) -> bool:
    """Return whether a type is of numbers, of text, or a record of these: nothing that leads to other objects."""
    if dtype.names is not None:
        return all(_plain(dtype[name]) for name in dtype.names)
    return dtype.base.kind in "iufbS" or h5py.check_string_dtype(dtype) is not None


def growing_dataset(
    file: h5py.File,
    name: str,
    shape: tuple[int, ...],
    dtype: DTypeLike,
    chunks: tuple[int, ...],
    codec: str = "zstd",
) -> h5py.Dataset:
    """Return a new data set that grows along its first axis. codec : of :data:`CODECS`, packed by Blosc, level 1 with
    bit shuffle (filter 32001), zstd as in DSEC's files; or "gzip", level 1 with byte shuffle, which every HDF5
    unpacks."""
    packed = packing(codec, _BIT_SHUFFLE)
    return file.create_dataset(
        name, shape, dtype, maxshape=(None, *shape[1:]), chunks=chunks, track_times=False, **packed
    )


def packing(codec: str, shuffle: int) -> dict[str, object]:
    """Return the arguments of ``create_dataset`` for a codec of :func:`growing_dataset`.   shuffle : of Blosc.

    Raises ConfigError: hdf5plugin is not installed, which gzip does not need."""
    if codec == "gzip":
        return {"compression": "gzip", "compression_opts": _LEVEL, "shuffle": True}
    try:
        blosc = _plugin().Blosc
    except ImportError as error:
        accepted = "use pip install hdf5plugin, or in a recipe output.compression: gzip"
        raise ConfigError("no Blosc for HDF5", value=codec, accepted=accepted) from error
    return {"compression": blosc(cname=codec, clevel=_LEVEL, shuffle=shuffle)}


def write_rows(data: h5py.Dataset, start: int, rows: np.ndarray) -> None:
    """Set ``data[start:] = rows`` for a data set of :func:`growing_dataset`, which grows to hold them.

    Blosc's chunks are compressed here, each by one thread, instead of inside HDF5. There Blosc would use the user's
    ``BLOSC_NTHREADS``, and with more than one thread it stores its blocks in the order they finish: bytes would differ
    from run to run."""
    if data.compression == "gzip":
        data.resize(start + len(rows), axis=0)
        data[start:] = rows
        return
    # Value 6 of Blosc's filter is the number of its codec.
    step, codec = data.chunks[0], data.id.get_create_plist().get_filter(0)[2][6]
    # The chunk in which the new rows begin is packed again as a whole.
    begin = start // step * step
    rows = np.ascontiguousarray(rows, data.dtype)
    if begin < start:
        rows = joined([data[begin:start], rows])
    data.resize(begin + len(rows), axis=0)
    for i in range(0, len(rows), step):
        piece = rows[i : i + step]
        if len(piece) < step:  # HDF5 stores the last chunk whole, filled with zeros
            piece = joined([piece, np.zeros((step - len(piece), *piece.shape[1:]), piece.dtype)])
        packed = _compressed(piece, _NAMES[codec])
        # As in HDF5's filter: what does not become smaller is stored unchanged, and the chunk says so.
        skipped = 1 if packed is None else 0
        data.id.write_direct_chunk(
            (begin + i, *(0,) * (data.ndim - 1)), piece.tobytes() if skipped else packed, skipped
        )


class Blocks:
    """Rows of several data sets of :func:`growing_dataset`, collected to blocks, so that a file's bytes do not depend
    on the pieces in which its rows come.

    columns : by name; more may be added before the first row.   size : rows of a block.   store : takes each block,
    rows by name, which nobody changes any more."""

    def __init__(self, columns: dict[str, h5py.Dataset], size: int, store: Callable[[dict[str, np.ndarray]], None]):
        self._columns, self._size, self._store, self._fill = columns, size, store, 0
        self._block: dict[str, np.ndarray] = {}

    def add(self, rows: Mapping[str, np.ndarray], count: int) -> None:
        """Append ``count`` rows, which are copied."""
        start = 0
        while start < count:
            if not self._fill:
                self._block = {k: np.empty((self._size, *c.shape[1:]), c.dtype) for k, c in self._columns.items()}
            taken = min(count - start, self._size - self._fill)
            for name, column in self._block.items():
                column[self._fill : self._fill + taken] = rows[name][start : start + taken]
            self._fill, start = self._fill + taken, start + taken
            if self._fill == self._size:
                self.flush()

    def flush(self) -> None:
        """Store the rows of the last block, which need not be full."""
        if self._fill:
            self._store({name: column[: self._fill] for name, column in self._block.items()})
            self._fill = 0


def joined(pieces: list[np.ndarray]) -> np.ndarray:
    """Return the arrays one after another, in the dtype of the first: NumPy's own concatenation removes the gaps
    between a record's fields, which a file's records keep."""
    out = np.zeros((sum(map(len, pieces)), *pieces[0].shape[1:]), pieces[0].dtype)
    at = 0
    for piece in pieces:
        out[at : at + len(piece)] = piece
        at += len(piece)
    return out


def _compressed(array: np.ndarray, codec: bytes) -> bytes | None:
    """Return one Blosc buffer; None when it is not smaller than the array."""
    out, size = ctypes.create_string_buffer(array.nbytes), ctypes.c_size_t
    n = _blosc().blosc_compress_ctx(
        _LEVEL,
        _BIT_SHUFFLE,
        size(array.dtype.itemsize),
        size(array.nbytes),
        array.ctypes.data_as(ctypes.c_void_p),
        out,
        size(array.nbytes),
        codec,
        # A block size of 0 lets Blosc choose; one thread.
        size(0),
        1,
    )
    if n < 0:
        raise RuntimeError(f"Blosc could not compress {array.nbytes} bytes: {n}")
    return out.raw[:n] if n else None


@functools.cache
def _blosc() -> ctypes.CDLL:
    """Return the C-Blosc that HDF5's own filter uses."""
    return ctypes.CDLL(str(Path(_plugin().PLUGIN_PATH) / "libh5blosc.so"))


def _plugin() -> Any:
    """Return hdf5plugin, whose import makes its filters known to HDF5. Raises ImportError."""
    import hdf5plugin

    return hdf5plugin
