"""Counter-based random numbers: every draw is a pure function of (seed, pixel, stream, index).

Philox4x32-10 (Salmon, Moraes, Dror, Shaw, "Parallel random numbers: as easy as 1, 2, 3", SC 2011). There is no shared
state, so results do not depend on the number of threads, the chunk length, or which pixels were busy. The counter is
(pixel, stream, index low, index high), the key the 64-bit seed. One block is 128 bits: two uniforms, or two normals.

Called from Python with arrays (uint64) the functions run in NumPy; compiled into a kernel they work on scalars (see
:mod:`blinkgl.events.arith`).
"""

from __future__ import annotations

from collections.abc import Callable
from enum import IntEnum
from typing import Any, TypeAlias

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import cos_sin_turn, log_f64

_U, _D = np.uint64, np.float64
# 32-bit words are held in uint64. 11 = 64 - 53: bits that a float64 in (0, 1) cannot hold.
_MASK32, _S32, _S11 = _U(0xFFFFFFFF), _U(32), _U(11)
# Multipliers and key increments of Philox4x32 (Salmon et al. 2011).
_M0, _M1 = _U(0xD2511F53), _U(0xCD9E8D57)
_W0, _W1 = _U(0x9E3779B9), _U(0xBB67AE85)
# 2^-53 is the spacing of the uniforms.
_HALF, _ULP53, _MINUS2 = _D(0.5), _D(2.0**-53), _D(-2.0)


Word: TypeAlias = int | np.integer | np.ndarray
"""A number below 2^64, or one for each draw."""


class Stream(IntEnum):
    """The purposes of draws. Append only: the numbers are part of every published data set."""

    THRESHOLD = 0  # (ON, OFF) spread of the thresholds, frozen per pixel
    JITTER = 1  # (ON, OFF) threshold jitter, index = the pixel's event count
    LEAK = 2  # (leak rate, hot pixel) frozen per pixel
    LEAK_JITTER = 3
    SHOT = 4  # shot noise; "pixel" is the block of 1024 pixels
    NOISE = 5  # photoreceptor noise, index = step
    HOT = 6
    DIFFUSION = 7  # Voltmeter, index = step * 2^20 + draw within the step
    START = 8  # initial state
    DEFECT = 9  # dead and hot pixels and their rates, frozen per pixel
    OWN_NOISE = 10  # noise events of pixels, "pixel" is the event's number
    LIGHT_NOISE = 11  # 0: a pixel's share, frozen; 1, 2: noise by light, "pixel" is the candidate's number


# "always": loops over draws become vector instructions only if nothing is called in them.
@register_jitable(inline="always")
def _round(c0, c1, c2, c3, k0, k1):
    # Two products of 32 x 32 bits; their high halves cross over to the other pair of words.
    p0 = c0 * _M0
    p1 = c2 * _M1
    return (p1 >> _S32) ^ c1 ^ k0, p1 & _MASK32, (p0 >> _S32) ^ c3 ^ k1, p0 & _MASK32


@register_jitable(inline="always")
def philox4x32(c0: Word, c1: Word, c2: Word, c3: Word, k0: Word, k1: Word) -> tuple[Word, Word, Word, Word]:
    """Return four 32-bit words (held in uint64) of the block at counter (c0, c1, c2, c3) under key (k0, k1)."""
    # Ten rounds, the key bumped between them by the golden ratio and sqrt(3) - 1.
    for _ in range(9):
        c0, c1, c2, c3 = _round(c0, c1, c2, c3, k0, k1)
        k0, k1 = (k0 + _W0) & _MASK32, (k1 + _W1) & _MASK32
    return _round(c0, c1, c2, c3, k0, k1)


@register_jitable(inline="always")
def uniform2(seed: Word, pixel: Word, stream: Word, index: Word) -> tuple[Any, Any]:
    """Return two independent uniforms in the open interval (0, 1), 53 bits each. All arguments uint64 (or arrays of
    it)."""
    w0, w1, w2, w3 = philox4x32(pixel & _MASK32, stream, index & _MASK32, index >> _S32, seed & _MASK32, seed >> _S32)
    # The upper 53 of 64 bits, and a half: 0 and 1 cannot occur.
    return ((((w1 << _S32) | w0) >> _S11) + _HALF) * _ULP53, ((((w3 << _S32) | w2) >> _S11) + _HALF) * _ULP53


@register_jitable
def normal2(seed: Word, pixel: Word, stream: Word, index: Word) -> tuple[np.ndarray, np.ndarray]:
    """Return two independent standard normals (Box-Muller), float64."""
    u, v = uniform2(seed, pixel, stream, index)
    # Box and Muller: radius sqrt(-2 ln u), angle 2 pi v. u is never 0.
    radius = np.sqrt(_MINUS2 * log_f64(u))  # type: ignore[bad-specialization]
    c, s = cos_sin_turn(v)
    return radius * c, radius * s


# A uniform has the variance 1/12, the sum of four 1/3.
_THREE_ROOT, _TWO, _ULP32 = _D(np.sqrt(3.0)), _D(2.0), _D(2.0**-32)


@register_jitable(inline="always")
def rough_normal(seed: int, pixel: int, stream: int, index: int) -> float:
    """Return a nearly normal value of mean 0 and variance 1 (sum of four uniforms, within +-3.5) at a third of the cost
    of a normal, for jitters whose exact law has not been measured."""
    w0, w1, w2, w3 = philox4x32(pixel & _MASK32, stream, index & _MASK32, index >> _S32, seed & _MASK32, seed >> _S32)
    # Four uniforms of variance 1/12; their mean, 2 - 2^-31, is subtracted, and sqrt(3) makes the variance 1.
    return ((w0 + w1 + w2 + w3) * _ULP32 + (_TWO * _ULP32 - _TWO)) * _THREE_ROOT


@register_jitable
def normal2_and_uniform(seed: int, pixel: int, stream: int, index: int) -> tuple[float, float, float]:
    """Return two independent standard normals (angle of 32 bits) and an independent uniform (32 bits) from one
    block."""
    w0, w1, w2, w3 = philox4x32(pixel & _MASK32, stream, index & _MASK32, index >> _S32, seed & _MASK32, seed >> _S32)
    # Words 0 and 1 give the 53 bits of the radius, word 2 the angle, word 3 the spare uniform.
    u = ((((w1 << _S32) | w0) >> _S11) + _HALF) * _ULP53
    c, s = cos_sin_turn((w2 + _HALF) * _ULP32)
    radius = np.sqrt(_MINUS2 * log_f64(u))  # type: ignore[bad-specialization]
    return radius * c, radius * s, (w3 + _HALF) * _ULP32


def pixel_counters(height: int, width: int) -> np.ndarray:
    """Return (H*W,) uint64 pixel numbers in raster order, the ``pixel`` argument of the draws."""
    return np.arange(height * width, dtype=np.uint64)


_BLOCK = 2**16
"""Pixels whose draws fit the cache: the temporary arrays of a whole 1080p sensor do not."""


def in_blocks(draw: Callable[..., tuple[np.ndarray, ...]], *arrays: np.ndarray) -> tuple[np.ndarray, ...]:
    """Return what ``draw`` returns for ``arrays`` of one length (or [], which stay so), called for a block of pixels at
    a time: the same numbers, faster."""
    count = len(arrays[0])
    parts = [
        draw(*(array[first : first + _BLOCK] if len(array) else array for array in arrays))
        for first in range(0, max(count, 1), _BLOCK)
    ]
    return parts[0] if len(parts) == 1 else tuple(np.concatenate(one) for one in zip(*parts))
