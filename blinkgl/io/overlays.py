"""What is drawn over pictures and beside them for people: boxes, tracks with tails, curves of an inertial unit."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.io.pictures import id_colours
from blinkgl.types.boxes import Boxes

_FROM_PX = 160
"""Pictures less wide than this have no room for words."""
_AXES = ((235, 105, 95), (110, 205, 120), (105, 160, 250))
"""Colours of x, y and z."""
_BACK, _LINE, _WORDS = (22, 24, 28), (70, 75, 84), (200, 205, 212)
TAIL_US = 150_000
"""How long a point's tail is."""


def with_boxes(picture: np.ndarray, boxes: Boxes) -> np.ndarray:
    """(h, w, 3) uint8: a copy of a picture of any size with the objects' boxes, in the colours of their ids: of what is
    seen in full lines, of the whole, cut at the picture's edges, in pale ones, and what they are called. Sky and
    ground, which are everywhere, have none."""
    out = np.ascontiguousarray(picture).copy()
    scale = np.tile([out.shape[1], out.shape[0]] / boxes.resolution, 2)
    for k in range(len(boxes)):
        if boxes.kind[k] in ("sky", "ground"):
            continue
        colour = _colour(boxes.instance[k])
        pale = out.copy()
        _rectangle(pale, (boxes.cut_box[k] + 0.5) * scale, colour)
        out = cv2.addWeighted(out, 0.55, pale, 0.45, 0)
        if boxes.visible_pixels[k]:
            seen = (boxes.visible_box[k] + 0.5) * scale
            _rectangle(out, seen, colour)
            if out.shape[1] >= _FROM_PX:
                _word(out, f"{boxes.kind[k]} {boxes.category[k]}", seen[0], seen[1], colour)
    return out


def with_tracks(picture: np.ndarray, tracks: TrackLines, t_us: int) -> np.ndarray:
    """(h, w, 3) uint8: a copy of a picture of any size with the points that are seen at t_us as dots, in the colours of
    their objects, and where they were before as tails that thin out. Between two of the tracks' times they are
    interpolated."""
    out = np.ascontiguousarray(picture).copy()
    scale = np.array([out.shape[1], out.shape[0]]) / tracks.resolution
    if not tracks.t_us[0] <= t_us <= tracks.t_us[-1]:
        return out
    now, share = _between(tracks.t_us, t_us)
    later = min(now + 1, len(tracks.t_us) - 1)
    first = int(np.searchsorted(tracks.t_us, t_us - TAIL_US))
    seen = ~tracks.occluded[:, now if share < 0.5 else later]
    ends = (1 - share) * tracks.px[:, now] + share * tracks.px[:, later]
    places = np.concatenate([tracks.px[:, first : now + 1], ends[:, None]], axis=1)
    hidden = np.concatenate([tracks.occluded[:, first : now + 1], ~seen[:, None]], axis=1)
    fine = np.round(((places + 0.5) * scale - 0.5) * 16).clip(-(2**20), 2**20).astype(np.int32)
    for k in np.flatnonzero(seen):
        colour = _colour(tracks.instance[k])
        for a in range(fine.shape[1] - 1):
            if hidden[k, a] or hidden[k, a + 1]:
                continue
            faded = [int(c * (0.35 + 0.65 * (a + 1) / (fine.shape[1] - 1))) for c in colour]
            cv2.line(out, fine[k, a].tolist(), fine[k, a + 1].tolist(), faded, 1, cv2.LINE_AA, 4)
        cv2.circle(out, fine[k, -1].tolist(), 24, (15, 15, 15), -1, cv2.LINE_AA, 4)
        cv2.circle(out, fine[k, -1].tolist(), 16, colour, -1, cv2.LINE_AA, 4)
    return out


@dataclass(frozen=True, eq=False)
class TrackLines:
    """Of point tracks what is drawn: t_us (T,), px (N, T, 2), occluded (N, T), instance (N,), resolution (2,) width and
    height of the picture that px are of."""

    t_us: np.ndarray
    px: np.ndarray
    occluded: np.ndarray
    instance: np.ndarray
    resolution: np.ndarray


class Curves:
    """Rates and accelerations of an inertial unit as a strip, (height, width, 3) uint8, the left half rad/s, the right
    m/s²; x red, y green, z blue. t_us : (N,) from ``span_us[0]`` to ``span_us[1]``.   rate, acceleration : (N, 3)."""

    def __init__(
        self,
        t_us: np.ndarray,
        rate: np.ndarray,
        acceleration: np.ndarray,
        span_us: tuple[int, int],
        width: int,
        height: int,
    ):
        half = width // 2
        both = [
            _plot(t_us, values, span_us, size, height, name)
            for values, name, size in ((rate, "rad/s", half), (acceleration, "m/s^2", width - half))
        ]
        self._whole, self._halves, self._span = np.concatenate(both, axis=1), (half, width - half), span_us

    def at(self, t_us: int) -> np.ndarray:
        """The strip when t_us is now: what is to come is dim."""
        out = self._whole.copy()
        share = (t_us - self._span[0]) / max(self._span[1] - self._span[0], 1)
        left = 0
        for size in self._halves:
            x = left + round(float(np.clip(share, 0, 1)) * (size - 1))
            out[:, x + 1 : left + size] = (out[:, x + 1 : left + size] * 0.4 + np.array(_BACK) * 0.6).astype(np.uint8)
            out[:, x] = _WORDS
            left += size
        return out


def _plot(
    t_us: np.ndarray, values: np.ndarray, span_us: tuple[int, int], width: int, height: int, unit: str
) -> np.ndarray:
    """(height, width, 3) uint8: three curves; of every column the range that its times have."""
    out = np.empty((height, width, 3), np.uint8)
    out[:] = _BACK
    most = float(np.abs(values).max(initial=0)) or 1.0
    column = np.clip((t_us - span_us[0]) * (width - 1) // max(span_us[1] - span_us[0], 1), 0, width - 1)
    place = (height - 1) / 2 * (1 - 0.9 * values / most)
    out[height // 2] = _LINE
    for axis, colour in enumerate(_AXES):
        low, high = np.full(width, np.inf), np.full(width, -np.inf)
        np.minimum.at(low, column, place[:, axis])
        np.maximum.at(high, column, place[:, axis])
        there = np.flatnonzero(np.isfinite(low))
        for a, b in pairwise(there):
            cv2.line(out, (int(a), round(high[a])), (int(b), round(low[b])), colour, 1, cv2.LINE_AA)
        for a in there[high[there] - low[there] > 1]:
            cv2.line(out, (int(a), round(low[a])), (int(a), round(high[a])), colour, 1)
    return _written(out, f"±{most:.3g} {unit}", (6, 2), _WORDS)


def _between(times: np.ndarray, t_us: int) -> tuple[int, float]:
    """The number of the last time that is not after t_us, and how far it is from there to the next."""
    now = max(int(np.searchsorted(times, t_us, side="right")) - 1, 0)
    step = times[now + 1] - times[now] if now + 1 < len(times) else 1
    return now, float((t_us - times[now]) / step)


def _colour(instance: int) -> list[int]:
    return [int(c) for c in id_colours(np.array([instance]))[0]]


def _rectangle(picture: np.ndarray, edges: np.ndarray, colour: list[int]) -> None:
    """The outermost pixels inside of edges, px from the picture's corner."""
    left, top, right, bottom = (int(v) for v in (*np.floor(edges[:2]), *(np.ceil(edges[2:]) - 1)))
    cv2.rectangle(picture, (left, top), (max(right, left), max(bottom, top)), colour, 1)


def _word(picture: np.ndarray, text: str, x: float, y: float, colour: list[int]) -> None:
    picture[:] = _written(picture, text, (int(x) + 2, int(y) + 1), tuple(colour), back=(12, 12, 14))


def _written(
    picture: np.ndarray,
    text: str,
    at: tuple[int, int],
    colour: tuple[int, ...],
    back: tuple[int, int, int] | None = None,
) -> np.ndarray:
    """A copy with words at their upper left corner. back : of the ground that they stand on; None: none."""
    made = Image.fromarray(picture)
    draw, font = ImageDraw.Draw(made), ImageFont.load_default(10)
    if back is not None:
        draw.rectangle(draw.textbbox(at, text, font=font), fill=back)
    draw.text(at, text, fill=tuple(colour), font=font)
    return np.asarray(made).copy()
