"""What batches of every kind of emulator share: tiles that wait for each other, and the sequences in them.

:mod:`blinkgl.card.atlas` says how they are used, and has ESIM's; :mod:`blinkgl.card.atlas_v2e` has V2E's.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, cast

import moderngl
import numpy as np

from blinkgl.card.emulator import CardEmulator
from blinkgl.card.kernels import CUT, EVENTS, HEAD_BYTES, UNUSABLE, Kernels, Rounding, refuse_without_compute
from blinkgl.card.late import Slot, maps_persistently
from blinkgl.card.proof import rounding as rounding_of
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import BLOCK, INTENSITY_LIMIT_BITS
from blinkgl.events.packing import MAX_CAUSE_ROWS
from blinkgl.events.table import emulator_of
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from typing_extensions import Self

    from blinkgl.card.room import Buffers
    from blinkgl.gl import GLContext

MAX_ROWS = 2**16
"""Of all tiles together: events say by their row whose they are. (Where they say what made them, a quarter.)"""
_UNIFORM_BLOCK = 1
"""0 is the shapes' of deforming meshes (blinkgl/render/resources.py)."""


class Tiles:
    """A batch. A class gives what stands below "of a class".

    causes : whether events say what made them.   late : read-back waits for nobody; None: where the context is not the
    processor's.   rounding : see :class:`~blinkgl.card.esim.CardEsim`.
    Raises GLError: no compute shaders, not enough memory; EventDataError: more rows than events can name."""

    # -- of a class -----------------------------------------------------------------------------------------
    kind: ClassVar[Any]
    """Of the processor's emulators."""
    row: ClassVar[np.dtype]
    """Of a tile, in the uniform block of the shaders."""

    def _make_room(self, tiles: int, kernels: Kernels) -> Buffers:
        """The buffers of all tiles."""
        raise NotImplementedError

    def _make(self, tile: int, config: Any, seed: int) -> Tile:
        """The emulator in a tile. Raises EventDataError: it asks for what the batch was not made for."""
        raise NotImplementedError

    def _run(self) -> None:
        """The kernels, for every tile whose row says that it fires; looks for values that cannot be used."""
        raise NotImplementedError

    def _emit(self) -> None:
        """Writes the events of the last run again, with more room."""
        raise NotImplementedError

    def _make_more_room(self) -> None:
        """After a run in which nothing fired because something but events was too large."""

    # -- the same for all -----------------------------------------------------------------------------------
    def __init__(
        self,
        gl: GLContext,
        height: int,
        width: int,
        tiles: int,
        causes: bool = False,
        late: bool | None = None,
        rounding: Rounding | None = None,
    ):
        refuse_without_compute(gl)
        gl.resume()
        self.rows = MAX_CAUSE_ROWS if causes else MAX_ROWS
        """That events can name."""
        block_bytes = gl.ctx.info["GL_MAX_UNIFORM_BLOCK_SIZE"]
        most = min(self.rows // max(1, height), block_bytes // self.row.itemsize)
        if not 1 <= tiles <= most:
            raise EventDataError(
                f"so many sequences of {width}x{height} do not go together",
                where="tiles",
                value=tiles,
                accepted=f"1 to {most}",
            )
        self.gl, self.height, self.width = gl, height, width
        self.pixels = -(-height * width // BLOCK) * BLOCK
        """Of a tile, with those that fill up its last block."""
        self.room: Any = self._make_room(tiles, Kernels(gl, rounding_of(gl) if rounding is None else rounding))
        self._block = gl.ctx.buffer(reserve=self.row.itemsize * tiles)
        self._table = np.zeros(tiles, self.row)
        self._in_use: list[Any] = [None] * tiles
        self._flying: list[Any] = []  # whose events are made, and not read yet
        self._late = (not gl.is_software if late is None else late) and maps_persistently(gl)
        self._slot: Slot | None = None
        self._expected = 0
        self._last: tuple[int, dict[int, tuple[int, int]]] = 0, {}  # events of the last round, intervals of its tiles
        self.rounds = 0
        """Times that tiles have been done together."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.release()

    def emulator(
        self, config: Any, seed: int = 0, reconstruction: str = "linear", size: tuple[int, int] | None = None
    ) -> Any:
        """That of a tile that is free, until it is released.   size : (height, width) that is wanted.

        Raises EventDataError: none is free, or the configuration asks for what the batch was not made for."""
        if emulator_of(config) is not self.kind:
            raise EventDataError(
                "the batch is of another emulator",
                where="events.emulator",
                value=config.emulator,
                accepted=self.kind.Config().emulator,
            )
        if problem := CardEmulator.unfit(config, reconstruction):
            raise problem
        if size not in (None, (self.height, self.width)):
            raise EventDataError(
                "sequences of a batch are of one size",
                where="camera",
                value=size,
                accepted=f"({self.height}, {self.width})",
            )
        if None not in self._in_use:
            raise EventDataError("every tile is in use", where="tiles", value=len(self._in_use), accepted="release one")
        tile = self._in_use.index(None)
        made = self._in_use[tile] = self._make(tile, config, seed)
        return made

    def leave(self, emulator: Tile) -> None:
        """The tile is free again. Events of it that nobody has taken are lost."""
        if emulator in self._flying:
            self._land()
        self._in_use[emulator.tile] = None
        self._fire_if_all_wait()

    def ready(self, emulator: Tile) -> None:
        """It has a new frame."""
        self._fire_if_all_wait()

    def deliver(self, emulator: Tile) -> None:
        """What it waits for is there afterwards."""
        if emulator.waits:
            self._fire()
        if emulator in self._flying:
            self._land()

    def last_round(self) -> tuple[moderngl.Buffer, int, dict[int, tuple[int, int]]]:
        """Packed events of the last round, how many, and the intervals, ns, by tile. Rows of tile k begin at
        k times ``height``. Tiles that wait are done first. A frame that cannot be used has no events; its own next step
        says so."""
        if any(one is not None and one.waits for one in self._in_use):
            self._fire()
        self._land()
        return self.room["packed"], *self._last

    def _fire_if_all_wait(self) -> None:
        used = [one for one in self._in_use if one is not None and one.goes_on]
        if used and all(one.waits for one in used):
            self._fire()

    def _fire(self) -> None:
        """Every tile that waits."""
        self._land()
        self.gl.resume()
        flying = [one for one in self._in_use if one is not None and one.waits]
        self._table["fires"] = 0
        for one in flying:
            one.tell(self._table[one.tile])
            one.waits = False
        self._flying, self.rounds = flying, self.rounds + 1
        self._send_rows()
        if self._late and not all(one.stays for one in flying):
            self._send()

    def _send_rows(self) -> None:
        self._block.write(self._table)
        self._block.bind_to_uniform_block(_UNIFORM_BLOCK)
        self._run()

    @property
    def values(self) -> dict[str, Any]:
        """Of the uniforms that all tiles share."""
        return {
            "words": self.room.words,
            "limit": int(INTENSITY_LIMIT_BITS),
            "width": self.width,
            "height": self.height,
            "pixels_of_tile": self.pixels,
            "cuts_at": self.room.cuts_at,
        }

    def _send(self) -> None:
        """Sends head and events off: as many as the last round had, and a quarter more."""
        expected = min(self.room.capacity, max(BLOCK, self._expected * 5 // 4))
        size = HEAD_BYTES + 8 * expected
        if self._slot is None or self._slot.size < size:
            if self._slot is not None:
                self._slot.release()
            self._slot = Slot(self.gl, size + size // 4)
        self._slot.copy(self.room["listed"], HEAD_BYTES)
        self._slot.copy(self.room["packed"], 8 * expected, HEAD_BYTES)
        self._slot.seal()
        self._expected = expected

    def _land(self) -> None:
        """Gives every tile that was done its events, or what is wrong with its frame."""
        if not self._flying:
            return
        self.gl.resume()
        room, sent = self.room, self._late and not all(one.stays for one in self._flying)
        memory = self._slot.wait() if sent and self._slot is not None else None
        head = (
            np.frombuffer(room["listed"].read(HEAD_BYTES), np.uint32)
            if memory is None
            else memory[:HEAD_BYTES].view(np.uint32)
        )
        while head[UNUSABLE]:  # nothing has fired
            sent = False
            room.clear_head()
            if head[UNUSABLE] & 1:
                for one in [one for one in self._flying if not one.usable()]:
                    one.spoilt, self._table["fires"][one.tile] = True, 0
                    self._flying.remove(one)
            if head[UNUSABLE] & 2:
                self._make_more_room()
            self._send_rows()
            head = np.frombuffer(room["listed"].read(HEAD_BYTES), np.uint32)
        count, flying = int(head[EVENTS]), self._flying
        if head[CUT]:
            cuts = room.cuts()
            room.clear_cuts()
            for one in flying:
                one.saturated += int(cuts[one.tile])
        if count > room.capacity:
            room.grow(count)
            self._emit()
            sent = False
        self._last = count, {one.tile: one.interval for one in flying}
        if all(one.stays for one in flying):
            self._flying = []
            return
        if sent and memory is not None and count <= self._expected:
            packed = memory[HEAD_BYTES : HEAD_BYTES + 8 * count].view(np.int64)
        else:
            packed = np.frombuffer(room["packed"].read(8 * count) if count else b"", np.int64)
        self._expected = count
        edges = np.searchsorted((packed >> 17) & (self.rows - 1), self.height * np.arange(len(self._in_use) + 1))
        for one in [one for one in flying if not one.stays]:
            mine = packed[edges[one.tile] : edges[one.tile + 1]]
            one.take(mine - (one.tile * self.height << 17))
        self._flying = []

    def release(self) -> None:
        """Frees what lies on the card. Harmless when repeated."""
        if not self.gl.released:
            with self.gl.borrowed():
                self.room.release()
                self._block.release()
                if self._slot is not None:
                    self._slot.release()
                    self._slot = None


class Tile(CardEmulator):
    """An emulator whose pixels are a tile of a batch; mixed in before that of its kind for the card. Events come one
    frame late, ``flush`` gives the last.

    tile : its number.   waits : whether it has a frame that has not been done.   stays : whether the events of its
    last frame are left on the card.   A class gives `_told`, and room that is a part of the batch's."""

    config: Any
    atlas: Any
    """Its :class:`Tiles`."""

    def _told(self, t_ns: int) -> Mapping[str, Any]:
        """What sequences of one size do not share, of the step to ``t_ns``, as the shaders name it. Raises
        EventDataError where there is no such step."""
        raise NotImplementedError

    def _settle(self, atlas: Tiles, tile: int, room: Any) -> None:
        """In its tile, before the first frame."""
        self.gl, self.atlas, self.tile, self.waits, self.spoilt = atlas.gl, atlas, tile, False, False
        self.stays = False
        self.interval = 0, 0
        """Of the events that are on their way, ns."""
        self._room = room
        self._stays, self._sorts, self._late, self._owns_gl = False, False, False, False
        self._made = 0, 0
        self._due, self._over, self._arrived = False, False, Events.empty()
        self._row: Mapping[str, Any] = {}
        self._flight, self._kept = None, []

    @property
    def goes_on(self) -> bool:
        """Whether it has had a frame, and is waited for: not between :meth:`flush` and the next one."""
        return self.t_ns is not None and not self._over

    @property
    def lags(self) -> bool:
        return True

    @property
    def done_ns(self) -> int | None:
        return self.interval[0] if self._due else self.t_ns

    def advance(self, luminance: np.ndarray | moderngl.Texture, t_ns: int) -> int:
        """As ``step``, but the events stay on the card, for :mod:`blinkgl.card.tile_sinks`. Those of a step before it
        that are on their way come with the next ``step`` or ``flush``. Returns 0: nobody counts them tile by tile."""
        self._stays = True
        try:
            before = self.step(cast(Any, luminance), t_ns)
        finally:
            self._stays = False
        self._kept += [before] if len(before) else []
        return 0

    def _advance(self, frame: np.ndarray | moderngl.Texture, t_ns: int, rate: np.ndarray | None) -> Events:
        before = self._taken()
        assert self.t_ns is not None
        self._row = self._told(t_ns)
        self.stays = self._stays
        self.gl.resume()
        self._room.turn()
        if isinstance(frame, moderngl.Texture):
            self._room.copy(frame)
        else:
            self._room.put("now", self._luminance(frame))
        self.interval, self.waits, self._due, self._over = (self.t_ns, t_ns), True, True, False
        self.atlas.ready(self)
        return before

    def flush(self) -> Events:
        self._over = True
        events, kept, self._kept = self._taken(), self._kept, []
        return Events.concatenate([*kept, events]) if kept else events

    def _taken(self) -> Events:
        """The events that were on their way. Raises EventDataError where the frame that ends their interval cannot be
        used; everything is then as it was before that frame."""
        if not self._due:
            return Events.empty()
        self.atlas.deliver(self)
        self._due = False
        if self.spoilt:
            self._undo()
        arrived, self._arrived = self._arrived, Events.empty()
        return arrived

    def step(
        self,
        luminance: np.ndarray | moderngl.Texture,
        t_ns: int,
        rows: tuple[int, int] | None = None,
        rate: np.ndarray | None = None,
    ) -> Events:
        events = super().step(cast(Any, luminance), t_ns, rows, rate)
        if self._stays or not self._kept:
            return events
        kept, self._kept = self._kept, []
        return Events.concatenate([*kept, events])

    def _undo(self) -> None:
        seen, self.spoilt = self._room.get("now", np.float32), False
        self._room.turn()
        self.t_ns, self.frames = self.interval[0], self.frames - 1
        try:
            self._refuse_intensity(seen)
        except EventDataError as error:
            error.t_ns = self.interval[1]
            raise

    # -- what the atlas asks --------------------------------------------------------------------------------
    def tell(self, row: np.void) -> None:
        """Writes what is its own into its row of the table."""
        for name, value in self._row.items():
            row[name] = value
        row["fires"], row["swapped"] = 1, self._room.swapped

    def usable(self) -> bool:
        """Whether its new frame has intensities alone."""
        try:
            self._refuse_intensity(self._room.get("now", np.float32))
        except EventDataError:
            return False
        return True

    def take(self, packed: np.ndarray) -> None:
        """(N,) int64, its events of the interval, not sorted."""
        start_ns, end_ns = self.interval
        rows = self._buffer.rows(1, max(1, len(packed)))
        rows[0, : len(packed)] = packed
        base_us = start_ns // 1000
        span_us = end_ns // 1000 - base_us
        self._arrived = self._buffer.to_events(np.array([len(packed)]), base_us, span_us, 1, self.causes)

    # -- state ----------------------------------------------------------------------------------------------
    def state_dict(self) -> dict[str, np.ndarray]:
        """As of the processor's class. Raises EventDataError before :meth:`flush`."""
        if self._due:
            raise EventDataError(
                "events are on their way from the card", where="state_dict", accepted="flush() before it"
            )
        return super().state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        raise EventDataError(
            "a sequence of a batch begins at its first frame", where="load_state_dict", accepted="an emulator alone"
        )

    def release(self) -> None:
        """Leaves the tile to others. Harmless when repeated."""
        if self.atlas._in_use[self.tile] is self:  # noqa: SLF001 - the atlas's own
            self.waits = False
            with self.gl.borrowed():
                self.atlas.leave(self)
