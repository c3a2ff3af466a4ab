"""Frames between frames, for sources too slow for their motion. Both generators pass the given frames on unchanged and
add frames in between; they need one frame (cubic: two) of look-ahead and keep nothing else.

Input and output: iterators of (luminance, t_ns), luminance (H, W) float32 linear light.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numba
import numpy as np

Timed = tuple[np.ndarray, int]
_EPS = np.float32(1e-3)


def cubic(frames: Iterable[Timed], factor: int = 4) -> Iterator[Timed]:
    """``factor - 1`` frames between any two by monotone piecewise-cubic interpolation of ln(1e-3 + I) over four neighbours (Fritsch
    and Butland 1984: no over-shoot, hence no invented events; unequal spacing is respected)."""
    window: list[tuple[np.ndarray, np.ndarray, int]] = []  # (luminance, log, t): frames k-1, k, k+1, k+2

    def between(before, a, b, after) -> Iterator[Timed]:
        slope = _secant(a, b)
        m0 = slope if before is None else _monotone(_secant(before, a), slope, a[2] - before[2], b[2] - a[2])
        m1 = slope if after is None else _monotone(slope, _secant(b, after), b[2] - a[2], after[2] - b[2])
        for k in range(1, factor):
            t = a[2] + (b[2] - a[2]) * k // factor
            if t > a[2]:
                yield np.maximum(np.exp(_hermite(a, b, m0, m1, t)) - _EPS, 0), t

    for frame, t in frames:
        window.append((frame, np.log(frame + _EPS), t))
        if len(window) == 1:
            yield frame, t
        elif len(window) >= 3:
            before = window[-4] if len(window) == 4 else None
            yield from between(before, *window[-3:])
            yield window[-2][0], window[-2][2]
            window = window[-3:]
    if len(window) >= 2:
        yield from between(window[-3] if len(window) == 3 else None, window[-2], window[-1], None)
        yield window[-1][0], window[-1][2]


def _secant(a, b) -> np.ndarray:
    return (b[1] - a[1]) / np.float32(b[2] - a[2])


@numba.njit(cache=True, nogil=True)
def _weighted(d0, d1, h0, h1, out):
    w0, w1 = 2 * h1 + h0, h1 + 2 * h0
    for i in range(len(out)):
        out[i] = (w0 + w1) * d0[i] * d1[i] / (w0 * d1[i] + w1 * d0[i]) if d0[i] * d1[i] > 0 else 0.0


def _monotone(d0: np.ndarray, d1: np.ndarray, h0: int, h1: int) -> np.ndarray:
    """Node slope: weighted harmonic mean of the secants beside it, 0 at an extremum."""
    scale = float(h0 + h1)
    out = np.empty(d0.size, np.float32)
    # Scaled to about one: products of secants per nanosecond underflow float32.
    _weighted((d0 * np.float32(scale)).ravel(), (d1 * np.float32(scale)).ravel(), h0 / scale, h1 / scale, out)
    return out.reshape(d0.shape) / np.float32(scale)


def _hermite(a, b, m0, m1, t) -> np.ndarray:
    h = b[2] - a[2]
    s = (t - a[2]) / h
    f = np.float32
    return (a[1] * f((1 + 2 * s) * (1 - s) ** 2) + b[1] * f(s * s * (3 - 2 * s))
            + m0 * f(h * s * (1 - s) ** 2) + m1 * f(h * s * s * (s - 1)))


@dataclass
class Displacement:
    """How far things move from one given frame to the next, px, as the dense flow says; filled while :func:`motion` runs."""

    pairs: int = 0
    median: float = 0.0
    """mean over the pairs of the median over the pixels"""
    p99: float = 0.0
    """largest 99th percentile of any pair"""
    largest: float = 0.0
    inserted: int = 0

    def add(self, speed: np.ndarray) -> None:
        self.median = (self.median * self.pairs + float(np.median(speed))) / (self.pairs + 1)
        self.pairs += 1
        self.p99 = max(self.p99, float(np.percentile(speed, 99)))
        self.largest = max(self.largest, float(speed.max()))

    def __str__(self) -> str:
        return (f"displacement per given frame: median {self.median:.2g} px, 99th percentile {self.p99:.2g} px, "
                f"largest {self.largest:.2g} px; {self.inserted} frames interpolated by dense-flow warp, not recorded")


def motion(frames: Iterable[Timed], max_px: float = 1.0, *, most: int = 64, displacement: Displacement | None = None) -> Iterator[Timed]:
    """So many frames in between that no more than ``max_px`` (99.5 % of the pixels) are moved per step, at most ``most`` per pair.

    Dense flow (OpenCV's DIS) both ways; both frames are warped to the intermediate time by linearly combined flows and
    blended by distance in time; where the flows contradict each other (occlusion) only the frame that sees the pixel counts.
    What no frame shows is guessed: the result is an interpolation and ``displacement`` says over how many pixels.
    """
    dis = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    statistics = displacement if displacement is not None else Displacement()
    last: tuple[np.ndarray, np.ndarray, int] | None = None
    for frame, t in frames:
        grey = _to8(frame)
        if last is not None:
            a, grey_a, t_a = last
            forward, backward = dis.calc(grey_a, grey, None), dis.calc(grey, grey_a, None)
            speed = np.hypot(forward[..., 0], forward[..., 1])
            statistics.add(speed)
            steps = int(min(max(np.ceil(np.percentile(speed, 99.5) / max_px), 1), most, t - t_a))
            yield from _between(a, frame, t_a, t, forward, backward, steps)
            statistics.inserted += steps - 1
        yield frame, t
        last = frame, grey, t


def _between(a, b, t_a, t_b, forward, backward, steps) -> Iterator[Timed]:
    if steps < 2:
        return
    height, width = a.shape
    grid = np.stack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)), axis=-1)
    look = lambda image, flow: cv2.remap(image, grid + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)  # noqa: E731
    seen_a, seen_b = _consistent(forward, look(backward, forward)), _consistent(backward, look(forward, backward))
    f = np.float32
    for k in range(1, steps):
        s = k / steps
        to_a = forward * f(-s * (1 - s)) + backward * f(s * s)
        to_b = forward * f((1 - s) ** 2) - backward * f(s * (1 - s))
        # What b does not see (a's inconsistent pixels) comes from a, and the other way round.
        weight_a, weight_b = f(1 - s) * look(seen_b, to_b), f(s) * look(seen_a, to_a)
        yield (weight_a * look(a, to_a) + weight_b * look(b, to_b)) / (weight_a + weight_b), t_a + (t_b - t_a) * k // steps


def _consistent(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """1 where going there and back returns, 0.01 where not."""
    miss = np.hypot(*np.moveaxis(flow + back, -1, 0))
    return np.where(miss <= 1 + 0.05 * np.hypot(flow[..., 0], flow[..., 1]), np.float32(1), np.float32(0.01))


def _to8(luminance: np.ndarray) -> np.ndarray:
    from blinkgl.io.images import to_srgb8
    return to_srgb8(luminance)
