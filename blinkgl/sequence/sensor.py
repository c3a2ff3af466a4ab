"""One camera of a sequence in time: its events, labels, images and pictures.

Events come in chunks, one per frame, cut where the time of a label or of a frame camera's image lies between two
frames; ground truth comes at its time, between them, and an image when its exposure ends. So training on a window of
events and the flow over it needs to store only that window, never the whole sequence.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from types import MappingProxyType

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.config.sequence import CameraOnRig
from blinkgl.errors import ConfigError
from blinkgl.events.camera import EventCamera
from blinkgl.imaging import FrameCamera
from blinkgl.render.tracks import Tracks
from blinkgl.sequence.inertial import Inertial
from blinkgl.sequence.request import CameraImage, EventChunk, GroundTruth, Item, Picture, SequenceRequest, StageClock
from blinkgl.timeline import Ticks, Timeline
from blinkgl.types.events import Events, count_causes, named_causes


class _Due:
    """The next item besides events: labels at their times, a frame camera's images at the end of their exposure."""

    def __init__(self, labels: Iterable[tuple[int, int]], camera: FrameCamera | None):
        self._labels, self._camera = iter(labels), camera
        self._next = next(self._labels, None)

    @property
    def ns(self) -> int | None:
        """Return its time; None: there are no more."""
        times = [self._next[1]] if self._next is not None else []
        if self._camera is not None and self._camera.due_ns is not None:
            times.append(self._camera.due_ns)
        return min(times, default=None)

    def label(self) -> tuple[int, int] | None:
        """Return number and time of the next label, and mark it as done; None: the camera is next."""
        label = self._next
        # Of one time the label comes before the image.
        if label is None or label[1] != self.ns:
            return None
        self._next = next(self._labels, None)
        return label


class SensorSimulation(ABC):
    """One camera in time: iterate over it once. :class:`~blinkgl.sequence.simulate.Simulation` has all of a sequence
    and holds their OpenGL.

    name : of the sensor; "" of a single camera.
    config : every value as drawn.   index : number of the sequence.   height, width : px.
    t0_ns, t1_ns : first and last time, ns.   pictures_hz : rate of its pictures, or None.
    clock : wall seconds per stage.   camera : emulator and read-out, None when no events are requested.
    events, labels : numbers so far.   triangles : of everything drawn; 0 for recorded frames.
    frame_camera : the :class:`~blinkgl.imaging.FrameCamera` of its images; None: there is none.
    timeline : the :class:`Timeline` of event frames; None for recorded frames, and without events.
    libraries : versions of those that affect this sequence but not every one."""

    triangles = 0
    timeline: Timeline | None = None
    frame_camera: FrameCamera | None = None
    libraries: Mapping[str, str] = MappingProxyType({})

    def __init__(
        self,
        request: SequenceRequest,
        of: CameraOnRig,
        clock: StageClock,
        *,
        size: tuple[int, int],
        span_ns: tuple[int, int],
        camera: EventCamera | None,
        pictures_hz: float | None,
    ):
        self.name, self.config, self.index, self.clock, self.camera = of.name, of.config, request.index, clock, camera
        (self.height, self.width), (self.t0_ns, self.t1_ns) = size, span_ns
        self.pictures_hz, self.events, self.labels = pictures_hz, 0, 0
        self._by_cause = count_causes(Events.empty())
        self._labels, self._begun = request.labels, False

    def __iter__(self) -> Iterator[Item]:
        if self._begun:
            raise ConfigError(
                "a simulation can be iterated over only once", where="simulate_sequence", accepted="a new one"
            )
        self._begun = True
        return self._items()

    def chunks(self) -> Iterator[EventChunk]:
        """Yield only the events."""
        return (item for item in self if isinstance(item, EventChunk))

    def gather(self) -> Events:
        """Return all events at once, for cutting windows out of a short sequence. :meth:`truth` can be called
        afterwards."""
        return Events.concatenate([chunk.events for chunk in self.chunks()])

    @abstractmethod
    def truth(self, t_ns: int, span_ns: int) -> GroundTruth:
        """Return the ground truth at any time t_ns, with flow forward to t_ns + span_ns and back to t_ns - span_ns (k
        is -1). Raises ConfigError for recorded frames, whose truth is known only at their times."""

    def _items(self) -> Iterator[Item]:
        # The caller may use OpenGL between two items, as another sensor of the rig does.
        self._resume()
        for item in self._in_order():
            yield item
            self._resume()

    def _in_order(self) -> Iterator[Item]:
        due = _Due(self._label_times() if self._labels else (), self.frame_camera)
        ticks = None if self.pictures_hz is None else Ticks(self.t0_ns // 1000, self.pictures_hz)
        for t_ns, events in self._event_pass() if self.camera is not None else ():
            self.events += len(events)
            if events.cause is not None:
                self._by_cause += count_causes(events)
            # Labels and images come between the events before and after their microsecond, so a chunk is cut at each.
            while (due_ns := due.ns) is not None and due_ns <= t_ns:
                before, events = events.split(due_ns // 1000)
                yield EventChunk(due_ns, before)
                yield self._next(due)
            yield EventChunk(t_ns, events)
            if ticks is not None and ticks.passed(t_ns // 1000):
                yield self._picture(t_ns)
        # Those at or after the last frame, and all of them without events.
        while due.ns is not None:
            yield self._next(due)

    def _next(self, due: _Due) -> GroundTruth | CameraImage:
        label = due.label()
        if label is not None:
            return self._counted(*label)
        assert self.frame_camera is not None
        return self.frame_camera.take()

    def _counted(self, k: int, t_ns: int) -> GroundTruth:
        truth = self._truth(k, t_ns)
        self.labels += truth.forward_ns is not None
        return truth

    @property
    def notes(self) -> Sequence[str]:
        """Return what was guessed, left out or not drawn of the files so far, and what limits its times, a line
        each."""
        return ()

    @property
    def frames(self) -> int:
        """Return the number of frames that the emulator has taken so far."""
        return 0 if self.camera is None else self.camera.frames

    @property
    def losses(self) -> tuple[int, int, int]:
        """Return numbers of events so far that the emulator's ``max_events_per_step`` cut, that found the read-out's
        queue full, and that are still on its bus."""
        return (0, 0, 0) if self.camera is None else (self.camera.saturated, self.camera.dropped, self.camera.late)

    @property
    def records_truth(self) -> bool:
        """Return whether its events record their surfaces (``labels.events``)."""
        return self.camera is not None and self.camera.records_truth

    @property
    def causes(self) -> dict[str, int]:
        """Return numbers of events so far by cause; empty unless ``events.causes`` is on."""
        asked = self.camera is not None and self.camera.emulator.causes
        return named_causes(self._by_cause) if asked else {}

    @property
    def seconds(self) -> dict[str, float]:
        """Return wall seconds per stage so far."""
        return dict(self.clock.seconds)

    @abstractmethod
    def facts(self) -> dict[str, object]:
        """Return plain values for the manifest about its source; complete when the iteration is."""

    @abstractmethod
    def poses(self) -> dict[str, np.ndarray]:
        """Return the content of poses.npz; empty where poses are unknown."""

    def exposure_poses(self) -> dict[str, np.ndarray]:
        """Return the arrays of :func:`blinkgl.io.sequence_tables.read_exposure_poses`; {}: there is no frame camera."""
        return {}

    @property
    def lens(self) -> CameraModel | None:
        """Return the camera if it has distortion."""
        return None

    def imu(self) -> Inertial | None:
        """Return the measurements of the inertial unit of ``imu:``; None: there is none. Raises ConfigError where the
        camera's velocity jumps."""
        return None

    def tracks(self) -> Tracks | None:
        """Return the points of ``tracks:``; None: not requested."""
        return None

    def lights(self) -> dict[str, np.ndarray]:
        """Return the arrays of :func:`blinkgl.io.sequence_tables.read_lights`; {}: no light changes over time."""
        return {}

    @abstractmethod
    def _resume(self) -> None:
        """Called before drawing again: the caller may have used OpenGL meanwhile."""

    @abstractmethod
    def _label_times(self) -> Iterable[tuple[int, int]]:
        """Yield number and time, ns, of every label."""

    @abstractmethod
    def _event_pass(self) -> Iterator[tuple[int, Events]]:
        """Yield the time of every frame of the event pass, ns, and the events up to it."""

    @abstractmethod
    def _truth(self, k: int, t_ns: int) -> GroundTruth:
        """Return the ground truth of a label, by its number and time."""

    @abstractmethod
    def _picture(self, t_ns: int) -> Picture:
        """Return the picture at a frame of the event pass."""
