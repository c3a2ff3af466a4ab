"""Shared code of all emulators: checking frames and times, threads, scratch memory, saving and restoring."""

from __future__ import annotations

import contextlib
from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple

import numpy as np

from blinkgl.config.events import EmulatorConfig
from blinkgl.errors import EventDataError
from blinkgl.events.arith import LOG_MAX_INPUT
from blinkgl.events.bands import BLOCK, Work
from blinkgl.events.packing import MAX_CAUSE_ROWS, MAX_INTERVAL_NS, PackedBuffer
from blinkgl.events.response import Response
from blinkgl.events.threads import run, thread_count
from blinkgl.types.events import Events

SHARE_BLOCKS = 64
"""Smallest share of a thread: 65,536 pixels, 100 µs and more. Waking a thread takes 20 to 50 µs."""
BANDS_PER_THREAD = 4
"""A thread that wakes late, or is delayed by another program, leaves bands to the others."""
INTENSITY_LIMIT_BITS = np.uint32(np.float32(LOG_MAX_INPUT).view(np.uint32))
"""Bit pattern of the largest accepted intensity. Read as unsigned integers, negative numbers, infinities and NaN
are all larger, so one running maximum per frame checks everything at once."""
MAX_SIDE = 2**16
NEVER_NS = -(2**62)
_NO_FRAME, _NO_CODES = np.empty(0, np.float32), np.empty(0, np.uint8)
"""Used for the kind of frame that a step does not have."""


class Source(NamedTuple):
    """The frame of a step for kernels: linear light, or codes of 8 bits with tables of all 256 of them."""

    frame: np.ndarray  # float32, flat; [] where there are codes
    codes: np.ndarray  # uint8; []
    table: np.ndarray  # (256,) what the emulator takes of a code
    signals: np.ndarray  # (256,) a second table: V2E's signal; []

    @classmethod
    def of(cls, frame: np.ndarray, table: np.ndarray, signals: np.ndarray = _NO_FRAME) -> Source:
        """Return the source of a flat frame, float32 or uint8."""
        if frame.dtype == np.uint8:
            return cls(frame=_NO_FRAME, codes=frame, table=table, signals=signals)
        return cls(frame=frame, codes=_NO_CODES, table=table, signals=signals)


def _flat(array: np.ndarray) -> np.ndarray:
    """Return (H*W,) in C order. Kernels do not write to frames, but numba compiles a separate kernel for read-only
    arrays, such as a renderer's views; so arrays whose memory is writable are passed on as writable."""
    flat = np.ascontiguousarray(array).reshape(-1)
    if not flat.flags.writeable:
        with contextlib.suppress(ValueError):  # the memory is really read-only
            flat.flags.writeable = True
    return flat


class Emulator(ABC):
    """Base of the emulators: takes frames, returns events.

    ``step(luminance, t_ns)`` takes one frame: float32 (H, W), linear, finite, >= 0, at most 2^30; or uint8 (H, W),
    looked up in the table of :meth:`set_decode`. The first call sets the reference and returns no events; call k
    returns the events of the interval (t_{k-1}, t_k]. Times are int64 ns, strictly increasing, at most 17 minutes
    apart. Event times are floored to the microsecond and never decrease, within a step or from step to step; an event
    at the very end of an interval belongs to it and is stamped with its end, so in half-open windows [t0, t1) it is the
    first of the next window.

    The events depend only on the configuration, the seed and the frames: not on the number of threads
    (``numba.set_num_threads``), not on saving and restoring between steps.

    Raises :class:`EventDataError` for any other frame, naming its number and value; the state is then unchanged, and
    the next valid frame continues.
    """

    config: Any
    """The configuration, of its class's ``Config``."""
    Config: ClassVar[type[EmulatorConfig]]
    """The configuration class: name, keys, and values from a sensor."""
    device: ClassVar[str] = "cpu"
    """Where events are computed: "cpu" or "cuda"."""
    tensor_device: Any = None
    """The torch device of which ``step`` takes frames as tensors, too; None: only arrays."""
    noisy: ClassVar[bool] = False
    """Whether it models noise, and so has that of a camera's curves (:mod:`~blinkgl.events.light_noise`), too."""
    _still_pixels_sleep = False
    """Whether a pixel whose luminance does not change has no events and no changing state. A subclass whose
    :meth:`_advance` is its own, and may change the frames, says it anew."""

    _state: ClassVar[tuple[str, ...]] = ()
    """Names of the array attributes that make up the state; ``None`` entries are features that are off."""

    def __init_subclass__(cls, **kwargs: object) -> None:
        super().__init_subclass__(**kwargs)
        if "_advance" in cls.__dict__ and "_still_pixels_sleep" not in cls.__dict__:
            cls._still_pixels_sleep = False

    @classmethod
    @abstractmethod
    def response(cls, config: Any) -> Response:
        """Return how luminance becomes the signal that timelines watch, and the signal's change per event."""

    @classmethod
    @abstractmethod
    def noiseless(cls, config: Any) -> EmulatorConfig:
        """Return the configuration without noise and bandwidth limit, of this or another emulator; `trade` compares its
        events."""

    def __init__(self, height: int, width: int, seed: int):
        if not (1 <= height < MAX_SIDE and 1 <= width < MAX_SIDE and height * width < 2**31):
            raise EventDataError(
                "frame size out of range", value=(height, width), accepted=f"1 to {MAX_SIDE - 1} rows and columns"
            )
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
        self._blocks = -(-self.height * self.width // BLOCK)

    # -- input ----------------------------------------------------------------------------------------------
    def set_decode(self, table: np.ndarray) -> None:
        """Set the linear luminance of each uint8 value, (256,) float32; the default is k / 255. For sRGB video pass the
        sRGB curve: 8-bit input then costs a table lookup and no conversion."""
        table = np.ascontiguousarray(table, np.float32)
        if table.shape != (256,) or not (
            np.isfinite(table).all() and table.min() >= 0 and table.max() <= LOG_MAX_INPUT
        ):
            raise EventDataError("decode table must hold 256 finite values >= 0", value=table.shape)
        self._decode = table
        self._tables_changed()

    def decoded(self, frame: np.ndarray) -> np.ndarray:
        """Return the (H, W) float32 linear luminance of a frame as ``step`` takes it."""
        return self._decode[frame] if frame.dtype == np.uint8 else frame

    def _tables_changed(self) -> None:  # noqa: B027 - most emulators keep nothing that depends on the tables
        pass

    def memory_s(self, luminance: np.ndarray) -> np.ndarray | None:
        """Return (H, W), how long a pixel's signal follows a change of light after it is over, s, for linear luminance
        (H, W); None: not at all. Used to find the surface of an event."""
        return None

    def push(self, luminance: np.ndarray, jump: float, rise_s: float) -> np.ndarray | None:
        """Return (H, W) float32, by how much ln I must be higher for ``rise_s`` so that the signal ends higher by
        ``jump``, for linear luminance (H, W); None: the signal follows at once. Used for jumps behind the photoreceptor
        (:mod:`~blinkgl.events.resets`)."""
        return None

    @property
    def causes(self) -> bool:
        """Return whether events record their causes, ``config.causes``."""
        return bool(getattr(self.config, "causes", False))

    def step(self, luminance: np.ndarray, t_ns: int, rows: tuple[int, int] | None = None) -> Events:
        """Return the events since the last frame; see the class.

        rows : the caller's promise that rows outside [y0, y1) equal those of the frame before (None: any may differ).
        Emulators whose still pixels do nothing skip those rows, without checking their values; the events are the
        same."""
        frame = self._checked_frame(luminance)
        t_ns = self._checked_time(t_ns)
        if self.t_ns is None and self.causes and self.height > MAX_CAUSE_ROWS:
            raise EventDataError(
                "the sensor has too many rows for causes",
                where="events.causes",
                value=self.height,
                accepted=f"at most {MAX_CAUSE_ROWS} rows, or events without causes",
            )
        # The first frame sets the reference of all pixels, whatever rows it says have changed.
        first, stop = (0, self.height) if rows is None or self.t_ns is None else rows
        # [first, stop) in pixels: the rows that may differ from the last frame's.
        self._changed = (max(0, first) * self.width, min(self.height, stop) * self.width)
        self._check_intensity(frame)
        events = self._start(frame, t_ns) if self.t_ns is None else self._advance(frame, t_ns)
        self.t_ns = t_ns
        self.frames += 1
        return events

    def _checked_frame(self, luminance: np.ndarray) -> np.ndarray:
        frame = np.asarray(luminance)
        if frame.shape != (self.height, self.width):
            grey = f": luminance, numpy.{frame.dtype}(frame @ [0.2126, 0.7152, 0.0722])"
            colours = grey if frame.ndim == 3 and frame.shape[2] == 3 else ""
            raise EventDataError(
                "a frame of another shape than the emulator's",
                where=f"frame {self.frames}",
                value=frame.shape,
                accepted=f"({self.height}, {self.width}){colours}",
            )
        if frame.dtype != np.uint8 and frame.dtype != np.float32:
            raise EventDataError(
                "unsupported frame type",
                where=f"frame {self.frames}",
                value=str(frame.dtype),
                accepted="float32 linear luminance or uint8",
            )
        return _flat(frame)

    def _checked_time(self, t_ns: int) -> int:
        # 33.3, milliseconds perhaps, would become 33 ns.
        if not isinstance(t_ns, (int, np.integer)) or isinstance(t_ns, bool):
            raise EventDataError(
                "not a time stamp", where=f"frame {self.frames}", value=t_ns, accepted="whole nanoseconds"
            )
        t_ns = int(t_ns)
        if self.t_ns is not None and t_ns <= self.t_ns:
            raise EventDataError(
                "time stamps must increase",
                where=f"frame {self.frames}",
                value=f"{t_ns} ns",
                accepted=f"more than {self.t_ns} ns",
            )
        if abs(t_ns) >= 2**61 or (self.t_ns is not None and t_ns - self.t_ns > MAX_INTERVAL_NS):
            raise EventDataError(
                "time stamp out of range",
                where=f"frame {self.frames}",
                value=f"{t_ns} ns",
                accepted="at most 17 minutes between two frames",
            )
        return t_ns

    def _check_intensity(self, frame: np.ndarray) -> None:
        """Check a frame before anything changes: one pass over bit patterns, and a slow search only where that finds
        something."""
        first, stop = self._changed
        if frame.dtype == np.uint8 or first >= stop or frame[first:stop].view(np.uint32).max() <= INTENSITY_LIMIT_BITS:
            return
        self._refuse_intensity(frame)

    def _refuse_intensity(self, frame: np.ndarray) -> None:
        """Raise EventDataError that names the first invalid pixel, if there is one."""
        bad = np.flatnonzero(~((frame >= 0) & (frame <= LOG_MAX_INPUT)))  # -0.0 is valid
        if bad.size:
            y, x = divmod(int(bad[0]), self.width)
            error = EventDataError(
                f"intensity at pixel x={x}, y={y} cannot be used",
                where=f"frame {self.frames}",
                value=float(frame[bad[0]]),
                accepted=f"a finite value from 0 to {LOG_MAX_INPUT:.3g}",
            )
            error.pixel = (x, y)
            raise error

    @abstractmethod
    def _start(self, frame: np.ndarray, t_ns: int) -> Events: ...

    @abstractmethod
    def _advance(self, frame: np.ndarray, t_ns: int) -> Events: ...

    # -- running the kernels --------------------------------------------------------------------------------
    def _run(self, kernel, arguments: tuple, base_us: int, span_us: int) -> Events:
        """Run a band kernel over all blocks, on up to :func:`~blinkgl.events.threads.thread_count` threads, and sort
        its events.

        ``kernel(taken, start, work, *arguments)`` calls :func:`~blinkgl.events.bands.drive`. A band that stops early,
        because its buffer might not hold the next block, continues from there in a larger one.
        """
        first, stop = self._changed if self._still_pixels_sleep else (0, self.height * self.width)
        first_block, stop_block = first // BLOCK, -(-stop // BLOCK)
        if first >= stop:
            return Events.empty()
        blocks = stop_block - first_block
        threads = max(1, min(thread_count(), blocks // SHARE_BLOCKS))
        bands = 1 if threads == 1 else BANDS_PER_THREAD * threads
        edges = first_block + blocks * np.arange(bands + 1, dtype=np.int64) // bands
        # Each block has its own share of the limit, so that results do not depend on the number of bands.
        share = max(BLOCK, self.config.max_events_per_step // self._blocks)
        progress = np.zeros((bands, 3), np.int64)  # next block, events so far, events cut
        # A band that runs out of room keeps its place, and goes on there once the buffer has grown.
        progress[:, 0] = edges[:-1]
        while True:
            # The first room is for one event of every fourth pixel.
            packed = self._buffer.rows(bands, self.height * self.width // (4 * bands))
            work = Work(edges=edges, progress=progress, packed=packed, share=share, pixels=self.height * self.width)
            run(kernel, bands, (work, *arguments), threads)
            # Every band has reached its end.
            if (progress[:, 0] >= edges[1:]).all():
                break
            # A block emits at most its share, or one event per pixel; so this loop ends, and memory is bounded.
            self._buffer.grow(bands, 2 * packed.shape[1] + 8 * BLOCK, progress[:, 1])
        self.saturated += int(progress[:, 2].sum())
        return self._buffer.to_events(progress[:, 1].copy(), base_us, span_us, threads, self.causes)

    # -- state ----------------------------------------------------------------------------------------------
    def state_dict(self) -> dict[str, np.ndarray]:
        """Return all state besides configuration and seed, as plain arrays (copies)."""
        state = {name: np.array(getattr(self, name)) for name in self._state if getattr(self, name) is not None}
        # Arrays alone: a state is saved as an npz without pickle.
        clock = [self.t_ns is not None, self.t_ns or 0, self.frames, self.saturated]
        return {"clock": np.array(clock, np.int64), "shape": np.array([self.height, self.width]), **state}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        """Restore the result of :meth:`state_dict` in an emulator with the same size, config and seed."""
        wanted = {name for name in self._state if getattr(self, name) is not None} | {"clock", "shape"}
        if set(state) != wanted or tuple(state["shape"]) != (self.height, self.width):
            raise EventDataError(
                "saved state is of another emulator", value=sorted(state), accepted=", ".join(sorted(wanted))
            )
        for name in wanted - {"clock", "shape"}:
            mine, theirs = getattr(self, name), np.asarray(state[name])
            if theirs.dtype != mine.dtype or theirs.shape != mine.shape:
                raise EventDataError(
                    "saved state is of another emulator", where=name, value=(theirs.dtype, theirs.shape)
                )
            mine[...] = theirs
        started, t_ns, self.frames, self.saturated = (int(v) for v in state["clock"])
        self.t_ns = t_ns if started else None
