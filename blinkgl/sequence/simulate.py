"""``simulate_sequence``: the items of a sequence in the order of time. Writing them is one of several uses.

    with simulate_sequence(SequenceRequest(config, index), gl) as sequence:
        for item in sequence:
            match item:
                case EventChunk(t_ns, events): ...
                case GroundTruth(): ...
                case CameraImage(): ...

A single camera is a rig of one, without a name. Each camera is a :class:`~blinkgl.sequence.sensor.SensorSimulation`,
which sees the scene from its pose; they share the scene, OpenGL, meshes, textures, shadow maps and the times of frames.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import replace
from operator import itemgetter
from typing import Any

from blinkgl.errors import ConfigError
from blinkgl.gl import GLContext, create_context
from blinkgl.machine.closing import Closing
from blinkgl.render.renderer import Renderer
from blinkgl.rng import Role, generator
from blinkgl.scene.build import sequence_scene
from blinkgl.scene.types import Scene
from blinkgl.sequence.inertial import Inertial, measured
from blinkgl.sequence.recorded import RecordedSequence
from blinkgl.sequence.rendered import RenderedSequence
from blinkgl.sequence.request import Item, SequenceRequest, StageClock
from blinkgl.sequence.sensor import SensorSimulation
from blinkgl.timeline import together
from blinkgl.types.trees import Tree


def simulate_sequence(request: SequenceRequest, gl: GLContext | None = None) -> Simulation:
    """Return a sequence with all its cameras, one or several, ready for iteration.

    gl : context to draw with; None: a new one, where something is drawn.
    Raises BlinkGLError for every error of the user or the machine, here or while iterating."""
    clock, config = StageClock(), request.config
    with ExitStack() as stack:
        if config.frames is not None:
            return Simulation(request, clock, [RecordedSequence(request)], None, stack.pop_all())
        scene = request.scene or (None if request.renderer is None else request.renderer.scene)
        if scene is None:
            with clock("scene"):
                scene = sequence_scene(config, request.index, request.base)
        members = list(_rendered(request, scene, gl, stack))
        timed = [member for member in members if member.timeline is not None]
        shared = together([member.timeline for member in timed if member.timeline is not None])
        for member, timeline in zip(timed, shared, strict=True):
            member.timeline = timeline
        return Simulation(request, clock, members, scene, stack.pop_all())


def _rendered(
    request: SequenceRequest, scene: Scene, gl: GLContext | None, stack: ExitStack
) -> Iterator[SensorSimulation]:
    """Yield the cameras, which share the resources of the first one's renderer; ``stack`` releases them."""
    settings, first = request.config.gl, None
    for camera in request.config.cameras():
        seen, renderer = scene, request.renderer
        if renderer is None:
            gl = gl or stack.enter_context(create_context(settings.backend, settings.device))
            seen = scene.seen_by(camera.number)
            renderer = stack.enter_context(Renderer(gl, seen, camera.config.render, beside=first))
            first = first or renderer
        yield RenderedSequence(request, camera, seen, renderer)


class Simulation(Closing):
    """A sequence of one camera or several. Iterate over it once: its items, in time order, each with the name of its
    ``sensor``; items of one time are in the order of the sensors. It holds OpenGL until its end, however the loop ends,
    or that of its ``with`` block.

    config : every value as drawn.   index : number of the sequence.   members : its cameras, in their order; what else
    is said of one camera (``height``, ``width``, ``imu()``, ``tracks()``, …) is the first one's.
    scene : with all sensors; None for recorded frames.   t0_ns, t1_ns : first and last time, ns.
    clock : wall seconds per stage, without those of the members.
    frames, events, labels : numbers so far.   triangles : of everything drawn; 0 for recorded frames.
    notes : what was guessed, left out or not drawn of the files so far, a line each.   causes : numbers of events so
    far by cause; empty unless ``events.causes`` is on.   seconds : wall seconds per stage so far.
    libraries : versions of those that affect this sequence but not every one."""

    in_pairs = False
    """Whether its items come as (member, item): those of ``blinkgl.simulate_rig`` do, for one release."""

    def __init__(
        self,
        request: SequenceRequest,
        clock: StageClock,
        members: list[SensorSimulation],
        scene: Scene | None,
        stack: ExitStack,
    ):
        self.config = request.config if request.config.sensors is not None else members[0].config
        self.index, self.clock, self.members, self.scene, self._stack = request.index, clock, members, scene, stack
        spans = [(member.t0_ns, member.t1_ns) for member in members]
        self.t0_ns, self.t1_ns = spans[0] if spans else (self.config.time.t0_ns, self.config.time.t1_ns)

    def __getattr__(self, name: str) -> Any:
        # Private names are Python's own questions, such as those of copy and pickle, and no camera's to answer.
        if name.startswith("_") or not self.members:
            raise AttributeError(f"'{type(self).__name__}' has no attribute '{name}'")
        return getattr(self.members[0], name)

    def close(self) -> None:
        """Release OpenGL. May be called repeatedly."""
        self._stack.close()

    @property
    def alone(self) -> SensorSimulation:
        """Return the only camera. Raises ConfigError: there are several sensors."""
        if self.config.sensors is not None:
            raise ConfigError(
                "several sensors are simulated together, not as one camera",
                where="sensors",
                value=[one.name for one in self.config.sensors],
                accepted="a configuration of a single camera",
            )
        return self.members[0]

    def __iter__(self) -> Iterator[Any]:
        for member, item in self.by_sensor():
            named = replace(item, sensor=member.name) if member.name else item
            yield (member, named) if self.in_pairs else named

    def by_sensor(self) -> Iterator[tuple[SensorSimulation, Item]]:
        """Yield (member, item) in the same order."""
        with self:
            waiting = [iter(member) for member in self.members]
            heads = [next(items, None) for items in waiting]
            while there := [(head.t_ns, k, head) for k, head in enumerate(heads) if head is not None]:
                # Never by the items themselves, which have no order.
                _, k, head = min(there, key=itemgetter(0, 1))
                yield self.members[k], head
                heads[k] = next(waiting[k], None)

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
        # All draw the same scene: a sum would count it once for each camera.
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


def _summed(tables: Any) -> Tree:
    total: Counter[str] = Counter()
    for table in tables:
        total.update(table)
    return dict(total)
