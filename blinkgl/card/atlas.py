"""Several small sequences as tiles of one event kernel: ten dispatches for a frame of each, instead of ten for each.

    with Atlas(gl, 128, 128, tiles=8) as atlas:
        emulators = [atlas.emulator(config, seed) for seed in seeds]
        for frames in rounds:                             # a frame of every sequence that goes on
            for emulator, (texture, t_ns) in zip(emulators, frames):
                events = emulator.step(texture, t_ns)     # of the interval before
        last = [emulator.flush() for emulator in emulators]

An emulator that is given a frame puts it into its tile and gives the events of its last frame. When all tiles in use
have one, or somebody wants events that are not there yet, every tile that waits is done, in one go. So nobody has to
keep step: sequences have times, thresholds, and ends of their own, and each has the events that it has alone, bit for
bit.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import moderngl
import numpy as np

from blinkgl.card.esim import CardEsim
from blinkgl.card.kernels import Kernels, Rounding
from blinkgl.card.room import Room
from blinkgl.card.stages import Stages, is_long
from blinkgl.card.tiles import Tile, Tiles
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import NEVER_NS
from blinkgl.events.esim import Esim

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_ROW = np.dtype(
    [
        *((name, np.uint32) for name in ("fires", "swapped", "start_ns", "share")),
        *((name, np.uint32, 2) for name in ("dt_ns", "base_ns", "refractory_ns", "seed")),
        *((name, np.int32, 2) for name in ("steps", "floors")),
        ("jitter", np.uint32, 2),
        ("eps", np.float32),
        ("spare", np.uint32),
    ]
)
"""As in shaders/include/tiles.glsl."""


class Atlas(Tiles):
    """Up to ``tiles`` sequences of one size, of ESIM.   spread, jitter, refractory : what any of them may ask for of
    ``threshold_sigma``, ``threshold_jitter``, ``refractory_us``; all pay for it.   late, rounding : see
    :class:`~blinkgl.card.tiles.Tiles`, which raises; memory is as :class:`~blinkgl.card.esim.CardEsim` has it."""

    kind: ClassVar[Any] = Esim
    row: ClassVar[np.dtype] = _ROW

    def __init__(
        self,
        gl: GLContext,
        height: int,
        width: int,
        tiles: int,
        *,
        spread: bool = True,
        jitter: bool = False,
        refractory: bool = False,
        late: bool | None = None,
        rounding: Rounding | None = None,
    ):
        self.spread, self.jitter, self.refractory = spread, jitter, refractory
        super().__init__(gl, height, width, tiles, False, late, rounding)

    def _make_room(self, tiles: int, kernels: Kernels) -> Room:
        room = Room(
            self.gl,
            tiles * self.pixels,
            f"{tiles} sequences of {self.width}x{self.height} pixels",
            (self.width, self.height),
            spread=self.spread,
            more=self.jitter or self.refractory,
            tiles=tiles,
        )
        self._stages = Stages(kernels, room, spread=self.spread, jitter=self.jitter, refractory=self.refractory)
        return room

    def _make(self, tile: int, config: Any, seed: int) -> TileEsim:
        return TileEsim(self, tile, config, seed)

    def _run(self) -> None:
        self._stages.fire(self.values, checked=True, long=self._long)

    def _emit(self) -> None:
        self._stages.emit(self.values, long=self._long)

    @property
    def _long(self) -> bool:
        return any(is_long(one.interval) for one in self._flying)


class _Layer:
    """One tile's part of the buffers, as :class:`~blinkgl.card.room.Room` is that of an emulator alone. Which of two
    buffers holds its last frame is its own affair, not all tiles having as many.

    swapped : it is "before"."""

    def __init__(self, room: Room, first: int, pixels: int):
        self._room, self._first, self._pixels, self.swapped = room, first, pixels, False

    def turn(self) -> None:
        self.swapped = not self.swapped

    def put(self, name: str, array: np.ndarray) -> None:
        self._room.put(self._named(name), array, self._first)

    def get(self, name: str, dtype: type) -> np.ndarray:
        return self._room.get(self._named(name), dtype, self._first, self._pixels)

    def copy(self, frame: moderngl.Texture) -> None:
        """A texture to where the frame lies that is "now"."""
        frame.read_into(self._room[self._named("now")], write_offset=4 * self._first)

    def _named(self, name: str) -> str:
        return {"now": "before", "before": "now"}.get(name, name) if self.swapped else name


class TileEsim(Tile, CardEsim):
    """See :class:`~blinkgl.card.tiles.Tile`."""

    def __init__(self, atlas: Atlas, tile: int, config: Any, seed: int):
        if problem := self.unfit(config):
            raise problem
        Esim.__init__(self, atlas.height, atlas.width, config, seed)
        for key, asked, there in (
            ("threshold_sigma", self._on.size, atlas.spread),
            ("threshold_jitter", self._fired.size, atlas.jitter),
            ("refractory_us", self._refractory_ns, atlas.refractory),
        ):
            if asked and not there:
                raise EventDataError(
                    "the batch was made without it", where=f"events.{key}", value=getattr(config, key), accepted="0"
                )
        self._before_is_log = False
        self._settle(atlas, tile, _Layer(atlas.room, tile * atlas.pixels, self.height * self.width))
        if atlas.spread:
            own = (self._on, self._off) if self._on.size else (self._on_all, self._off_all)
            thresholds = np.empty((self.height * self.width, 2), np.int32)
            thresholds[:, 0], thresholds[:, 1] = own
            self._room.put("thresholds", thresholds)

    def _told(self, t_ns: int) -> dict[str, Any]:
        return self._own_values((self.t_ns or 0, t_ns))

    def _put_state(self) -> None:
        self._room.put("levels", np.stack([self._upper, self._lower], axis=1))
        if self.atlas.jitter or self.atlas.refractory:
            more = np.zeros((self.height * self.width, 4), np.uint32)
            last = self._last_ns if self._last_ns.size else np.full(len(more), NEVER_NS, np.int64)
            more[:, 2:] = last.view(np.uint32).reshape(-1, 2)
            self._room.put("more", more)
