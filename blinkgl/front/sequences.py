"""A sequence as it happens, and one held in memory."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.runs import (
    MAX_INDEX,
    Settings,
    Source,
    configured,
    requested,
)
from blinkgl.labels import Flow, LabelFrame
from blinkgl.render.tracks import Tracks
from blinkgl.sequence import CameraImage, EventChunk, GroundTruth, Item, Simulation, simulate as core
from blinkgl.sequence.inertial import Inertial
from blinkgl.srgb import to_srgb8
from blinkgl.types.events import Events

if TYPE_CHECKING:
    from typing_extensions import Unpack


@check.public
def simulate_sequence(
    source: Source,
    *,
    index: int = 0,
    events: bool = True,
    pictures_hz: float | None = None,
    **settings: Unpack[Settings],
) -> Simulation:
    """What happens in one sequence, in the order of time; nothing is written and nothing kept:

        for item in simulate_sequence(scene):
            match item:
                case EventChunk(): item.events                        # of about one frame, t in µs
                case GroundTruth(): item.frame.forward.flow           # (H, W, 2) float32 px
                case CameraImage(): item.image                        # of `images:`, codes

    All events before a label's time come before its :class:`GroundTruth`, and no others. OpenGL is
    held until the loop ends, however it does.

    source : :class:`Scene` or what :func:`load` gave, recorded frames (``frames:``)
    included.   index : number of the sequence.
    settings : emulator, sensor, timeline, quality, labels, images, imu, tracks as of :func:`record`; what ``labels``
    does not name is not drawn; ``imu()`` and ``tracks()`` of the iterator give the last two.
    events : False leaves them out.
    pictures_hz : gives a :class:`Picture` so many times per second of simulated time, at event frames.
    The iterator has ``config``, ``height``, ``width``, ``t0_ns``, ``t1_ns``, and counts ``frames``, ``events``,
    ``labels``. Iterate over it once, or use it in ``with`` where it may never be. Raises ConfigError, AssetError,
    GLError and, as it goes, EventDataError."""
    config = _configured(source, index, settings)
    check.one_of(events, "events", bool, "True or False")
    if pictures_hz is not None:
        pictures_hz = check.number(pictures_hz, "pictures_hz", above=0, most=1e4)
    return core.simulate_sequence(requested(source, config, index, events=events, pictures_hz=pictures_hz))


def _configured(source: Source, index: int, settings: Settings) -> SequenceConfig:
    return configured(source, **settings).sequence(check.whole(index, "index", 0, MAX_INDEX))


@dataclass(frozen=True, eq=False)
class Recording:
    """A sequence in memory.

    events : all of them, t in µs on the scene's clock.   t_us : (K,) int64, times of the labels.
    labels : K times :class:`LabelFrame`; what was not asked for is None in it.
    images : (K + 1, H, W, 3) uint8 sRGB at ``image_t_us`` (K + 1,) int64 (recorded ones as they are), or None.
    config : every value as drawn.   frames : how many the emulator saw.
    lost : events that its limit and the read-out swallowed.
    camera : :class:`CameraImage` of the frame camera, where ``images:`` asks for one.
    imu : what an inertial unit measured, :class:`~blinkgl.sequence.inertial.Inertial`; None: there is none.
    tracks : points followed, :class:`~blinkgl.render.tracks.Tracks`; None: nobody asked."""

    events: Events
    t_us: np.ndarray
    labels: tuple[LabelFrame, ...]
    image_t_us: np.ndarray
    images: np.ndarray | None
    config: SequenceConfig = field(repr=False)
    frames: int
    lost: int
    camera: tuple[CameraImage, ...] = ()
    imu: Inertial | None = None
    tracks: Tracks | None = None

    @property
    def flow(self) -> np.ndarray:
        """(K, H, W, 2) float32 px, +x right, +y down, from each label's time to the next; 0
        where :attr:`valid` is False."""
        return np.stack([flow.flow for flow in self._forward()])

    @property
    def valid(self) -> np.ndarray:
        """(K, H, W) bool."""
        return np.stack([flow.valid for flow in self._forward()])

    def window(self, k: int) -> Events:
        """Events from label ``k``'s time until the next one's, those that flow ``k`` spans."""
        k = check.whole(k, "k", 0, len(self.t_us) - 1)
        return self.events.window(int(self.t_us[k]), int(self.image_t_us[k + 1]))

    def _forward(self) -> list[Flow]:
        flows = [label.forward for label in self.labels if label.forward is not None]
        if len(flows) < len(self.labels):
            raise ConfigError("the recording has no forward flow", where="labels", accepted="'forward' among them")
        return flows


@check.public
def record(source: Source, *, index: int = 0, **settings: Unpack[Settings]) -> Recording:
    """Events, images and ground truth of one sequence as arrays: what :func:`generate` writes, held in memory.

    source : :class:`Scene` or what :func:`load` gave.   index : number of the sequence.
    emulator : "esim", "v2e", "voltmeter", or a table with its values, ``{"emulator": "v2e", "cutoff_hz": 200}``.
    sensor : camera whose size, emulator values and read-out are taken, such as "davis346".
    timeline : :class:`Timeline`.
    quality : "fast", "balanced" (the default), "accurate" or "reference".
    labels : names of labels, such as images, forward and backward (flow), occlusion, depth
    (docs/configuration.md has all), and numbers: intervals of ``flow_intervals``, s; "events": what made each
    event, ``events.truth``; default: the source's.
    images : a frame camera: the name of a preset, "deblurring", or a table of ``images:``, ``{"exposure_us": 10000}``.
    imu : an inertial unit: the name of a preset, "adis16448", or a table of ``imu:``, ``{"rate": 400}``.
    tracks : points on surfaces, followed: "grid", "surface", or a table of ``tracks:``, ``{"points": 100}``.
    Raises ConfigError, AssetError, GLError, EventDataError."""
    config = _configured(source, index, settings)
    gathered = Gathered()
    with core.simulate_sequence(requested(source, config, index)) as sequence:
        for item in sequence:
            gathered.take(item)
        return gathered.recording(sequence)


class Gathered:
    """What has happened in one sequence so far, to become a :class:`Recording`."""

    def __init__(self) -> None:
        self._events: list[Events] = []
        self._t_us: list[int] = []
        self._labels: list[LabelFrame] = []
        self._pictures: list[np.ndarray] = []
        self._images: list[CameraImage] = []

    def take(self, item: Item) -> None:
        """Pictures for those who watch are not kept."""
        if isinstance(item, EventChunk):
            self._events.append(item.events)
        elif isinstance(item, GroundTruth):
            image = item.frame.values.pop("images", None)
            if image is not None:
                self._pictures.append(to_srgb8(image) if image.dtype.kind == "f" else image)
            self._labels.append(item.frame)
            self._t_us.append(item.t_ns // 1000)
        elif isinstance(item, CameraImage):
            self._images.append(item)

    def recording(self, sequence: Simulation) -> Recording:
        """Of the sequence that all items were of."""
        t_us = np.array(self._t_us, np.int64)
        return Recording(
            Events.concatenate(self._events),
            t_us[:-1],
            tuple(self._labels[:-1]),
            t_us,
            np.stack(self._pictures) if self._pictures else None,
            sequence.config,
            sequence.frames,
            sum(sequence.losses[:2]),
            tuple(self._images),
            sequence.imu(),
            sequence.tracks(),
        )
