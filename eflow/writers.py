"""Writers of flow: ``writer.add(answer)`` for one window after the other. Files appear completely or not at all.
Pictures of events, ground truth, prediction and error, side by side with captions."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from blinkgl.io.atomic import atomic_file, atomic_folder, output_errors, write_whole
from blinkgl.io.colour import INVALID, event_colour, flow_colour
from blinkgl.io.flow import write_flow_png
from blinkgl.io.images import encode_image, encode_npy
from blinkgl.io.video import VideoWriter
from eflow.data.window import RawSample, StreamWindow, hit_pixels
from eflow.types import Flow, Grid, Mask, Numbers, Picture

_STEADY = 0.95


@dataclass(frozen=True, eq=False)
class Answer:
    """The flow of a pair of windows, t -> t + Δ, the event tensor of the new one (:class:`eflow.infer.Predictor`), and
    the time that it took, s."""

    pair: StreamWindow | RawSample
    flow: Flow
    events: Grid
    seconds: float = 0.0


class Writer(Protocol):
    """Takes answers, in order."""

    def add(self, answer: Answer) -> None:
        """Write one answer. Raises OutputError."""


@contextlib.contextmanager
def flow_folder(final: str | os.PathLike, *, npy: bool = False, at_events: bool = False) -> Iterator[FlowWriter]:
    """Open a new folder of flow: ``%06d.png`` (DSEC's 16 bits), ``pictures/%06d.png`` and ``timestamps.txt`` (from_us,
    to_us).

    npy : also write exact flow to ``npy/%06d.npy``, (H, W, 2) float32.   at_events : flow of pixels without events
    nearby is not valid, NaN in ``npy/``. Raises OutputError: the folder exists."""
    with atomic_folder(final) as folder:
        writer = FlowWriter(folder, Path(final), npy, at_events)
        yield writer
        with output_errors(final):
            (folder / "timestamps.txt").write_text("\n".join(writer.lines) + "\n", encoding="utf-8")


class FlowWriter:
    """Writes windows into the folder of :func:`flow_folder`. lines : of its time stamps.   lost : number of flows that
    a PNG cannot hold and that are not valid there."""

    def __init__(self, folder: Path, final: Path, npy: bool, at_events: bool):
        self._folder, self._final, self.npy, self.at_events = folder, final, npy, at_events
        self.lines, self.lost = ["# from_timestamp_us, to_timestamp_us"], 0

    def add(self, answer: Answer) -> None:
        """Write one window. Raises OutputError."""
        name, flow = f"{len(self.lines) - 1:06d}", answer.flow.astype(np.float32, copy=False)
        valid, near = np.all(np.isfinite(flow), axis=-1), near_events(answer)
        if self.at_events:
            valid &= near
        self.lost += write_flow_png(self._folder / f"{name}.png", flow, valid)
        with output_errors(self._final):
            if self.npy:
                values = np.where(valid[..., None], flow, np.float32(np.nan)) if self.at_events else flow
                self._part("npy", f"{name}.npy").write_bytes(encode_npy(values))
            write_picture(self._part("pictures", f"{name}.png"), comparison(events_of(answer.events), flow, near=near))
        self.lines.append(f"{answer.pair.new.t0}, {answer.pair.new.t1}")

    def _part(self, folder: str, name: str) -> Path:
        (self._folder / folder).mkdir(exist_ok=True)
        return self._folder / folder / name


@contextlib.contextmanager
def flow_video(path: str | os.PathLike, height: int, width: int, fps: float) -> Iterator[FlowVideo]:
    """Open a video. Small sensors are enlarged twice.

    fps : windows per second of video. Raises OutputError: the video cannot be written."""
    factor, still = 2 if height < 200 else 1, np.zeros((height, width, 2), np.float32)
    blank = _fitted(comparison(np.zeros((height, width, 3), np.uint8), still), factor)
    with atomic_file(path, overwrite=False) as final, VideoWriter(final, blank.shape[0], blank.shape[1], fps) as video:
        yield FlowVideo(video, factor)


class FlowVideo:
    """Draws the events and flow of successive windows into a video, enlarged by ``factor``.

    The colour scale grows at once and falls slowly, so that colours do not flicker."""

    def __init__(self, video: VideoWriter, factor: int):
        self._video, self._factor, self._largest = video, factor, 0.0
        self._began: int | None = None

    def add(self, answer: Answer) -> None:
        """Draw one window. Raises OutputError."""
        window, near = answer.pair.new, near_events(answer)
        # Times may be Unix times; captions count from the first window.
        self._began = window.t0 if self._began is None else self._began
        caption = f"{(window.t1 - window.t0) / 1000:g} ms at {(window.t0 - self._began) / 1e6:.3f} s"
        self._largest = max(_STEADY * self._largest, full_colour(answer.flow[near] if near.any() else answer.flow))
        strip = comparison(events_of(answer.events), answer.flow, largest=self._largest, caption=caption, near=near)
        self._video.write(_fitted(strip, self._factor))


def _fitted(strip: Picture, factor: int) -> Picture:
    """Return the strip enlarged and padded to an even height and width, which the codec needs."""
    strip = strip.repeat(factor, 0).repeat(factor, 1)
    return np.pad(strip, ((0, strip.shape[0] % 2), (0, strip.shape[1] % 2), (0, 0)), constant_values=255)


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


def near_events(answer: Answer) -> Mask:
    """Return the pixels with an event of the new window within ``NEAR_PX``, (H, W) bool."""
    # Of the events: in a tensor that is normalised over all cells those without events are not 0.
    hit = hit_pixels([answer.pair.new], *answer.flow.shape[:2]).astype(np.uint8)
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
