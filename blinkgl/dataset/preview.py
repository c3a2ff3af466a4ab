"""Feeds the preview while a sequence happens."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from blinkgl.config.sequence import PreviewConfig
from blinkgl.io.overlays import Curves, TrackLines
from blinkgl.labels import LABELS, Label
from blinkgl.sequence import EventChunk, Item, Picture, Simulation
from blinkgl.sequence.inertial import Inertial
from blinkgl.sequence_files.preview import Panels, RigPreviewWriter
from blinkgl.sequence_files.sequence_dir import SequenceWriter


class PreviewRecorder:
    """Context manager; does nothing where no sequence gives pictures. The flow panel shows the instantaneous
    velocity times the label interval, which is what the flow labels look like for small
    motions; recorded frames have none. Boxes and point tracks, where they are asked for in the sensor's own pixels, are
    drawn over the frame, and the curves of an inertial unit below.

    sequences : of one camera, or of those of a rig, shown one below the other by their names.
    unit : an inertial unit of the rig, whose curves stand below the last camera without one of its own."""

    def __init__(
        self,
        config: PreviewConfig,
        sequences: Sequence[Simulation],
        writer: SequenceWriter,
        unit: Inertial | None = None,
    ):
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
                tracks=_lines(one),
                curves=_curves(one, unit if one is shown[-1] else None),
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
                over = [partial(_drawn_over, LABELS[name], value) for name, value in item.over.items()]
                self._video.frame(number, item.t_ns // 1000, item.image, over)

    def __enter__(self) -> PreviewRecorder:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if self._video is not None:
            with self._clock("preview"):
                self._video.close() if kind is None else self._video.abort()


def _lines(sequence: Simulation) -> TrackLines | None:
    """The sequence's tracks as they are drawn; None where there are none in the sensor's pixels."""
    with sequence.clock("tracks"):
        tracks = None if sequence.rectifies else sequence.tracks()
    if tracks is None or not len(tracks.instance):
        return None
    size = np.array([sequence.width, sequence.height])
    return TrackLines(tracks.t_us, tracks.target_points, tracks.occluded, tracks.instance, size)


def _curves(sequence: Simulation, other: Inertial | None) -> Callable[[int, int], Curves] | None:
    """What draws the sequence's inertial unit, or the other one; None where there is none."""
    unit = sequence.imu() or other
    if unit is None or not len(unit.t_ns):
        return None
    span = sequence.t0_ns // 1000, sequence.t1_ns // 1000
    return partial(Curves, unit.t_ns // 1000, unit.rate, unit.acceleration, span)


def _drawn_over(label: Label, value: Any, picture: np.ndarray) -> np.ndarray:
    over = label.drawn_on(picture, value)
    return picture if over is None else over
