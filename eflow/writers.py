"""Writers of flow: ``writer.add(answer)`` for one window after the other. Files appear completely or not at all."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from blinkgl.io.atomic import atomic_file, atomic_folder, output_errors
from blinkgl.io.flow import write_flow_png
from blinkgl.io.images import encode_npy
from blinkgl.io.video import VideoWriter
from eflow.data.window import RawSample, StreamWindow
from eflow.pictures import comparison, events_of, full_colour, near_events, write_picture
from eflow.types import Flow, Grid, Picture

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
    """Writes windows into the folder of :func:`flow_folder`. lines : of its time stamps."""

    def __init__(self, folder: Path, final: Path, npy: bool, at_events: bool):
        self._folder, self._final, self.npy, self.at_events = folder, final, npy, at_events
        self.lines = ["# from_timestamp_us, to_timestamp_us"]

    def add(self, answer: Answer) -> None:
        """Write one window. Raises OutputError."""
        name, flow = f"{len(self.lines) - 1:06d}", answer.flow.astype(np.float32, copy=False)
        valid, near = np.all(np.isfinite(flow), axis=-1), near_events(answer.events)
        if self.at_events:
            valid &= near
        write_flow_png(self._folder / f"{name}.png", flow, valid)
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
        window, near = answer.pair.new, near_events(answer.events)
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
