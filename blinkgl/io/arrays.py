"""Events as NumPy files: .npz with x, y, t, p, or .npy with a structured array. Whole recordings in memory, unlike the others."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.events.types import Events
from blinkgl.io.atomic import output_errors
from blinkgl.io.images import numpy_errors

DTYPE = np.dtype([("t", "<i8"), ("x", "<u2"), ("y", "<u2"), ("p", "u1")])
_NAMES = {"t": ("t", "ts", "timestamp", "timestamps"), "x": ("x",), "y": ("y",), "p": ("p", "polarity", "polarities", "pol", "on")}


class ArrayReader:
    """``.npz`` with four columns or ``.npy`` structured. Integer times are µs, float times seconds; p is 0/1, -1/1 or bool.

    A plain (N, 4) array is refused: files in the wild disagree about the order of its columns."""

    def __init__(self, path: str | os.PathLike):
        self.path = Path(path)
        self.height = self.width = None
        with numpy_errors(path):
            data = np.load(path, allow_pickle=False)
            names = (data.dtype.names or ()) if isinstance(data, np.ndarray) else tuple(data.files)
            found = {k: next((n for n in options if n in names), None) for k, options in _NAMES.items()}
            if missing := [k for k, name in found.items() if name is None]:
                raise AssetError(f"no column '{missing[0]}'", where=str(path), value=list(names) or "a plain array",
                                 accepted="x, y, t, p in an .npz or a structured .npy")
            columns = {k: np.asarray(data[name]) for k, name in found.items()}
            if not isinstance(data, np.ndarray):
                if "height" in names and "width" in names:
                    self.height, self.width = int(data["height"]), int(data["width"])
                data.close()
        self._events = _events(columns, path)

    def chunks(self, size: int = 1 << 20) -> Iterator[Events]:
        for i in range(0, len(self._events), size):
            yield Events(*(getattr(self._events, k)[i:i + size] for k in "xytp"))


class ArrayWriter:
    """Collects events, writes on close."""

    def __init__(self, path: str | os.PathLike, height: int, width: int):
        self.path, self._size, self._chunks = Path(path), (height, width), []

    def append(self, events: Events) -> None:
        self._chunks.append(Events(*(getattr(events, k).copy() for k in "xytp")))

    def close(self, t_end_us: int | None = None) -> None:
        e = Events.concatenate(self._chunks)
        with output_errors(self.path), open(self.path, "wb") as file:
            if self.path.suffix == ".npz":
                np.savez_compressed(file, x=e.x, y=e.y, t=e.t, p=e.p, height=self._size[0], width=self._size[1])
            else:
                table = np.empty(len(e), DTYPE)
                for k in DTYPE.names:
                    table[k] = getattr(e, k)
                np.save(file, table, allow_pickle=False)

    def abort(self) -> None:
        self._chunks = []


def _events(columns: dict[str, np.ndarray], path) -> Events:
    """The four columns as Events; AssetError for shapes and values that cannot be events."""
    if len({c.shape for c in columns.values()}) != 1 or columns["t"].ndim != 1:
        raise AssetError("columns differ in length", where=str(path), value={k: c.shape for k, c in columns.items()})
    for k, low, high in (("x", 0, 65535), ("y", 0, 65535), ("p", -1, 1)):
        c = columns[k]
        if c.dtype.kind not in "iufb" or (len(c) and not (c.min() >= low and c.max() <= high)):
            raise AssetError(f"column '{k}' outside {low}…{high}", where=str(path), value=c.dtype if c.dtype.kind not in "iuf" else (c.min(), c.max()))
    t = columns["t"]
    if t.dtype.kind == "f":
        if not np.isfinite(t).all():
            raise AssetError("column 't' holds NaN or infinity", where=str(path))
        t = np.rint(t.astype(np.float64) * 1e6)
    elif t.dtype.kind not in "iu":
        raise AssetError("column 't'", where=str(path), value=t.dtype, accepted="integer µs or float seconds")
    return Events(columns["x"].astype(np.uint16), columns["y"].astype(np.uint16), t.astype(np.int64), (columns["p"] > 0).astype(np.uint8))
