"""Feeds the preview while a sequence happens."""

from __future__ import annotations

import numpy as np

from blinkgl.config.sequence import PreviewConfig
from blinkgl.events import Events
from blinkgl.io.preview import PreviewWriter
from blinkgl.io.sequence_dir import SequenceWriter
from blinkgl.sequence import Picture, Simulation


class PreviewRecorder:
    """Context manager; does nothing where the sequence gives no pictures. The flow panel shows the instantaneous
    velocity times the label interval, which is what the flow labels look like for small
    motions; recorded frames have none."""

    def __init__(self, config: PreviewConfig, sequence: Simulation, writer: SequenceWriter):
        self._clock, rate = sequence.clock, sequence.pictures_hz
        self._interval_s = np.float32(sequence.config.time.interval_ns * 1e-9)
        self._video: PreviewWriter | None = None
        if rate is not None:
            self._video = PreviewWriter(
                writer.path("preview.mp4"),
                sequence.height,
                sequence.width,
                t0_us=sequence.t0_ns // 1000,
                flow=sequence.config.frames is None,
                rate_hz=rate,
                fps=rate / config.slowdown,
            )

    def add_events(self, events: Events) -> None:
        """Every chunk, in order."""
        if self._video is not None:
            with self._clock("preview"):
                self._video.add_events(events)

    def show(self, picture: Picture) -> None:
        """Every picture, after the events up to then."""
        if self._video is None:
            return
        with self._clock("preview"):
            if picture.velocity is not None:
                self._video.set_flow(picture.velocity * self._interval_s)
            self._video.frame(picture.t_ns // 1000, picture.image)

    def __enter__(self) -> PreviewRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._video is not None:
            with self._clock("preview"):
                self._video.close() if kind is None else self._video.abort()
