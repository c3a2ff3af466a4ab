"""The functions of :mod:`blinkgl.events.arith` on tensors: the same sums and products, so the same bits.

Eager torch rounds every operation separately, by IEEE 754, on CPUs and GPUs. Operations that would break this are
avoided: fused operations (``addcmul``, ``lerp``), the libraries' own ``log``, ``exp`` and ``sin``, and division by a
constant written as a multiplication. Coefficients come from the numba functions, so there is one copy of each.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from torch import Tensor

from blinkgl.events import arith

PerEnv = Any
"""A number where all environments have the same, else a tensor with one for each of them, or for each element."""


def _c(name: str) -> float:
    """Return a constant of the numba functions."""
    return float(getattr(arith, name))


# Highest power first, for Horner's scheme.
_LOG32, _EXP32, _LOG64, _SIN, _COS = (
    list(map(float, one)) for one in (arith.LOG_32, arith.EXP_32, arith.LOG_64, arith.SIN_64, arith.COS_64)
)
_EXP64 = [_c(f"_X{k}") for k in range(13)]
_ROOT_BITS_32, _ROOT_BITS_64 = int(_c("_SQRT_HALF_BITS")), 0x3FE6A09E667F3BCD
_Q_LN2, _Q_SCALE, _LN2_32, _LN2_64 = int(_c("_Q_LN2")), _c("_Q_SCALE"), _c("_LN2_32"), _c("_LN2_64")
_LOG2E_32, _LN2_HI_32, _LN2_LO_32 = _c("_LOG2E_32"), _c("_LN2_HI_32"), _c("_LN2_LO_32")
_LOG2E_64, _LN2_HI_64, _LN2_LO_64 = _c("_LOG2E_64"), _c("_LN2_HI_64"), _c("_LN2_LO_64")
_ROUND_32, _ROUND_64 = _c("_ROUND_32"), _c("_ROUND_64")


def horner(v: Tensor, coefficients: list[float], out: Tensor | None = None) -> Tensor:
    """Return the polynomial of v, coefficients from the highest power down; one rounding for each product and sum."""
    p = torch.mul(v, coefficients[0], out=out)
    p += coefficients[1]
    for c in coefficients[2:]:
        p *= v
        p += c
    return p


def log_q25_(v: Tensor, out: Tensor, first: Tensor, second: Tensor) -> None:
    """Write ln(v) in units of 2^-25 to ``out``.   v : float32 in [2^-30, 2^30], overwritten.   out : int32.
    first, second : scratch, float32. All of one size."""
    # In place, with the caller's scratch memory: allocating would cost as much as the arithmetic. v = m 2^exponent with
    # m in [sqrt(1/2), sqrt(2)): subtracting sqrt(1/2) from the bits moves the exponent's step there.
    bits, shifted = v.view(torch.int32), first.view(torch.int32)
    exponent = torch.sub(bits, _ROOT_BITS_32, out=out)
    exponent >>= 23
    bits -= torch.bitwise_left_shift(exponent, 23, out=shifted)
    # f = m - 1; then f + f^2 p(f).
    v -= 1.0
    p = horner(v, _LOG32, out=first)
    p *= torch.mul(v, v, out=second)
    p += v
    p *= _Q_SCALE
    exponent *= _Q_LN2
    # Towards zero, as the numba kernel does.
    exponent += v.view(torch.int32).copy_(p)


def sqrt(v: Tensor) -> Tensor:
    """Return the square root, rounded by IEEE 754."""
    # On some CPUs torch's root comes from a library and is off by a unit in the last place for every fourth float32.
    # NumPy uses the CPU's instruction; CUDA rounds correctly.
    return torch.from_numpy(np.sqrt(v.numpy())) if v.device.type == "cpu" else torch.sqrt(v)


def log_f32(v: Tensor) -> Tensor:
    """Return ln(v), float32 to float32, v normal and positive."""
    bits = v.view(torch.int32)
    # As in log_q25_, with a result in float32.
    exponent = (bits - _ROOT_BITS_32) >> 23
    f = (bits - (exponent << 23)).view(torch.float32) - 1.0
    return exponent.to(torch.float32) * _LN2_32 + (f + f * f * horner(f, _LOG32))


def exp_f32(v: Tensor) -> Tensor:
    """Return exp(v), float32, v <= 80; below -87 it is exp(-87)."""
    v = v.clamp(min=-87.0)
    # Adding and subtracting 1.5 * 2^23 rounds to an integer, as in arith.exp_f32.
    n = (v * _LOG2E_32 + _ROUND_32) - _ROUND_32
    r = (v - n * _LN2_HI_32) - n * _LN2_LO_32
    return horner(r, _EXP32) * ((n.to(torch.int32) + 127) << 23).view(torch.float32)


def log_f64(v: Tensor) -> Tensor:
    """Return ln(v), float64, v normal and positive."""
    bits = v.view(torch.int64)
    # The exponent for which m lies in [sqrt(1/2), sqrt(2)).
    exponent = (bits - _ROOT_BITS_64) >> 52
    m = (bits - (exponent << 52)).view(torch.float64)
    # ln m = 2 artanh(s), a series in s^2.
    s = (m - 1.0) / (m + 1.0)
    z = s * s
    return exponent.to(torch.float64) * _LN2_64 + (s * 2.0 + s * z * horner(z, _LOG64))


def fall_f64(x: Tensor) -> Tensor:
    """Return e^-x, float64, x >= 0; beyond 600 it is e^-600."""
    # For x <= 1/2 the exponent is 0 and nothing is reduced, as in arith.fall_f64.
    v = (-x).clamp(min=-600.0)
    t = torch.where(x <= 0.5, torch.full_like(x, _ROUND_64), v * _LOG2E_64 + _ROUND_64)
    n = t - _ROUND_64
    r = (v - n * _LN2_HI_64) - n * _LN2_LO_64
    c, r2 = _EXP64, r * r
    # Estrin's scheme, in the order of arith._exp_reduced.
    r4 = r2 * r2
    low = (r * c[1] + c[0]) + r2 * (r * c[3] + c[2])
    middle = (r * c[5] + c[4]) + r2 * (r * c[7] + c[6])
    high = (r * c[9] + c[8]) + r2 * (r * c[11] + c[10])
    p = low + r4 * (middle + r4 * (high + r4 * c[12]))
    # The rounding constant's bits are shifted out.
    return p * ((t.view(torch.int64) + 1023) << 52).view(torch.float64)


def cos_sin_turn(u: Tensor) -> tuple[Tensor, Tensor]:
    """Return (cos 2 pi u, sin 2 pi u), float64, u in [0, 1]."""
    turns = u * 4.0
    nearest = (turns + _ROUND_64) - _ROUND_64
    # Quarter turns, in [-1/2, 1/2].
    f = turns - nearest
    quadrant = nearest.to(torch.int64) & 3
    z = f * f
    s, c = horner(z, _SIN) * f, horner(z, _COS)
    # An odd quadrant exchanges the two; the kernels blend, which is exact, too.
    odd = (quadrant & 1).bool()
    cos, sin = torch.where(odd, s, c), torch.where(odd, c, s)
    # Cosine negative in quadrants 1 and 2, sine in 2 and 3.
    return torch.where(((quadrant + 1) & 2).bool(), -cos, cos), torch.where((quadrant & 2).bool(), -sin, sin)


# ---------------------------------------------------------------------------------------------------------------------
# The draws of :mod:`blinkgl.events.philox` on tensors: Philox4x32-10 in int64, the same numbers.
#
# torch has no unsigned 64-bit multiplication, and needs none: the low 64 bits of a product are the same for signed
# numbers, and a shift is masked to the bits of a logical one. Arguments are int64 tensors or integers that fit 32 bits;
# the key is the seed's two words.

_MASK32, _MASK53 = 0xFFFFFFFF, 2**53 - 1
_M0, _M1, _W0, _W1 = 0xD2511F53, 0xCD9E8D57, 0x9E3779B9, 0xBB67AE85
_ULP53, _ULP32 = 2.0**-53, 2.0**-32


def words_of(seed: int) -> tuple[int, int]:
    """Return the two 32-bit words of a 64-bit seed: the key."""
    return seed & _MASK32, (seed >> 32) & _MASK32


def philox4x32(key: tuple[PerEnv, ...], pixel: PerEnv, stream: int, index: PerEnv) -> list[PerEnv]:
    """Return four 32-bit words (int64) of the block (pixel, stream, index) under ``key``; at least one is a tensor."""
    c0, c1, c2, c3 = pixel & _MASK32, stream, index & _MASK32, (index >> 32) & _MASK32
    k0, k1 = key
    for turn in range(10):
        # 32 x 32 bits: the low 64 bits are exact, also in signed arithmetic.
        p0, p1 = c0 * _M0, c2 * _M1
        c0, c1, c2, c3 = ((p1 >> 32) & _MASK32) ^ c1 ^ k0, p1 & _MASK32, ((p0 >> 32) & _MASK32) ^ c3 ^ k1, p0 & _MASK32
        # The key is raised after each of the ten rounds but the last.
        if turn < 9:
            k0, k1 = (k0 + _W0) & _MASK32, (k1 + _W1) & _MASK32
    return [c0, c1, c2, c3]


def uniform2(key: tuple[object, ...], pixel: object, stream: int, index: object) -> tuple[Tensor, Tensor]:
    """Return two independent uniforms in (0, 1), float64."""
    w0, w1, w2, w3 = philox4x32(key, pixel, stream, index)
    # The upper 53 of 64 bits, and a half: 0 and 1 cannot occur.
    u, v = (((high << 32) | low) >> 11 & _MASK53 for low, high in ((w0, w1), (w2, w3)))
    return (u.to(torch.float64) + 0.5) * _ULP53, (v.to(torch.float64) + 0.5) * _ULP53


def normal2(key: tuple[object, ...], pixel: object, stream: int, index: object) -> tuple[Tensor, Tensor]:
    """Return two independent standard normals (Box-Muller), float64."""
    u, v = uniform2(key, pixel, stream, index)
    radius = sqrt(log_f64(u) * -2.0)
    c, s = cos_sin_turn(v)
    return radius * c, radius * s


def rough_normal(key: tuple[object, ...], pixel: object, stream: int, index: object) -> Tensor:
    """Return a nearly normal value of mean 0 and variance 1: the sum of four uniforms, float64."""
    w0, w1, w2, w3 = philox4x32(key, pixel, stream, index)
    # Mean 2 and variance 1/3, shifted and scaled as in events.philox.rough_normal.
    total = (w0 + w1 + w2 + w3).to(torch.float64)
    return (total * _ULP32 + (2.0 * _ULP32 - 2.0)) * math.sqrt(3.0)
