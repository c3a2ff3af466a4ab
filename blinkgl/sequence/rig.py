"""Several sensors on one rig: their sequences, merged by time.

    with simulate_rig(config, index, gl) as rig:
        for member, item in rig:
            member.sensor.folder, item

Each camera is a :class:`~blinkgl.sequence.rendered.RenderedSequence` of its own, which sees the scene from its place;
they share the scene, OpenGL, meshes, textures, shadow maps and the times of frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from operator import itemgetter
from pathlib import Path
from typing import Any

from blinkgl.config.sequence import SequenceConfig
from blinkgl.gl import GLContext, create_context
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, generator
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.sequence.clock import StageClock
from blinkgl.sequence.inertial import Inertial, measured
from blinkgl.sequence.items import Item
from blinkgl.sequence.rendered import RenderedSequence
from blinkgl.timeline import together


def simulate_rig(
    config: SequenceConfig,
    index: int = 0,
    gl: GLContext | None = None,
    *,
    base: Path = Path("."),
    pictures_hz: float | None = None,
    scene: Scene | None = None,
) -> RigSequence:
    """Sequence ``index`` of a run whose configuration has ``sensors``; arguments as of
    :func:`~blinkgl.sequence.simulate.simulate_sequence`. Raises BlinkGLError."""
    return RigSequence(config, index, gl, base=base, pictures_hz=pictures_hz, scene=scene)


class RigSequence:
    """Iterate over it once: (member, what happens there), in time order; of what happens at one time that of the first
    sensor comes first. It holds OpenGL until its end, or that of its ``with`` block.

    config : of the rig.   members : of its cameras, in their order; ``member.sensor.folder`` is the sensor's name.
    scene : with all sensors.   clock : wall seconds per stage, but those of the members."""

    def __init__(
        self,
        config: SequenceConfig,
        index: int,
        gl: GLContext | None,
        *,
        base: Path,
        pictures_hz: float | None,
        scene: Scene | None = None,
    ):
        self.config, self.index, self.clock, self.pictures_hz = config, index, StageClock(), pictures_hz
        with self.clock("scene"):
            self.scene = scene or sequence_scene(config, index, base)
        self.t0_ns, self.t1_ns = self.scene.t0_ns, self.scene.t1_ns
        self.members: list[RenderedSequence] = []
        with ExitStack() as stack:
            renderers: list[Renderer] = []
            for k, one in enumerate(config.sensors or ()):
                if not one.sees:
                    continue
                gl = gl or stack.enter_context(create_context(config.gl.backend, config.gl.device))
                beside = renderers[0] if renderers else None
                renderers.append(stack.enter_context(Renderer(gl, self.scene.seen_by(k), config.render, beside=beside)))
                self.members.append(
                    RenderedSequence(
                        config.of_sensor(k),
                        index,
                        gl,
                        base=base,
                        events=one.events is not None,
                        labels=True,
                        # of a camera without events at the frames of nobody: it has none
                        pictures_hz=pictures_hz if one.events is not None else None,
                        scene=self.scene.seen_by(k),
                        renderer=renderers[-1],
                        window_ns=None,
                        number=k,
                    )
                )
            timed = [member for member in self.members if member.timeline is not None]
            shared = together([member.timeline for member in timed if member.timeline is not None])
            for member, timeline in zip(timed, shared, strict=True):
                member.timeline = timeline
            self._stack = stack.pop_all()

    def __enter__(self) -> RigSequence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Lets go of OpenGL. Harmless when repeated."""
        self._stack.close()

    def __iter__(self) -> Iterator[tuple[RenderedSequence, Item]]:
        with self:
            waiting = [(iter(member), member) for member in self.members]
            heads = [next(items, None) for items, _ in waiting]
            while there := [(head.t_ns, k, head) for k, head in enumerate(heads) if head is not None]:
                _, k, head = min(there, key=itemgetter(0, 1))
                yield waiting[k][1], head
                heads[k] = next(waiting[k][0], None)

    def inertial_units(self) -> Iterator[tuple[str, Any, Inertial]]:
        """(name, configuration, what it measured) of the sensors that are inertial units and nothing else; those of
        cameras are ``member.imu()``. Raises ConfigError where the rig's velocity jumps."""
        for k, one in enumerate(self.config.sensors or ()):
            if one.imu is not None and not one.sees:
                path = self.scene.rig.path_of(self.scene.sensors[k])
                rng = generator(self.config.seed, self.index, Role.IMU, k)
                yield one.name, one.imu, measured(path, one.imu, self.t0_ns, self.t1_ns, rng)

    # ---- what a report counts, of all members together -----------------------------------------------------------

    @property
    def frames(self) -> int:
        return sum(member.frames for member in self.members)

    @property
    def events(self) -> int:
        return sum(member.events for member in self.members)

    @property
    def labels(self) -> int:
        return sum(member.labels for member in self.members)

    @property
    def triangles(self) -> int:
        return max((member.triangles for member in self.members), default=0)

    @property
    def causes(self) -> dict[str, int]:
        return _summed(member.causes for member in self.members)

    @property
    def seconds(self) -> dict[str, float]:
        return _summed([self.clock.seconds, *(member.seconds for member in self.members)])

    @property
    def achieved(self) -> dict[str, Any]:
        """Of the first camera's timeline: all have the same times."""
        return self.members[0].achieved if self.members else {}

    @property
    def omissions(self) -> tuple[str, ...]:
        return self.scene.omissions

    @property
    def libraries(self) -> Mapping[str, str]:
        return self.members[0].libraries if self.members else {}


def _summed(tables: Any) -> dict[str, Any]:
    total: dict[str, Any] = {}
    for table in tables:
        for key, value in table.items():
            total[key] = total.get(key, 0) + value
    return total
