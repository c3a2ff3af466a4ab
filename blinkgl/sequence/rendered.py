"""A sequence of a scene: frames are drawn at the times of the timeline and passed through the emulator; ground truth is
drawn at label times."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import cached_property, partial
from typing import Any

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.camera.pinhole import rectified
from blinkgl.config.over_time import track_times
from blinkgl.config.scene import lights_change
from blinkgl.config.sensor import other_size
from blinkgl.config.sequence import CameraOnRig
from blinkgl.errors import EventDataError
from blinkgl.events import emulator_of
from blinkgl.events.camera import EventCamera, EventFrame, emulate, emulate_beside
from blinkgl.events.truth import Surfaces, SurfaceTruth
from blinkgl.imaging import FrameCamera
from blinkgl.imaging.optics import Optics
from blinkgl.labels import LABELS, LabelRequest, asked_for
from blinkgl.render.antialiasing import samples_of
from blinkgl.render.renderer import Renderer
from blinkgl.render.tracks import Tracks, track_points
from blinkgl.rng import Role, generator, kernel_seed
from blinkgl.scene.shapes.sweep import filled
from blinkgl.scene.types import Scene, SceneObject
from blinkgl.sequence.inertial import Inertial, measured
from blinkgl.sequence.light_truth import LightTruth
from blinkgl.sequence.request import GroundTruth, Item, Picture, SequenceRequest, StageClock
from blinkgl.sequence.sensor import SensorSimulation
from blinkgl.tensors.choice import make_on_device, on_device
from blinkgl.timeline import make_timeline
from blinkgl.types.events import Events
from blinkgl.types.trees import Tree

SURFACES = LabelRequest("ids", "depth", "velocity")
"""Labels that give the truth of an event."""


def drawn(
    renderer: Renderer,
    times: Iterable[int],
    surfaces: bool = False,
    device: Any = None,
    optics: Optics | None = None,
) -> Iterator[EventFrame]:
    """Yield the frames of the event pass at ``times``, ns.
    surfaces : with the surface at every pixel.   device : torch's, on which frames are tensors; None: they are
    arrays.   optics : what the light passes; None: nothing."""
    frame = None
    source = optics.light if optics is not None else lambda moment: renderer.luminance(moment).read()
    changes = LightTruth(renderer, source) if surfaces and renderer.scene.waveforms else None
    for t_ns in times:
        if changes is not None:
            now = source(renderer.moment(t_ns))
            seen = surfaces_at(renderer, t_ns)
            yield EventFrame(t_ns, now, None, seen._replace(light=changes.of(t_ns, now)))
            continue
        if optics is not None:
            light: Any = optics.light(t_ns)
            if device is not None:
                light = on_device(light, device)
            yield EventFrame(t_ns, light, None, surfaces_at(renderer, t_ns) if surfaces else None)
            continue
        before, frame = frame, renderer.luminance(t_ns)
        # The emulator skips unchanged rows: with a still camera the cost depends on what moves.
        rows = frame.rows_changed_since(before)
        luminance = frame.view() if device is None else frame.tensor(device)
        yield EventFrame(t_ns, luminance, rows, surfaces_at(renderer, t_ns) if surfaces else None)


def surfaces_at(renderer: Renderer, t_ns: int) -> Surfaces:
    """Return the surface at every pixel's centre at t_ns, and the bodies under a pixel where they are nearer."""
    seen = renderer.labels(t_ns, SURFACES)
    surfaces = Surfaces(seen.ids, seen.depth, seen.velocity)
    bodies, diameters = renderer.specks(t_ns)
    return with_specks(surfaces, renderer, t_ns, bodies, diameters) if len(bodies) else surfaces


def with_specks(
    surfaces: Surfaces, renderer: Renderer, t_ns: int, bodies: np.ndarray, diameters: np.ndarray
) -> Surfaces:
    """Return the surfaces with those of bodies that no pixel's centre need meet, in every pixel that they touch.

    bodies : their numbers in the scene, the nearest first.   diameters : px."""
    ids, depth, velocity = (array.copy() for array in (surfaces.ids, surfaces.depth, surfaces.velocity))
    moment, camera, centres = renderer.moment(t_ns), renderer.scene.camera, renderer.body_centres[bodies]
    points = np.einsum("nij,nj->ni", moment.T_cam_obj[bodies, :3], centres)
    rates = np.einsum("nij,nj->ni", moment.dT_cam_obj[bodies, :3], centres)
    speeds = np.einsum("nij,nj->ni", camera.jacobian(points), rates)
    numbers = np.array([renderer.scene.objects[body].instance_id for body in bodies])
    # The first and the last pixel that each touches; pixel i is the square from i - 1/2 to i + 1/2. A lens's picture is
    # drawn flat first, and a pixel of it spreads over another one.
    place, half = camera.project(points), 0.5 * (diameters[:, None] + (renderer.lens != ""))
    first, last = (np.floor(place + side + 0.5).astype(np.int64) for side in (-half, half))
    # At most 1.5 px wide, 2.5 through a lens, a body touches no more than four pixels in x and in y.
    for dy, dx in np.ndindex(4, 4):
        x, y = (first + (dx, dy)).T
        rows = np.flatnonzero((x <= last[:, 0]) & (y <= last[:, 1]) & (x >= 0) & (y >= 0))[::-1]  # the nearest last
        rows = rows[(x[rows] < camera.width) & (y[rows] < camera.height)]
        rows = rows[points[rows, 2] < depth[y[rows], x[rows]]]
        at = y[rows], x[rows]
        ids[at], depth[at], velocity[at] = numbers[rows], points[rows, 2], speeds[rows]
    return Surfaces(ids, depth, velocity)


class RenderedSequence(SensorSimulation):
    """The simulation of a camera in a scene.

    scene : as it was built, with only this camera.   renderer : draws it.   number : of the sensor on its rig, which
    selects its noise."""

    def __init__(self, request: SequenceRequest, of: CameraOnRig, scene: Scene, renderer: Renderer):
        config, clock, self.number = of.config, StageClock(), of.number
        size, span_ns = (renderer.height, renderer.width), request.window_ns or (scene.t0_ns, scene.t1_ns)
        self.scene, self.renderer = scene, renderer
        # Of a random world only what is not drawn: it draws its own bodies from its pools, and logs each.
        log = () if config.scene.kind == "random" else scene.log
        self._notes = scene.omissions + log + nothing_in_view(scene) + renderer.notes
        self._notes += other_size(config.sensor, scene.camera.width, scene.camera.height)
        if scene.dynamics is not None:
            self.libraries = {scene.dynamics.engine: scene.dynamics.version}
        if request.labels:
            for name in asked_for(config.labels):
                LABELS[name].check(scene, config.labels)
        # A given renderer may have drawn before: its seconds until now do not belong to this sequence.
        self.triangles, self._before = renderer.triangles, (renderer.stats.render_s, renderer.stats.readback_s)
        self._optics = None if config.optics is None else Optics(renderer, config.optics)
        camera, pictures_hz = None, None
        if request.events and of.gives_events:
            pictures_hz = request.pictures_hz
            truth = SurfaceTruth(reach=int(samples_of(config.render.antialiasing).shared))
            camera = EventCamera(
                config.events.beside(request.base),
                config.readout,
                *size,
                kernel_seed(config.seed, request.index, Role.EVENTS, of.number),
                truth if config.labels.events else None,
                partial(make_on_device, gl=renderer.gl),
            )
            # A frame is drawn at every impact: a velocity jumps there, and no speed measured before it bounds the step.
            stops = () if scene.dynamics is None else scene.dynamics.impacts_ns
            response = emulator_of(config.events).response(config.events)
            lights = tuple(scene.waveforms.values())
            self.timeline = make_timeline(config.timeline, *span_ns, renderer, response, stops, lights)
        if request.labels and config.images is not None:
            seed = kernel_seed(config.seed, request.index, Role.IMAGES, of.number)
            self.frame_camera = FrameCamera(renderer, config.images, seed, span_ns)
        super().__init__(request, of, clock, size=size, span_ns=span_ns, camera=camera, pictures_hz=pictures_hz)

    @property
    def notes(self) -> tuple[str, ...]:
        notes = self._notes if self.camera is None else self._notes + self.camera.notes
        return notes if self.timeline is None else notes + self.timeline.notes

    def _resume(self) -> None:
        self.renderer.gl.resume()

    def _event_pass(self) -> Iterator[tuple[int, Events]]:
        assert self.camera is not None and self.timeline is not None
        try:
            # A tensor's frame stays on the card, which works beside the processor by itself.
            device = self.camera.tensor_device
            frames = drawn(self.renderer, self.timeline, self.camera.records_truth, device, self._optics)
            yield from (emulate_beside if device is None else emulate)(frames, self.camera, self.clock)
        except EventDataError as error:
            raise self._explained(error) from error

    def _in_order(self) -> Iterator[Item]:
        yield from super()._in_order()
        self._resume()
        self.renderer.gl.check()  # before the sequence counts as complete

    def _explained(self, error: EventDataError) -> EventDataError:
        """Return the error with the time and, where a pixel is wrong, the object seen there."""
        if error.pixel is None or error.t_ns is None:
            return error
        seen = self.renderer.shown_at(*error.pixel, error.t_ns)
        explained = EventDataError(
            f"{error.problem}: it shows {seen}",
            where=f"{error.where} at {error.t_ns * 1e-9:.9g} s",
            value=error.value,
            accepted=error.accepted,
        )
        explained.pixel, explained.t_ns = error.pixel, error.t_ns
        return explained

    def _label_times(self) -> Iterator[tuple[int, int]]:
        return ((k, t) for k, t in enumerate(self.config.time.label_times_ns) if self.t0_ns <= t <= self.t1_ns)

    def _truth(self, k: int, t_ns: int) -> GroundTruth:
        request, interval = asked_for(self.config.labels), self.config.time.interval_ns
        last = k == self.config.time.label_count
        if last:
            # No label begins at the last label time: flow and related labels have no other end.
            request = request.only(name for name in request if LABELS[name].at_last)
        return self._truth_over(k, t_ns, interval, request, last)

    def truth(self, t_ns: int, span_ns: int) -> GroundTruth:
        self._resume()
        self.renderer.gl.check()
        return self._truth_over(-1, t_ns, span_ns, asked_for(self.config.labels), False)

    def _truth_over(self, k: int, t_ns: int, span_ns: int, request: LabelRequest, last: bool) -> GroundTruth:
        request = request.within(self.scene.t0_ns - t_ns, self.scene.t1_ns - t_ns)
        frame = self.renderer.labels(t_ns, request, t_ns + span_ns, t_ns - span_ns, self._rectified)
        camera, objects = poses_at(self.scene, [t_ns])
        # Times of forward and backward flow.
        leads_to = (None, None) if last else (t_ns + span_ns, t_ns - span_ns)
        return GroundTruth(k, t_ns, frame, *leads_to, camera[0], objects[:, 0])

    def _picture(self, t_ns: int) -> Picture:
        # Cheap, unless bodies under a pixel are in view, of which it would show nothing.
        samples = None if len(self.renderer.specks(t_ns)[0]) else "none"
        image = self.renderer.colour(t_ns, antialiasing=samples).read()
        interval = self.config.time.interval_ns
        span = min(interval, self.scene.t1_ns - t_ns)
        if 4 * span < interval:
            return Picture(t_ns, image)  # of so short a motion the rest of an interval does not follow
        forward = self.renderer.labels(t_ns, LabelRequest("flow_forward"), t_ns + span).forward
        assert forward is not None
        return Picture(t_ns, image, np.nan_to_num(forward.flow) * np.float32(interval / span))

    @property
    def seconds(self) -> dict[str, float]:
        stats, (render_s, readback_s) = self.renderer.stats, self._before
        images = {} if self.frame_camera is None else {"images": self.frame_camera.seconds}
        drawing = {"render": stats.render_s - render_s, "read-back": stats.readback_s - readback_s}
        return {**self.clock.seconds, **images, **drawing}

    def poses(self) -> dict[str, np.ndarray]:
        """Return t_ns (M,) int64, the start and every label's time (label k has index k + 1); first_label, the index
        of the first label, 1; T_world_cam (M, 4, 4) float64; T_world_obj (n, M, 4, 4) float64 in the order of
        object_ids (n,) and object_names (n,); K (3, 3); resolution (width, height); near; for a camera with distortion
        lens, its kind, and distortion (k,)."""
        scene, times = self.scene, [self.config.time.t0_ns, *self.config.time.label_times_ns]
        T_world_cam, T_world_obj = poses_at(scene, times)
        return {
            "t_ns": np.asarray(times, np.int64),
            "first_label": np.array(1),
            "T_world_cam": T_world_cam,
            "T_world_obj": T_world_obj,
            "object_ids": np.array([o.instance_id for o in scene.objects], np.int64),
            "object_names": np.array([o.name for o in scene.objects], dtype=str),
            "object_categories": np.array([o.category for o in scene.objects], dtype=str),
            "K": scene.camera.K,
            "resolution": np.array([scene.camera.width, scene.camera.height], np.int64),
            "near": np.array(scene.camera.near),
            **(
                {}
                if self.lens is None
                else {"lens": np.array(self.lens.kind), "distortion": np.asarray(self.lens.distortion, np.float64)}
            ),
        }

    def exposure_poses(self) -> dict[str, np.ndarray]:
        if self.frame_camera is None:
            return {}
        t_ns = np.array(self.frame_camera.exposed_ns, np.int64).reshape(-1, 3)
        return {"t_ns": t_ns, "T_world_cam": self.scene.camera_path.poses(t_ns.ravel()).reshape(-1, 3, 4, 4)}

    @property
    def lens(self) -> CameraModel | None:
        return self.scene.camera if self.scene.camera.coefficients else None

    @property
    def _rectified(self) -> PinHole | None:
        """Return the camera whose pixels labels use; None: the sensor's own."""
        asked = self.config.labels.pixels == "rectified"
        return rectified(self.scene.camera) if asked and self.lens is not None else None

    def lights(self) -> dict[str, np.ndarray]:
        if not lights_change(self.config.scene):
            return {}
        waves, times = self.scene.waveforms, [self.config.time.t0_ns, *self.config.time.label_times_ns]
        span = self.scene.t0_ns, self.scene.t1_ns
        jumps = sorted((t, k) for k, wave in enumerate(waves.values()) for t in wave.jumps(*span))
        factors = [[wave.factor(t) for t in times] for wave in waves.values()]
        # A waveform has its new value from the time of the jump on.
        after = [[*waves.values()][k].factor(t) for t, k in jumps]
        return {
            "t_ns": np.asarray(times, np.int64),
            "names": np.array([*waves], dtype=str),
            "factors": np.array(factors, np.float64).reshape(len(waves), len(times)),
            "jump_t_ns": np.array([t for t, _ in jumps], np.int64),
            "jump_light": np.array([k for _, k in jumps], np.int64),
            "jump_factor": np.array(after, np.float64),
        }

    def imu(self) -> Inertial | None:
        return self._imu

    def tracks(self) -> Tracks | None:
        return self._tracks

    @cached_property
    def _imu(self) -> Inertial | None:
        if self.config.imu is None:
            return None
        rng = generator(self.config.seed, self.index, Role.IMU, self.number)
        return measured(self.scene.camera_path, self.config.imu, self.config.time.t0_ns, self.config.time.t1_ns, rng)

    @cached_property
    def _tracks(self) -> Tracks | None:
        config, time = self.config.tracks, self.config.time
        if config is None:
            return None
        times = track_times(config.rate, time.label_times_ns[0], time.t1_ns, time.interval_ns)
        # of the scene as it is drawn: its labels are of the same triangles
        scene, flat = self.renderer.scene, self._rectified
        scene = scene if flat is None else scene.with_camera(flat)
        rng = generator(self.config.seed, self.index, Role.TRACKS, self.number)
        return track_points(scene, config, times, rng)

    def _crowded(self) -> Tree:
        """Return the manifest's entry on event frames that are drawn with samples, for all their lines."""
        if self.timeline is None or self.renderer.antialiasing == self.config.render.antialiasing:
            return {}
        return {"antialiasing": {"drawn": self.renderer.antialiasing, "because": self.renderer.crowded}}

    def _facts_of_labels(self) -> Tree:
        labels, facts = self.config.labels, {}
        for name in asked_for(labels):
            facts.update(LABELS[name].facts(self.renderer.scene, labels))
        return facts

    def facts(self) -> Tree:
        gl, scene, physics = self.renderer.gl, self.renderer.scene, {}
        if (falling := scene.dynamics) is not None:
            physics["dynamics"] = {
                "engine": falling.engine,
                "bodies": falling.bodies,
                "steps": falling.steps,
                "impacts": len(falling.impacts_ns),
                "paths_sha256": falling.digest,
            }
        return {
            "opengl": {"renderer": gl.renderer, "version": gl.version, "vendor": gl.vendor, "backend": gl.backend},
            "timeline": {"kind": self.config.timeline.kind},
            "triangles": self.triangles,
            **self._crowded(),
            "objects": [_described(o) for o in scene.objects],
            **self._facts_of_labels(),
            "scene_log": list(scene.log),
            "not_drawn": list(scene.omissions),
            **physics,
            **({} if self.frame_camera is None else {"frame_camera": self.frame_camera.facts()}),
        }


_LOOKS = 64


def nothing_in_view(scene: Scene) -> tuple[str, ...]:
    """Return a line where bounding spheres of bodies never meet the camera's picture, at evenly spaced times."""
    times = np.linspace(scene.t0_ns, scene.t1_ns, _LOOKS).astype(np.int64)
    world, planes = np.linalg.inv(scene.camera_path.poses(times)), scene.camera.frustum_planes()
    bodies = [one for one in scene.objects if one.category == "object"]
    for one in bodies:
        at = world @ one.path.poses(times)
        # A sphere meets the picture if its centre is outside no plane by more than its radius.
        outside = -(at[:, :3, 3] @ planes.T).min(axis=1).max()
        if outside <= one.radius or (one.deforms and outside <= _reach(one)):
            return ()
    return ("no body is ever in the camera's view: its pose may be meant otherwise",) if bodies else ()


def _reach(one: SceneObject) -> float:
    """Return the largest distance of a body's points from its origin at any time."""
    shapes = [filled(part.mesh) for part in one.parts]
    return max(float(np.linalg.norm(hull, axis=1).max()) + margin for hull, margin in shapes)


def _described(one: SceneObject) -> Tree:
    """Return the description of a body for users without the scene: its box at rest in its own axes, and for each part
    the source of its mesh and its material."""
    corners = np.concatenate([part.mesh.vertices for part in one.parts]) if one.parts else np.zeros((1, 3))
    low, high = corners.min(axis=0), corners.max(axis=0)
    return {
        "name": one.name,
        "id": one.instance_id,
        "category": one.category,
        "source_hashes": sorted({part.mesh.source_hash for part in one.parts}),
        "box": [low.tolist(), high.tolist()],
        "parts": [
            {
                "mesh": part.mesh.name,
                "mesh_hash": part.mesh.source_hash,
                "triangles": len(part.mesh.faces),
                "texture": None if part.material.texture is None else part.material.texture.name,
                "texture_hash": None if part.material.texture is None else part.material.texture.source_hash,
                "base_color": list(part.material.base_color),
                "uv_scale": list(part.material.uv_scale),
            }
            for part in one.parts
        ],
    }


def poses_at(scene: Scene, times_ns: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Return T_world_cam (M, 4, 4) and T_world_obj (n, M, 4, 4), float64, at M times."""
    t = np.asarray(times_ns, np.int64)
    return (
        scene.camera_path.poses(t),
        np.stack([o.path.poses(t) for o in scene.objects]) if scene.objects else np.zeros((0, len(t), 4, 4)),
    )
