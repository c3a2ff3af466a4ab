"""Untrusted HDF5 files: opened without following references to other files, data sets checked before use.

An HDF5 file may say that its data are in other files (external storage, virtual data sets, external links): read as
root, such a file copies any file into a column. Every file is opened for reading by :func:`open_hdf5`, which refuses
them by name.
"""

from __future__ import annotations

import contextlib
import ctypes
import functools
import math
import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import DTypeLike

from blinkgl.errors import AssetError, ConfigError

_MAX_CHUNK_BYTES = 1 << 28
"""HDF5 unpacks a whole chunk, even for a small part of it."""

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
_SUM, _SUM_BYTES = 3, 4
"""Fletcher32 ends the process on chunks shorter than its sum, so it has to be the last filter: their sizes show it."""
_BLOSC, _PLUGGED = 32001, frozenset((32001, 32004, 32015))
"""Blosc, and all filters that hdf5plugin brings."""
_ECF = 0x8ECF
"""Prophesee's filter."""


def open_hdf5(path: Path) -> h5py.File:
    """Open a file for reading. Raises AssetError with the likely cause, also for a file that refers to other files."""
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
    return file


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
def hdf5_errors(path: Path, file: h5py.File | None = None) -> Iterator[None]:
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


def dataset(
    file: h5py.File, name: str, path: Path, *, shape: tuple[int | None, ...], kinds: str = "iu"
) -> h5py.Dataset:
    """Return the data set ``name``, with its shape (None: any length) and NumPy kinds ("iu" integers, "f" floats, "b"
    bools) as requested, and as many values stored as declared.

    Raises AssetError: none of that name (or a group), another shape or type, values that were never written, huge
    chunks."""
    found = file.get(name)
    if not isinstance(found, h5py.Dataset):
        raise AssetError(f"no dataset '{name}'", where=str(path))
    fits = (
        found.shape is not None
        and len(found.shape) == len(shape)
        and all(b in (None, a) for a, b in zip(found.shape, shape))
    )
    if not fits or found.dtype.kind not in kinds or found.dtype.shape:
        wanted = {"iu": "integers", "iub": "integers", "f": "floats"}.get(kinds, "numbers")
        raise AssetError(
            f"dataset '{name}' has the wrong shape or type",
            where=str(path),
            value=f"{found.dtype} {found.shape}",
            accepted=f"{wanted} ({', '.join('N' if n is None else str(n) for n in shape)})",
        )
    check_storage(found, name, path)
    return found


def check_storage(found: h5py.Dataset, name: str, path: Path) -> None:
    """Check how a data set is stored before a value of it is read. Raises AssetError: a filter that is not run, values
    that were never written, huge chunks, a filter without its parameters."""
    layout = found.id.get_create_plist()
    count = layout.get_nfilters()
    summed = [k for k in range(count) if layout.get_filter(k)[0] == _SUM]
    if summed and (summed != [count - 1] or _shortest_chunk(found) <= _SUM_BYTES):
        raise AssetError(
            f"dataset '{name}' is packed by an HDF5 filter that is not run here",
            where=str(path),
            value="Fletcher32 within others, or over less than its sum",
            accepted=f"{', '.join(_FILTERS.values())} (h5repack -f GZIP=1)",
        )
    for code, _, values, called in (layout.get_filter(k) for k in range(count)):
        if code not in _FILTERS:
            raise AssetError(
                f"dataset '{name}' is packed by an HDF5 filter that is not run here",
                where=str(path),
                value=f"{code} {called.decode(errors='replace')}".strip(),
                accepted="the camera's .raw"
                if code == _ECF
                else f"{', '.join(_FILTERS.values())} (h5repack -f GZIP=1)",
            )
        if code == _BLOSC and len(values) < _BLOSC_VALUES:
            raise AssetError(f"damaged HDF5 file: dataset '{name}' lacks data that Blosc needs", where=str(path))
    if found.chunks is None:
        # Compact data lie in the object's header and are always whole.
        whole = layout.get_layout() == h5py.h5d.COMPACT or found.id.get_storage_size() >= found.nbytes
    else:
        if math.prod(found.chunks) * found.dtype.itemsize > _MAX_CHUNK_BYTES:
            raise AssetError(
                f"dataset '{name}' has chunks that are too large",
                where=str(path),
                value=found.chunks,
                accepted=f"at most {_MAX_CHUNK_BYTES >> 20} MB each",
            )
        # The number of chunks along each axis is the quotient, rounded up.
        whole = found.id.get_num_chunks() >= math.prod(-(-n // c) for n, c in zip(found.shape, found.chunks))
    if not whole:
        raise AssetError(f"dataset '{name}' declares {found.size} values, but stores fewer", where=str(path))


def _shortest_chunk(found: h5py.Dataset) -> int:
    sizes = (found.id.get_chunk_info(k).size for k in range(found.id.get_num_chunks()))
    return min(sizes, default=_SUM_BYTES + 1)


def attribute(file: h5py.HLObject, name: str, path: Path) -> Any:
    """Return the attribute ``name`` of a file or an object in it, numbers or text; None where there is none.

    Raises AssetError: of another type. h5py reads lists of any length without checking the file, and a damaged type
    that is taken for one ends the process."""
    if name not in file.attrs:
        return None
    kind = h5py.h5a.open(file.id, name.encode()).get_type().get_class()
    if kind not in (h5py.h5t.INTEGER, h5py.h5t.FLOAT, h5py.h5t.STRING):
        raise AssetError(f"attribute '{name}' holds neither numbers nor text", where=str(path))
    return file.attrs[name]


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


def packing(codec: str, shuffle: int) -> dict[str, Any]:
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
