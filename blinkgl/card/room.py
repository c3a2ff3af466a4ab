"""The buffers that an event kernel works in."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from blinkgl.card.kernels import HEAD_BYTES, PIXELS_PER_GROUP, WORD
from blinkgl.card.memory import refuse_if_out_of_memory, refuse_too_large
from blinkgl.errors import GLError
from blinkgl.events.emulator import BLOCK

if TYPE_CHECKING:
    import moderngl

    from blinkgl.gl import GLContext

FAR = 2**30
"""A level that no logarithm reaches: of the pixels that fill up the last block."""


class Buffers:
    """Of a kernel, by name; `listed`, `marks`, `counts`, `places`, `sums` and `packed` are of all kernels, `now` and
    `before` take turns.

    pixels : of all pictures.   sizes : bytes, besides those.   what, size : for messages, and width and height of the
    picture.   tiles : of a batch, whose cut events are counted behind `counts`.
    words : of 32 pixels, whole blocks.   capacity : events that `packed` holds.
    Raises GLError where the card has no room for them."""

    def __init__(
        self,
        gl: GLContext,
        pixels: int,
        sizes: dict[str, int],
        what: str,
        size: tuple[int, int],
        tiles: int = 0,
    ):
        self._gl, self._pixels, self.tiles = gl, pixels, tiles
        self.padded = -(-pixels // BLOCK) * BLOCK
        self.cuts_at = self.padded + PIXELS_PER_GROUP
        self.words, self.capacity = self.padded // WORD, max(BLOCK, self.padded // 4)
        sizes = {
            "marks": 4 * self.words,
            "listed": HEAD_BYTES + 8 * self.padded,
            "counts": 4 * (self.cuts_at + tiles),
            "places": 4 * (self.padded + PIXELS_PER_GROUP),
            "sums": 4 * (self.words + PIXELS_PER_GROUP),
            "packed": 8 * self.capacity,
            **sizes,
        }
        refuse_too_large(gl, sizes, what, size)
        self._buffers = {name: gl.ctx.buffer(reserve=size) for name, size in sizes.items()}
        try:
            refuse_if_out_of_memory(gl, what)
        except GLError:
            self.release()
            raise
        self.clear_head()
        self.clear_cuts()

    def __getitem__(self, name: str) -> moderngl.Buffer:
        return self._buffers[name]

    def turn(self) -> None:
        """What is now becomes what was before; `now` is to be written."""
        both = self._buffers
        both["now"], both["before"] = both["before"], both["now"]

    def clear_head(self) -> None:
        self._buffers["listed"].write(bytes(HEAD_BYTES))

    def clear_cuts(self) -> None:
        """No tile has had events cut."""
        if self.tiles:
            self._buffers["counts"].write(bytes(4 * self.tiles), 4 * self.cuts_at)

    def cuts(self) -> np.ndarray:
        """(tiles,) events that each has had cut."""
        return np.frombuffer(self._buffers["counts"].read(4 * self.tiles, offset=4 * self.cuts_at), np.uint32)

    def bytes_per_pixel(self, name: str) -> int:
        """Of a buffer that has a value for every pixel."""
        return self._buffers[name].size // (self.words * WORD)

    def put(self, name: str, array: np.ndarray, first: int = 0) -> None:
        """Values of the pixels from ``first`` on."""
        self._buffers[name].write(np.ascontiguousarray(array), first * self.bytes_per_pixel(name))

    def get(self, name: str, dtype: type, first: int = 0, pixels: int | None = None) -> np.ndarray:
        """Of so many pixels from ``first`` on, or of all, flat."""
        size = self.bytes_per_pixel(name)
        many = self._pixels if pixels is None else pixels
        return np.frombuffer(self._buffers[name].read(size * many, offset=size * first), dtype)

    def grow(self, count: int) -> None:
        """Room for so many events, and a quarter more."""
        capacity = count + count // 4
        refuse_too_large(self._gl, {"packed": 8 * capacity}, f"{count} events in one step")
        self._buffers["packed"].release()
        self._buffers["packed"], self.capacity = self._gl.ctx.buffer(reserve=8 * capacity), capacity

    def release(self) -> None:
        for buffer in self._buffers.values():
            buffer.release()


class Room(Buffers):
    """Those of an ESIM, or of several whose pixels follow each other.

    spread, more : see :class:`~blinkgl.card.esim.CardEsim`."""

    def __init__(
        self,
        gl: GLContext,
        pixels: int,
        what: str,
        size: tuple[int, int],
        *,
        spread: bool,
        more: bool,
        tiles: int = 0,
    ):
        padded = -(-pixels // BLOCK) * BLOCK
        sizes = {
            "now": 4 * padded,
            "before": 4 * padded,
            "levels": 8 * padded,
            "records": (32 if more else 16) * padded,
            **({"thresholds": 8 * padded} if spread else {}),
            **({"more": 16 * padded} if more else {}),
        }
        super().__init__(gl, pixels, sizes, what, size, tiles)
        self._buffers["levels"].write(np.tile(np.array([FAR, -FAR], np.int32), padded).tobytes())
        for name in ("now", "before"):
            self._buffers[name].write(np.ones(padded, np.float32).tobytes())
