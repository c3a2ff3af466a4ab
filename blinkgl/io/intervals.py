"""Labels that lead from one time to several, a file per label (``flow/intervals/000000.h5``):

    from_us ()        int64, the label's time, µs on the sequence's clock
    interval_ns (K,)  int64, increasing: how far each leads, ns; negative: back
    to_us (K,)        int64, where each leads, µs
    flow (K, H, W, 2) float32 px, 0 where not valid;  valid (K, H, W) uint8         of flow/intervals/
    occluded (K, H, W) uint8                                                        of occlusion/intervals/

Blosc (``import hdf5plugin``), a chunk per interval. K is that of the label: times outside the sequence are left out.
"""

from __future__ import annotations

import io
import os
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from blinkgl.errors import AssetError
from blinkgl.io.hdf5 import dataset, growing_dataset, open_hdf5, write_rows

SHAPES: dict[str, tuple[tuple[int | None, ...], str]] = {
    "flow": ((None, None, None, 2), "f"),
    "valid": ((None, None, None), "iub"),
    "occluded": ((None, None, None), "iub"),
}
"""Shape of each array (None any length), and NumPy kinds."""
_LONGEST = 1 << 62


def encode_intervals(t_ns: int, interval_ns: np.ndarray, arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of a file. arrays : of :data:`SHAPES`, by name; bools are written as uint8."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        ends = {"interval_ns": interval_ns, "to_us": (int(t_ns) + interval_ns) // 1000}
        for name, values in ends.items():
            file.create_dataset(name, data=np.asarray(values, np.int64), track_times=False)
        file.create_dataset("from_us", data=np.int64(t_ns // 1000), track_times=False)
        for name, array in arrays.items():
            array = array.view(np.uint8) if array.dtype == bool else array
            data = growing_dataset(file, name, (0, *array.shape[1:]), array.dtype, (1, *array.shape[1:]))
            for k, one in enumerate(array):
                write_rows(data, k, one[None])
    return buffer.getvalue()


def intervals_in(path: str | os.PathLike) -> np.ndarray:
    """Return the intervals of the labels in a file, (K,) int64 ns. Raises AssetError."""
    path = Path(path)
    with open_hdf5(path) as file:
        return _int64(dataset(file, "interval_ns", path, shape=(None,))[()], "interval_ns", path)


def _int64(values: np.ndarray, name: str, path: Path) -> np.ndarray:
    if len(values) and not -_LONGEST < int(values.min()) <= int(values.max()) < _LONGEST:
        raise AssetError(f"'{name}' holds no times", where=str(path), value=values.tolist()[:8])
    return values.astype(np.int64)


def read_intervals(path: str | os.PathLike, names: tuple[str, ...]) -> tuple[int, np.ndarray, dict[str, np.ndarray]]:
    """Return from_us, interval_ns (K,) int64, and the arrays of these names; "valid" and "occluded" as bool. Raises
    AssetError: missing, damaged, arrays of different sizes, times beyond int64, valid flow that is no number, or
    intervals that do not increase."""
    path = Path(path)
    with open_hdf5(path) as file:
        # Shards hand on the file as a whole, so that all that it holds is checked.
        for data in (data for group in file.groups().values() for data in group.data().values()):
            data.check()
        from_us = int(_int64(dataset(file, "from_us", path, shape=())[()].reshape(1), "from_us", path)[0])
        interval_ns = _int64(dataset(file, "interval_ns", path, shape=(None,))[()], "interval_ns", path)
        arrays = {name: dataset(file, name, path, shape=SHAPES[name][0], kinds=SHAPES[name][1])[()] for name in names}
    sizes = {array.shape[:3] for array in arrays.values()}
    if len(sizes) != 1 or next(iter(sizes))[0] != len(interval_ns):
        raise AssetError("arrays of different sizes", where=str(path), value=sorted(sizes))
    if (np.diff(interval_ns) <= 0).any() or (interval_ns == 0).any():
        raise AssetError("the intervals do not increase", where=str(path), value=interval_ns.tolist()[:8])
    if "flow" in arrays and "valid" in arrays and not np.isfinite(arrays["flow"][arrays["valid"].astype(bool)]).all():
        raise AssetError("valid flow that is no number", where=str(path))
    return from_us, interval_ns, {k: a.astype(np.float32 if k == "flow" else bool) for k, a in arrays.items()}
