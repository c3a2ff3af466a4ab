"""Conversion of light to the converter's input: photons, full well, read noise, gain, black level, colour filters.

The electrons of a pixel are Poisson distributed around its light, limited to the full well; the read-out adds normal
noise; the gain maps full_well / gain electrons to 1. So far from both ends the variance of a value is mean * gain /
full_well plus that of the read noise: in codes mean / (electrons per code).

Noise is a function of (seed, image, pixel, channel) by the counter-based generator of :mod:`blinkgl.events.philox`, so
it does not depend on the order of drawing.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numba.extending import register_jitable

from blinkgl.events.arith import exp_f64, log_f64
from blinkgl.events.philox import Word, normal2, uniform2
from blinkgl.machine.kernels import kernel
from blinkgl.srgb import linear_from_srgb, srgb_from_linear

PATTERNS = {
    "rggb": ((0, 1), (1, 2)),
    "bggr": ((2, 1), (1, 0)),
    "grbg": ((1, 0), (2, 1)),
    "gbrg": ((1, 2), (0, 1)),
}
"""Channel of the pixel at (row % 2, column % 2)."""


class Stream(IntEnum):
    """The purposes of draws. Append only: the numbers are part of every published data set."""

    PHOTONS = 0  # index = image * 2^16 + try
    READ_OUT = 1


_U = np.uint64
_PHOTONS, _READ_OUT = _U(Stream.PHOTONS), _U(Stream.READ_OUT)
_TRIES = _U(1 << 16)
_FEW = 10.0  # electrons up to which the distribution is summed
_LN_ROOT_2PI = 0.5 * np.log(2.0 * np.pi)


@register_jitable
def _log_factorial(k):
    """Return ln k! of k >= 9, float64: Stirling's series, error < 1e-12 there."""
    # ln k! = ln Gamma(k + 1), with the series' terms up to x^-7.
    x = k + 1.0
    inverse = 1.0 / x
    z = inverse * inverse
    tail = inverse * (1.0 / 12.0 - z * (1.0 / 360.0 - z * (1.0 / 1260.0 - z / 1680.0)))
    return (x - 0.5) * log_f64(x) - x + _LN_ROOT_2PI + tail


@register_jitable
def poisson(mean: float, seed: Word, pixel: Word, index: Word) -> float:
    """Return a Poisson distributed number with mean >= 0, as float64; it depends only on (seed, pixel, index).

    For a small mean the distribution is summed, otherwise transformed rejection with squeeze (Hoermann, "The
    transformed rejection method for generating Poisson random variables", 1993, algorithm PTRS)."""
    if mean <= 0.0:
        return 0.0
    first = index * _TRIES
    # Inversion: the probabilities of 0, 1, 2, … are subtracted from u until it lies within one.
    if mean < _FEW:
        u, _ = uniform2(seed, pixel, _PHOTONS, first)
        k, p = 0.0, exp_f64(-mean)
        while u > p and k < 200.0:
            u -= p
            k += 1.0
            p *= mean / k
        return k
    # The constants of PTRS for its hat; below v_r most points lie under the squeeze.
    b = 0.931 + 2.53 * np.sqrt(mean)
    a = -0.059 + 0.02483 * b
    inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
    v_r = 0.9277 - 3.6224 / (b - 2.0)
    ln_mean = log_f64(mean)
    for number in range(65535):
        u, v = uniform2(seed, pixel, _PHOTONS, first + _U(number))
        u -= 0.5
        us = 0.5 - abs(u)
        k = np.floor((2.0 * a / us + b) * u + mean + 0.43)
        # The squeeze accepts most points without a logarithm.
        if us >= 0.07 and v <= v_r:
            return k
        if k < 0.0 or (us < 0.013 and v > us):
            continue
        if k < 9.0:
            ln_k = 0.0
            for factor in range(2, int(k) + 1):
                ln_k += log_f64(float(factor))
        else:
            ln_k = _log_factorial(k)
        if log_f64(v * inverse_alpha / (a / (us * us) + b)) <= k * ln_mean - mean - ln_k:
            return k
    # So many rejections do not occur; the mean is a valid result.
    return np.floor(mean)


@kernel
def readings(
    light: np.ndarray,
    electrons_of_light: float,
    gain: float,
    full_well: float,
    photon_noise: bool,
    read_noise: float,
    seed: np.uint64,
    image: np.uint64,
    out: np.ndarray,
) -> None:
    """Write the converter's input to out (N,), 1 being the largest code, not yet limited, from (N,) light, float64
    both.

    electrons_of_light : of light 1 with this exposure.   gain : per electron.   full_well, read_noise : electrons.
    image : number of the image."""
    flood = 4.0 * full_well + 1000.0  # fills the well for any draw
    for i in range(light.size):
        electrons = min(light[i] * electrons_of_light, flood)
        if photon_noise:
            electrons = poisson(electrons, seed, _U(i), image)
        electrons = min(electrons, full_well)
        if read_noise > 0.0:
            n, _ = normal2(seed, _U(i), _READ_OUT, image)
            electrons += read_noise * n
        out[i] = electrons * gain


def mosaic(image: np.ndarray, pattern: str) -> np.ndarray:
    """Return (H, W) of (H, W, 3): for each pixel the channel of its filter."""
    out = np.empty(image.shape[:2], image.dtype)
    for y, row in enumerate(PATTERNS[pattern]):
        for x, channel in enumerate(row):
            out[y::2, x::2] = image[y::2, x::2, channel]
    return out


# ---------------------------------------------------------------------------------------------------------------------
# Conversion of linear light to codes, and back.


def encode(linear: np.ndarray, response: str, gamma: float, bits: int) -> np.ndarray:
    """Return codes of linear light in [0, 1], rounded to nearest: uint8 for 8 bits, else uint16. Any shape.

    response : "srgb", "linear", or "gamma": light ^ (1 / gamma)."""
    x = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    if response == "srgb":
        x = srgb_from_linear(x)
    elif response == "gamma":
        x = x ** (1.0 / gamma)
    return np.floor(x * largest_code(bits) + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def decode(codes: np.ndarray, response: str, gamma: float, bits: int) -> np.ndarray:
    """Return linear light, float64 in [0, 1], at the middle of each code: :func:`encode` gives the code again."""
    x = np.asarray(codes, np.float64) / largest_code(bits)
    if response == "srgb":
        return linear_from_srgb(x)
    return x**gamma if response == "gamma" else x


def largest_code(bits: int) -> int:
    """Return the largest code of this many bits."""
    return (1 << bits) - 1
