"""Logarithm, exponential, sine and cosine from IEEE additions, multiplications and bit fields only.

They replace NumPy's or libm's for two reasons. They vectorise inside fused numba loops (numba without SVML calls a
scalar ``log`` per pixel), and they give the same bits on every machine, in numba and in NumPy, so that a seed gives the
same events everywhere. The same source serves both: scalars when compiled into a kernel, arrays when called from Python
(:func:`numba.extending.register_jitable`). fastmath is off in every caller, because contraction or re-association would
change the last bit.

Coefficients are Chebyshev fits made with mpmath on the reduced intervals; the tests compare with mpmath/NumPy.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from numba.extending import overload, register_jitable

Number = TypeVar("Number", float, np.ndarray)

_F, _I, _D, _L = np.float32, np.int32, np.float64, np.int64


def select(condition: bool, a: float, b: float) -> float:
    """Return ``a`` where the condition holds, else ``b``; a conditional move inside a kernel."""
    return np.where(condition, a, b)


@overload(select)
def _select(condition, a, b):
    return lambda condition, a, b: a if condition else b


def bits_f64(v: float) -> int:
    """Return the bits of float64 numbers, int64."""
    return np.asarray(v, np.float64).view(np.int64)


@overload(bits_f64)
def _bits_f64(v):
    return lambda v: np.float64(v).view(np.int64)


@register_jitable
def horner(v: float, coefficients: tuple[object, ...]) -> float:
    """Return the polynomial of v, coefficients from the highest power down; one rounding for each product and sum."""
    p = v * coefficients[0] + coefficients[1]
    for k in range(2, len(coefficients)):
        p = p * v + coefficients[k]
    return p


# --- natural logarithm in 32-bit fixed point -------------------------------------------------------------
Q = 25
"""Fraction bits of fixed-point log intensity: resolution 2^-25 = 3.0e-8, range +-64."""
Q_ONE = 1 << Q
LOG_MAX_INPUT = float(2.0**30)
"""Largest intensity of :func:`log_q25` (and 2^-30 the smallest): a log, a threshold and their difference fit."""
# ln 2 and 1 in units of 2^-25.
_Q_LN2 = _I(round(np.log(2.0) * Q_ONE))
_Q_SCALE = _F(Q_ONE)
# 0x3F3504F3 is the bit pattern of sqrt(1/2) in float32, whose fraction has 23 bits.
_F1, _SQRT_HALF_BITS, _EXP23 = _F(1.0), _I(0x3F3504F3), _I(23)
# Coefficients of p in log(1 + f) = f + f^2 p(f), the highest power first, as in all the polynomials below.
LOG_32 = tuple(
    _F(c)
    for c in (
        -0.07673641501674025,
        0.1272267278801096,
        -0.1312755565128765,
        0.14204855952571013,
        -0.16626645629127462,
        0.20001234461093456,
        -0.25000781239812697,
        0.33333330028354796,
        -0.4999999764977098,
    )
)


@register_jitable
def _log1p_reduced(f):
    """Return log(1 + f) for f in [sqrt(1/2) - 1, sqrt(2) - 1], float32, absolute error < 5e-8."""
    # log(1 + f) = f + f^2 p(f), so that small f keep all their digits.
    return f + f * f * horner(f, LOG_32)


@register_jitable
def log_q25(v: float) -> float:
    """Return ln(v) as int32 in units of 2^-25; v float32 in [2^-30, 2^30]. Absolute error < 1.3e-7.

    Fixed point makes sums of thresholds exact: a brightness that returns to its old value returns to its old level, a
    reference never drifts, and ties do not depend on rounding. In float32 the same four bytes would resolve 5e-7 at ln
    v = -6.
    """
    # sqrt(1/2) is subtracted from the bits, so that the exponent field changes at sqrt(1/2) 2^n instead of at 2^n: the
    # reduced interval is around 1.
    bits = _F(v).view(np.int32)
    # v = m 2^exponent with m in [sqrt(1/2), sqrt(2)).
    exponent = _I(_I(bits - _SQRT_HALF_BITS) >> _EXP23)
    f = _F(_I(bits - _I(exponent << _EXP23)).view(np.float32) - _F1)
    return _I(_I(exponent * _Q_LN2) + _I(_log1p_reduced(f) * _Q_SCALE))


_LN2_32 = _F(np.log(2.0))


@register_jitable
def log_f32(v: float) -> float:
    """Return ln(v), float32 to float32, v normal and positive. Error < 1.3e-7 + 1.5 ulp of the result."""
    # The same split as in log_q25: v = m 2^exponent, f = m - 1.
    bits = _F(v).view(np.int32)
    exponent = _I(_I(bits - _SQRT_HALF_BITS) >> _EXP23)
    f = _F(_I(bits - _I(exponent << _EXP23)).view(np.float32) - _F1)
    return _F(_F(exponent) * _LN2_32 + _log1p_reduced(f))


# --- exponential, float32 --------------------------------------------------------------------------------
# log2(e), and ln 2 in two parts: 355/512 has nine bits, so that n times it is exact; the second part is
# the rest.
_LOG2E_32, _LN2_HI_32, _LN2_LO_32 = _F(1.4426950408889634), _F(0.693359375), _F(-2.12194440e-4)
_ROUND_32 = _F(12582912.0)  # 1.5 * 2^23: adding and subtracting it rounds to the nearest integer
# Chebyshev fit of e^r on |r| <= ln(2)/2; close to 1/n!.
EXP_32 = tuple(
    _F(c)
    for c in (
        0.0013941108433972674,
        0.008375126398153335,
        0.04166635289677516,
        0.16666415514653277,
        0.5000000047117757,
        1.000000037716214,
        1.0,
    )
)
# Below e^-87 the result would become subnormal. 127 is the bias of the exponent of a float32.
_EXP_MIN_32, _BIAS_32 = _F(-87.0), _I(127)


@register_jitable
def exp_f32(v: float) -> float:
    """Return exp(v) for float32 v <= 80, relative error < 2e-7; below -87 it is exp(-87) = 1.6e-38."""
    v = np.maximum(v, _EXP_MIN_32)
    # e^v = 2^n e^r with |r| <= ln(2)/2. n ln 2 in two parts (Cody and Waite): the first has so few bits that n times it
    # is exact.
    n = _F(_F(v * _LOG2E_32 + _ROUND_32) - _ROUND_32)
    r = _F(_F(v - n * _LN2_HI_32) - n * _LN2_LO_32)
    p = horner(r, EXP_32)
    # 2^n is written straight into the exponent field.
    return _F(p * _I((_I(n) + _BIAS_32) << _EXP23).view(np.float32))


# --- double precision ------------------------------------------------------------------------------------
# Integers become float64 by arithmetic: of an array of one, np.float64 makes a scalar before NumPy 2.4.
_D1, _D2, _HALF = _D(1.0), _D(2.0), _D(0.5)
# The bit pattern of sqrt(1/2) in float64, whose fraction has 52 bits.
_SQRT_HALF_BITS_64, _EXP52, _LN2_64 = _L(0x3FE6A09E667F3BCD), _L(52), _D(np.log(2.0))
# Coefficients of p in ln m = 2 s + s^3 p(s^2), s = (m - 1)/(m + 1); close to 2/3, 2/5, 2/7, ...
LOG_64 = tuple(
    _D(c)
    for c in (
        0.14616449685043406,
        0.15331721600556042,
        0.18182889125261723,
        0.2222221113479508,
        0.28571428625975487,
        0.39999999999899505,
        0.666666666666667,
    )
)


@register_jitable
def log_f64(v: Number) -> Number:
    """Return ln(v), float64, v normal and positive; error < 4e-16 (1 + |ln v|)."""
    bits = bits_f64(v)
    # The exponent for which m lies in [sqrt(1/2), sqrt(2)).
    exponent = _L(_L(bits - _SQRT_HALF_BITS_64) >> _EXP52)
    m = _L(bits - _L(exponent << _EXP52)).view(np.float64)
    # ln m = 2 artanh(s) = 2 s + s^3 p(s^2): odd, so half as many terms.
    s = (m - _D1) / (m + _D1)
    z = s * s
    return exponent * _LN2_64 + (_D2 * s + s * z * horner(z, LOG_64))


# log2(e), and ln 2 in two parts, the first with zeros at its end.
_LOG2E_64, _LN2_HI_64, _LN2_LO_64 = (
    _D(1.4426950408889634),
    _D(6.93147180369123816490e-01),
    _D(1.90821492927058770002e-10),
)
# 1.5 * 2^52 rounds as _ROUND_32 does. 1023 is the bias of the exponent of a float64.
_ROUND_64, _EXP_MIN_64, _BIAS_64 = _D(6755399441055744.0), _D(-700.0), _L(1023)
# Chebyshev fit of e^r on |r| <= 1/2; close to 1/n!.
_X0, _X1, _X2, _X3, _X4, _X5, _X6, _X7, _X8, _X9, _X10, _X11, _X12 = (
    _D(c)
    for c in (
        1.0,
        1.0,
        0.5,
        0.16666666666666702,
        0.04166666666666669,
        0.008333333333309528,
        0.001388888888887189,
        0.000198412699092171,
        2.4801587350110797e-05,
        2.7557224958392624e-06,
        2.7557251904174915e-07,
        2.5114869528657765e-08,
        2.09215799649503e-09,
    )
)


@register_jitable
def _exp_reduced(r):
    """Return exp(r) for |r| <= 1/2, float64."""
    # Estrin's scheme: a chain of four multiplications instead of twelve.
    r2 = r * r
    r4 = r2 * r2
    low = (_X0 + _X1 * r) + r2 * (_X2 + _X3 * r)
    middle = (_X4 + _X5 * r) + r2 * (_X6 + _X7 * r)
    high = (_X8 + _X9 * r) + r2 * (_X10 + _X11 * r)
    return low + r4 * (middle + r4 * (high + r4 * _X12))


@register_jitable
def exp_f64(v: Number) -> Number:
    """Return exp(v) for float64 v <= 700, relative error < 5e-16; below -700 it is exp(-700) ~ 1e-304."""
    v = np.maximum(v, _EXP_MIN_64)  # type: ignore[bad-assignment]
    # As exp_f32: e^v = 2^n e^r, n ln 2 in two parts, and 2^n straight into the exponent field.
    n = (v * _LOG2E_64 + _ROUND_64) - _ROUND_64
    r = (v - n * _LN2_HI_64) - n * _LN2_LO_64
    p = _exp_reduced(r)
    return p * _L((_L(n) + _BIAS_64) << _EXP52).view(np.float64)


_FALL_MIN_64 = _D(-600.0)


@register_jitable
def fall_f64(x: float) -> float:
    """Return e^-x for float64 x >= 0; without the range reduction where x <= 1/2, and without a branch. Beyond 600 it
    is e^-600 = 1e-261, so that products do not become subnormal, which not every GPU supports."""
    v = np.maximum(-x, _FALL_MIN_64)
    # The low bits of the sum are the exponent; the shift removes those of the constant.
    t = select(x <= _HALF, _ROUND_64, v * _LOG2E_64 + _ROUND_64)
    n = t - _ROUND_64
    p = _exp_reduced((v - n * _LN2_HI_64) - n * _LN2_LO_64)
    return p * _L((bits_f64(t) + _BIAS_64) << _EXP52).view(np.float64)


# sin(pi/2 f) = f p(f^2) for |f| <= 1/2.
SIN_64 = tuple(
    _D(c)
    for c in (
        5.633933781537854e-08,
        -3.59864335298231e-06,
        0.0001604411507421909,
        -0.004681754132340976,
        0.07969262624604301,
        -0.6459640975062443,
        1.5707963267948966,
    )
)
# cos(pi/2 f) = p(f^2) for |f| <= 1/2.
COS_64 = tuple(
    _D(c)
    for c in (
        -6.321256869628588e-09,
        4.710609726757823e-07,
        -2.520203677046026e-05,
        0.0009192602741831558,
        -0.02086348076331121,
        0.2536695079010467,
        -1.2337005501361697,
        1.0,
    )
)
_D4, _L1, _L2, _L3 = _D(4.0), _L(1), _L(2), _L(3)


@register_jitable
def cos_sin_turn(u: float) -> tuple[float, float]:
    """Return (cos 2 pi u, sin 2 pi u) for u in [0, 1], float64, absolute error < 4e-16."""
    turns = u * _D4
    nearest = (turns + _ROUND_64) - _ROUND_64
    # f: quarter turns from the nearest one, in [-1/2, 1/2].
    f = turns - nearest
    quadrant = _L(nearest) & _L3
    z = f * f
    s, c = horner(z, SIN_64) * f, horner(z, COS_64)
    # In odd quadrants sine and cosine of the rest are exchanged.
    odd = (quadrant & _L1) * _D1  # blends rather than branches: exact, since odd is 0 or 1
    # The cosine is negative in quadrants 1 and 2, the sine in 2 and 3.
    cos_sign = _D1 - _D2 * (((quadrant + _L1) & _L2) >> _L1)
    sin_sign = _D1 - _D2 * ((quadrant & _L2) >> _L1)
    return cos_sign * (c * (_D1 - odd) + s * odd), sin_sign * (s * (_D1 - odd) + c * odd)
