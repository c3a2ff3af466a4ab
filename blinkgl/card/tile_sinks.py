"""Tensors of the events of an :class:`~blinkgl.card.atlas.Atlas`, per tile, in one dispatch for all of them.

    sinks = TileSinks(atlas, Voxels, bins=5)
    for emulator in emulators:
        sinks.begin(emulator, t0_us, t1_us)
    for frames in rounds:
        for emulator, (texture, t_ns) in zip(emulators, frames):
            emulator.advance(texture, t_ns)     # as `step`, but no event is read back
        sinks.add()                             # of this round, all tiles
    grids = [sinks.read(emulator) for emulator in emulators]

The sums are those of :mod:`blinkgl.card.sinks`: a tile has the numbers that a sequence has alone, bit for bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from blinkgl.card.kernels import PIXELS_PER_GROUP, Kernels
from blinkgl.card.memory import refuse_if_out_of_memory, refuse_too_large
from blinkgl.card.sinks import Counts, Latest, Voxels, refuse_bins, refuse_window
from blinkgl.card.tensors import Readers, Way
from blinkgl.errors import EventDataError

if TYPE_CHECKING:
    from blinkgl.card.tiles import Tile, Tiles


class TileSinks:
    """One for each tile.   kind : what is added up: :class:`Voxels`, :class:`Counts`, or :class:`Latest`.
    bins : of voxel grids.   shape : of what :meth:`read` gives.
    Raises EventDataError: bins out of range; GLError: not enough memory."""

    def __init__(self, atlas: Tiles, kind: type[Voxels | Counts | Latest], bins: int = 5):
        refuse_bins(bins)
        self._atlas, self._kind = atlas, kind
        planes = bins if kind is Voxels else 2
        self.shape = planes, atlas.height, atlas.width
        tiles, gl = atlas.room.tiles, atlas.gl
        gl.resume()
        self._kernels = Kernels(gl)
        self._bytes = 4 * planes * atlas.height * atlas.width
        what = f"{tiles} times {planes} planes of {atlas.width}x{atlas.height}"
        refuse_too_large(gl, {"sinks": tiles * self._bytes}, what, (atlas.width, atlas.height))
        self._buffer, self._windows = gl.ctx.buffer(reserve=tiles * self._bytes), gl.ctx.buffer(reserve=8 * tiles)
        refuse_if_out_of_memory(gl, what)
        self._readers = Readers(gl, self._buffer)
        self._window_us = np.zeros((tiles, 2), np.int64)  # no window: nothing is in it

    def begin(self, emulator: Tile, t0_us: int, t1_us: int) -> None:
        """A new window [t0_us, t1_us) of a tile, empty; its others go on. Raises EventDataError: no length, or over 17
        minutes; an emulator of another atlas."""
        tile = self._tile(emulator)
        refuse_window(t0_us, t1_us)
        self._atlas.gl.resume()
        self._window_us[tile] = t0_us, t1_us
        self._buffer.clear(self._bytes, tile * self._bytes)

    def add(self) -> None:
        """The events of the last round, of every tile that had a frame in it, those outside of its window left out;
        tiles that wait for the others are done first. What cannot be used as a frame has no events; the tile's own next
        ``step`` or ``flush`` says so."""
        atlas = self._atlas
        packed, count, intervals = atlas.last_round()
        windows = np.zeros((atlas.room.tiles, 2), np.int32)
        for tile, (start_ns, _) in intervals.items():
            (t0_us, t1_us), base_us = self._window_us[tile].tolist(), start_ns // 1000
            if base_us < t1_us and base_us - t0_us >= -(2**31):
                windows[tile] = base_us - t0_us, t1_us - t0_us
        if not count or not windows[:, 1].any():
            return
        self._windows.write(windows)
        values = {
            "count": count,
            "width": atlas.width,
            "height": atlas.height,
            "pixels": atlas.height * atlas.width,
            "planes": self.shape[0],
            "rows": atlas.rows - 1,
            "bins": self.shape[0],
        }
        self._kernels.run(
            "compute/events_sink.glsl",
            {self._kind.define: 1, "BATCH": 1},
            {0: packed, 1: self._buffer, 2: self._windows},
            values,
            items=count,
            local=PIXELS_PER_GROUP,
        )

    def read(self, emulator: Tile) -> np.ndarray:
        """The tile's window so far, as the kind's ``read`` has it. Raises EventDataError: another atlas's emulator."""
        tile = self._tile(emulator)
        self._atlas.gl.resume()
        data = self._buffer.read(self._bytes, offset=tile * self._bytes)
        return self._kind.finished(np.frombuffer(data, np.int32).reshape(self.shape), int(self._window_us[tile, 0]))

    def tensor(self, emulator: Tile, device: str | None = None) -> Any:
        """The tile's window so far as a torch tensor of its own, as the kind's ``tensor`` has it. Raises
        EventDataError: no torch, no such device, another atlas's emulator."""
        tile, reader = self._tile(emulator), self._readers.on(device)
        whole = reader.read(self._bytes, tile * self._bytes).reshape(self.shape)
        return self._kind.finished_tensor(whole, int(self._window_us[tile, 0]))

    def way(self, device: str | None = None) -> Way:
        """How :meth:`tensor` goes to a device, and why no shorter way. Raises as :meth:`tensor`."""
        return self._readers.on(device).way

    def _tile(self, emulator: Tile) -> int:
        if emulator.atlas is not self._atlas:
            raise EventDataError("not a tile of this atlas", where="emulator", value=emulator.tile)
        return emulator.tile

    def release(self) -> None:
        """Frees the buffers. Harmless when repeated."""
        if not self._atlas.gl.released:
            with self._atlas.gl.borrowed():
                self._readers.release()
                self._buffer.release()
                self._windows.release()
