"""How far two frames are apart for an interpolation: what is measured before recorded frames become events.

Pure functions of frames (H, W) float32 linear light and flows (H, W, 2) px, +x right, +y down; one number each. Which
numbers are too large is configuration (``frames.qualify``), chosen by ``tools/validate_interpolation.py`` of 348eebef.
"""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np

EPS = np.float32(1e-3)
"""Added to light before its logarithm, as the interpolation does."""
CHANGE = 0.01
"""Least mean change of ln(light) that an error is a share of; event cameras see changes of 0.1 and more."""
PERCENTILE = 99.0
WIDTHS_PX = (2, 3, 4, 6, 8, 12, 16, 24, 32)
"""Of structures that may be thin for their motion."""


def displacement(flow: np.ndarray, valid: np.ndarray) -> float:
    """99th percentile of the length of the valid vectors, px. ValueError: none is, or the shapes differ."""
    _check(flow, valid)
    if not valid.any():
        raise ValueError("no valid vector")
    return float(np.percentile(np.hypot(flow[..., 0], flow[..., 1])[valid], PERCENTILE))


def hidden(forward: np.ndarray, valid: np.ndarray, backward: np.ndarray, valid_backward: np.ndarray) -> np.ndarray:
    """(H, W) bool: pixels of which going there and coming back does not return, |f + b'|^2 > 0.01 (|f|^2 + |b'|^2) +
    0.5 (Sundaram, Brox and Keutzer 2010, eq. 5), or leads out of the picture: occluded, or one of the flows is wrong.

    b' is the backward flow where the forward one ends, bilinear; where that is not valid, the pixel counts as hidden.
    False where the forward flow is not valid. ValueError: shapes differ."""
    _check(forward, valid, backward)
    there = _ends(forward)
    back = _look(backward, there)
    square = lambda field: field[..., 0] * field[..., 0] + field[..., 1] * field[..., 1]
    miss = square(forward + back) > 0.01 * (square(forward) + square(back)) + 0.5
    miss |= _look(valid_backward.astype(np.float32), there) < 0.999
    return (miss | _outside(there)) & valid


def uncovered(flow: np.ndarray, valid: np.ndarray) -> float:
    """Share of the second frame's pixels that no pixel of the first comes to, by the forward flow alone: what appears
    from behind something or from outside the picture. Pixels are splatted with bilinear weights; covered is what
    receives half a pixel or more. Pixels without a valid vector stay where they are. ValueError: shapes differ."""
    _check(flow, valid)
    height, width = valid.shape
    there = _ends(np.where(valid[..., None], flow, np.float32(0)))
    low = np.floor(there)
    part = there - low
    weight = np.zeros(height * width)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        x, y = low[..., 0] + dx, low[..., 1] + dy
        share = (part[..., 0] if dx else 1 - part[..., 0]) * (part[..., 1] if dy else 1 - part[..., 1])
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        weight += np.bincount((y[inside] * width + x[inside]).astype(np.int64), share[inside], minlength=height * width)
    return float(np.mean(weight < 0.5))


def residual(a: np.ndarray, b: np.ndarray, flow: np.ndarray, visible: np.ndarray) -> float:
    """Mean |ln b(x + flow) - ln a(x)| over the visible pixels that stay inside the picture: how much of the light's
    change the flow does not explain (a wrong flow, changing light, reflections). NaN where no pixel is left. b is
    sampled bilinearly. ValueError: shapes differ."""
    _check(flow, visible, None, a, b)
    there = _ends(flow)
    seen = visible & ~_outside(there)
    if not seen.any():
        return float("nan")
    return float(np.abs(_look(np.log(b + EPS), there) - np.log(a + EPS))[seen].mean())


def thin(flow: np.ndarray, valid: np.ndarray) -> float:
    """Share of the valid pixels on structures that move, against what surrounds them, by more than their own width: a
    twig before a wall. Between two frames such a thing overlaps itself nowhere, and dense flow takes the surroundings'.

    The top-hat and bottom-hat transforms (Serra 1982) of both components with squares of ``WIDTHS_PX``: what no square
    of w px fits into, and differs from its surroundings by more than w px. Pixels without a valid vector are not looked
    at. ValueError: none is valid, or the shapes differ."""
    _check(flow, valid)
    if not valid.any():
        raise ValueError("no valid vector")
    found = np.zeros(valid.shape, bool)
    vectors = np.where(valid[..., None], flow, np.float32(np.nan))
    farthest = float(np.ptp(flow[valid], axis=0).max()) * np.sqrt(2)
    border = WIDTHS_PX[-1] - 1
    # Continued in a straight line, lest slopes that end at the border stand out there.
    wide = [np.pad(component, border, mode="reflect", reflect_type="odd") for component in np.moveaxis(vectors, -1, 0)]
    inside = (slice(border, -border),) * 2
    for width in WIDTHS_PX:
        if width >= farthest:
            break
        hats = [np.maximum(image - _opened(image, width), -_opened(-image, width) - image)[inside] for image in wide]
        found |= np.hypot(*hats) > width
    return float(found[valid].mean())


def _opened(image: np.ndarray, width: int) -> np.ndarray:
    """Grey-scale opening with a square of ``width`` px; what is not finite is not looked at."""
    square = np.ones((width, width), np.uint8)
    low = cv2.erode(np.where(np.isfinite(image), image, np.float32(np.inf)), square)
    # A square of even width lies the other way round when it is dilated with, so that no pixel moves.
    anchor = (width - 1 - width // 2,) * 2
    return cv2.dilate(np.where(np.isfinite(low), low, np.float32(-np.inf)), square, anchor=anchor)


def astray(estimated: np.ndarray, flow: np.ndarray, valid: np.ndarray, weight: np.ndarray | None = None) -> float:
    """Share of the valid pixels of which the flow that the interpolation follows is off the given one by more than 1 px
    and more than a twentieth of its length. weight : (H, W) >= 0, how much each pixel counts; default: all the same.
    NaN where all weigh nothing. ValueError: shapes differ."""
    _check(flow, valid, estimated)
    off = np.hypot(*np.moveaxis(estimated - flow, -1, 0))
    wrong = off > np.maximum(1, 0.05 * np.hypot(flow[..., 0], flow[..., 1]))
    counts = valid.astype(np.float64) if weight is None else np.where(valid, weight, 0.0)
    total = counts.sum()
    return float(counts[wrong].sum() / total) if total > 0 else float("nan")


def left_out(
    before: np.ndarray, middle: np.ndarray, after: np.ndarray, halfway: Callable[[np.ndarray, np.ndarray], np.ndarray]
) -> float:
    """The interpolation tried where the truth is known: mean |ln guess - ln middle|, of the frame in the middle as
    ``halfway(before, after)`` guesses it from those beside it, over the mean |ln after - ln before|. Where that is less
    than ``CHANGE``, over ``CHANGE``: where nothing moves, noise does not count. ValueError: shapes differ."""
    if not before.shape == middle.shape == after.shape:
        raise ValueError(f"shapes differ: {before.shape}, {middle.shape}, {after.shape}")
    return change(halfway(before, after), middle) / max(change(before, after), CHANGE)


def change(a: np.ndarray, b: np.ndarray) -> float:
    """Mean |ln b - ln a|."""
    return float(np.abs(np.log(b + EPS) - np.log(a + EPS)).mean())


def edges(frame: np.ndarray) -> np.ndarray:
    """(H, W) float32, length of the gradient of ln(frame), 1/px: where events come from."""
    log = np.log(frame + EPS)
    return np.hypot(cv2.Sobel(log, cv2.CV_32F, 1, 0, scale=0.125), cv2.Sobel(log, cv2.CV_32F, 0, 1, scale=0.125))


def fine(frame: np.ndarray) -> float:
    """Share of ln(light)'s variation along rows and columns that is lost when the frame is shifted by half a pixel,
    sampled bilinearly: 0 of slopes, edges and whatever is two pixels wide, 1/2 of lines of one pixel, all of what
    alternates from pixel to pixel. Texture too fine to be warped without losing contrast, and events with it."""
    log = np.log(frame.astype(np.float64) + EPS)
    there = lost = 0.0
    for along in (log, log.T):
        there += np.abs(np.diff(along, axis=1)[:, 1:]).sum()
        lost += np.abs(np.diff((along[:, 1:] + along[:, :-1]) / 2, axis=1)).sum()
    return float(max(1 - lost / there, 0.0)) if there > 0 else 0.0


def of_given_flow(
    a: np.ndarray,
    b: np.ndarray,
    flow: np.ndarray,
    valid: np.ndarray,
    *,
    gone: np.ndarray | None = None,
    own: np.ndarray | None = None,
) -> dict[str, float]:
    """The measures of a pair of frames that need its flow, by name; those that can be had.

    gone : (H, W) bool, pixels that the second frame does not show, where it is known.   own : the flow that the
    interpolation follows, where it follows one. ValueError: no valid vector, or shapes differ."""
    values = {"displacement": displacement(flow, valid), "uncovered": uncovered(flow, valid), "thin": thin(flow, valid)}
    if gone is not None:
        values["hidden"] = float(gone[valid].mean())
    values["residual"] = residual(a, b, flow, valid if gone is None else valid & ~gone)
    if own is not None:
        values["astray"] = astray(own, flow, valid, edges(a))
    return {name: value for name, value in values.items() if np.isfinite(value)}


def _check(flow: np.ndarray, valid: np.ndarray, other: np.ndarray | None = None, *frames: np.ndarray) -> None:
    if flow.ndim != 3 or flow.shape[2] != 2 or flow.shape[:2] != valid.shape:
        raise ValueError(f"not a flow (H, W, 2) and its mask (H, W): {flow.shape}, {valid.shape}")
    for array, wanted in ((other, flow.shape), *((frame, valid.shape) for frame in frames)):
        if array is not None and array.shape != wanted:
            raise ValueError(f"shapes differ: {array.shape}, {wanted}")


def _ends(flow: np.ndarray) -> np.ndarray:
    """Where every pixel's vector ends, (H, W, 2) float32 px."""
    height, width = flow.shape[:2]
    x, y = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    return np.stack([x, y], -1) + flow.astype(np.float32, copy=False)


def _outside(there: np.ndarray) -> np.ndarray:
    height, width = there.shape[:2]
    x, y = there[..., 0], there[..., 1]
    return (x < 0) | (y < 0) | (x > width - 1) | (y > height - 1)


def _look(image: np.ndarray, there: np.ndarray) -> np.ndarray:
    return cv2.remap(image, there[..., 0], there[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
