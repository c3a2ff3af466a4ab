"""How linear light becomes codes, and back."""

from __future__ import annotations

import numpy as np

from blinkgl.srgb import linear_from_srgb, srgb_from_linear


def encode(linear: np.ndarray, response: str, gamma: float, bits: int) -> np.ndarray:
    """Codes of linear light in [0, 1], rounded to nearest: uint8 of 8 bits, else uint16. Any shape.

    response : "srgb", "linear", or "gamma": light ^ (1 / gamma)."""
    x = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    if response == "srgb":
        x = srgb_from_linear(x)
    elif response == "gamma":
        x = x ** (1.0 / gamma)
    return np.floor(x * largest_code(bits) + 0.5).astype(np.uint8 if bits == 8 else np.uint16)


def decode(codes: np.ndarray, response: str, gamma: float, bits: int) -> np.ndarray:
    """Linear light, float64 in [0, 1], of the middle of each code: what :func:`encode` turns into it again."""
    x = np.asarray(codes, np.float64) / largest_code(bits)
    if response == "srgb":
        return linear_from_srgb(x)
    return x**gamma if response == "gamma" else x


def largest_code(bits: int) -> int:
    """Of so many bits."""
    return (1 << bits) - 1
