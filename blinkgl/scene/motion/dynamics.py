"""Rigid-body simulation of falling, bouncing and thrown objects by MuJoCo: from a scene's objects to paths, before
drawing.

    objects, dynamics = simulate(objects, {"die": BodyConfig(velocity=(1, 0, 2))}, PhysicsConfig(), t0_ns, t1_ns)

Objects that are not named keep their motion: fixed where they stand still; where they move, they push others and
nothing stops them.

**Steps.** The engine is MuJoCo's semi-implicit Euler with implicit Coriolis forces, ``rate`` steps per second (20,000,
where 1,000 are usual). Such a method is a leapfrog: its velocities are those of the middle of the steps. Started half a
step of gravity back, its positions are exactly the parabola's, and the mean of two of its velocities is the velocity at
the time between them. Both are used for the path.

**Restitution.** MuJoCo's contacts are soft: a spring with a damper, ``solref = (-stiffness, -damping)``, per mass. A
body leaves a contact after about half a period of the spring, ``IMPACT_S``, with a share e of its speed that depends
only on the damping ratio. The ratio for a given e is found with the engine's own recurrence, averaged over all phases
in which a step can meet the surface (body_shapes.py). The phase remains as an error: at the default rate e varies by
+-0.015 where it is 0.3, by +-0.006 where it is 0.8, and by less with more steps.

**Paths.** A path keeps only the steps that a cubic needs to pass all others within 2e-6 of the body's radius
(``piecewise.thin``): few in flight, every one or two in an impact. So the velocity jumps within the 1.6 ms of the
contact, nothing overshoots, and memory does not grow with the rate. A body at rest is asleep: its pose is bitwise
constant.

**Reproducibility.** MuJoCo is deterministic for one build on one machine, on one thread, which is all that is used
here. :class:`~blinkgl.scene.types.Dynamics` records its version and a digest of all paths.
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import ModuleType

import numpy as np
from scipy.spatial.transform import Rotation

from blinkgl.config.physics import IN_THE_WAY, BodyConfig, PhysicsConfig
from blinkgl.errors import ConfigError
from blinkgl.machine.extras import install
from blinkgl.scene.motion.body_shapes import Barrier, Shape, damping_ratio, plane_of, quaternions, shapes_of
from blinkgl.scene.motion.paths import HermitePath, StaticPath
from blinkgl.scene.motion.piecewise import thin
from blinkgl.scene.motion.pose_path import PosePath
from blinkgl.scene.types import Dynamics, SceneObject
from blinkgl.types.poses import pose_of

IMPACT_S = 1.6e-3
"""Duration of an impact, s: longer is softer. At a low rate it lasts ``LEAST_STEPS`` steps, which is longer."""
LEAST_STEPS = 16
# Steps are checked and thinned in pieces of this many.
_CHUNK = 1000  # steps between two checks
_TOLERANCE = 2e-6  # of the radius, and rad: largest distance of a path from a step
_SINK = 1e-4  # of the smaller radius: largest overlap of two bodies at the start
_LIFT, _LIFTS = 0.01, 50  # of the same: largest overlap that is removed by lifting, and number of iterations
_IMPEDANCE = 0.9999  # MuJoCo's maximum: 1 would be a contact that follows its spring exactly
_HULL_VERTICES = 500
_SLOW_S = 5e-4  # slow means less than gravity's change of speed in this time, s
_HEAVY = 1e4  # mass of unstoppable bodies relative to the heaviest body


class Exploded(ConfigError):
    """The simulation diverged. body : name of the body without a finite position, or too fast."""

    body = ""


def engine() -> ModuleType:
    """Return MuJoCo. Raises ConfigError with the command that installs it."""
    # It would load an OpenGL library for its own pictures.
    wanted = os.environ.get("MUJOCO_GL")
    os.environ["MUJOCO_GL"] = "disable"
    try:
        import mujoco
    except ImportError:
        raise ConfigError(
            "physics needs MuJoCo, which is not installed", where="scene.physics", accepted=f"run {install('mujoco')}"
        ) from None
    finally:
        if wanted is None:
            del os.environ["MUJOCO_GL"]
        else:
            os.environ["MUJOCO_GL"] = wanted
    # Its own handler writes a file into the working folder; the checks here replace it.
    mujoco.set_mju_user_warning(lambda message: None)  # type: ignore[missing-attribute]
    return mujoco


def engine_version() -> str:
    """Return the version of the installed engine. Raises ConfigError where there is none."""
    return engine().__version__


def simulate(
    objects: Sequence[SceneObject],
    bodies: Mapping[str, BodyConfig],
    settings: PhysicsConfig,
    t0_ns: int,
    t1_ns: int,
    *,
    camera: tuple[PosePath, float] | None = None,
    sides: Sequence[Barrier] = (),
) -> tuple[tuple[SceneObject, ...], Dynamics]:
    """Return the objects, dynamic ones on their simulated paths over [t0, t1], and a record of the simulation.

    bodies : by name of the object. Objects without an entry: ``IN_THE_WAY``; sky: ignored.
    camera : its path and the radius of the sphere around it that nothing enters.   sides : invisible barriers. Raises
    ConfigError: no MuJoCo, bodies inside each other at t0, a simulation that diverges."""
    return _World(engine(), objects, bodies, settings, camera, sides, int(t0_ns), int(t1_ns)).run()


@dataclass(eq=False)
class _Body:
    """One object (or the camera) in the engine. role : dynamic, fixed or pusher.   centre : (3,) of mass, in the
    object's axes.
    volume : of its shapes, 0 until known.   at : index among the moving bodies, -1: none."""

    name: str
    role: str
    config: BodyConfig
    path: PosePath
    shapes: list[Shape]
    radius: float
    centre: np.ndarray = field(default_factory=lambda: np.zeros(3))
    volume: float = 0.0
    at: int = -1

    @property
    def mass(self) -> float:
        return self.config.mass or self.config.density * self.volume


class _World:
    """A model, its state, and the resulting paths."""

    def __init__(self, mujoco, objects, bodies, settings, camera, sides, t0_ns, t1_ns):
        self.mujoco, self.objects, self.settings, self.sides = mujoco, tuple(objects), settings, sides
        self.t0_ns, self.t1_ns, self.step = t0_ns, t1_ns, 1.0 / settings.rate
        # At a low rate the impact is stretched, so that it has enough steps.
        self.impact_steps = max(IMPACT_S * settings.rate, LEAST_STEPS)
        self.bodies: list[_Body] = []
        # Disabled objects, those without faces, and the sky do not collide.
        for obj in self.objects:
            config = bodies.get(obj.name, IN_THE_WAY)
            if obj.category == "sky" or config.kind == "none" or not any(len(p.mesh.faces) for p in obj.parts):
                continue
            role = "dynamic" if config.kind == "dynamic" else "fixed" if obj.path.is_static else "pusher"
            self.bodies.append(_Body(obj.name, role, config, obj.path, shapes_of(obj, config), obj.radius))
        if camera is not None:
            path, radius = camera
            role = "fixed" if path.is_static else "pusher"
            self.bodies.append(_Body("the camera", role, IN_THE_WAY, path, [Shape("SPHERE", (radius, 0, 0))], radius))
        # Moving bodies have a free joint and entries in qpos and qvel; fixed ones belong to the world.
        self.moving = [body for body in self.bodies if body.role != "fixed"]
        for at, body in enumerate(self.moving):
            body.at = at
        self.dynamic = [body for body in self.moving if body.role == "dynamic"]
        self.pushers = [body for body in self.moving if body.role == "pusher"]
        self._side = _Body("the region's side", "fixed", IN_THE_WAY, StaticPath(), [], math.inf)
        self._compile()
        self.records = {body.name: _Record(body, self.step, self.impact_steps) for body in self.dynamic}

    # ---- the model ---------------------------------------------------------------------------------------------------

    def _compile(self) -> None:
        """Compile the model twice: with any density, to get volumes and centres of mass; then with those as the bodies'
        origins, so that a body in flight follows a parabola."""
        model = self._model(weighed=False)
        for body in self.moving:
            # Body 0 of the model is the world.
            at = body.at + 1
            # The first model has the density radius^-5, so that its masses are of moderate size.
            body.centre, body.volume = model.body_ipos[at].copy(), float(model.body_mass[at]) * body.radius**5
        self.model = self._model(weighed=True)
        self.data = self.mujoco.MjData(self.model)

    def _model(self, weighed: bool):
        mujoco = self.mujoco
        spec = mujoco.MjSpec()
        option = spec.option
        option.timestep, option.gravity = self.step, list(self.settings.gravity)
        # An elliptic friction cone: Coulomb's law itself, not its pyramid approximation.
        option.integrator, option.cone = mujoco.mjtIntegrator.mjINT_IMPLICIT, mujoco.mjtCone.mjCONE_ELLIPTIC
        # Friction is stiffer than contact, so that bodies at rest on a slope do not creep.
        option.impratio = 10.0
        option.sleep_tolerance = _SLOW_S * float(np.linalg.norm(self.settings.gravity))
        option.enableflags |= int(mujoco.mjtEnableBit.mjENBL_SLEEP)
        # Without the automatic reset a divergence is visible in the state, see _check_sound.
        option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        heaviest = max((body.mass for body in self.dynamic), default=1.0)
        # MuJoCo has a minimum inertia of 1e-15 kg m², a ball of a millimetre; below it, in another unit of mass,
        # nothing moves.
        least = min((body.mass * body.radius**2 for body in self.dynamic), default=1.0)
        unit = max(1.0, 1e-9 / least) if weighed else 1.0
        for k, side in enumerate(self.sides):
            self._geometry(spec, spec.worldbody, f"side {k}", plane_of(side), IN_THE_WAY, 0.0, False, 1.0)
        for number, body in enumerate(self.bodies):
            T = body.path.pose(self.t0_ns)
            holder, density = spec.worldbody, body.radius**-5
            # A free joint for all moving bodies; pushers are weightless, and their pose is set at every step.
            if body.role != "fixed":
                holder = spec.worldbody.add_body(
                    pos=T[:3, :3] @ body.centre + T[:3, 3],
                    quat=quaternions(T[None, :3, :3])[0],
                    sleep=mujoco.mjtSleepPolicy.mjSLEEP_NEVER,
                    gravcomp=float(body.role == "pusher"),
                )
                holder.add_freejoint()
                if weighed:
                    density = unit * (_HEAVY * heaviest if body.role == "pusher" else body.mass) / body.volume
            # A moving body's origin is its centre of mass.
            frame = T if body.role == "fixed" else pose_of(-body.centre)
            for k, shape in enumerate(body.shapes):
                name, dynamic = f"{number} {k}", body.role == "dynamic"
                self._geometry(spec, holder, name, shape.moved(frame), body.config, body.radius, dynamic, density)
        try:
            return spec.compile()
        except ValueError as error:
            raise ConfigError(
                f"MuJoCo cannot use the scene's bodies: {' '.join(str(error).split())}", where="scene.physics"
            ) from None

    def _geometry(self, spec, holder, name, shape, config: BodyConfig, radius, dynamic, density) -> None:
        # The contact's spring: half a period lasts impact_steps steps.
        frequency = math.pi / (self.impact_steps * self.step)
        rolling = config.rolling * radius
        mesh = {}
        if shape.vertices is not None:
            spec.add_mesh(name=name, uservert=shape.vertices.ravel(), maxhullvert=_HULL_VERTICES)
            mesh = {"meshname": name}
        holder.add_geom(
            name=name,
            type=getattr(self.mujoco.mjtGeom, f"mjGEOM_{shape.kind}"),
            size=shape.size,
            pos=shape.position,
            quat=shape.quaternion,
            density=density,
            # solref below 0 is -stiffness, -damping, per unit of mass: w^2 and 2 zeta w.
            solref=[-(frequency**2), -2.0 * damping_ratio(config.restitution, self.impact_steps) * frequency],
            # The impedance at the surface and at depth: equal, so that the width, middle and power have no effect.
            solimp=[_IMPEDANCE, _IMPEDANCE, 1e-3, 0.5, 2.0],
            friction=[config.friction, rolling, rolling],
            # Forces along the normal, and against sliding, spinning and rolling, the three numbers of ``friction``.
            condim=6,
            # Dynamic bodies collide with all; the others do not collide with each other. Bit masks: geometries collide
            # where one's contype and the other's conaffinity share a bit.
            contype=1 if dynamic else 2,
            conaffinity=3 if dynamic else 0,
            **mesh,
        )

    # ---- the run -----------------------------------------------------------------------------------------------------

    def run(self) -> tuple[tuple[SceneObject, ...], Dynamics]:
        """Run :func:`simulate`. Steps are one ahead of the stored poses: the velocity at a pose is the mean of the
        velocities before and after it."""
        model, data = self.model, self.data
        # Steps up to t1; a rounding error adds none.
        count = math.ceil((self.t1_ns - self.t0_ns) * 1e-9 * self.settings.rate - 1e-6)
        # A moving body has seven numbers in qpos (position, quaternion w x y z) and six in qvel (velocity in world
        # axes, angular velocity in its own).
        qpos, qvel = np.empty((_CHUNK + 2, model.nq)), np.empty((_CHUNK + 2, model.nv))
        pushed = self._pushed(0)
        for body in self.dynamic:
            at, R = 6 * body.at, body.path.pose(self.t0_ns)[:3, :3]
            # Velocities are those of half a step before: half a step of gravity is subtracted.
            data.qvel[at : at + 3] = body.config.velocity - 0.5 * self.step * model.opt.gravity
            # Angular velocity in the body's axes.
            data.qvel[at + 3 : at + 6] = np.radians(body.config.spin) @ R
        self._push(pushed, 0)
        self._lift()
        qpos[0], qvel[0] = data.qpos, data.qvel
        self._check_sound(0, qpos[:1], qvel[:1])
        self._advance(pushed, 0)
        qpos[1], qvel[1] = data.qpos, data.qvel
        for first in range(0, count, _CHUNK):
            steps = min(_CHUNK, count - first)
            pushed = self._pushed(first)
            for k in range(1, steps + 1):
                self._advance(pushed, k)
                qpos[k + 1], qvel[k + 1] = data.qpos, data.qvel
            self._check_sound(first, qpos[: steps + 2], qvel[: steps + 2])
            for body in self.dynamic:
                self.records[body.name].add(first, qpos[: steps + 1], qvel[: steps + 2], model.opt.gravity)
            self._let_sleep(qvel[: steps + 2])
            # The last two rows of a chunk are the first two of the next.
            qpos[:2], qvel[:2] = qpos[steps : steps + 2].copy(), qvel[steps : steps + 2].copy()
        paths = {name: record.path(self.t0_ns, self.settings.rate) for name, record in self.records.items()}
        digest = hashlib.sha256()
        for path in paths.values():
            for array in path.coefficients:
                digest.update(array.tobytes())
        # Every impact once, although both bodies record it.
        impacts = sorted({step for record in self.records.values() for step in record.impacts})
        times = _times(np.array(impacts, np.int64), self.t0_ns, self.settings.rate)
        return (
            tuple(replace(obj, path=paths.get(obj.name, obj.path)) for obj in self.objects),
            Dynamics(
                "mujoco",
                self.mujoco.__version__,
                len(paths),
                count,
                tuple(int(t) for t in times if self.t0_ns < t < self.t1_ns),
                digest.hexdigest(),
            ),
        )

    def _advance(self, pushed, k: int) -> None:
        self._push(pushed, k)
        self.mujoco.mj_step(self.model, self.data)

    def _pushed(self, first: int) -> list[tuple[int, np.ndarray, np.ndarray]]:
        """Return (which body, qpos (n, 7), qvel (n, 6)) of the pushers at steps ``first`` and after."""
        times = _times(np.arange(first, first + _CHUNK + 2), self.t0_ns, self.settings.rate)
        pushed = []
        for body in self.pushers:
            T = body.path.poses(times)
            # A pusher's velocity moves it to its next pose within one step.
            q, R = quaternions(T[:, :3, :3]), Rotation.from_matrix(T[:, :3, :3])
            p = T[:, :3, 3] + T[:, :3, :3] @ body.centre
            turns = (R[:-1].inv() * R[1:]).as_rotvec()
            pushed.append((body.at, np.hstack([p, q])[:-1], np.hstack([np.diff(p, axis=0), turns]) / self.step))
        return pushed

    def _push(self, pushed, k: int) -> None:
        for at, qpos, qvel in pushed:
            self.data.qpos[7 * at : 7 * at + 7] = qpos[k]
            self.data.qvel[6 * at : 6 * at + 6] = qvel[k]

    def _let_sleep(self, qvel: np.ndarray) -> None:
        """Let bodies that were slow for a whole chunk sleep in the next. A body that is slow only for a moment may be
        at the top of its flight."""
        policies = self.mujoco.mjtSleepPolicy
        for body in self.dynamic:
            # Angular velocities times the radius are velocities of the surface, so that one limit serves both.
            v = qvel[:, 6 * body.at : 6 * body.at + 6] * np.repeat([1.0, body.radius], 3)
            slow = float(np.abs(v).max()) < self.model.opt.sleep_tolerance
            self.model.tree_sleep_policy[body.at] = int(policies.mjSLEEP_ALLOWED if slow else policies.mjSLEEP_NEVER)

    def _lift(self) -> None:
        """Move bodies out of small overlaps at the start: the springs would eject them. Raises ConfigError where they
        overlap more."""
        deep: list[tuple[_Body, _Body, float, np.ndarray]] = []
        for _ in range(_LIFTS):
            self.mujoco.mj_forward(self.model, self.data)
            deep = [pair for pair in self._touching() if pair[2] > _SINK * min(pair[0].radius, pair[1].radius)]
            if not deep:
                return
            if any(depth > _LIFT * min(body.radius, other.radius) for body, other, depth, _ in deep):
                break  # too deep to be lifted
            for body, other, depth, away in deep:
                # If both can move, each moves half; a fixed body or a pusher cannot move.
                share = 0.5 if other.role == "dynamic" else 1.0
                self.data.qpos[7 * body.at : 7 * body.at + 3] += share * depth * away
        body, other, depth, _ = max(deep, key=lambda pair: pair[2])
        raise ConfigError(
            f"at the start {body.name} is {depth:.3g} m inside {other.name}, or inside its convex hull",
            where="scene.physics",
            accepted="bodies apart at the start, or physics: {kind: none} for one that nothing is to meet",
        )

    def _touching(self) -> Iterator[tuple[_Body, _Body, float, np.ndarray]]:
        """Yield (a dynamic body, what it touches, overlap, the direction out of it); for two dynamic ones in both
        orders."""
        contact, model = self.data.contact, self.model
        for pair, distance, frame in zip(contact.geom, contact.dist, contact.frame):
            names = [model.geom(int(g)).name.split()[0] for g in pair]
            # Names are "body shape"; a side of the region has no number.
            one, other = (self.bodies[int(name)] if name.isdigit() else self._side for name in names)
            # The first row of a contact's frame is its normal, from the first geometry to the second.
            for body, met, away in ((one, other, -frame[:3]), (other, one, frame[:3])):
                if body.role == "dynamic":
                    yield body, met, -float(distance), away

    def _check_sound(self, first: int, qpos: np.ndarray, qvel: np.ndarray) -> None:
        """Raise ConfigError where a body has no finite position, or is too fast."""
        limit = self.settings.max_speed
        for body in self.dynamic:
            # A free body has 7 numbers in qpos and 6 in qvel, of which the first 3 are its velocity.
            p, v = qpos[:, 7 * body.at : 7 * body.at + 7], qvel[:, 6 * body.at : 6 * body.at + 3]
            # Overflow is expected here.
            with np.errstate(over="ignore", invalid="ignore"):
                speed = np.where(np.isfinite(p).all(axis=1), np.linalg.norm(v, axis=1), np.inf)
            if not (speed <= limit).all():
                k = int(np.argmin(speed <= limit))
                error = Exploded(
                    f"{body.name} diverges {(first + k) * self.step:.6g} s after the start: its speed in m/s",
                    where="scene.physics",
                    value=float(speed[k]),
                    accepted=f"at most max_speed {limit:g}; a lower speed, or more space between bodies that "
                    "cannot move",
                )
                error.body = body.name
                raise error
        warnings = self.mujoco.mjtWarning
        for kind in (warnings.mjWARN_CONTACTFULL, warnings.mjWARN_CNSTRFULL):
            if self.data.warning[int(kind)].number:
                raise ConfigError(
                    "more contacts than MuJoCo has memory for",
                    where="scene.physics",
                    accepted="fewer or simpler bodies",
                )


class _Record:
    """The stored data of one body: the poses that its path needs, and the steps of its impacts."""

    def __init__(self, body: _Body, step: float, impact_steps: float):
        self.body, self.step, self.impact_steps = body, step, impact_steps
        self.pieces: list[tuple[np.ndarray, ...]] = []
        self.impacts: list[int] = []
        self._still = False
        self._last, self._peak = -math.inf, 0.0

    def add(self, first: int, qpos: np.ndarray, qvel: np.ndarray, gravity: np.ndarray) -> None:
        """Add steps. qpos : (n, …) of steps ``first`` and after.   qvel : (n + 1, …), before each of them and after the
        last."""
        at, body = self.body.at, self.body
        p, q = qpos[:, 7 * at : 7 * at + 3], qpos[:, 7 * at + 3 : 7 * at + 7]
        raw = qvel[:, 6 * at : 6 * at + 6]
        self._note_impacts(first, raw[:, :3], gravity)
        still = not raw[1:].any()
        # A body at rest: only the end of the last piece is moved.
        if still and self._still:  # the same pose for longer
            steps, *rest = self.pieces[-1]
            self.pieces[-1] = (np.append(steps[:-1], first + len(p) - 1), *rest)
            return
        self._still = still
        mean = 0.5 * (raw[:-1] + raw[1:])
        v, w = mean[:, :3], mean[:, 3:]
        # Quaternions drift from unit length by rounding.
        q = q / np.linalg.norm(q, axis=1, keepdims=True)
        # The engine's quaternions are w x y z, scipy's are x y z w.
        R = Rotation.from_quat(q[:, [1, 2, 3, 0]])
        # The path is of the object's origin, the engine's of the centre of mass.
        p = p - R.apply(body.centre)
        v = v - R.apply(np.cross(w, body.centre))
        keep = thin(self.step, p, v, q, w, _TOLERANCE * body.radius, _TOLERANCE)
        # Its first pose is the last one of the piece before.
        keep[0] = not self.pieces  # the last of the piece before
        if still:
            v, w = np.zeros_like(v), np.zeros_like(w)
        self.pieces.append((first + np.flatnonzero(keep), p[keep], v[keep], q[keep], w[keep]))

    def _note_impacts(self, first: int, v: np.ndarray, gravity: np.ndarray) -> None:
        """Record the step of the hardest push of each impact. A push counts when it would stop a twentieth of the
        body's own speed and is ten times gravity's."""
        # Acceleration other than gravity's.
        push = np.linalg.norm(np.diff(v, axis=0) / self.step - gravity, axis=1)[1:]
        frequency = math.pi / (self.impact_steps * self.step)
        speed = np.linalg.norm(v[1:-1], axis=1)
        hard = push > 10.0 * np.linalg.norm(gravity) + 0.05 * frequency * speed
        for k in np.flatnonzero(hard):
            step = first + 1 + int(k)
            # Later than a quarter of an impact after the last push: another impact.
            if step - self._last > self.impact_steps / 4:
                self.impacts.append(step)
                self._peak = 0.0
            if push[k] > self._peak:
                self.impacts[-1], self._peak = step, float(push[k])
            self._last = step

    def path(self, t0_ns: int, rate: float) -> HermitePath:
        steps, *rest = (np.concatenate(arrays) for arrays in zip(*self.pieces))
        return HermitePath(_times(steps, t0_ns, rate), *rest)


def _times(steps: np.ndarray, t0_ns: int, rate: float) -> np.ndarray:
    return t0_ns + np.rint(steps * (1e9 / rate)).astype(np.int64)
