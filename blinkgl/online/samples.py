"""Samples of a stream, and their files in the spool folder."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.io.images import NpzReader
from blinkgl.types.events import Events

_COLUMNS = ("x", "y", "t", "p")


@dataclass(frozen=True, eq=False)
class WindowSample:
    """Two adjacent windows of events, and the flow over each.

    old, new : events of [t - Δ, t) and [t, t + Δ), µs of the sequence's clock.   t_us, span_us : t and Δ.
    flow : (H, W, 2) float32 px, t -> t + Δ at reference t, +x right, +y down.   valid : (H, W) bool.
    backward, backward_valid : the same of t -> t - Δ, where the recipe has that label; else None.
    name : "davis240_000017/31250us+20000us": group and number of the sequence, t and Δ."""

    old: Events
    new: Events
    t_us: int
    span_us: int
    flow: np.ndarray
    valid: np.ndarray
    backward: np.ndarray | None
    backward_valid: np.ndarray | None
    name: str

    @property
    def height(self) -> int:
        return self.valid.shape[0]

    @property
    def width(self) -> int:
        return self.valid.shape[1]

    def write(self, path: Path) -> None:
        """Write ``path`` (.npz), completely or not at all, so that a reader never sees a part of it."""
        arrays = _columns(old=self.old, new=self.new) | {"flow": self.flow, "valid": self.valid}
        if self.backward is not None:
            arrays |= {"backward": self.backward, "backward_valid": self.backward_valid}
        _save(path, name=np.array(self.name), t=np.array(self.t_us), span=np.array(self.span_us), **arrays)


@dataclass(frozen=True, eq=False)
class StreamSample:
    """Consecutive windows of one sequence, for networks with a memory.

    windows : K times the events of [t_k, t_k+1).   t_us : (K + 1,) int64 µs of the sequence's clock, evenly spaced.
    flow : (K, H, W, 2) float32 px, t_k -> t_k+1 at reference t_k.   valid : (K, H, W) bool.
    name : "davis240_000017/31250us+8x20000us": group and number of the sequence, first time, windows."""

    windows: tuple[Events, ...]
    t_us: np.ndarray
    flow: np.ndarray
    valid: np.ndarray
    name: str

    @property
    def height(self) -> int:
        return self.valid.shape[1]

    @property
    def width(self) -> int:
        return self.valid.shape[2]

    def write(self, path: Path) -> None:
        """Write the sample as :meth:`WindowSample.write`."""
        arrays = _columns(all=Events.concatenate(self.windows))
        counts = np.array([len(window) for window in self.windows])
        _save(
            path, name=np.array(self.name), times=self.t_us, counts=counts, flow=self.flow, valid=self.valid, **arrays
        )


def read_sample(path: Path) -> WindowSample | StreamSample:
    """Return a written sample of either kind. Raises FileNotFoundError; AssetError, ValueError, KeyError: another
    file."""
    with NpzReader(path) as z:
        arrays = {key: z[key] for key in z.names}
    name = str(arrays["name"])
    if "times" in arrays:
        events = _events(arrays, "all")
        # All windows lie in one array, one after the other, and counts says where each ends.
        ends = np.cumsum(arrays["counts"])
        windows = tuple(
            Events(*(getattr(events, c)[start:end] for c in _COLUMNS))
            for start, end in zip(ends - arrays["counts"], ends, strict=True)
        )
        return StreamSample(windows, arrays["times"], arrays["flow"], arrays["valid"], name)
    return WindowSample(
        old=_events(arrays, "old"),
        new=_events(arrays, "new"),
        t_us=int(arrays["t"]),
        span_us=int(arrays["span"]),
        flow=arrays["flow"],
        valid=arrays["valid"],
        backward=arrays.get("backward"),
        backward_valid=arrays.get("backward_valid"),
        name=name,
    )


def _columns(**events: Events) -> dict[str, np.ndarray]:
    return {f"{side}_{c}": getattr(e, c) for side, e in events.items() for c in _COLUMNS}


def _events(arrays: dict[str, np.ndarray], side: str) -> Events:
    return Events(*(arrays[f"{side}_{c}"] for c in _COLUMNS))


def _save(path: Path, **arrays: Any) -> None:
    temporary = path.with_suffix(f".{os.getpid()}")
    with open(temporary, "wb") as file:
        np.savez(file, **arrays)
    # A reader in another process sees the whole file or none.
    os.replace(temporary, path)
