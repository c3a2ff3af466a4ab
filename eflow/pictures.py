"""Events, ground truth, prediction and error side by side."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np

from blinkgl.io.atomic import atomic_file
from blinkgl.io.colour import INVALID, event_colour, flow_colour
from blinkgl.io.images import encode_image

_GAP = 4
_HEAT = np.array([[0, 0, 0], [70, 0, 90], [190, 40, 60], [250, 150, 30], [255, 250, 190]], np.float32)


def error_colour(error: np.ndarray, largest: float, valid: np.ndarray) -> np.ndarray:
    """(H, W) px error to (H, W, 3) uint8: black none, through red, to pale yellow at
    ``largest`` and beyond; invalid grey."""
    at = np.clip(np.nan_to_num(error, nan=largest) / max(largest, 1e-9), 0, 1) * (len(_HEAT) - 1)
    low = np.minimum(at.astype(int), len(_HEAT) - 2)
    rgb = _HEAT[low] + (_HEAT[low + 1] - _HEAT[low]) * (at - low)[..., None]
    return np.where(valid[..., None], rgb.astype(np.uint8), INVALID)


def events_of(tensor: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 picture of an event tensor (C, H, W): where it is positive (blue) and negative (red)."""
    strength = np.abs(tensor)
    top = np.percentile(strength[strength > 0], 95) if (strength > 0).any() else 1.0
    level = lambda t: np.minimum(8, np.ceil(3 * np.clip(t, 0, None).sum(0) / top)).astype(np.uint16)
    return event_colour(np.stack([level(-tensor), level(tensor)]))


def comparison(
    events: np.ndarray, predicted: np.ndarray, truth: np.ndarray | None = None, valid: np.ndarray | None = None
) -> np.ndarray:
    """One RGB strip: events | ground truth | prediction | error (without truth: events | prediction). Flow panels share
    one scale: the 99th percentile of the true speed. events : (H, W, 3) uint8; flows (H, W, 2) px."""
    if truth is None or valid is None or not valid.any():
        panels = [events, flow_colour(predicted)]
    else:
        largest = float(np.percentile(np.hypot(*truth[valid].T), 99)) or 1.0
        error = np.hypot(*(np.moveaxis(predicted - truth, -1, 0)))
        panels = [
            events,
            flow_colour(truth, largest, valid),
            flow_colour(predicted, largest),
            error_colour(error, max(3.0, largest / 2), valid),
        ]
    height, width = events.shape[:2]
    strip = np.full((height, len(panels) * (width + _GAP) - _GAP, 3), 255, np.uint8)
    for i, panel in enumerate(panels):
        strip[:, i * (width + _GAP) : i * (width + _GAP) + width] = panel
    return strip


def write_picture(path: str | os.PathLike, image: np.ndarray) -> None:
    """PNG, whole or not at all."""
    with atomic_file(path) as temporary:
        Path(temporary).write_bytes(encode_image(image))
