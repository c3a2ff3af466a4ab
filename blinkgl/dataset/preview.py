"""Feeds the preview while events are being made."""

from __future__ import annotations

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.clock import StageClock
from blinkgl.events import Events
from blinkgl.io.preview import PreviewWriter
from blinkgl.io.sequence_dir import SequenceWriter
from blinkgl.render.renderer import Renderer


class PreviewRecorder:
    """Context manager; does nothing when the configuration wants no preview. The flow panel shows the instantaneous
    velocity times the label interval, which is what the flow labels look like for small motions."""

    def __init__(self, config: SequenceConfig, renderer: Renderer, writer: SequenceWriter, clock: StageClock):
        self._renderer, self._clock = renderer, clock
        self._interval_s = np.float32(config.time.interval_ns * 1e-9)
        self._video: PreviewWriter | None = None
        if config.preview.enabled:
            self._video = PreviewWriter(
                writer.path("preview.mp4"), renderer.height, renderer.width, t0_us=config.time.t0_ns // 1000,
                rate_hz=config.preview.rate, fps=config.preview.rate / config.preview.slowdown)

    def add_events(self, events: Events) -> None:
        """Every chunk, in order."""
        if self._video is not None:
            with self._clock("preview"):
                self._video.add_events(events)

    def due(self, t_ns: int) -> bool:
        return self._video is not None and self._video.due(t_ns // 1000)

    def frame(self, t_ns: int) -> None:
        """The picture at t_ns: colour and flow are drawn for it."""
        colour = self._renderer.colour(t_ns, antialiasing="none").read()
        velocity = self._renderer.velocity(t_ns).read()
        with self._clock("preview"):
            self._video.set_flow(velocity * self._interval_s)
            self._video.frame(t_ns // 1000, colour)

    def __enter__(self) -> PreviewRecorder:
        return self

    def __exit__(self, kind, *_) -> None:
        if self._video is not None:
            with self._clock("preview"):
                self._video.close() if kind is None else self._video.abort()
