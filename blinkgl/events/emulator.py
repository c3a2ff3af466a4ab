"""What every emulator shares: checking frames and times, threads, scratch memory, saving and restoring."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any

import numba
import numpy as np

from blinkgl.errors import EventDataError
from blinkgl.events.arith import LOG_MAX_INPUT
from blinkgl.events.packing import MAX_INTERVAL_NS, PackedBuffer
from blinkgl.events.types import Events

BLOCK = 1024
"""Pixels a kernel looks at in one go: its scratch stays in the first-level cache. Bands are whole blocks."""
INTENSITY_LIMIT_BITS = np.uint32(np.float32(LOG_MAX_INPUT).view(np.uint32))
"""Bit pattern of the largest accepted intensity. Read as unsigned integers, negative numbers, infinities and NaN
are all larger, so one running maximum per frame checks everything at once."""
MAX_SIDE = 2**16
NEVER_NS = -(2**62)
NO_CAP = 2**62


class Emulator(ABC):
    """Frames in, events out.

    ``step(luminance, t_ns)`` takes one frame: float32 (H, W), linear, finite, >= 0, at most 2^30; or uint8 (H, W),
    looked up in the table of :meth:`set_decode`. The first call sets the reference and returns no events; call k
    returns the events of the interval (t_{k-1}, t_k]. Times are int64 ns, strictly increasing, at most 17 minutes
    apart. Event times are floored to the microsecond and never decrease, within a step or from step to step; an
    event at the very end of an interval belongs to it and is stamped with its end, so in half-open windows
    [t0, t1) it is the first of the next window.

    The events depend on the configuration, the seed and the frames, and on nothing else: not on the number of
    threads (``numba.set_num_threads``), not on saving and restoring between steps.

    Raises :class:`EventDataError` for a frame that is none of the above, naming its number and value; the state is
    then untouched and the next good frame goes on.
    """

    _state: tuple[str, ...] = ()
    """Names of the array attributes that make up the state; ``None`` entries are features that are off."""

    def __init__(self, height: int, width: int, seed: int):
        if not (1 <= height < MAX_SIDE and 1 <= width < MAX_SIDE and height * width < 2**31):
            raise EventDataError("frame size out of range", value=(height, width), accepted=f"1 to {MAX_SIDE - 1} rows and columns")
        self.height, self.width = int(height), int(width)
        self.seed = np.uint64(int(seed) & (2**64 - 1))
        self.t_ns: int | None = None
        """Time of the last frame, None before the first."""
        self.frames = 0
        """Frames taken so far."""
        self.saturated = 0
        """Events cut by ``max_events_per_step`` so far."""
        self._decode = np.arange(256, dtype=np.float32) / np.float32(255.0)
        self._buffer = PackedBuffer()
        self._active = np.empty(height * width + BLOCK, np.int32)

    # -- input ----------------------------------------------------------------------------------------------
    def set_decode(self, table: np.ndarray) -> None:
        """Linear luminance of each uint8 value, (256,) float32; the default is k / 255. An sRGB video wants the
        sRGB curve here: 8-bit input then costs a table look-up and no conversion."""
        table = np.ascontiguousarray(table, np.float32)
        if table.shape != (256,) or not (np.isfinite(table).all() and table.min() >= 0 and table.max() <= LOG_MAX_INPUT):
            raise EventDataError("decode table must hold 256 finite values >= 0", value=table.shape)
        self._decode = table
        self._tables_changed()

    def _tables_changed(self) -> None:
        pass

    def step(self, luminance: np.ndarray, t_ns: int) -> Events:
        """Events since the last frame; see the class."""
        frame = self._checked_frame(luminance)
        t_ns = self._checked_time(t_ns)
        events = self._start(frame, t_ns) if self.t_ns is None else self._advance(frame, t_ns)
        self.t_ns = t_ns
        self.frames += 1
        return events

    def _checked_frame(self, luminance: np.ndarray) -> np.ndarray:
        frame = np.asarray(luminance)
        if frame.shape != (self.height, self.width):
            raise EventDataError("frame size changed", where=f"frame {self.frames}", value=frame.shape,
                                 accepted=f"({self.height}, {self.width})")
        if frame.dtype != np.uint8 and frame.dtype != np.float32:
            raise EventDataError("unsupported frame type", where=f"frame {self.frames}", value=str(frame.dtype),
                                 accepted="float32 linear luminance or uint8")
        return np.ascontiguousarray(frame).reshape(-1)

    def _checked_time(self, t_ns: int) -> int:
        t_ns = int(t_ns)
        if self.t_ns is not None and t_ns <= self.t_ns:
            raise EventDataError("time stamps must increase", where=f"frame {self.frames}", value=f"{t_ns} ns",
                                 accepted=f"more than {self.t_ns} ns")
        if abs(t_ns) >= 2**61 or (self.t_ns is not None and t_ns - self.t_ns > MAX_INTERVAL_NS):
            raise EventDataError("time stamp out of range", where=f"frame {self.frames}", value=f"{t_ns} ns",
                                 accepted="at most 17 minutes between two frames")
        return t_ns

    def _refuse_bad_intensity(self, frame: np.ndarray, worst_bits: int) -> None:
        if worst_bits <= INTENSITY_LIMIT_BITS:
            return
        bad = int(np.flatnonzero(~((frame >= 0) & (frame <= LOG_MAX_INPUT)))[0])
        raise EventDataError(f"intensity at pixel x={bad % self.width}, y={bad // self.width} cannot be used",
                             where=f"frame {self.frames}", value=float(frame[bad]),
                             accepted=f"a finite value from 0 to {LOG_MAX_INPUT:.3g}")

    @abstractmethod
    def _start(self, frame: np.ndarray, t_ns: int) -> Events: ...

    @abstractmethod
    def _advance(self, frame: np.ndarray, t_ns: int) -> Events: ...

    # -- threads --------------------------------------------------------------------------------------------
    def _band_edges(self) -> np.ndarray:
        """(B + 1,) int64 pixel numbers, one band of whole blocks per thread."""
        pixels = self.height * self.width
        blocks = -(-pixels // BLOCK)
        bands = min(numba.get_num_threads(), blocks)
        return np.minimum(BLOCK * (blocks * np.arange(bands + 1, dtype=np.int64) // bands), pixels)

    # -- state ----------------------------------------------------------------------------------------------
    def state_dict(self) -> dict[str, np.ndarray]:
        """Everything the future depends on besides configuration and seed, as plain arrays (copies)."""
        state = {name: np.array(getattr(self, name)) for name in self._state if getattr(self, name) is not None}
        clock = [self.t_ns is not None, self.t_ns or 0, self.frames, self.saturated]
        return {"clock": np.array(clock, np.int64), "shape": np.array([self.height, self.width]), **state}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Restore :meth:`state_dict`'s result into an emulator built with the same size, config and seed."""
        wanted = {name for name in self._state if getattr(self, name) is not None} | {"clock", "shape"}
        if set(state) != wanted or tuple(state["shape"]) != (self.height, self.width):
            raise EventDataError("saved state is of another emulator", value=sorted(state), accepted=", ".join(sorted(wanted)))
        for name in wanted - {"clock", "shape"}:
            mine, theirs = getattr(self, name), np.asarray(state[name])
            if theirs.dtype != mine.dtype or theirs.shape != mine.shape:
                raise EventDataError("saved state is of another emulator", where=name, value=(theirs.dtype, theirs.shape))
            mine[...] = theirs
        started, t_ns, self.frames, self.saturated = (int(v) for v in state["clock"])
        self.t_ns = t_ns if started else None

    @property
    def state_bytes_per_pixel(self) -> float:
        """Memory that is kept from step to step, bytes per pixel."""
        arrays = [getattr(self, name) for name in self._state]
        return sum(a.nbytes for a in arrays if a is not None) / (self.height * self.width)
