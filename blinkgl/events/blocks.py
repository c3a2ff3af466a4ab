"""Branch-free loops over one block of pixels that several emulators share.

They take slices and index them from 0: numba then vectorises them, which it does not with an offset in the index.
"""

from __future__ import annotations

import numba
import numpy as np

from blinkgl.events.packing import JIT


@numba.njit(**JIT)
def copy_block(source: np.ndarray, target: np.ndarray) -> None:
    """``target[:] = source``."""
    for i in range(source.size):
        target[i] = source[i]


@numba.njit(**JIT)
def scale_block(frame: np.ndarray, scale: float, out: np.ndarray) -> None:
    """``out[:] = frame * scale``."""
    for i in range(frame.size):
        out[i] = frame[i] * scale


@numba.njit(**JIT)
def lookup_block(codes: np.ndarray, table: np.ndarray, out: np.ndarray) -> None:
    """``out[:] = table[codes]``."""
    for i in range(codes.size):
        out[i] = table[codes[i]]


# The product of eight bytes of 0 or 1 with this constant has them as the bits of its top byte.
_BYTES_TO_BITS, _S56 = np.uint64(0x0102040810204080), np.uint64(56)
# Tables over all bytes: positions of the set bits, and their number.
_BIT_POSITIONS = np.zeros((256, 8), np.int32)
for _mask in range(256):
    _set = [_bit for _bit in range(8) if _mask >> _bit & 1]
    _BIT_POSITIONS[_mask, : len(_set)] = _set
_BIT_COUNTS = np.array([_mask.bit_count() for _mask in range(256)], np.int64)


@numba.njit(**JIT)
def compact_flags(flags: np.ndarray, scratch: np.ndarray, first_pixel: int, out: np.ndarray) -> int:
    """Numbers ``first_pixel + i`` of the set flags into ``out``; returns how many.

    flags : (n,) uint8 of 0 and 1, n a multiple of 8. scratch : (n / 8,) int64. out : int32 with room for 8 more than
    are set. Eight flags are one word, squeezed to a byte by a multiplication and looked up: which pixels fire is
    unpredictable, so a branch per pixel would cost several times more.
    """
    words = flags.view(np.uint64)
    used = 0
    # Numbers of the words with any flag, listed without a branch: always written, kept where the count
    # moves on.
    for k in range(words.size):
        scratch[used] = k
        used += np.int64(words[k] != np.uint64(0))
    count = 0
    for j in range(used):
        k = scratch[j]
        # Byte b of the (little-endian) word lands on bit b of the top byte.
        mask = np.int64((words[k] * _BYTES_TO_BITS) >> _S56)
        base = np.int32(first_pixel + 8 * k)
        # All eight places are written; only the set ones are counted, and the next word writes over the
        # rest.
        for b in range(8):
            out[count + b] = np.int32(base + _BIT_POSITIONS[mask, b])
        count += _BIT_COUNTS[mask]
    return count
