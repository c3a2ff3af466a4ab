"""Feeds the preview while a sequence happens."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from blinkgl.config.sequence import PreviewConfig
from blinkgl.sequence import EventChunk, Item, Picture, Simulation
from blinkgl.sequence_files.preview import Panels, RigPreviewWriter
from blinkgl.sequence_files.sequence_dir import SequenceWriter


class PreviewRecorder:
    """Context manager; does nothing where no sequence gives pictures. The flow panel shows the instantaneous
    velocity times the label interval, which is what the flow labels look like for small
    motions; recorded frames have none.

    sequences : of one camera, or of those of a rig, shown one below the other by their names."""

    def __init__(self, config: PreviewConfig, sequences: Sequence[Simulation], writer: SequenceWriter):
        self._shown = {id(one): k for k, one in enumerate(one for one in sequences if one.pictures_hz is not None)}
        self._video: RigPreviewWriter | None = None
        shown = [one for one in sequences if id(one) in self._shown]
        if not shown:
            return
        self._clock = shown[0].clock
        rate, time = config.rate if shown[0].pictures_hz is None else shown[0].pictures_hz, shown[0].config.time
        self._interval_s = np.float32(time.interval_ns * 1e-9)
        panels = [
            Panels(
                one.height,
                one.width,
                t0_us=one.t0_ns // 1000,
                flow=one.config.frames is None,
                rate_hz=rate,
                fps=rate / config.slowdown,
                label=one.name or "frame",
            )
            for one in shown
        ]
        self._video = RigPreviewWriter(writer.path("preview.mp4"), panels, rate / config.slowdown)

    def take(self, sequence: Simulation, item: Item) -> None:
        """All that happens in a sequence, in order."""
        if self._video is None or (number := self._shown.get(id(sequence))) is None:
            return
        if isinstance(item, EventChunk):
            with sequence.clock("preview"):
                self._video.panels[number].add_events(item.events)
        elif isinstance(item, Picture):
            with sequence.clock("preview"):
                if item.velocity is not None:
                    self._video.panels[number].set_flow(item.velocity * self._interval_s)
                self._video.frame(number, item.t_ns // 1000, item.image)

    def __enter__(self) -> PreviewRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._video is not None:
            with self._clock("preview"):
                self._video.close() if kind is None else self._video.abort()
