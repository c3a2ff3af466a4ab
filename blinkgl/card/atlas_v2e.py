"""Several small sequences of V2E as tiles of one event kernel; :mod:`blinkgl.card.atlas` says how it is used.

    with AtlasV2e(gl, 128, 128, tiles=8, config=config) as atlas:
        emulators = [atlas.emulator(config, seed) for seed in seeds]

What a sequence's photoreceptors hold has two halves of one buffer, which take turns with its own frames; levels, clocks
of noise and tables have their parts by tile. Sequences have thresholds, rates, corners and times of their own, and ask
for the same parts of the model: what is off in one is off in all.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, ClassVar

import moderngl
import numpy as np

from blinkgl.card.kernels import Kernels, Rounding
from blinkgl.card.tiles import Tile, Tiles
from blinkgl.card.v2e import FEW_SHOTS, SIZES, CardV2e, V2eRoom, V2eStages
from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events.emulator import BLOCK
from blinkgl.events.v2e import V2e
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from blinkgl.gl import GLContext

_ROW = np.dtype(
    [
        *((name, np.uint32) for name in ("fires", "swapped", "start_ns", "share")),
        *((name, np.uint32) for name in ("scale", "since", "kappa", "second_keep")),
        *((name, np.uint32) for name in ("second_ramp", "number", "bound", "spare")),
        *((name, np.uint32, 2) for name in ("start", "dt_ns", "dt_whole", "dt_s")),
        *((name, np.uint32, 2) for name in ("kappa_double", "since_0", "since_1", "leak_jitter")),
        *((name, np.uint32, 2) for name in ("refractory_ns", "seed", "shot_unit", "inverse_threshold")),
    ]
)
"""As in shaders/include/v2e_tiles.glsl."""
_KEYS = {
    "LOW_PASS": "cutoff_hz",
    "SECOND": "second_cutoff_hz",
    "LEAKS": "leak_rate_hz",
    "LEAK_JITTER": "leak_jitter",
    "HUMS": "photoreceptor_noise",
    "SHOTS": "shot_noise_rate_hz",
    "DEAD_TIME": "refractory_us",
    "CAUSES": "causes",
    "HOT": "hot_pixel_fraction",
}
"""What asks for a part of the model."""


class _Description(CardV2e):
    """One that has no room on the card: what its configuration asks for."""

    def __init__(self, config: V2eConfig):
        V2e.__init__(self, 1, 1, config)


class AtlasV2e(Tiles):
    """Up to ``tiles`` sequences of one size, of V2E.   config : one that asks for the parts of the model that all of
    them ask for.   late, rounding : see :class:`~blinkgl.card.tiles.Tiles`, which raises; memory is as
    :class:`~blinkgl.card.v2e.CardV2e` has it."""

    kind: ClassVar[Any] = V2e
    row: ClassVar[np.dtype] = _ROW

    def __init__(
        self,
        gl: GLContext,
        height: int,
        width: int,
        tiles: int,
        config: V2eConfig | None = None,
        *,
        late: bool | None = None,
        rounding: Rounding | None = None,
    ):
        config = config or V2eConfig()
        self.layout = _Description(config)._layout()  # noqa: SLF001 - its own
        super().__init__(gl, height, width, tiles, config.causes, late, rounding)

    def _make_room(self, tiles: int, kernels: Kernels) -> V2eRoom:
        layout = self.layout
        room = V2eRoom(
            self.gl,
            tiles * self.pixels,
            f"{tiles} sequences of {self.width}x{self.height} pixels",
            (self.width, self.height),
            layout.signal,
            layout.state,
            FEW_SHOTS if "SHOTS" in layout.features else None,
            tiles,
        )
        self._stages = V2eStages(kernels, room, layout.features)
        return room

    def _make(self, tile: int, config: Any, seed: int) -> TileV2e:
        return TileV2e(self, tile, config, seed)

    @property
    def values(self) -> dict[str, Any]:
        candidates = max((one.likely for one in self._flying), default=FEW_SHOTS)
        return {**super().values, "pixels": self.height * self.width, "candidates": candidates}

    def _run(self) -> None:
        values = self.values
        if self.room.shots and values["candidates"] > self.room.shots:
            self.room.make_room_for_shots(values["candidates"])
        self._stages.fire(values, checked=True)

    def _emit(self) -> None:
        self._stages.emit(self.values)

    def _make_more_room(self) -> None:
        """More noise than was likely, in somebody's block."""
        for one in self._flying:
            one.likely = max(2 * one.likely, self.room.shots)
        self.room.make_room_for_shots(2 * self.room.shots)


class _Layer:
    """One tile's part of the buffers, as :class:`~blinkgl.card.v2e.V2eRoom` is that of an emulator alone.

    swapped : which half its last frame is in."""

    def __init__(self, room: V2eRoom, tile: int, padded: int, pixels: int):
        self._room, self._tile, self._first, self._pixels, self.swapped = room, tile, tile * padded, pixels, False
        self._blocks = padded // BLOCK

    def turn(self) -> None:
        self.swapped = not self.swapped

    @property
    def _half(self) -> int:
        """Bytes before the half that is "now"."""
        return self._room.held if self.swapped else 0

    def put(self, name: str, array: np.ndarray) -> None:
        """A frame: ``name`` is "now"."""
        self._room[name].write(np.ascontiguousarray(array), self._half + 4 * self._first)

    def get(self, name: str, dtype: type) -> np.ndarray:
        return np.frombuffer(self._room[name].read(4 * self._pixels, offset=self._half + 4 * self._first), dtype)

    def copy(self, frame: moderngl.Texture) -> None:
        frame.read_into(self._room["now"], write_offset=self._half + 4 * self._first)

    def _at(self, buffer: str, plane: str, k: int) -> int:
        number = self._room.planes(buffer)[plane] + k
        return (self._half if buffer == "now" else 0) + 4 * (number * self._room.padded + self._first)

    def put_plane(self, buffer: str, plane: str, array: np.ndarray) -> None:
        for k, part in enumerate(array.view(np.uint32).reshape(self._pixels, -1).T):
            self._room[buffer].write(np.ascontiguousarray(part), self._at(buffer, plane, k))

    def get_plane(self, buffer: str, plane: str, dtype: type) -> np.ndarray:
        read = lambda k: self._room[buffer].read(4 * self._pixels, offset=self._at(buffer, plane, k))
        parts = [np.frombuffer(read(k), np.uint32) for k in range(np.dtype(dtype).itemsize // 4)]
        return np.ascontiguousarray(np.stack(parts, axis=1)).view(dtype)[:, 0]

    @property
    def _clocks_at(self) -> int:
        return self._half + self._room.clocks_at + 16 * self._tile * self._blocks

    def put_clocks(self, clocks: np.ndarray) -> None:
        self._room["now"].write(np.ascontiguousarray(clocks), self._clocks_at)

    def get_clocks(self) -> np.ndarray:
        data = self._room["now"].read(16 * self._blocks, offset=self._clocks_at)
        return np.frombuffer(data, np.int64).reshape(-1, 2)

    def put_table(self, table: np.ndarray) -> None:
        self._room["table"].write(table, self._tile * table.nbytes)

    def put_sizes(self, sizes: np.ndarray) -> None:
        self._room["sizes"].write(np.ascontiguousarray(sizes), 4 * SIZES * self._tile)


class TileV2e(Tile, CardV2e):
    """See :class:`~blinkgl.card.tiles.Tile`.   likely : candidates of noise that no block of its has more of."""

    def __init__(self, atlas: AtlasV2e, tile: int, config: V2eConfig, seed: int):
        V2e.__init__(self, atlas.height, atlas.width, config, seed)
        self.likely = FEW_SHOTS
        features, there = self._layout().features, atlas.layout.features
        for name, key in _KEYS.items():
            if (name in features) != (name in there):
                raise EventDataError(
                    "sequences of a batch ask for the same parts of the model",
                    where=f"events.{key}",
                    value=getattr(config, key),
                    accepted="what the batch was made with" if name in there else "none: the batch was made without it",
                )
        self._settle(atlas, tile, _Layer(atlas.room, tile, atlas.pixels, self.height * self.width))
        atlas.gl.resume()
        self._put_constants()

    def _told(self, t_ns: int) -> dict[str, Any]:
        self.likely = self._likely_shots(t_ns)
        return self._own_values(t_ns)

    def _advance(self, frame: np.ndarray | moderngl.Texture, t_ns: int, rate: np.ndarray | None) -> Events:
        assert self.t_ns is not None
        self._refuse_shots(t_ns - self.t_ns)
        events = super()._advance(frame, t_ns, rate)
        self._seen(frame, t_ns)
        return events

    def _taken(self) -> Events:
        events = super()._taken()
        self._begin_due_leaks()
        return events

    def _undo(self) -> None:
        self._due_ns = None
        super()._undo()
