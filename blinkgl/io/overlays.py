"""Overlays on pictures: boxes, and tracks with tails."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.io.pictures import id_colours
from blinkgl.types.boxes import Boxes

_FROM_PX = 160
"""Narrower pictures have no space for text."""
TAIL_US = 150_000
"""Duration of a point's tail."""


def with_boxes(picture: np.ndarray, boxes: Boxes) -> np.ndarray:
    """Return a copy of a picture of any size, (h, w, 3) uint8, with the objects' boxes in the colours of their ids and
    their names: visible boxes in full lines, whole ones, clipped at the picture's edges, in pale ones. Sky and ground
    have none."""
    out = np.ascontiguousarray(picture).copy()
    scale = np.tile([out.shape[1], out.shape[0]] / boxes.resolution, 2)
    for k in range(len(boxes)):
        if boxes.kind[k] in ("sky", "ground"):
            continue
        colour = _colour(boxes.instance[k])
        pale = out.copy()
        # Pixel centres are at whole numbers, so the picture begins at -0.5.
        _rectangle(pale, (boxes.cut_box[k] + 0.5) * scale, colour)
        out = cv2.addWeighted(out, 0.55, pale, 0.45, 0)
        if boxes.visible_pixels[k]:
            seen = (boxes.visible_box[k] + 0.5) * scale
            _rectangle(out, seen, colour)
            if out.shape[1] >= _FROM_PX:
                _word(out, f"{boxes.kind[k]} {boxes.category[k]}", seen[0], seen[1], colour)
    return out


def with_tracks(picture: np.ndarray, tracks: TrackLines, t_us: int) -> np.ndarray:
    """Return a copy of a picture of any size, (h, w, 3) uint8, with the points visible at t_us as dots in the colours
    of their objects, and their earlier positions as fading tails. Positions are interpolated between the tracks'
    times."""
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
    # In 1/16 px, the four bits that OpenCV's functions are told last; pixel centres are at whole numbers.
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
    """The drawn data of point tracks: t_us (T,), px (N, T, 2), occluded (N, T), instance (N,), resolution (2,) width
    and height of the picture that px refer to."""

    t_us: np.ndarray
    px: np.ndarray
    occluded: np.ndarray
    instance: np.ndarray
    resolution: np.ndarray


def _between(times: np.ndarray, t_us: int) -> tuple[int, float]:
    """Return the index of the last time that is not after t_us, and the fraction to the next."""
    now = max(int(np.searchsorted(times, t_us, side="right")) - 1, 0)
    step = times[now + 1] - times[now] if now + 1 < len(times) else 1
    return now, float((t_us - times[now]) / step)


def _colour(instance: int) -> list[int]:
    return [int(c) for c in id_colours(np.array([instance]))[0]]


def _rectangle(picture: np.ndarray, edges: np.ndarray, colour: list[int]) -> None:
    """Draw the outermost pixels inside of edges, px from the picture's corner."""
    left, top, right, bottom = (int(v) for v in (*np.floor(edges[:2]), *(np.ceil(edges[2:]) - 1)))
    cv2.rectangle(picture, (left, top), (max(right, left), max(bottom, top)), colour, 1)


def _word(picture: np.ndarray, text: str, x: float, y: float, colour: list[int]) -> None:
    """Write text on a dark ground, its upper left corner beside (x, y)."""
    made, at = Image.fromarray(picture), (int(x) + 2, int(y) + 1)
    draw, font = ImageDraw.Draw(made), ImageFont.load_default(10)
    draw.rectangle(draw.textbbox(at, text, font=font), fill=(12, 12, 14))
    draw.text(at, text, fill=tuple(colour), font=font)
    picture[:] = np.asarray(made)
