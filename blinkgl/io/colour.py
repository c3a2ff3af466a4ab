"""Colours of flow and events."""

from __future__ import annotations

import functools

import numpy as np

from blinkgl.machine.kernels import kernel

INVALID = np.array([40, 40, 40], np.uint8)
_RADIUS = 255
_BANDS = (
    (15, (255, 0, 0), (255, 255, 0)),
    (6, (255, 255, 0), (0, 255, 0)),
    (4, (0, 255, 0), (0, 255, 255)),
    (11, (0, 255, 255), (0, 0, 255)),
    (13, (0, 0, 255), (255, 0, 255)),
    (6, (255, 0, 255), (255, 0, 0)),
)
"""Hue bands of the Middlebury wheel: number of steps, from, to (Baker et al., "A Database and Evaluation Methodology
for Optical Flow", IJCV 2011, colour coding after Ware); unequal, because equal steps of hue do not look equal."""


@functools.cache
def flow_wheel() -> np.ndarray:
    """Return the colour of unit-disc flow (u, v) at [255 + 255 v, 255 + 255 u], (511, 511, 3) uint8; white at rest."""
    ring = np.concatenate([np.linspace(a, b, n, endpoint=False) for n, a, b in _BANDS])
    v, u = np.mgrid[-_RADIUS : _RADIUS + 1, -_RADIUS : _RADIUS + 1] / _RADIUS
    # Middlebury's colour code: the angle of (-u, -v), from -pi to pi, is the place on the ring.
    position = (np.arctan2(-v, -u) / np.pi + 1) / 2 * len(ring)  # closed: no seam at pure +x
    low = position.astype(int) % len(ring)
    high = (low + 1) % len(ring)
    part = (position % 1)[..., None]
    hue = (ring[low] * (1 - part) + ring[high] * part) / 255
    radius = np.minimum(np.hypot(u, v), 1)[..., None]
    return np.rint(255 * (1 - radius * (1 - hue))).astype(np.uint8)


def flow_colour(flow: np.ndarray, maximum: float | None = None, valid: np.ndarray | None = None) -> np.ndarray:
    """Return the RGB of a flow field by the Middlebury wheel: direction is hue, speed is saturation.

    flow : (H, W, 2) px, +x right, +y down. maximum : px of full saturation (default: the largest valid speed); faster
    pixels keep their hue at full saturation. valid : (H, W) bool; invalid or non-finite pixels are dark grey. Returns
    (H, W, 3) uint8.
    """
    flow = np.ascontiguousarray(flow, np.float32)
    valid = np.ones(flow.shape[:2], np.bool_) if valid is None else np.ascontiguousarray(valid, np.bool_)
    if maximum is None:
        maximum = _largest_speed(flow, valid)
    rgb = np.empty((*flow.shape[:2], 3), np.uint8)
    _look_up(flow, valid, max(maximum, 1e-12), flow_wheel(), INVALID, rgb)
    return rgb


@kernel
def _largest_speed(flow, valid):
    largest = 0.0
    for y in range(flow.shape[0]):
        for x in range(flow.shape[1]):
            speed = np.hypot(flow[y, x, 0], flow[y, x, 1])
            if valid[y, x] and np.isfinite(speed) and speed > largest:
                largest = speed
    return largest


@kernel
def _look_up(flow, valid, maximum, wheel, invalid, rgb):
    radius = wheel.shape[0] // 2
    for y in range(flow.shape[0]):
        for x in range(flow.shape[1]):
            u, v = np.float64(flow[y, x, 0]), np.float64(flow[y, x, 1])
            speed = np.sqrt(u * u + v * v)
            if valid[y, x] and np.isfinite(speed):
                # Vectors beyond the maximum have the colour of the wheel's rim.
                scale = radius / max(speed, maximum)
                row, column = int(np.rint(v * scale)) + radius, int(np.rint(u * scale)) + radius
                for c in range(3):
                    rgb[y, x, c] = wheel[row, column, c]
            else:
                for c in range(3):
                    rgb[y, x, c] = invalid[c]


@kernel
def count_events(x: np.ndarray, y: np.ndarray, p: np.ndarray, counts: np.ndarray) -> None:
    """Add events to ``counts`` (2, H, W) uint16 by polarity, saturating."""
    for i in range(len(x)):
        n = counts[p[i], y[i], x[i]]
        if n < 65535:
            counts[p[i], y[i], x[i]] = n + 1


def event_colour(counts: np.ndarray) -> np.ndarray:
    """Return (H, W, 3) uint8 of (2, H, W) counts: ON blue, OFF red on white, both violet; one event is visible, more
    are darker."""
    rgb = np.empty((*counts.shape[1:], 3), np.uint8)
    _shade(counts, _SHADE, rgb)
    return rgb


# The first event takes 59 % of a channel, each further one 59 % of what is left; eight take all of it.
_SHADE = np.rint(255 * (1 - np.exp(-0.9 * np.arange(9)))).astype(np.uint8)


@kernel
def _shade(counts, shade, rgb):
    for y in range(rgb.shape[0]):
        for x in range(rgb.shape[1]):
            off, on = shade[min(counts[0, y, x], len(shade) - 1)], shade[min(counts[1, y, x], len(shade) - 1)]
            # On white, ON takes red and green away, and OFF green and blue.
            rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2] = 255 - on, 255 - max(off, on), 255 - off
