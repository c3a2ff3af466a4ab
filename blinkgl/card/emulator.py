"""What the emulators on the card share: frames in, kernels, events out, at once or one frame late.

A frame that was drawn by the same context is handed on as the texture it lies in and copied from there; arrays are
copied to the card. No place of an event comes of an unordered atomic, so the order is that of the kernels on the
processor before they sort. Where the buffer is too small for a step's events, it is made again and they are emitted
again: nothing is lost. Events are sorted on the card (``events_sort.glsl``) or by the processor, and come at once or,
so that nobody waits, one frame late (:mod:`blinkgl.card.late`).
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import moderngl
import numpy as np

from blinkgl.card.kernels import CUT, EVENTS, HEAD_BYTES, UNUSABLE, Kernels, Rounding, SortRoom
from blinkgl.card.late import Slot, maps_persistently
from blinkgl.card.proof import rounding as rounding_of
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import BLOCK, Emulator
from blinkgl.events.packing import unpacked
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.gl import GLContext


class Flight(NamedTuple):
    """Events of one interval, ns, that are made.   values : of the uniforms that made them.   packed : where they are.
    slot, expected : where they will be, and how many of them."""

    start_ns: int
    end_ns: int
    values: Mapping[str, Any]
    packed: moderngl.Buffer
    slot: Slot | None = None
    expected: int = 0


class CardEmulator(Emulator):
    """What a class for the card mixes in before that for the processor, whose events it makes bit for bit.

    ``step`` takes, besides arrays, a texture of ``gl``, (W, H) R32F, row 0 the picture's top row, and is done with it
    when it returns. A class gives ``_room`` (:class:`~blinkgl.card.room.Buffers`), whose buffer `now` begins with the
    frame, and what stands below "of a class"."""

    device = "gl"
    takes_textures = True

    # -- of a class -----------------------------------------------------------------------------------------
    @classmethod
    def unfit(cls, config: Any, reconstruction: str = "linear") -> EventDataError | None:
        """Why the card's kernel does not do this, naming the key; None: it does."""
        if reconstruction != "linear":
            return EventDataError(
                "the card follows straight lines between frames only",
                where="timeline.reconstruction",
                value=reconstruction,
                accepted="linear, or events.device: cpu",
            )
        return None

    @classmethod
    def trial(cls, config: Any) -> Any:
        """What tells whether a card runs the same kernels as for this configuration right."""
        raise NotImplementedError

    def _values(self, t_ns: int) -> dict[str, Any]:
        """Of the uniforms of the step to ``t_ns``. Raises EventDataError where there is no such step."""
        raise NotImplementedError

    def _fire(self, flight: Flight, checked: bool) -> None:
        """Runs the kernels.   checked : looks for values that cannot be used: then nothing fires."""
        raise NotImplementedError

    def _emit(self, flight: Flight) -> None:
        """Writes the events again, with more room."""
        raise NotImplementedError

    def _put_state(self) -> None:
        """What the processor's attributes say, to the card."""
        raise NotImplementedError

    def _get_state(self) -> None:
        """The other way."""
        raise NotImplementedError

    def _undone(self, flight: Flight) -> None:
        """The flight's frame was none."""

    # -- the same for all -----------------------------------------------------------------------------------
    def _set_up(
        self, gl: GLContext, owns_gl: bool, rounding: Rounding | None, late: bool | None, sorts: bool | None
    ) -> None:
        """Before a class makes its room."""
        self.gl, self._owns_gl = gl, owns_gl
        gl.resume()
        self._kernels = Kernels(gl, rounding_of(gl) if rounding is None else rounding)
        self._room: Any = None
        self._stays = False
        self._made = 0, 0  # events of the last step, and the microsecond before it
        self._late = (not gl.is_software if late is None else late) and maps_persistently(gl)
        self._sorts = not gl.is_software if sorts is None else sorts
        self._sorting: SortRoom | None = None
        self._slots: list[Slot | None] = [None, None]
        self._flight: Flight | None = None
        self._kept: list[Events] = []  # that were on their way when the next ones were told to stay

    def release(self) -> None:
        """Frees what lies on the card. Harmless when repeated."""
        if not self.gl.released:
            with self.gl.borrowed():
                self._room.release()
                for thing in (self._sorting, *self._slots):
                    if thing is not None:
                        thing.release()
                self._sorting = None
                self._slots = [None, None]
            if self._owns_gl:
                self.gl.release()

    # -- steps ----------------------------------------------------------------------------------------------
    def advance(self, luminance: np.ndarray | moderngl.Texture, t_ns: int) -> int:
        """As ``step``, but the events stay on the card, for :mod:`blinkgl.card.sinks`; how many there are. (Those of a
        step before it that are on their way come with the next ``step`` or ``flush``.)"""
        self._stays = True
        try:
            self.step(cast(Any, luminance), t_ns)
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

    def _luminance(self, frame: np.ndarray) -> np.ndarray:
        return self._decode[frame] if frame.dtype == np.uint8 else frame

    def _start(self, frame: np.ndarray, t_ns: int, rate: np.ndarray | None) -> Events:
        events = cast(Any, super())._start(frame, t_ns, rate)  # noqa: SLF001 - the processor's class
        self._made = 0, t_ns // 1000
        self.gl.resume()
        self._room.put("now", self._luminance(frame))
        self._put_state()
        return events

    def _advance(self, frame: np.ndarray | moderngl.Texture, t_ns: int, rate: np.ndarray | None) -> Events:
        self.gl.resume()
        before = self._landed()
        room, flight = self._room, Flight(self.t_ns or 0, t_ns, self._values(t_ns), self._room["packed"])
        room.turn()
        drawn_here = isinstance(frame, moderngl.Texture)
        if drawn_here:
            frame.read_into(room["now"])  # from one place on the card to another
        else:
            room.put("now", self._luminance(frame))
        self._fire(flight, drawn_here)
        if self._late and not self._stays:
            self._send(flight)
            return before
        head = self._head()
        self._refuse_unusable(head, flight)
        count = self._counted(self._with_room(head, flight), flight)
        if self._stays:
            self._kept += [before] if len(before) else []
            return Events.empty()
        flight = flight._replace(packed=self._where_they_are(flight.start_ns, t_ns))
        return Events.concatenate([before, self._read(flight, count)]) if len(before) else self._read(flight, count)

    def _head(self) -> np.ndarray:
        return np.frombuffer(self._room["listed"].read(HEAD_BYTES), np.uint32)

    # -- from the card to the processor ---------------------------------------------------------------------
    def _refuse_unusable(self, head: np.ndarray, flight: Flight) -> None:
        """Raises EventDataError where the frame at the flight's end had a value that cannot be used. Nothing has fired
        and no level has moved; everything is as it was before that frame."""
        if not head[UNUSABLE] & 1:
            return
        room, seen = self._room, self._room.get("now", np.float32)
        room.turn()
        room.clear_head()
        self._undone(flight)
        if self.t_ns == flight.end_ns:  # it was taken for good then
            self.t_ns, self.frames = flight.start_ns, self.frames - 1
        try:
            self._refuse_intensity(seen)
        except EventDataError as error:
            error.t_ns = flight.end_ns
            raise

    def _counted(self, head: np.ndarray, flight: Flight) -> int:
        """How many events there are; where they did not find room they are emitted again, into more."""
        count = int(head[EVENTS])
        self.saturated += int(head[CUT])
        self._made = count, flight.start_ns // 1000
        if count > self._room.capacity:
            self._room.grow(count)
            self._emit(flight)
        return count

    def _with_room(self, head: np.ndarray, flight: Flight) -> np.ndarray:
        """The head of the same step after another try with more room, where something but events was too large."""
        return head

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

    def _send(self, flight: Flight) -> None:
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
        capacity, again = self._room.capacity, self._with_room(head, flight)
        count = self._counted(again, flight)
        if count > capacity or again is not head:
            packed = self._where_they_are(flight.start_ns, flight.end_ns)
            events = self._read(flight._replace(packed=packed), count)
        elif count > flight.expected:
            events = self._read(flight, count)
        else:
            events = self._unpacked(memory[HEAD_BYTES : HEAD_BYTES + 8 * count].view(np.int64), flight)
        return Events.concatenate([*kept, events]) if kept else events

    def _read(self, flight: Flight, count: int) -> Events:
        if not count:
            return Events.empty()
        rows = self._buffer.rows(1, count)[0, :count]
        flight.packed.read_into(rows, 8 * count)
        return self._unpacked(rows, flight)

    def _unpacked(self, packed: np.ndarray, flight: Flight) -> Events:
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

    # -- state ----------------------------------------------------------------------------------------------
    def state_dict(self) -> dict[str, np.ndarray]:
        """As of the processor's class, with which it may be exchanged. Raises EventDataError while events are on their
        way, which are no state, and would be lost."""
        if self._flight is not None or self._kept:
            raise EventDataError(
                "events are on their way from the card", where="state_dict", accepted="flush() before it"
            )
        if self.t_ns is not None:
            self.gl.resume()
            self._get_state()
        return super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        super().load_state_dict(state)
        self._flight, self._kept = None, []
        self.gl.resume()
        self._put_state()
