"""A rig's sequence as it happens, and one held in memory."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.config.sequence import SequenceConfig
from blinkgl.errors import ConfigError
from blinkgl.front import arguments as check
from blinkgl.front.rigs import Rig
from blinkgl.front.runs import MAX_INDEX, Settings, Source, configured, requested
from blinkgl.front.sequences import Gathered, Recording
from blinkgl.sequence import rig as core
from blinkgl.sequence.inertial import Inertial
from blinkgl.sequence.rig import RigSequence

if TYPE_CHECKING:
    from typing_extensions import Unpack


@check.public
def simulate_rig(
    source: Source, rig: Rig | str | None = None, *, index: int = 0, **settings: Unpack[Settings]
) -> RigSequence:
    """What happens at the sensors of one rig, in the order of time; nothing is written and nothing kept:

        for member, item in simulate_rig(scene, "stereo"):
            member.name, item                 # "left", EventChunk(…): items as of simulate_sequence

    source : :class:`Scene`, whose camera's pose is the rig's, or what :func:`load` gave.
    rig : :class:`Rig`, or a preset's name; None: the source's.   index : number of the sequence.
    settings : emulator, sensor, timeline, quality, labels of all its cameras that say nothing else, as of
    :func:`record`.
    The iterator has ``config``, ``scene``, ``t0_ns``, ``t1_ns`` and ``members``, one of each camera, as
    :func:`simulate_sequence` gives them; ``inertial_units()`` is what the other sensors measured. Iterate over it once,
    or use it in ``with``. Raises ConfigError, AssetError, GLError and, as it goes, EventDataError."""
    template = configured(source, rig, **settings)
    config = template.sequence(check.whole(index, "index", 0, MAX_INDEX))
    if config.sensors is None:
        raise ConfigError(
            "the source is of a single camera", where="rig", value=rig, accepted="a Rig, or a preset's name; or record"
        )
    return core.simulate_rig(requested(source, config, index))


@dataclass(frozen=True, eq=False)
class RigRecording:
    """A rig's sequence in memory. ``recording["left"]`` is the :class:`Recording` of that camera.

    cameras : by name; of a frame camera without events there are none in its recording.
    imu : of every sensor that has an inertial unit, by name; ``T_cam_imu`` leads to that sensor's axes.
    T_rig_sensor : (4, 4) float64 by name, from a sensor's axes to the rig's.
    t_us : (M,) int64, the start and every label's time, the last one's end included.   T_world_rig : (M, 4, 4) float64,
    where the rig was.
    config : every value as drawn."""

    cameras: Mapping[str, Recording]
    imu: Mapping[str, Inertial]
    T_rig_sensor: Mapping[str, np.ndarray]
    t_us: np.ndarray
    T_world_rig: np.ndarray
    config: SequenceConfig = field(repr=False)

    def __getitem__(self, name: str) -> Recording:
        if name not in self.cameras:
            raise ConfigError("no such camera on the rig", where="name", value=name, accepted=", ".join(self.cameras))
        return self.cameras[name]


@check.public
def record_rig(
    source: Source, rig: Rig | str | None = None, *, index: int = 0, **settings: Unpack[Settings]
) -> RigRecording:
    """What all sensors of a rig record of one sequence, as arrays: what :func:`generate` writes, held in memory.

    Arguments as of :func:`simulate_rig`. Raises ConfigError, AssetError, GLError, EventDataError."""
    with simulate_rig(source, rig, index=index, **settings) as sequence:
        gathered = {member.name: Gathered() for member in sequence.members}
        for member, item in sequence:
            gathered[member.name].take(item)
        cameras = {member.name: gathered[member.name].recording(member) for member in sequence.members}
        units = {name: one.imu for name, one in cameras.items() if one.imu is not None}
        units |= {name: measured for name, _, measured in sequence.inertial_units()}
    config, scene = sequence.config, sequence.scene
    assert scene is not None  # of a rig
    times = np.array([config.time.t0_ns, *config.time.label_times_ns], np.int64)
    return RigRecording(
        cameras,
        units,
        {one.name: one.place.T for one in config.sensors or ()},
        times // 1000,
        scene.rig.path.poses(times),
        config,
    )
