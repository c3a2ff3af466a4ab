"""Interpolated frames, for sources too slow for their motion. The generator passes the given frames on unchanged and
adds frames in between; it needs one frame of look-ahead and stores nothing else.

Input and output: iterators of (luminance, t_ns), luminance (H, W) float32 linear light.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.srgb import to_srgb8

Timed = tuple[np.ndarray, int]
_EPS = np.float32(1e-3)


@dataclass
class Displacement:
    """Displacements between given frames, px, from dense flow; filled while :func:`motion` runs."""

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
        return (
            f"displacement per given frame: median {self.median:.2g} px, 99th percentile {self.p99:.2g} px, "
            f"largest {self.largest:.2g} px; {self.inserted} frames interpolated by dense-flow warp, not recorded"
        )


def motion(
    frames: Iterable[Timed], max_px: float = 1.0, *, most: int = 64, displacement: Displacement | None = None
) -> Iterator[Timed]:
    """Add enough frames that at most ``max_px`` (99.5 % of the pixels) of motion remain per step, at most ``most`` per
    pair.

    Dense flow (OpenCV's DIS) is computed in both directions. Both frames are warped to the intermediate time by
    linearly combined flows and blended by distance in time; where the flows contradict each other (occlusion), only the
    frame that sees the pixel counts. Between pixels the value is a cubic of ln(1e-3 + I) (Catmull and Rom 1974),
    limited to the range of the four pixels around: linear interpolation loses contrast and so events, and a cubic of
    the light adds false events beside dark pixels. Surfaces that no frame shows are guessed; ``displacement`` tells
    over how many pixels.
    """
    dense = DenseFlow()
    statistics = displacement if displacement is not None else Displacement()
    last: tuple[np.ndarray, np.ndarray, int] | None = None
    for frame, t in frames:
        grey = dense.codes(frame)
        if last is not None:
            a, grey_a, t_a = last
            forward, backward = dense(grey_a, grey)
            speed = np.hypot(forward[..., 0], forward[..., 1])
            statistics.add(speed)
            # Never more steps than there are ns between the frames.
            steps = int(min(max(np.ceil(np.percentile(speed, 99.5) / max_px), 1), most, t - t_a))
            yield from _between(a, frame, t_a, t, forward, backward, steps)
            statistics.inserted += steps - 1
        yield frame, t
        last = frame, grey, t


def watched(frames: Iterable[Timed], moved_px: list[float]) -> Iterator[Timed]:
    """Yield the frames unchanged. ``moved_px`` gets the 99th percentile of the dense flow between a few pairs: those
    that end at frame 1, 2, 4 and 8, and at every 16th.

    frames : luminance (H, W) float32, or uint8 codes, and t_ns; a frame may be overwritten when the next is asked
    for."""
    # It takes a quarter of the time of the medium preset and is as good for a percentile.
    dense = DenseFlow(cv2.DISOPTICAL_FLOW_PRESET_FAST)
    last: np.ndarray | None = None
    for number, (frame, t) in enumerate(frames):
        if last is not None:
            speed = np.hypot(*np.moveaxis(dense.forward(last, dense.codes(frame)), -1, 0))
            moved_px.append(float(np.percentile(speed, 99)))
        following = number + 1
        # Only a frame before one of those at which a pair ends has to be kept.
        last = dense.codes(frame).copy() if 16 % following == 0 or following % 16 == 0 else None
        yield frame, t


class DenseFlow:
    """OpenCV's DIS flow (Kroeger et al. 2016): the medium preset, which :func:`motion` uses, or another."""

    LEAST = 32
    """Smallest side, px, that OpenCV is given: below it dense flow raises, returns NaN or ends the process, depending
    on preset and the other side. Smaller pictures are continued at their borders, and the flow is cut out again."""

    def __init__(self, preset: int = cv2.DISOPTICAL_FLOW_PRESET_MEDIUM) -> None:
        self._dis = cv2.DISOpticalFlow_create(preset)  # type: ignore[missing-attribute]

    @staticmethod
    def codes(frame: np.ndarray) -> np.ndarray:
        """Return the input of the flow, (H, W) uint8, from linear light or codes."""
        return frame if frame.dtype == np.uint8 else to_srgb8(frame)

    def forward(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """Return the flow (H, W, 2) float32 px from a to b, of codes."""
        height, width = a.shape
        below, right = max(0, self.LEAST - height), max(0, self.LEAST - width)
        if below or right:
            a, b = (cv2.copyMakeBorder(one, 0, below, 0, right, cv2.BORDER_REPLICATE) for one in (a, b))
        return self._dis.calc(a, b, None)[:height, :width]  # type: ignore[no-matching-overload]

    def __call__(self, a: np.ndarray, b: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the flow (H, W, 2) float32 px from a to b and from b to a, of codes."""
        return self.forward(a, b), self.forward(b, a)


def _between(a, b, t_a, t_b, forward, backward, steps) -> Iterator[Timed]:
    if steps < 2:
        return
    height, width = a.shape
    grid = np.stack(np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32)), axis=-1)
    # Reads flow at integer pixels and between them.
    look = lambda image, flow: cv2.remap(  # type: ignore[no-matching-overload]
        image, grid + flow, None, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    pictures = [(np.ascontiguousarray(one, np.float32), np.log(one + _EPS)) for one in (a, b)]
    seen_a, seen_b = _consistent(forward, look(backward, forward)), _consistent(backward, look(forward, backward))
    f = np.float32
    for k in range(1, steps):
        s = k / steps
        # Flow from the intermediate time back to a and on to b, from both flows (Jiang et al. 2018,
        # Super SloMo).
        to_a = forward * f(-s * (1 - s)) + backward * f(s * s)
        to_b = forward * f((1 - s) ** 2) - backward * f(s * (1 - s))
        # Pixels that b does not see (a's inconsistent ones) come from a, and vice versa.
        weight_a, weight_b = f(1 - s) * look(seen_b, to_b), f(s) * look(seen_a, to_a)
        moved = [np.empty(a.shape, np.float32) for _ in pictures]
        for (light, log), to, out in zip(pictures, (to_a, to_b), moved):
            _look(light, log, grid + to, out)
        yield (
            (weight_a * moved[0] + weight_b * moved[1]) / (weight_a + weight_b),
            t_a + (t_b - t_a) * k // steps,
        )


@kernel(error_model="numpy")
def _look(light, log, places, out):
    """Write the light at ``places`` (H, W, 2), x and y in px, to ``out``; the border continues outwards."""
    height, width = log.shape
    wx, wy = np.empty(4, np.float32), np.empty(4, np.float32)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            x, y = places[row, column, 0], places[row, column, 1]
            # NaN becomes 0 as well.
            x = min(x, np.float32(width - 1)) if x > 0 else np.float32(0)
            y = min(y, np.float32(height - 1)) if y > 0 else np.float32(0)
            i, j = int(x), int(y)
            _catmull_rom(x - np.float32(i), wx)
            _catmull_rom(y - np.float32(j), wy)
            total = np.float32(0)
            for n in range(4):
                # Rows and columns beyond the border repeat it.
                line = log[min(max(j + n - 1, 0), height - 1)]
                part = np.float32(0)
                for m in range(4):
                    part += wx[m] * line[min(max(i + m - 1, 0), width - 1)]
                total += wy[n] * part
            # The four pixels around limit the result.
            right, below = i + (x > i), j + (y > j)
            a, b, c, d = light[j, i], light[j, right], light[below, i], light[below, right]
            value = np.exp(total) - _EPS
            out[row, column] = min(max(value, min(a, b, c, d)), max(a, b, c, d))


@kernel
def _catmull_rom(f, out):
    """Compute the weights of the four samples around a place ``f`` beyond the second: exact for parabolas."""
    # float32 numbers, so that no product becomes float64.
    half, one = np.float32(0.5), np.float32(1)
    out[0] = half * f * (f * (np.float32(2) - f) - one)
    out[1] = half * (f * f * (np.float32(3) * f - np.float32(5)) + np.float32(2))
    out[2] = half * f * (f * (np.float32(4) - np.float32(3) * f) + one)
    out[3] = half * f * f * (f - one)


def _consistent(flow: np.ndarray, back: np.ndarray) -> np.ndarray:
    """Return 1 where going there and back returns, 0.01 elsewhere."""
    # Forward and back again should end where it began.
    miss = np.hypot(*np.moveaxis(flow + back, -1, 0))
    # Not 0, so that the weights of a pixel that neither frame sees still have a sum.
    return np.where(miss <= 1 + 0.05 * np.hypot(flow[..., 0], flow[..., 1]), np.float32(1), np.float32(0.01))
