"""The sequences of the sensors on one rig, merged by time. A single camera is a rig of one.

    with simulate_rig(SequenceRequest(config, index), gl) as rig:
        for member, item in rig:
            member.name, item

Each camera is its own :class:`~blinkgl.sequence.simulate.Simulation`, which sees the scene from its pose; they share
the scene, OpenGL, meshes, textures, shadow maps and the times of frames.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from operator import itemgetter
from typing import Any

from blinkgl.config.sequence import SequenceConfig
from blinkgl.gl import GLContext, create_context
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, generator
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.sequence.factory import simulate_sequence
from blinkgl.sequence.inertial import Inertial, measured
from blinkgl.sequence.request import Item, SequenceRequest, StageClock
from blinkgl.sequence.simulate import Simulation
from blinkgl.timeline import together


def simulate_rig(request: SequenceRequest, gl: GLContext | None = None) -> RigSequence:
    """Return a sequence with all cameras of its configuration, one or several.

    gl : context to draw with; None: a new one, where something is drawn. Raises BlinkGLError."""
    clock, config, index = StageClock(), request.config, request.index
    with ExitStack() as stack:
        if config.sensors is None:
            alone = stack.enter_context(simulate_sequence(request, gl))
            return RigSequence(alone.config, index, clock, [alone], alone, stack.pop_all())
        with clock("scene"):
            scene = request.scene or sequence_scene(config, index, request.base)
        members = list(_rendered(request, scene, gl, stack))
        timed = [member for member in members if member.timeline is not None]
        shared = together([member.timeline for member in timed if member.timeline is not None])
        for member, timeline in zip(timed, shared, strict=True):
            member.timeline = timeline
        return RigSequence(config, index, clock, members, scene, stack.pop_all())


def _rendered(request: SequenceRequest, scene: Scene, gl: GLContext | None, stack: ExitStack) -> Iterator[Simulation]:
    """Yield the cameras of a rig, which share the resources of the first one's renderer; ``stack`` releases them."""
    settings, first = request.config.gl, None
    for number, _, config, gives_events in request.config.cameras():
        gl = gl or stack.enter_context(create_context(settings.backend, settings.device))
        renderer = stack.enter_context(Renderer(gl, scene.seen_by(number), config.render, beside=first))
        first = first or renderer
        own = replace(
            request,
            config=config,
            events=gives_events,
            # none for a camera without events, which has no event frames
            pictures_hz=request.pictures_hz if gives_events else None,
            scene=scene.seen_by(number),
            renderer=renderer,
            number=number,
        )
        yield simulate_sequence(own, gl)


class RigSequence:
    """A sequence of a rig. Iterate over it once: (member, item), in time order; items of one time are in the order of
    the sensors. It holds OpenGL until its end, or that of its ``with`` block.

    config : of the rig, every value as drawn.   members : of its cameras, in their order; ``member.name`` is the
    sensor's, "" of a single camera.   scene : with all sensors; None of a single camera.
    t0_ns, t1_ns : first and last time, ns.   clock : wall seconds per stage, without those of the members.
    """

    def __init__(
        self,
        config: SequenceConfig,
        index: int,
        clock: StageClock,
        members: list[Simulation],
        whole: Scene | Simulation,
        stack: ExitStack,
    ):
        self.config, self.index, self.clock, self.members = config, index, clock, members
        self.scene = whole if isinstance(whole, Scene) else None
        self.t0_ns, self.t1_ns = whole.t0_ns, whole.t1_ns
        self._stack = stack

    def __enter__(self) -> RigSequence:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Release OpenGL. May be called repeatedly."""
        self._stack.close()

    def __iter__(self) -> Iterator[tuple[Simulation, Item]]:
        with self:
            waiting = [(iter(member), member) for member in self.members]
            heads = [next(items, None) for items, _ in waiting]
            while there := [(head.t_ns, k, head) for k, head in enumerate(heads) if head is not None]:
                _, k, head = min(there, key=itemgetter(0, 1))
                yield waiting[k][1], head
                heads[k] = next(waiting[k][0], None)

    def inertial_units(self) -> Iterator[tuple[str, Any, Inertial]]:
        """Yield (name, configuration, measurements) of the sensors that are only inertial units; those of cameras are
        ``member.imu()``. Raises ConfigError where the rig's velocity jumps."""
        for k, one in enumerate(self.config.sensors or ()):
            if one.imu is not None and not one.sees and self.scene is not None:
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
    def notes(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(line for member in self.members for line in member.notes))

    @property
    def causes(self) -> dict[str, int]:
        return _summed(member.causes for member in self.members)

    @property
    def seconds(self) -> dict[str, float]:
        return _summed([self.clock.seconds, *(member.seconds for member in self.members)])

    @property
    def libraries(self) -> Mapping[str, str]:
        return self.members[0].libraries if self.members else {}


def _summed(tables: Any) -> dict[str, Any]:
    total: dict[str, Any] = {}
    for table in tables:
        for key, value in table.items():
            total[key] = total.get(key, 0) + value
    return total
