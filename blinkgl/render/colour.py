"""Light and bytes: the sRGB transfer function and the luminance every pass agrees on."""

from __future__ import annotations

import numpy as np

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float64)
"""Rec. 709 weights of linear r, g, b."""


def srgb_to_linear(encoded: np.ndarray) -> np.ndarray:
    """sRGB-encoded [0, 1] to linear light, any shape, float64 (IEC 61966-2-1)."""
    c = np.asarray(encoded, np.float64)
    return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """Linear light, clipped to [0, 1], to sRGB-encoded [0, 1], any shape, float64 (IEC 61966-2-1)."""
    c = np.clip(np.asarray(linear, np.float64), 0.0, 1.0)
    return np.where(c <= 0.0031308, c * 12.92, 1.055 * c ** (1 / 2.4) - 0.055)


_DECODE = srgb_to_linear(np.arange(256) / 255.0).astype(np.float32)


def decode_image(image: np.ndarray) -> np.ndarray:
    """(h, w, 3) uint8 sRGB or float32 linear -> (h, w, 3) float32 linear."""
    return _DECODE[image] if image.dtype == np.uint8 else np.ascontiguousarray(image, np.float32)


def luminance_image(image: np.ndarray, base_color: tuple[float, float, float]) -> np.ndarray:
    """(h, w) float32 linear luminance of texture * base_color; what the event pass samples."""
    weights = (LUMA * np.asarray(base_color, np.float64)).astype(np.float32)
    if image.dtype == np.uint8:
        tables = _DECODE[:, None] * weights  # (256, 3): decode and weigh in one look-up per channel
        return tables[image[..., 0], 0] + tables[image[..., 1], 1] + tables[image[..., 2], 2]
    return np.ascontiguousarray(image, np.float32) @ weights
