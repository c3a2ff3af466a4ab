"""Pictures of arrays, by kind of label or of a shader debugger's buffer; objects' boxes and the tracks of points over a
picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.errors import ConfigError
from blinkgl.srgb import srgb_from_linear
from blinkgl.types.boxes import Boxes

MAPS = ("viridis", "turbo", "inferno", "gray", "RdBu_r", "coolwarm")
SCALAR_MAP, SIGNED_MAP = "viridis", "RdBu_r"
EMPTY = np.array([40, 40, 40], np.uint8)  # nothing hit, or not a number


def finite_range(values: np.ndarray, signed: bool = False, share: float = 0.005) -> tuple[float, float]:
    """Return a range for display: the finite values without the outermost ``share`` at each end; symmetric when
    signed."""
    finite = values[np.isfinite(values)]
    if not finite.size:
        return 0.0, 1.0
    low, high = (float(v) for v in np.quantile(finite, [share, 1 - share]))
    if signed:
        low, high = -max(abs(low), abs(high)), max(abs(low), abs(high))
    if not high > low:
        low, high = low - 0.5 * (abs(low) or 1.0), high + 0.5 * (abs(high) or 1.0)
    return low, high


def map_scalar(values: np.ndarray, name: str, low: float, high: float, log: bool = False) -> np.ndarray:
    """Return (H, W, 3) uint8; dark grey where not finite. log : equal ratios get equal steps of colour."""
    if log and low > 0:
        with np.errstate(invalid="ignore", divide="ignore"):
            return map_scalar(np.log(values), name, float(np.log(low)), float(np.log(high)))
    if name not in MAPS:
        raise ConfigError("unknown colour map", where="map", value=name, accepted="one of " + ", ".join(MAPS))
    with np.errstate(invalid="ignore", over="ignore"):
        scaled = np.clip((values.astype(np.float64) - low) / ((high - low) or 1.0), 0.0, 1.0)
    rgb = _table(name)[np.minimum(256 * np.nan_to_num(scaled), 255).astype(np.uint8)]
    rgb[~np.isfinite(values)] = EMPTY
    return rgb


def _table(name: str) -> np.ndarray:
    """Return the 256 colours of a map of :data:`MAPS`, (256, 3) uint8."""
    steps = np.arange(256, dtype=np.uint8)[:, None]
    if name == "gray":
        return np.repeat(steps, 3, axis=1)
    if (number := getattr(cv2, f"COLORMAP_{name.upper()}", None)) is not None:
        return cv2.applyColorMap(steps, number)[:, 0, ::-1]
    import matplotlib  # has the diverging maps, and is slow to import

    return (matplotlib.colormaps[name](steps[:, 0])[:, :3] * 255).round().astype(np.uint8)


def id_colours(ids: np.ndarray) -> np.ndarray:
    """Return distinct hues by the golden ratio, (H, W, 3) uint8, dark grey for 0; a number always has the same
    colour."""
    numbers = ids.astype(np.int64)
    hue = (numbers * 0.61803398875) % 1.0
    # Another irrational step, so that the value is not tied to the hue.
    value = 0.62 + 0.38 * ((numbers * 0.7548776662) % 1.0)
    # HSV to RGB: with k = (n + 6 hue) mod 6 a channel is value (1 - saturation clip(min(k, 4 - k), 0, 1)), n = 5, 3, 1.
    k = (np.array([5, 3, 1]) + 6 * hue[..., None]) % 6
    rgb = value[..., None] * (1 - 0.62 * np.clip(np.minimum(k, 4 - k), 0, 1))
    out = (rgb * 255).round().astype(np.uint8)
    out[numbers == 0] = EMPTY
    return out


def component(array: np.ndarray, which: str) -> np.ndarray:
    """Return (H, W) of (H, W[, C]): a component, or the length of the vector."""
    if array.ndim == 2:
        return array
    if which in ("auto", "length"):
        return np.linalg.norm(array.astype(np.float64), axis=-1)
    k = "xyzw".find(which) if len(which) == 1 else -1
    if not 0 <= k < array.shape[2]:
        raise ConfigError(
            "no such component",
            where="component",
            value=which,
            accepted="one of auto, length, " + ", ".join("xyzw"[: array.shape[2]]),
        )
    return array[..., k]


def picture(
    kind: str,
    array: np.ndarray,
    *,
    which: str = "auto",
    colours: str | None = None,
    low: float | None = None,
    high: float | None = None,
    hit: np.ndarray | None = None,
) -> tuple[np.ndarray, dict]:
    """Return (H, W, 3) uint8 and a legend: {"kind": "bar", "map", "low", "high", "log"}, {"kind": "wheel", "high"} or
    {"kind": kind}.

    kind : as of a :class:`~blinkgl.labels.Label`, or "uv".   which : component of a vector; "auto": the kind's default.
    hit : (H, W) bool, where scalars are valid (they set the range, the rest is dark grey)."""
    if array.dtype == bool or kind == "mask":
        return np.where(array[..., None], np.uint8(245), np.uint8(25)).repeat(3, axis=-1), {"kind": "mask"}
    if which == "auto" and colours is None:
        if kind == "ids":
            return id_colours(array), {"kind": "ids"}
        if kind == "light":
            top = high if high is not None else 1.0
            return (srgb_from_linear(array / top) * 255).round().astype(np.uint8), {"kind": "light", "high": top}
        if kind == "unit":
            rgb = np.clip(127.5 + 127.5 * array, 0, 255).round().astype(np.uint8)
            rgb[(array == 0).all(axis=-1)] = EMPTY
            return rgb, {"kind": "unit"}
        if kind == "uv":
            with np.errstate(invalid="ignore"):
                fraction = np.nan_to_num(array % 1.0)
            rgb = np.concatenate([fraction * 255, np.full((*array.shape[:2], 1), 60)], axis=-1).round().astype(np.uint8)
            return rgb, {"kind": "uv"}
        if kind == "motion":
            speed = component(array, "length")
            top = high if high is not None else finite_range(speed if hit is None or not hit.any() else speed[hit])[1]
            from blinkgl.io.colour import flow_colour  # imported late, because labels use this module

            return flow_colour(array, top, hit), {"kind": "wheel", "high": float(top)}
    values = component(np.asarray(array), which).astype(np.float64)
    if hit is not None:
        values = np.where(hit, values, np.nan)
    signed = kind == "signed" or (kind in ("motion", "unit") and which in ("x", "y", "z"))
    name = colours or (SIGNED_MAP if signed else SCALAR_MAP)
    auto = finite_range(values, signed)
    low, high = auto[0] if low is None else low, auto[1] if high is None else high
    log = kind == "depth" and low > 0
    return map_scalar(values, name, low, high, log), {
        "kind": "bar",
        "map": name,
        "low": float(low),
        "high": float(high),
        "log": log,
    }


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
    # Between two times a point is visible if it is at the nearer one.
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
