"""The sRGB transfer curve (IEC 61966-2-1) in both directions. Every picture that is read or written uses it."""

from __future__ import annotations

import numpy as np

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float32)
"""Rec. 709 weights of linear r, g, b."""


def linear_from_srgb(encoded: np.ndarray) -> np.ndarray:
    """Return the linear light of sRGB values in [0, 1]. Any shape; float64 stays float64, all others become float32."""
    x = _floating(encoded)
    one = x.dtype.type
    curve = np.power((np.maximum(x, 0) + one(0.055)) / one(1.055), one(2.4))
    return np.where(x <= one(0.04045), x / one(12.92), curve).astype(one, copy=False)  # NumPy 1 promotes single values


def srgb_from_linear(linear: np.ndarray) -> np.ndarray:
    """Return the sRGB values in [0, 1] of linear light, which is clipped to [0, 1] (NaN becomes 0). Any shape; dtype as
    above."""
    x = _floating(linear)
    one = x.dtype.type
    x = np.clip(np.nan_to_num(x, nan=0.0), 0, 1)
    curve = one(1.055) * np.power(x, one(1 / 2.4)) - one(0.055)
    return np.where(x <= one(0.0031308), x * one(12.92), curve).astype(one, copy=False)


def to_srgb8(linear: np.ndarray) -> np.ndarray:
    """Return uint8 sRGB codes, rounded to nearest, of linear light in [0, 1]."""
    return (srgb_from_linear(linear) * np.float32(255) + np.float32(0.5)).astype(np.uint8)


KNEE = 0.7
"""Linear light up to which :func:`tone_mapped` changes nothing."""


def tone_mapped(linear: np.ndarray, brightest: float) -> np.ndarray:
    """Return linear light, float32, in which no value up to ``brightest`` exceeds 1; for display. If ``brightest`` does
    not exceed 1 it is the array itself.

    linear : (..., 3), whose largest channel decides, which keeps the hue, or (H, W). Up to KNEE nothing changes;
    beyond, with x the excess, x / (1 + a x): the slope is 1 at the knee and ``brightest`` becomes 1."""
    if brightest <= 1.0:
        return linear
    a = np.float32(1.0 / (1.0 - KNEE) - 1.0 / (brightest - KNEE))
    level = linear.max(axis=-1, keepdims=True) if linear.ndim == 3 else linear
    over = np.maximum(level - np.float32(KNEE), 0)
    # computed from the part above the knee alone: below it the factor is 1
    mapped = np.float32(KNEE) + over / (1 + a * over)
    return np.where(over > 0, linear * (mapped / np.maximum(level, np.float32(KNEE))), linear).astype(np.float32)


def _floating(x: np.ndarray) -> np.ndarray:
    x = np.asarray(x)
    return x if x.dtype == np.float64 else x.astype(np.float32, copy=False)


DECODE_8BIT = linear_from_srgb(np.arange(256) / 255.0).astype(np.float32)
"""(256,) float32: linear light of each 8-bit code."""
