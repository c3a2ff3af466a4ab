"""The loop that every emulator's kernel runs: bands of blocks, taken by the threads that are free.

An emulator supplies three compiled functions, which the loop inlines, and scratch memory of its own:

* ``sense(block, s, e, source, p, v, flags, scratch)`` computes the signal of the pixels [s, e) at the interval's end
  and flags (uint8) those that may fire. It changes no state. It returns (most events of one pixel, 0: no pixel is
  flagged; the block's state at the end).
* ``emit(active, first, end, p, v, cap, packed, begin)`` writes the events of the flagged pixels, at most ``cap`` of
  each, to ``packed[begin:]`` and moves their levels. It returns (end of the events, number of events cut).
* ``keep(block, s, e, end, p)`` makes the block's state at the end the one that the next interval starts from.

``source`` is the frame, ``p`` the arrays of all pixels, ``v`` the values of the interval.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.packing import compact_flags
from blinkgl.events.threads import take_part

BLOCK = 1024
"""Pixels that a kernel processes at once: their data fits the first cache levels. Threads get whole blocks."""


class Work(NamedTuple):
    """What the threads of one step share."""

    edges: np.ndarray  # (bands + 1,) int64: band b is the blocks [edges[b], edges[b + 1])
    progress: np.ndarray  # (bands, 3) int64: next block, events written, events cut
    packed: np.ndarray  # (bands, room) int64: the events of each band
    share: int  # most events of a block
    pixels: int


def driver(sense: Callable, emit: Callable, keep: Callable) -> Callable:
    """Return the loop of these functions, for the kernel of an emulator; see the module."""
    # A closure, because numba does not store a kernel that passes functions as arguments. Inlined as source, here and
    # in the emulators, because a call would count the references to every array of ``p`` at every block.

    @register_jitable(inline="always")
    def drive(taken, start, work, source, p, v, scratch):
        """Process the bands that no other thread has taken, each until its end or until it has no room for its next
        block."""
        # compact_flags writes eight numbers at a time, so ``active`` has eight more.
        flags, words, active = np.zeros(BLOCK, np.uint8), np.empty(BLOCK // 8, np.int64), np.empty(BLOCK + 8, np.int32)
        b = take_part(taken, start)
        while b >= 0:
            packed, stop = work.packed[b], work.edges[b + 1]
            block, filled, cut = work.progress[b]
            while block < stop:
                s = block * BLOCK
                e = min(s + BLOCK, work.pixels)
                if e - s < BLOCK:
                    # The last block is shorter, and compact_flags looks at whole words.
                    flags[:] = 0
                cap, end = sense(block, s, e, source, p, v, flags, scratch)
                count = compact_flags(flags, words, s, active) if cap else 0
                if count:
                    if count * cap > work.share:
                        cap = max(1, work.share // count)
                    # No room for the worst case; nothing of this block has been changed: the caller makes room and
                    # repeats it.
                    if filled + count * cap > packed.size:
                        break
                    filled, cut_here = emit(active[:count], s, end, p, v, cap, packed, filled)
                    cut += cut_here
                # Last, because ``p`` holds the frame before until here.
                keep(block, s, e, end, p)
                block += 1
            work.progress[b, 0], work.progress[b, 1], work.progress[b, 2] = block, filled, cut
            b = take_part(taken, start)

    return drive
