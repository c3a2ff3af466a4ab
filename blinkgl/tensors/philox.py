"""The draws of :mod:`blinkgl.events.philox` on tensors: Philox4x32-10 in int64, the same numbers.

torch has no unsigned 64-bit multiplication, and needs none: the low 64 bits of a product are the same for signed
numbers, and a shift is masked to the bits that a logical one would leave. Arguments are int64 tensors or integers that
fit 32 bits; the key is the seed's two words.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from blinkgl.tensors.arith import cos_sin_turn, log_f64, sqrt

_MASK32, _MASK53 = 0xFFFFFFFF, 2**53 - 1
_M0, _M1, _W0, _W1 = 0xD2511F53, 0xCD9E8D57, 0x9E3779B9, 0xBB67AE85
_ULP53, _ULP32 = 2.0**-53, 2.0**-32


def words_of(seed: int) -> tuple[int, int]:
    """The two 32-bit words of a 64-bit seed: the key."""
    return seed & _MASK32, (seed >> 32) & _MASK32


def philox4x32(key: tuple[Any, ...], pixel: Any, stream: int, index: Any) -> list[Any]:
    """Four 32-bit words (int64) of the block (pixel, stream, index) under ``key``; at least one is a tensor."""
    c0, c1, c2, c3 = pixel & _MASK32, stream, index & _MASK32, (index >> 32) & _MASK32
    k0, k1 = key
    for turn in range(10):
        # 32 x 32 bits: the low 64 bits are exact, also in signed arithmetic.
        p0, p1 = c0 * _M0, c2 * _M1
        c0, c1, c2, c3 = ((p1 >> 32) & _MASK32) ^ c1 ^ k0, p1 & _MASK32, ((p0 >> 32) & _MASK32) ^ c3 ^ k1, p0 & _MASK32
        if turn < 9:
            k0, k1 = (k0 + _W0) & _MASK32, (k1 + _W1) & _MASK32
    return [c0, c1, c2, c3]


def uniform2(key: tuple[Any, ...], pixel: Any, stream: int, index: Any) -> tuple[Tensor, Tensor]:
    """Two independent uniforms in (0, 1), float64."""
    w0, w1, w2, w3 = philox4x32(key, pixel, stream, index)
    # The upper 53 of 64 bits, and a half: neither 0 nor 1 comes out.
    u, v = (((high << 32) | low) >> 11 & _MASK53 for low, high in ((w0, w1), (w2, w3)))
    return (u.to(torch.float64) + 0.5) * _ULP53, (v.to(torch.float64) + 0.5) * _ULP53


def normal2(key: tuple[Any, ...], pixel: Any, stream: int, index: Any) -> tuple[Tensor, Tensor]:
    """Two independent standard normals (Box-Muller), float64."""
    u, v = uniform2(key, pixel, stream, index)
    radius = sqrt(log_f64(u) * -2.0)
    c, s = cos_sin_turn(v)
    return radius * c, radius * s


def rough_normal(key: tuple[Any, ...], pixel: Any, stream: int, index: Any) -> Tensor:
    """Mean 0, variance 1, near normal: the sum of four uniforms, float64."""
    w0, w1, w2, w3 = philox4x32(key, pixel, stream, index)
    # Mean 2 and variance 1/3, shifted and scaled as in events.philox.rough_normal.
    total = (w0 + w1 + w2 + w3).to(torch.float64)
    return (total * _ULP32 + (2.0 * _ULP32 - 2.0)) * math.sqrt(3.0)
