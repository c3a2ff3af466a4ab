"""The luminance that all passes use, and the conversion of textures before upload."""

from __future__ import annotations

import numpy as np

from blinkgl.srgb import DECODE_8BIT

LUMA = np.array([0.2126, 0.7152, 0.0722], np.float64)
"""Rec. 709 weights of linear r, g, b."""


def linear_image(image: np.ndarray) -> np.ndarray:
    """Return linear light, (h, w, 3) float32, of (h, w, 3) uint8 sRGB or float32 linear."""
    return DECODE_8BIT[image] if image.dtype == np.uint8 else np.ascontiguousarray(image, np.float32)


def luminance_image(image: np.ndarray, base_color: tuple[float, float, float]) -> np.ndarray:
    """Return the linear luminance of texture * base_color, (h, w) float32; the event pass samples it."""
    weights = (LUMA * np.asarray(base_color, np.float64)).astype(np.float32)
    if image.dtype == np.uint8:
        tables = DECODE_8BIT[:, None] * weights  # (256, 3): decodes and weighs in one lookup per channel
        return tables[image[..., 0], 0] + tables[image[..., 1], 1] + tables[image[..., 2], 2]
    return np.ascontiguousarray(image, np.float32) @ weights
