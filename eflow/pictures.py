"""Pictures of events, ground truth, prediction and error, side by side with captions."""

from __future__ import annotations

import os

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.io.atomic import write_whole
from blinkgl.io.colour import INVALID, event_colour, flow_colour
from blinkgl.io.images import encode_image
from eflow.types import Flow, Grid, Mask, Numbers, Picture

_GAP, BAR = 4, 18
"""Gap between panels and height of the bar of captions above them, px."""
NEAR_PX = 3
"""Distance from a pixel within which its events tell its flow."""
_HEAT = np.array([[0, 0, 0], [70, 0, 90], [190, 40, 60], [250, 150, 30], [255, 250, 190]], np.float32)


def error_colour(error: Numbers, largest: float, valid: Mask) -> Picture:
    """Return a picture (H, W, 3) uint8 of an error (H, W) px: black for 0, then red, pale yellow from ``largest`` on,
    grey where invalid."""
    at = np.clip(np.nan_to_num(error, nan=largest) / max(largest, 1e-9), 0, 1) * (len(_HEAT) - 1)
    low = np.minimum(at.astype(int), len(_HEAT) - 2)
    rgb = _HEAT[low] + (_HEAT[low + 1] - _HEAT[low]) * (at - low)[..., None]
    return np.where(valid[..., None], rgb.astype(np.uint8), INVALID)


def events_of(tensor: Grid) -> Picture:
    """Return a picture (H, W, 3) uint8 of an event tensor (C, H, W): positive values blue, negative red."""
    strength = np.abs(tensor)
    top = np.percentile(strength[strength > 0], 95) if (strength > 0).any() else 1.0
    level = lambda t: np.minimum(8, np.ceil(3 * np.clip(t, 0, None).sum(0) / top)).astype(np.uint16)
    return event_colour(np.stack([level(-tensor), level(tensor)]))


def near_events(tensor: Grid) -> Mask:
    """Return the pixels of an event tensor (C, H, W) with an event within ``NEAR_PX``, (H, W) bool."""
    hit = (tensor != 0).any(axis=0).astype(np.uint8)
    return cv2.dilate(hit, np.ones((2 * NEAR_PX + 1,) * 2, np.uint8)) > 0


def comparison(
    events: Picture,
    predicted: Flow,
    truth: Flow | None = None,
    valid: Mask | None = None,
    *,
    largest: float | None = None,
    caption: str = "events",
    near: Mask | None = None,
) -> Picture:
    """Return one RGB strip: events | ground truth | prediction | error; without truth events | prediction.

    A bar of :data:`BAR` px above names each panel and the length of flow at full colour. Flow panels share one scale:
    ``largest`` px, or the 99th percentile of the true speed (without truth, of the predicted speed).
    events : (H, W, 3) uint8; flows (H, W, 2) px. caption : of the events.   near : (H, W) bool; elsewhere predicted
    flow is pale, since no event tells it."""
    # Called when `largest` is known: truth and prediction share one scale.
    coloured = lambda: _paled(flow_colour(predicted, largest), near)
    panels = [(caption, events)]
    if truth is None or valid is None or not valid.any():
        largest = largest or full_colour(predicted)
        panels.append((f"flow, full colour {largest:.3g} px", coloured()))
    else:
        largest = largest or full_colour(truth[valid])
        error, pale = np.hypot(*(np.moveaxis(predicted - truth, -1, 0))), max(3.0, largest / 2)
        panels += [
            (f"truth, full colour {largest:.3g} px", flow_colour(truth, largest, valid)),
            ("predicted", coloured()),
            (f"error, pale {pale:.3g} px", error_colour(error, pale, valid)),
        ]
    height, width = events.shape[:2]
    strip = np.full((height + BAR, len(panels) * (width + _GAP) - _GAP, 3), 255, np.uint8)
    font = ImageFont.load_default(11)
    for i, (text, panel) in enumerate(panels):
        left = i * (width + _GAP)
        bar = Image.new("RGB", (width, BAR), (255, 255, 255))
        ImageDraw.Draw(bar).text((2, 2), text, (40, 40, 40), font=font)
        strip[:BAR, left : left + width], strip[BAR:, left : left + width] = np.asarray(bar), panel
    return strip


def _paled(picture: Picture, near: Mask | None) -> Picture:
    if near is None:
        return picture
    return np.where(near[..., None], picture, (0.25 * picture + 0.75 * 255).astype(np.uint8))


def full_colour(flow: Flow) -> float:
    """Return the length of flow (..., 2) at full colour, px: its 99th percentile."""
    speed = np.hypot(flow[..., 0], flow[..., 1])
    speed = speed[np.isfinite(speed)]
    return (float(np.percentile(speed, 99)) if speed.size else 0.0) or 1.0


def write_picture(path: str | os.PathLike, image: Picture) -> None:
    """Write a PNG, completely or not at all."""
    write_whole(path, encode_image(image))
