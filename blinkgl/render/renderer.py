"""Frames of a scene by rasterisation: the event pass, the velocity pass and the label pass.

    with create_context() as gl, Renderer(gl, scene, RenderConfig()) as renderer:
        frame = renderer.luminance(t_ns)                       # (H, W) float32, linear light
        labels = renderer.labels(t_ns, LabelRequest("flow_forward", "depth"), t_forward_ns=t1_ns)

Poses are composed in float64 relative to the camera (``matrices.py``); vertices stay object-local. Programs and
targets are made the first time something asks for them, and only in the variants the scene's materials need.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import moderngl
import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.labels import Flow, LabelFrame, LabelRequest
from blinkgl.machine.compiling import working_clock
from blinkgl.render.antialiasing import Samples, samples_of
from blinkgl.render.frames import RenderStats
from blinkgl.render.matrices import (
    cam_from_obj,
    cam_from_obj_rate,
    inverse_depth_bits,
    mat4_bytes,
    rows_xyw_bytes,
)
from blinkgl.render.occlusion import occlusion_mask
from blinkgl.render.resources import DrawItem, SceneResources
from blinkgl.render.statistics import largest_speed
from blinkgl.render.still import Backdrop, Rectangle, screen_rectangle
from blinkgl.scene.geometry.lod import at_level_of_detail
from blinkgl.scene.geometry.meshes import without_collapsed_faces
from blinkgl.scene.types import PosePath, Scene


@dataclass(eq=False)
class _Moment:
    """All objects at one time: T_cam_obj and clip matrices, (n, 4, 4) float64; and of every item the centre of its bounding sphere,
    (m, 3) float64 in camera axes, and ``inverse_depths`` of guard.glsl, (m, 2) uint32."""

    T_world_cam: np.ndarray
    T_world_obj: np.ndarray
    T_cam_obj: np.ndarray
    mvp: np.ndarray
    centres: np.ndarray
    inverse_depths: np.ndarray


class Renderer:
    """Draws one scene. Holds GL resources: use it as a context manager or call :meth:`release`.

    gl : blinkgl.gl.GLContext.   config : blinkgl.config.sequence.RenderConfig.
    scene : as it is drawn, frames and ground truth alike: at the level of detail that the configuration asks for, without triangles
    that are lines in float32.
    changed : rectangles in which the last :meth:`luminance` may differ from the one before it, of whatever kind; None: anywhere.
    """

    def __init__(self, gl, scene: Scene, config):
        scene = without_collapsed_faces(at_level_of_detail(scene, config.lod))
        self.gl, self.scene, self.config = gl, scene, config
        self.width, self.height = scene.camera.width, scene.camera.height
        self.stats = RenderStats()
        self._projection = scene.camera.clip_from_cam()
        self._paths: list[PosePath] = [o.path for o in scene.objects]
        self._moving = [i for i, p in enumerate(self._paths) if not p.is_static]
        self._T_world_obj = np.stack([p.pose(scene.t0_ns) for p in self._paths]) if self._paths else np.zeros((0, 4, 4))
        self._targets: dict = {}
        self._uniforms: dict = {}
        self._last_moment: tuple[int, _Moment] | None = None
        self._moves = np.array([not p.is_static for p in self._paths], bool)
        # Worth it when something stands still besides the camera; a scene of movers alone is drawn whole.
        self._still = scene.camera_path.is_static and not self._moves.all()
        self._backdrops: dict[str, Backdrop] = {}
        self._held: tuple[Backdrop, np.ndarray, np.ndarray | None] | None = None  # whose last frame is in which arrays
        self.changed: list[Rectangle] | None = None
        self._surfaces: dict[int, tuple[np.ndarray, np.ndarray]] = {}
        self._samples, self._image_samples = samples_of(config.antialiasing), samples_of(config.image_antialiasing, "render.image_antialiasing")
        self._resources = SceneResources(gl, scene, config.anisotropy, config.mip_bias)
        items = self._resources.items
        self._item_object = np.array([i.object_index for i in items], np.intp)
        self._item_centre = np.array([i.centre for i in items]).reshape(-1, 3)
        self._item_radius = np.array([i.radius for i in items])
        self._item_layer = np.array([i.layer for i in items])
        self._frustum = scene.camera.frustum_planes()
        self._whole = Rectangle(0, 0, self.width, self.height)

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_) -> None:
        self.release()

    def release(self) -> None:
        if self.gl.released:  # everything went with the context
            return
        with self.gl.borrowed():
            for target in self._targets.values():
                target.release()
            self._targets = {}
            self._resources.release()

    def look_through(self, camera: CameraModel) -> None:
        """From now on draws with another camera of the same size and path: another part of the picture at the same cost.
        Nothing of what was drawn before is used again."""
        self._projection, self._frustum = camera.clip_from_cam(), camera.frustum_planes()
        if self._last_moment is not None:
            t_ns, moment = self._last_moment
            self._last_moment = (t_ns, replace(moment, mvp=self._projection @ moment.T_cam_obj))
        self._still = False  # what stands still in one picture is no backdrop of the other
        self._backdrops, self._held, self._surfaces, self.changed = {}, None, {}, None

    @property
    def changed_rows(self) -> tuple[int, int] | None:
        """(y0, y1): outside these rows the last luminance frame equals the one before it; None: it may differ anywhere."""
        if self.changed is None:
            return None
        return (min(r.y0 for r in self.changed), max(r.y1 for r in self.changed)) if self.changed else (0, 0)

    @property
    def triangles(self) -> int:
        """Of the whole scene, before culling."""
        return self._resources.triangles

    # ---- passes ------------------------------------------------------------------------------------------------

    def luminance(self, t_ns: int, out: np.ndarray | None = None, rate: np.ndarray | None = None) -> np.ndarray:
        """Linear luminance at t_ns, (H, W) float32, into ``out`` when given (C-contiguous).

        rate : (H, W) float32, filled with d(luminance)/dt per second of each pixel when given, as the surface it shows moves
        (edges that pass are not in it); a shader variant of its own, not compiled otherwise.
        With a still camera only what moves is drawn, and when ``out`` and ``rate`` are those of the call before, only what
        has changed is written: leave them as they were returned. ``changed`` then says where."""
        started = working_clock()
        samples, (name, fmt) = self._samples, ("luminance", "R32F") if rate is None else ("luminance+rate", "RG32F")
        target = self._target(name, samples.grid, (fmt,), samples.multi)
        moment = self._moment(t_ns)
        rates = None if rate is None else self._rates(t_ns, moment)
        image = np.empty((self.height, self.width), np.float32) if out is None else out
        if self._still:
            return self._mend_luminance(name, fmt, moment, rates, target, started, image, rate)
        self._begin(target, moment, (self.scene.background, 0.0))
        self._draw_luminance(moment, self._visible(moment), target, rates)
        target = self._filtered(target, name, fmt, samples)
        if rate is None:
            return self._read(target, 0, started, image)
        image[...], rate[...] = np.moveaxis(self._read(target, 0, started, None), -1, 0)
        return image

    def brightness(self, t_ns: int, every: int = 1) -> np.ndarray:
        """Luminance and d(luminance)/dt per second, (h, w, 2) float32, on every n-th pixel in x and y, textures filtered as for the
        whole image. h = max(1, H // every), w likewise: the small picture covers the whole image, so that its pixels are H / h and W / w
        pixels apart, a little more than ``every`` where that is no divisor."""
        started = working_clock()
        target = self._target("brightness", 1, ("RG32F",), every=every)
        moment = self._moment(t_ns)
        self._begin(target, moment, (self.scene.background, 0.0))
        self._draw_luminance(moment, self._visible(moment), target, self._rates(t_ns, moment), every)
        return self._read(target, 0, started, None)

    def speed(self, t_ns: int, sample_every: int = 1, percentile: float = 100.0) -> float:
        """Largest image speed at t_ns, px/s (or a percentile of the pixels' speeds), on every n-th pixel in x and y.
        With a still camera the moving objects alone are drawn, those behind something included: still a bound."""
        return largest_speed(self.motion(t_ns, sample_every), percentile)

    def motion(self, t_ns: int, every: int = 1) -> np.ndarray:
        """:meth:`velocity` of what moves, (h, w, 2) float32 px/s, for the time sampling: with a still camera of the moving objects alone."""
        return self.velocity(t_ns, every, moving_only=self._still)

    def velocity(self, t_ns: int, reduce: int = 1, moving_only: bool = False) -> np.ndarray:
        """Image velocity at t_ns in px/s (of the full-size image), (h, w, 2) float32, 0 where nothing is hit.
        ``reduce`` samples every n-th pixel, h and w as for :meth:`brightness`: enough to find the largest motion, at 1/n² the cost.
        ``moving_only`` leaves out objects that stand still, also where they hide something."""
        started = working_clock()
        target = self._target("velocity", 1, ("RG32F",), every=reduce)
        moment = self._moment(t_ns)
        rate, _ = self._rates(t_ns, moment)
        self._begin(target, moment)
        for item in self._visible(moment):
            if moving_only and not self._moves[item.object_index]:
                continue
            uniforms = self._bind("label.glsl", item, moment, {"OUT_VELOCITY": 0})
            self._set_motion(uniforms, "rate", rate, item, target)
            self._draw(uniforms, item)
        velocity = self._read(target, 0, started, None)
        scale = np.array([self.width / target.fbo.width, self.height / target.fbo.height], np.float32)
        return velocity * scale if reduce != 1 else velocity

    def labels(self, t_ns: int, request: LabelRequest, t_forward_ns: int | None = None,
               t_backward_ns: int | None = None) -> LabelFrame:
        """Ground truth at t_ns: flow_forward runs from t_ns to t_forward_ns, flow_backward to t_backward_ns."""
        result: dict = {}
        if "images" in request:
            result["images"] = self.colour(t_ns)
        outputs = []
        needs_occlusion = "occlusion_forward" in request or "occlusion_backward" in request
        for name, wanted, fmt in (
            ("DEPTH", "depth" in request, "R32F"),
            ("ID", "ids" in request or needs_occlusion, "R32UI"),
            ("NORMAL", "normals" in request, "RGBA32F"),
            ("VELOCITY", "velocity" in request, "RG32F"),
            ("FLOW_FORWARD", "flow_forward" in request, "RGBA32F"),
            ("FLOW_BACKWARD", "flow_backward" in request, "RGBA32F"),
        ):
            if wanted:
                outputs.append((name, fmt))
        if outputs:
            buffers = self._geometry(t_ns, outputs, t_forward_ns, t_backward_ns)
            if "depth" in request:
                result["depth"] = np.where(buffers["DEPTH"] > 0, buffers["DEPTH"], np.float32(np.inf))
            if "ids" in request:
                result["ids"] = buffers["ID"]
            if "normals" in request:
                result["normals"] = np.ascontiguousarray(buffers["NORMAL"][..., :3])
            if "velocity" in request:
                result["velocity"] = buffers["VELOCITY"]
            for name, key, t_other in (("FLOW_FORWARD", "forward", t_forward_ns), ("FLOW_BACKWARD", "backward", t_backward_ns)):
                if name in buffers:
                    flow = self._flow(buffers[name], buffers.get("ID"), t_other, f"occlusion_{key}" in request)
                    result[f"flow_{key}"] = Flow(flow.flow, flow.valid)
                    if flow.occluded is not None:
                        result[f"occlusion_{key}"] = flow.occluded
        return LabelFrame(t_ns, result)

    def shown_at(self, x: int, y: int, t_ns: int) -> str:
        """What is seen at the centre of pixel (x, y) at t_ns, in words, for messages."""
        number = int(self._surface(t_ns)[1][y, x])
        names = [f"object '{o.name}' (id {number})" for o in self.scene.objects if number and o.instance_id == number]
        return names[0] if names else "the background"

    def colour(self, t_ns: int, antialiasing: str | None = None) -> np.ndarray:
        """Linear radiance at t_ns, (H, W, 3) float32; ``antialiasing`` overrides the configuration's."""
        started = working_clock()
        samples = self._image_samples if antialiasing is None else samples_of(antialiasing)
        target = self._target("colour", samples.grid, ("RGBA32F",), samples.multi)
        moment = self._moment(t_ns)
        self._begin(target, moment, (self.scene.background,) * 3)
        for item in self._visible(moment):
            uniforms = self._bind("label.glsl", item, moment, {"OUT_COLOUR": 0})
            uniforms["base_color"].value = tuple(item.material.base_color)
            if item.textured:
                self._resources.colour_texture(item.material).use(0)
            self._draw(uniforms, item)
        target = self._filtered(target, "colour", "RGBA32F", samples)
        return np.ascontiguousarray(self._read(target, 0, started, None)[..., :3])

    # ---- parts of the event pass -------------------------------------------------------------------------------

    def _draw_luminance(self, moment: _Moment, items: list[DrawItem], target, rates: tuple | None = None, every: int = 1) -> None:
        defines = {} if rates is None else {"RATE": 1} if every == 1 else {"RATE": 1, "EVERY": every}
        textured = defines | {"TAPS4": 1} if self._samples.taps == 4 and every == 1 else defines
        for item in items:
            uniforms = self._bind("luminance.glsl", item, moment, textured if item.textured else defines)
            if item.textured:
                self._resources.luminance_texture(item.material).use(0)
            else:
                uniforms["albedo"].value = self._resources.albedo_luminance(item.material)
            if rates is not None:
                self._set_rates(uniforms, rates, item, target)
            self._draw(uniforms, item)

    def _set_rates(self, uniforms: dict, rates: tuple[np.ndarray, np.ndarray], item: DrawItem, target) -> None:
        matrices, dT_world_obj = rates
        if "rate" in uniforms:
            self._set_motion(uniforms, "rate", matrices, item, target)
        if "sun_rate" in uniforms:
            dR = dT_world_obj[item.object_index, :3, :3]
            uniforms["sun_rate"].value = tuple(self.scene.light.sun_direction @ dR)
            uniforms["up_rate"].value = tuple(dR[2])

    def _mend_luminance(self, name: str, fmt: str, moment: _Moment, rates: tuple | None, target, started: float, image: np.ndarray,
                        rate: np.ndarray | None) -> np.ndarray:
        """:meth:`luminance` for a still camera; see ``still.py``."""
        samples, ctx = self._samples, self.gl.ctx
        visible = self._visible(moment)
        movers = [(item, screen_rectangle(item, moment.T_cam_obj[item.object_index], self.scene.camera))
                  for item in visible if self._moves[item.object_index]]
        movers = [(item, rectangle) for item, rectangle in movers if rectangle is not None]
        backdrop = self._backdrops.get(name)
        if backdrop is None:
            picture = self._target("backdrop:" + name, samples.grid, (fmt,), samples.multi)
            self._begin(picture, moment, (self.scene.background, 0.0))
            self._draw_luminance(moment, [item for item in visible if not self._moves[item.object_index]], picture, rates)
            backdrop = self._backdrops[name] = Backdrop(self.gl, picture, target)
            stale = backdrop.stale([self._whole])
            backdrop.stale([r for _, r in movers])
        else:
            stale = backdrop.stale([r for _, r in movers])
        self._prepare(target)
        for rectangle in stale:
            fine = rectangle.scaled(samples.grid)
            ctx.scissor = (fine.x0, fine.y0, fine.x1 - fine.x0, fine.y1 - fine.y0)
            backdrop.restore(fine)
            self._draw_luminance(moment, [item for item, r in movers if r.meets(rectangle)], target, rates)
        ctx.scissor = None
        self.stats.frames += 1
        result = self._filtered(target, name, fmt, samples, stale=bool(stale))
        held, self._held = self._held, (backdrop, image, rate)
        same_kind = held is not None and held[0] is backdrop
        # Rectangles tell of two frames of one kind; a frame with rates in between may have been of any other time.
        self.changed = stale if same_kind else [self._whole]
        if not (same_kind and held[1] is image and held[2] is rate):
            stale = [self._whole]
        ctx.finish()
        drawn = working_clock()
        for r in stale:
            if r == self._whole and rate is None:
                result.read(0, out=image)
                continue
            part, place = result.read(0, region=(r.x0, r.y0, r.x1 - r.x0, r.y1 - r.y0)), np.s_[r.y0:r.y1, r.x0:r.x1]
            if rate is None:
                image[place] = part
            else:
                image[place], rate[place] = part[..., 0], part[..., 1]
        self.stats.render_s += drawn - started
        self.stats.readback_s += working_clock() - drawn
        return image

    # ---- parts of the label pass -------------------------------------------------------------------------------

    def _geometry(self, t_ns: int, outputs: list[tuple[str, str]], t_forward_ns: int | None,
                  t_backward_ns: int | None) -> dict[str, np.ndarray]:
        started = working_clock()
        defines = {f"OUT_{name}": i for i, (name, _) in enumerate(outputs)}
        target = self._target("geometry:" + ",".join(defines), 1, tuple(fmt for _, fmt in outputs))
        moment = self._moment(t_ns)
        motions = []
        if "OUT_VELOCITY" in defines:
            motions.append(("rate", self._rates(t_ns, moment)[0]))
        for name, t_other in (("forward", t_forward_ns), ("backward", t_backward_ns)):
            if f"OUT_FLOW_{name.upper()}" in defines:
                motions.append((f"difference_{name}", self._moment(t_other).mvp - moment.mvp))
        self._begin(target, moment)
        for item in self._visible(moment):
            uniforms = self._bind("label.glsl", item, moment, defines)
            for name, matrices in motions:
                self._set_motion(uniforms, name, matrices, item, target)
            if "OUT_ID" in defines:
                uniforms["instance_id"].value = self.scene.objects[item.object_index].instance_id
            if "OUT_NORMAL" in defines:
                rotation = moment.T_cam_obj[item.object_index, :3, :3]
                uniforms["camera_from_local"].write(np.ascontiguousarray(rotation.T, np.float32).tobytes())
            self._draw(uniforms, item)
        return {name: self._read(target, i, started if i == 0 else working_clock(), None)
                for i, (name, _) in enumerate(outputs)}

    def _flow(self, buffer: np.ndarray, ids: np.ndarray | None, t_other_ns: int, occlusion: bool) -> Flow:
        surface = self._surface(t_other_ns) if occlusion else None
        started = working_clock()
        w_next = buffer[..., 2]
        hit = buffer[..., 3] > 0
        valid = hit & (w_next > 0)
        flow = np.where(valid[..., None], buffer[..., :2], np.float32(0))
        occluded = None
        if surface is not None:
            occluded = occlusion_mask(flow, w_next, valid, ids, *surface, self.scene.camera.near)
        self.stats.render_s += working_clock() - started
        return Flow(flow, valid, occluded)

    def _surface(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """(depth, ids) at t_ns. Neighbouring labels look at the same moments, so the last three are kept."""
        if t_ns not in self._surfaces:
            buffers = self._geometry(t_ns, [("DEPTH", "R32F"), ("ID", "R32UI")], None, None)
            self._surfaces[t_ns] = (buffers["DEPTH"], buffers["ID"])
            while len(self._surfaces) > 3:
                self._surfaces.pop(next(iter(self._surfaces)))
        return self._surfaces[t_ns]

    # ---- matrices ----------------------------------------------------------------------------------------------

    def _moment(self, t_ns: int) -> _Moment:
        if self._last_moment is not None and self._last_moment[0] == t_ns:  # several passes of one frame share it
            return self._last_moment[1]
        T_world_obj = self._T_world_obj.copy()
        for i in self._moving:
            T_world_obj[i] = self._paths[i].pose(t_ns)
        T_world_cam = self.scene.camera_path.pose(t_ns)
        T_cam_obj = cam_from_obj(T_world_cam, T_world_obj)
        T = T_cam_obj[self._item_object]
        centres = (T[:, :3, :3] @ self._item_centre[..., None])[..., 0] + T[:, :3, 3]
        moment = _Moment(T_world_cam, T_world_obj, T_cam_obj, self._projection @ T_cam_obj, centres,
                         inverse_depth_bits(centres[:, 2], self._item_radius, self.scene.camera.near))
        self._last_moment = (t_ns, moment)
        return moment

    def _rates(self, t_ns: int, moment: _Moment) -> tuple[np.ndarray, np.ndarray]:
        """(n, 4, 4) float64 d(MVP)/dt and d(T_world_obj)/dt, 1/s, from the analytic derivatives of the paths."""
        dT_world_obj = np.zeros_like(moment.T_world_obj)
        for i in self._moving:
            dT_world_obj[i] = self._paths[i].derivative(t_ns)
        return self._projection @ cam_from_obj_rate(moment.T_world_cam, self.scene.camera_path.derivative(t_ns),
                                                    moment.T_world_obj, dT_world_obj), dT_world_obj

    def _visible(self, moment: _Moment) -> list[DrawItem]:
        """Items whose bounding sphere meets the view frustum: objects front to back, then ground, then sky."""
        if not len(self._item_object):
            return []
        inside = (moment.centres @ self._frustum.T >= -self._item_radius[:, None]).all(axis=1)
        nearest = moment.centres[:, 2] - self._item_radius
        order = np.lexsort((nearest, self._item_layer))
        items = self._resources.items
        return [items[i] for i in order if inside[i]]

    # ---- GL state ----------------------------------------------------------------------------------------------

    def _target(self, name: str, scale: int, formats: tuple[str, ...], samples: int = 0, every: int = 1):
        """Of ``scale`` times the image's size, or of the small pictures' (:meth:`brightness`)."""
        key = (name, scale, samples, every)
        if key not in self._targets:
            width, height = (max(1, size * scale // every) for size in (self.width, self.height))
            self._targets[key] = self.gl.framebuffer(width, height, colour=formats, depth=True, samples=samples)
        return self._targets[key]

    def _begin(self, target, moment: _Moment, background: tuple[float, ...] = ()) -> None:
        self._prepare(target)
        target.clear((*background, 0.0, 0.0, 0.0, 0.0)[: target.formats[0].components], depth=0.0)
        self.stats.frames += 1

    def _prepare(self, target) -> None:
        ctx = self.gl.ctx
        target.fbo.use()
        ctx.viewport = (0, 0, target.fbo.width, target.fbo.height)
        ctx.enable_only(moderngl.DEPTH_TEST)
        ctx.depth_func = ">"  # reversed-Z
        ctx.front_face = "cw"  # counter-clockwise meshes in an image whose y points down
        ctx.cull_face = "back"
        self._culling = False

    def _bind(self, name: str, item: DrawItem, moment: _Moment, defines: dict) -> dict:
        """Uniforms of the program variant for ``item``, with the matrices and the light set."""
        key = (name, tuple(defines.items()), item.textured, item.lit, item.two_sided)
        if key not in self._uniforms:
            variant = dict(defines)
            for define, on in (("TEXTURED", item.textured), ("LIT", item.lit), ("TWO_SIDED", item.two_sided)):
                if on:
                    variant[define] = 1
            program = self.gl.program(name, variant)
            uniforms = {n: program[n] for n in program if isinstance(program[n], moderngl.Uniform)}
            uniforms[""] = program
            self._uniforms[key] = uniforms
        uniforms = self._uniforms[key]
        index = item.object_index
        uniforms["mvp"].write(mat4_bytes(moment.mvp[index]))
        uniforms["inverse_depths"].write(moment.inverse_depths[item.number].tobytes())
        if "sun_direction" in uniforms:
            # Every time: the context's programs are shared with other renderers, their uniforms included.
            uniforms["light_strength"].value = (self.scene.light.sun, self.scene.light.sky)
            R = moment.T_world_obj[index, :3, :3]
            uniforms["sun_direction"].value = tuple(self.scene.light.sun_direction @ R)
            uniforms["up_direction"].value = tuple(R[2])
        return uniforms

    def _set_motion(self, uniforms: dict, name: str, matrices: np.ndarray, item: DrawItem, target) -> None:
        uniforms[name].write(rows_xyw_bytes(matrices[item.object_index]))
        uniforms["image_size"].value = (target.fbo.width, target.fbo.height)

    def _draw(self, uniforms: dict, item: DrawItem) -> None:
        cull = not item.two_sided
        if cull != self._culling:
            (self.gl.ctx.enable if cull else self.gl.ctx.disable)(moderngl.CULL_FACE)
            self._culling = cull
        self._resources.vertex_array(uniforms[""], item).render(moderngl.TRIANGLES)
        self.stats.triangles += len(item.mesh.faces)

    def _filtered(self, drawn, name: str, fmt: str, samples: Samples, stale: bool = True):
        """Target with one value per pixel: ``drawn`` itself, or the mean of its samples (of before, where not ``stale``)."""
        if samples.stored == 1:
            return drawn
        key = (name, "mean")
        if key not in self._targets:
            self._targets[key] = self.gl.framebuffer(self.width, self.height, colour=(fmt,), depth=False)
        target = self._targets[key]
        if stale and samples.multi:
            drawn.resolve_into(target)
        elif stale:
            self._downsample(drawn, target, samples.grid)
        return target

    def _downsample(self, fine, target, factor: int) -> None:
        program = self.gl.program("downsample.glsl", {"FACTOR": factor})
        vao_key = ("downsample", factor)
        if vao_key not in self._uniforms:
            self._uniforms[vao_key] = self.gl.ctx.vertex_array(program, [])
        target.fbo.use()
        self.gl.ctx.viewport = (0, 0, self.width, self.height)
        self.gl.ctx.disable(moderngl.DEPTH_TEST | moderngl.CULL_FACE)
        fine.colour[0].use(0)
        self._uniforms[vao_key].render(moderngl.TRIANGLES, vertices=3)

    def _read(self, target, index: int, started: float, out: np.ndarray | None) -> np.ndarray:
        self.gl.ctx.finish()
        drawn = working_clock()
        image = target.read(index, out=out)
        self.stats.render_s += drawn - started
        self.stats.readback_s += working_clock() - drawn
        return image
