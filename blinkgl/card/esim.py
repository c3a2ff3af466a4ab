"""ESIM on the card (``shaders/compute/events_*.glsl``): the events of :class:`~blinkgl.events.esim.Esim`, bit for bit.

A frame that was drawn by the same context is handed on as the texture it lies in and copied from there; arrays are
copied to the card. A step is ten dispatches. *Mark*: the logarithm of every pixel against its two levels, a bit each;
of a texture also whether it has a value that cannot be used, in which case nothing fires. *List*: the pixels that fire,
in raster order, their places found by prefix sums. *Fire*: how many events each has, its next levels, and a record.
*Emit*: the events, from the records alone, at places found by prefix sums again. No place comes of an unordered atomic,
so the order is that of the kernels on the processor before they sort, and the state has moved when events are written:
a buffer that is too small is made again and *emit* repeated, nothing is lost. Events are sorted on the card
(``events_sort.glsl``) or by the processor, and come at once or, so that nobody waits, one frame late
(:mod:`blinkgl.card.late`).

Logarithms and levels are whole numbers of 2^-25, times are divided exactly in 64 bits made of pairs of 32, the draws
of jitter are doubles made of whole numbers (:file:`shaders/include/soft_double.glsl`). What is left are sums and
products of floats in the logarithm; :mod:`blinkgl.card.proof` asks the card whether it rounds them as IEEE 754 says,
and where it does not, they are whole numbers, too.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import moderngl
import numpy as np

from blinkgl.card.arith import words
from blinkgl.card.kernels import (
    CUT,
    EVENTS,
    HEAD_BYTES,
    UNUSABLE,
    Kernels,
    SortRoom,
    refuse_without_compute,
)
from blinkgl.card.late import Slot, maps_persistently
from blinkgl.card.proof import rounds_like_ieee
from blinkgl.card.room import Room
from blinkgl.card.stages import Stages, is_long
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events.arith import Q_ONE, log_q25
from blinkgl.events.emulator import BLOCK, INTENSITY_LIMIT_BITS
from blinkgl.events.esim import Esim
from blinkgl.events.packing import unpacked
from blinkgl.events.types import Events

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_LARGEST_STEP = 22.0
"""Thresholds beyond that, ln units, do not fit into 32 bits with a logarithm; normal numbers stay below 8.6."""


class CardEsim(Esim):
    """See the module and :class:`~blinkgl.events.emulator.Emulator`; straight lines between frames alone.

    ``step`` takes, besides arrays, a texture of ``gl``, (W, H) R32F, row 0 the picture's top row, and is done with it
    when it returns.
    gl : where it runs; made current at every step.   soft_float : logarithms in whole numbers; None: where the card's
    own rounding is not that of IEEE 754.
    owns_gl : release the context with it.
    late : ``step`` returns the events of the interval before its own, whose way back nobody had to wait for; ``flush``
    the last ones (as of any emulator that ``lags``). sorts : events are sorted on the card. None for either: where the
    context is not the processor's, which gains by neither. Events and their order are the same.
    State on the card: 16 bytes per pixel, spread thresholds 8 more, jitter or a refractory period 16.
    Raises EventDataError for a configuration that it does not do, GLError: no compute shaders, or not enough memory."""

    device = "gl"
    takes_textures = True

    def __init__(
        self,
        height: int,
        width: int,
        config: EsimConfig | None = None,
        seed: int = 0,
        reconstruction: str = "linear",
        *,
        gl: GLContext,
        owns_gl: bool = False,
        soft_float: bool | None = None,
        late: bool | None = None,
        sorts: bool | None = None,
    ):
        config = config or EsimConfig()
        if problem := self.unfit(config, reconstruction):
            raise problem
        refuse_without_compute(gl)
        super().__init__(height, width, config, seed, reconstruction)
        self.gl, self._owns_gl = gl, owns_gl
        gl.resume()
        self._kernels = Kernels(gl, not rounds_like_ieee(gl) if soft_float is None else soft_float)
        self._room: Any = Room(
            gl,
            self.height * self.width,
            f"{width}x{height} pixels",
            (width, height),
            spread=self._on.size > 0,
            more=self._has_more,
        )
        self._stages = Stages(
            self._kernels,
            self._room,
            spread=bool(self._on.size),
            jitter=bool(self._fired.size),
            refractory=bool(self._last_ns.size),
        )
        if self._on.size:
            self._room.put("thresholds", np.stack([self._on, self._off], axis=1))
        self._before_is_log, self._stays = False, False
        self._made = 0, 0  # events of the last step, and the microsecond before it
        self._late = (not gl.is_software if late is None else late) and maps_persistently(gl)
        self._sorts = not gl.is_software if sorts is None else sorts
        self._sorting: SortRoom | None = None
        self._slots: list[Slot | None] = [None, None]
        self._flight: _Flight | None = None
        self._kept: list[Events] = []  # that were on their way when the next ones were told to stay

    @classmethod
    def unfit(cls, config: EsimConfig, reconstruction: str = "linear") -> EventDataError | None:
        """Why the card's kernel does not do this, naming the key; None: it does."""
        if reconstruction != "linear":
            return EventDataError(
                "the card follows straight lines between frames only",
                where="timeline.reconstruction",
                value=reconstruction,
                accepted="linear, or events.device: cpu",
            )
        largest = max(config.contrast_threshold, config.contrast_threshold_off or 0.0)
        largest = 10.0 if config.threshold_sigma else largest
        if config.threshold_jitter and largest + 8.6 * config.threshold_jitter > _LARGEST_STEP:
            return EventDataError(
                "thresholds with so much jitter do not fit the card's whole numbers",
                where="events.threshold_jitter",
                value=config.threshold_jitter,
                accepted=f"at most {(_LARGEST_STEP - largest) / 8.6:.3g}, or events.device: cpu",
            )
        return None

    @classmethod
    def trial(cls, config: EsimConfig) -> EsimConfig:
        """What tells whether a card runs the same kernels as for this configuration right."""
        return EsimConfig(
            threshold_sigma=0.03 if config.threshold_sigma else 0.0,
            threshold_jitter=0.03 if config.threshold_jitter else 0.0,
            refractory_us=150.0 if config.refractory_us else 0.0,
        )

    @property
    def _has_more(self) -> bool:
        return bool(self._fired.size or self._last_ns.size)

    def release(self) -> None:
        """Frees what lies on the card. Harmless when repeated."""
        if not self.gl.released:
            with self.gl.borrowed():
                self._room.release()
                for thing in (self._sorting, *self._slots):
                    if thing is not None:
                        thing.release()
                self._sorting, self._slots = None, [None, None]
            if self._owns_gl:
                self.gl.release()

    # -- steps ----------------------------------------------------------------------------------------------
    def advance(self, luminance: np.ndarray | moderngl.Texture, t_ns: int) -> int:
        """As ``step``, but the events stay on the card, for :mod:`blinkgl.card.sinks`; how many there are. (Those of a
        step before it that are on their way come with the next ``step`` or ``flush``.)"""
        self._stays = True
        try:
            self.step(luminance, t_ns)
        finally:
            self._stays = False
        return self._made[0]

    @property
    def lags(self) -> bool:
        return self._late

    @property
    def done_ns(self) -> int | None:
        return self.t_ns if self._flight is None else self._flight.start_ns

    def flush(self) -> Events:
        self.gl.resume()
        return self._landed()

    @property
    def on_card(self) -> tuple[moderngl.Buffer, int, int]:
        """Packed events of the last step as they were emitted, not sorted by time; how many; the microsecond that their
        times count from."""
        return self._room["packed"], *self._made

    def _checked_frame(self, luminance: Any) -> Any:
        if not isinstance(luminance, moderngl.Texture):
            return super()._checked_frame(luminance)
        shape, kind = (luminance.height, luminance.width), (luminance.components, luminance.dtype)
        if luminance.ctx is not self.gl.ctx or kind != (1, "f4"):
            raise EventDataError(
                "not a frame of this card",
                where=f"frame {self.frames}",
                value=f"{kind[0]} x {kind[1]}" + ("" if luminance.ctx is self.gl.ctx else " of another context"),
                accepted="a texture of one 32-bit float a pixel, of the emulator's own context",
            )
        if shape == (self.height, self.width) and self.t_ns is not None:
            return luminance
        return super()._checked_frame(np.frombuffer(luminance.read(), np.float32).reshape(shape))

    def _check_intensity(self, frame: Any) -> None:
        if not isinstance(frame, moderngl.Texture):  # those are looked at on the card
            super()._check_intensity(frame)

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        events = super()._start(frame, t_ns, rate)
        self._made = 0, t_ns // 1000
        self.gl.resume()
        self._room.turn()
        self._room.put("now", self._intensity(frame))
        self._before_is_log = False
        self._put_state()
        return events

    def _intensity(self, frame: np.ndarray) -> np.ndarray:
        return self._decode[frame] if frame.dtype == np.uint8 else frame

    def _advance(self, frame: np.ndarray | moderngl.Texture, t_ns: int, rate: np.ndarray | None) -> Events:
        self.gl.resume()
        room, interval = self._room, (self.t_ns, t_ns)
        before = self._landed()
        room.turn()
        drawn_here = isinstance(frame, moderngl.Texture)
        if drawn_here:
            frame.read_into(room["now"])  # from one place on the card to another
        else:
            room.put("now", self._intensity(frame))
        was_log, self._before_is_log = self._before_is_log, False
        self._stages.fire(self._values(interval, was_log), checked=drawn_here, long=is_long(interval))
        flight = _Flight(*interval, was_log, room["packed"])
        if self._late and not self._stays:
            self._send(flight)
            return before
        head = np.frombuffer(room["listed"].read(HEAD_BYTES), np.uint32)
        self._refuse_unusable(head, flight)
        count = self._counted(head, flight)
        if self._stays:
            self._kept += [before] if len(before) else []
            return Events.empty()
        flight = flight._replace(packed=self._where_they_are(*interval))
        return Events.concatenate([before, self._read(flight, count)]) if len(before) else self._read(flight, count)

    # -- from the card to the processor ---------------------------------------------------------------------
    def _refuse_unusable(self, head: np.ndarray, flight: _Flight) -> None:
        """Raises EventDataError where the frame at the flight's end had a value that cannot be used. Nothing has fired
        and no level has moved; everything is as it was before that frame."""
        if not head[UNUSABLE]:
            return
        room, seen = self._room, self._room.get("now", np.float32)
        room.turn()
        room.clear_head()
        self._before_is_log = flight.was_log
        if self.t_ns == flight.end_ns:  # it was taken for good then
            self.t_ns, self.frames = flight.start_ns, self.frames - 1
        try:
            self._refuse_intensity(seen)
        except EventDataError as error:
            error.t_ns = flight.end_ns
            raise

    def _counted(self, head: np.ndarray, flight: _Flight) -> int:
        """How many events there are; where they did not find room they are emitted again, into more."""
        count = int(head[EVENTS])
        self.saturated += int(head[CUT])
        self._made = count, flight.start_ns // 1000
        if count > self._room.capacity:
            self._room.grow(count)
            interval = flight.start_ns, flight.end_ns
            self._stages.emit(self._values(interval, flight.was_log), long=is_long(interval))
        return count

    def _where_they_are(self, start_ns: int, end_ns: int) -> moderngl.Buffer:
        """The events of an interval, sorted where that is done on the card."""
        room = self._room
        if not self._sorts:
            return room["packed"]
        if self._sorting is None or self._sorting.capacity != room.capacity:
            if self._sorting is not None:
                self._sorting.release()
            self._sorting = SortRoom(self.gl, room.capacity)
        bits = (end_ns // 1000 - start_ns // 1000).bit_length()
        return self._kernels.sort(room["listed"], room["packed"], self._sorting, bits)

    def _send(self, flight: _Flight) -> None:
        """Sends the events off: as many as the last step had, and a quarter more. (How many there are nobody knows yet;
        more of them are fetched when they are missed.)"""
        flight = flight._replace(packed=self._where_they_are(flight.start_ns, flight.end_ns))
        expected = min(self._room.capacity, max(BLOCK, self._made[0] * 5 // 4))
        size, turn = HEAD_BYTES + 8 * expected, self.frames % 2
        slot = self._slots[turn]
        if slot is None or slot.size < size:
            if slot is not None:
                slot.release()
            slot = self._slots[turn] = Slot(self.gl, size + size // 4)
        slot.copy(self._room["listed"], HEAD_BYTES)
        slot.copy(flight.packed, 8 * expected, HEAD_BYTES)
        slot.seal()
        self._flight = flight._replace(slot=slot, expected=expected)

    def _landed(self) -> Events:
        """The events that were on their way."""
        kept, self._kept = self._kept, []
        flight, self._flight = self._flight, None
        if flight is None:
            return Events.concatenate(kept) if kept else Events.empty()
        assert flight.slot is not None
        memory = flight.slot.wait()
        head = memory[:HEAD_BYTES].view(np.uint32)
        self._refuse_unusable(head, flight)
        capacity = self._room.capacity
        count = self._counted(head, flight)
        if count > capacity:
            packed = self._where_they_are(flight.start_ns, flight.end_ns)
            events = self._read(flight._replace(packed=packed), count)
        elif count > flight.expected:
            events = self._read(flight, count)
        else:
            events = self._unpacked(memory[HEAD_BYTES : HEAD_BYTES + 8 * count].view(np.int64), flight)
        return Events.concatenate([*kept, events]) if kept else events

    def _read(self, flight: _Flight, count: int) -> Events:
        if not count:
            return Events.empty()
        rows = self._buffer.rows(1, count)[0, :count]
        flight.packed.read_into(rows, 8 * count)
        return self._unpacked(rows, flight)

    def _unpacked(self, packed: np.ndarray, flight: _Flight) -> Events:
        """(N,) int64 as they came, sorted here where the card has not done it."""
        base_us = flight.start_ns // 1000
        if not len(packed):
            return Events.empty()
        if self._sorts:
            return unpacked(packed, base_us, self.causes)
        rows = self._buffer.rows(1, len(packed))
        if not np.shares_memory(rows, packed):
            rows[0, : len(packed)] = packed
        span_us = flight.end_ns // 1000 - base_us
        return self._buffer.to_events(np.array([len(packed)]), base_us, span_us, 1, self.causes)

    # -- kernels --------------------------------------------------------------------------------------------
    def _values(self, interval: tuple[int, int], was_log: bool) -> dict[str, Any]:
        return {
            "words": self._room.words,
            "limit": int(INTENSITY_LIMIT_BITS),
            "before_is_log": was_log,
            "width": self.width,
            **self._own_values(interval),
        }

    def _own_values(self, interval: tuple[int, int]) -> dict[str, Any]:
        """What sequences of one size do not share, as shaders/include/tiles.glsl names it."""
        start_ns, end_ns = interval
        jitter = np.float64(self.config.threshold_jitter * Q_ONE)
        return {
            "eps": float(np.float32(self.config.log_eps)),
            "share": max(BLOCK, self.config.max_events_per_step // self._blocks),
            "steps": (self._on_all, self._off_all),
            "start_ns": start_ns % 1000,
            "dt_ns": words(end_ns - start_ns),
            "base_ns": words(start_ns - start_ns % 1000),
            "refractory_ns": words(self._refractory_ns),
            "floors": (self._floor_on, self._floor_off),
            "jitter": words(int(jitter.view(np.uint64))),
            "seed": words(int(self.seed)),
        }

    # -- state ----------------------------------------------------------------------------------------------
    def _put_state(self) -> None:
        self._room.put("levels", np.stack([self._upper, self._lower], axis=1))
        if self._has_more:
            more = np.zeros((self.height * self.width, 4), np.uint32)
            if self._fired.size:
                more[:, 0] = self._fired.view(np.uint32)
            if self._last_ns.size:
                more[:, 2:] = self._last_ns.view(np.uint32).reshape(-1, 2)
            self._room.put("more", more)

    def state_dict(self) -> dict[str, np.ndarray]:
        """As of :class:`Esim`, with which it may be exchanged. Raises EventDataError while events are on their way,
        which are no state, and would be lost."""
        if self._flight is not None or self._kept:
            raise EventDataError(
                "events are on their way from the card", where="state_dict", accepted="flush() before it"
            )
        if self.t_ns is not None:
            self.gl.resume()
            levels = self._room.get("levels", np.int32).reshape(-1, 2)
            self._upper[...], self._lower[...] = levels.T
            if self._before_is_log:  # restored, and not gone on since
                self._log[...] = self._room.get("now", np.int32)
            else:
                self._log[...] = log_q25(self._room.get("now", np.float32) + np.float32(self.config.log_eps))
            if self._has_more:
                more = self._room.get("more", np.uint32).reshape(-1, 4)
                if self._fired.size:
                    self._fired[...] = more[:, 0].view(np.int32)
                if self._last_ns.size:
                    self._last_ns[...] = np.ascontiguousarray(more[:, 2:]).view(np.int64)[:, 0]
        return super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._flight, self._kept = None, []
        self.gl.resume()
        self._room.put("now", self._log)
        self._before_is_log = True
        self._put_state()


class _Flight(NamedTuple):
    """Events of one interval, ns, that are made.   was_log : what was before are logarithms, not intensities.
    packed : where they are.   slot, expected : where they will be, and how many of them."""

    start_ns: int
    end_ns: int
    was_log: bool
    packed: moderngl.Buffer
    slot: Slot | None = None
    expected: int = 0
