"""Iteration over a sequence during its simulation, and a sequence in memory."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Unpack, cast

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.rigs import Rig
from blinkgl.front.runs import (
    MAX_INDEX,
    Settings,
    Source,
    configured,
    requested,
)
from blinkgl.labels import Flow, LabelFrame
from blinkgl.render.tracks import Tracks
from blinkgl.sequence import CameraImage, EventChunk, GroundTruth, Item, SensorSimulation, Simulation, simulate
from blinkgl.sequence.inertial import Inertial
from blinkgl.srgb import to_srgb8
from blinkgl.types.events import Events

_no_times = partial(np.zeros, 0, np.int64)


@check.public(Settings)
def simulate_sequence(
    source: Source,
    rig: Rig | str | None = None,
    *,
    index: int = 0,
    events: bool = True,
    pictures_hz: float | None = None,
    **settings: Unpack[Settings],
) -> Simulation:
    """Iterate over one sequence in the order of time; nothing is written or stored:

        for item in simulate_sequence(scene):
            match item:
                case EventChunk(): item.events                        # of about one frame, t in µs
                case GroundTruth(): item.frame.forward.flow           # (H, W, 2) float32 px
                case CameraImage(): item.image                        # of `images:`, codes

    All events before a label's time come before its :class:`GroundTruth`, and no others. Items of several sensors are
    merged by time; ``item.sensor`` is the name of theirs. OpenGL is released when the loop ends, also by an error.

    source : :class:`Scene`, whose camera's pose is the rig's, or the result of :func:`load`, recorded frames
    (``frames:``) included.
    rig : :class:`Rig`, or a preset's name; None: the source's, or its single camera.   index : number of the sequence.
    settings : emulator, sensor, timeline, quality, labels of all cameras that do not set them, and for a single camera
    images, imu, tracks, as of :func:`record`; labels not in ``labels`` are not drawn.
    events : False: no events.
    pictures_hz : number of :class:`Picture` per second of simulated time, at event frames.
    The iterator has ``config``, ``t0_ns``, ``t1_ns``, and counts ``frames``, ``events``, ``labels``. ``members`` has
    each camera's ``name``, ``height``, ``width``, ``imu()`` and ``tracks()``; those of the first are its own, too.
    ``inertial_units()`` gives the measurements of the other sensors. Iterate over it once, or use it in ``with`` if it
    may not be iterated. Raises ConfigError, AssetError, GLError and, during iteration, EventDataError."""
    config = configured(source, rig, **settings).sequence(check.whole(index, "index", 0, MAX_INDEX))
    check.one_of(events, "events", bool, "True or False")
    if pictures_hz is not None:
        pictures_hz = check.number(pictures_hz, "pictures_hz", above=0, most=1e4)
    return simulate.simulate_sequence(requested(source, config, index, events=events, pictures_hz=pictures_hz))


@dataclass(frozen=True, eq=False)
class Recording:
    """A sequence in memory, of one camera or of a rig: ``recording["left"]`` is the Recording of that camera, and what
    follows is the first camera's.

    events : all of them, t in µs on the scene's clock.   t_us : (K,) int64, times of the labels.
    labels : K times :class:`LabelFrame`; labels that were not requested are None.
    images : (K + 1, H, W, 3) uint8 sRGB at ``image_t_us`` (K + 1,) int64 (recorded ones unchanged), or None.
    config : every value as drawn.   frames : number of frames that the emulator received.
    lost : events dropped by its limit and the read-out.
    camera : :class:`CameraImage` of the frame camera, with ``images:``.
    imu : measurements of the inertial unit, :class:`~blinkgl.sequence.inertial.Inertial`; None: no unit.
    tracks : tracked points, :class:`~blinkgl.render.tracks.Tracks`; None: not requested.
    lights : of light that changes over time, as of :func:`blinkgl.io.sequence_tables.read_lights`; {}: none does.

    cameras : recordings by name; that of a frame camera without events contains none.
    units : measurements of every sensor with an inertial unit, by name; ``T_cam_imu`` leads to that sensor's axes.
    T_rig_sensor : (4, 4) float64 by name, from a sensor's axes to the rig's.
    rig_t_us : (M,) int64, the start and every label's time, the last one's end included.   T_world_rig : (M, 4, 4)
    float64, the rig's poses then, those of a single camera; of recorded frames they are unknown and M is 0.
    A single camera has the name ""."""

    config: SequenceConfig = field(repr=False)
    events: Events = field(default_factory=Events.empty)
    t_us: np.ndarray = field(default_factory=_no_times)
    labels: tuple[LabelFrame, ...] = ()
    image_t_us: np.ndarray = field(default_factory=_no_times)
    images: np.ndarray | None = None
    frames: int = 0
    lost: int = 0
    camera: tuple[CameraImage, ...] = ()
    imu: Inertial | None = None
    tracks: Tracks | None = None
    lights: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    cameras: Mapping[str, Recording] = field(default_factory=dict, repr=False)
    units: Mapping[str, Inertial] = field(default_factory=dict, repr=False)
    T_rig_sensor: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)
    rig_t_us: np.ndarray = field(default_factory=_no_times)
    T_world_rig: np.ndarray = field(default_factory=lambda: np.zeros((0, 4, 4)), repr=False)

    def __getitem__(self, name: str) -> Recording:
        if name not in self.cameras:
            raise ConfigError("no such camera on the rig", where="name", value=name, accepted=", ".join(self.cameras))
        return self.cameras[name]

    @property
    def flow(self) -> np.ndarray:
        """Flow (K, H, W, 2) float32 px, +x right, +y down, from each label's time to the next; 0
        where :attr:`valid` is False."""
        return np.stack([flow.flow for flow in self._forward()])

    @property
    def valid(self) -> np.ndarray:
        """(K, H, W) bool: where :attr:`flow` is valid."""
        return np.stack([flow.valid for flow in self._forward()])

    def window(self, k: int) -> Events:
        """Return the events from label ``k``'s time until the next one's, the time of flow ``k``."""
        k = check.whole(k, "k", 0, len(self.t_us) - 1)
        return self.events.window(int(self.t_us[k]), int(self.image_t_us[k + 1]))

    def _forward(self) -> list[Flow]:
        flows = [label.forward for label in self.labels if label.forward is not None]
        if len(flows) < len(self.labels):
            raise ConfigError("the recording has no forward flow", where="labels", accepted="'forward' among them")
        return flows


@check.public(Settings)
def record(source: Source, rig: Rig | str | None = None, *, index: int = 0, **settings: Unpack[Settings]) -> Recording:
    """Return events, images and ground truth of one sequence as arrays, as :func:`generate` writes them.

    source : :class:`Scene`, whose camera's pose is the rig's, or the result of :func:`load`.
    rig : several sensors, a :class:`Rig` or a preset's name; None: the source's, or its single camera.
    index : number of the sequence.   The rest is for all cameras that do not set it; images, imu and tracks only for a
    single camera, since a rig's sensors have their own.
    emulator : "esim", "v2e", "voltmeter", or a table with its values, ``{"emulator": "v2e", "cutoff_hz": 200}``.
    sensor : camera that gives size, emulator values and read-out, such as "davis346".
    timeline : :class:`Timeline`.
    quality : "fast", "balanced" (the default), "accurate" or "reference".
    labels : names of labels, such as images, forward and backward (flow), occlusion, depth
    (docs/configuration.md has all), and numbers: intervals of ``flow_intervals``, s; "events": the cause of each event,
    ``events.truth``; default: the source's.
    images : a frame camera: the name of a preset, "deblurring", or a table of ``images:``, ``{"exposure_us": 10000}``.
    imu : an inertial unit: the name of a preset, "adis16448", or a table of ``imu:``, ``{"rate": 400}``.
    tracks : points on surfaces: "grid", "surface", or a table of ``tracks:``, ``{"points": 100}``.
    optics, readout : tables of ``optics:`` and ``readout:``, ``{"psf": {"kind": "gaussian", "sigma": 0.8}}``.
    What limits the result, such as motion too fast for the shortest step, is a warning.
    Raises ConfigError, AssetError, GLError, EventDataError."""
    with simulate_sequence(source, rig, index=index, **settings) as sequence:
        gathered = {member.name: Gathered() for member in sequence.members}
        for member, item in sequence.by_sensor():
            gathered[member.name].take(item)
        cameras = {member.name: gathered[member.name].recording(member) for member in sequence.members}
        units = {name: one.imu for name, one in cameras.items() if one.imu is not None}
        units |= {name: measured for name, _, measured in sequence.inertial_units()}
        for line in sequence.notes:
            warnings.warn(line, stacklevel=3)
    made = replace(
        next(iter(cameras.values()), Recording(sequence.config)),
        config=sequence.config,
        cameras=cameras,
        units=units,
        T_rig_sensor={one.name: one.place.T for one in sequence.config.sensors or ()} or {"": np.eye(4)},
    )
    if sequence.scene is None:
        return made
    times = np.array([sequence.config.time.t0_ns, *sequence.config.time.label_times_ns], np.int64)
    return replace(made, rig_t_us=times // 1000, T_world_rig=sequence.scene.rig.path.poses(times))


class Gathered:
    """The items of one sequence so far, from which a :class:`Recording` is made."""

    def __init__(self) -> None:
        self._events: list[Events] = []
        self._t_us: list[int] = []
        self._labels: list[LabelFrame] = []
        self._pictures: list[np.ndarray] = []
        self._images: list[CameraImage] = []

    def take(self, item: Item) -> None:
        """Store an item; pictures for display are not stored."""
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

    def recording(self, sequence: SensorSimulation) -> Recording:
        """Return the recording of the camera of all items."""
        t_us = np.array(self._t_us, np.int64)
        return Recording(
            config=sequence.config,
            events=Events.concatenate(self._events),
            t_us=t_us[:-1],
            labels=tuple(self._labels[:-1]),
            image_t_us=t_us,
            images=np.stack(self._pictures) if self._pictures else None,
            frames=sequence.frames,
            lost=sum(sequence.losses[:2]),
            camera=tuple(self._images),
            imu=sequence.imu(),
            tracks=sequence.tracks(),
            lights=sequence.lights(),
        )


# ---------------------------------------------------------------------------------------------------------------------
# Former names; they stay for one release.

RigRecording = Recording
"""Write ``Recording``."""


def record_rig(*arguments: Any, **settings: Any) -> Recording:
    """Write ``record(source, rig)``, whose ``units`` and ``rig_t_us`` are called ``imu`` and ``t_us`` here."""
    warnings.warn("write record(source, rig) instead of record_rig", DeprecationWarning, stacklevel=2)
    made = record(*arguments, **settings)
    return replace(made, imu=cast(Any, made.units), t_us=made.rig_t_us)


def simulate_rig(*arguments: Any, **settings: Any) -> Simulation:
    """Write ``simulate_sequence(source, rig)``, whose items have a ``sensor``; here they are (member, item) pairs."""
    warnings.warn("write simulate_sequence(source, rig) instead of simulate_rig", DeprecationWarning, stacklevel=2)
    made = simulate_sequence(*arguments, **settings)
    made.in_pairs = True
    return made
