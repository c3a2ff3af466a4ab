"""Frames of a scene by rasterisation: combines passes and draws them.

    with create_context() as gl, Renderer(gl, scene, RenderConfig()) as renderer:
        luminance = renderer.luminance(t_ns).read()            # (H, W) float32, linear light
        labels = renderer.labels(t_ns, LabelRequest("flow_forward", "depth"), t_forward_ns=t1_ns)
        edges = renderer.draw(MyPass(), t_ns)                  # a Frame: on the GPU until it is read

A pass (``passes/``) defines what is drawn; a :class:`~blinkgl.render.moment.Moment` holds the positions of everything;
a :class:`~blinkgl.render.canvas.Canvas` holds the picture of one pass, and :class:`~blinkgl.render.canvas.StillCanvas`
redraws only moving objects. Poses are composed in float64 relative to the camera (``moment.py``); vertices stay
object-local. Programs and targets are made when first needed, only in the variants that the scene's materials need.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.camera import CameraModel, PinHole
from blinkgl.gl import GLContext
from blinkgl.labels import LABELS, LabelFrame, LabelRequest
from blinkgl.machine.closing import Releasing
from blinkgl.machine.compiling import working_clock
from blinkgl.render.antialiasing import Samples, samples_of
from blinkgl.render.canvas import Canvas, StillCanvas
from blinkgl.render.crowding import crowded_as, crowding
from blinkgl.render.draw_items import DrawItem
from blinkgl.render.frames import Frame
from blinkgl.render.labels import DrawnLabel, Seen
from blinkgl.render.lens import Lens
from blinkgl.render.moment import Moment, Moments, View
from blinkgl.render.motion import Motion
from blinkgl.render.painter import Painter, RenderStats
from blinkgl.render.passes import (
    Brightness,
    Colour,
    Gather,
    Geometry,
    Luminance,
    Pass,
    ShadowMap,
    Shot,
    Velocity,
    filtered,
    one_value,
    shadow_maps,
)
from blinkgl.render.resources import SceneResources
from blinkgl.scene.geometry.meshes import without_collapsed_faces
from blinkgl.scene.types import Scene
from blinkgl.types.recent import Kept, Recent

if TYPE_CHECKING:
    from blinkgl.config.sequence import RenderConfig


class Renderer(Releasing):
    """Draws one scene. It holds GL resources: use it as a context manager or call :meth:`release`.

    scene : as it is drawn, for frames and ground truth: at the configured level of detail, without triangles that are
    lines in float32.   width, height : of the image, px.   stats : RenderStats.
    whole : frames are always drawn completely; otherwise only moving objects are redrawn for a camera that stands
    still, to the same pixels.
    beside : renderer of the same scene for another sensor; this one shares its meshes, textures, poses and shadow maps.
    It must be released last.
    painter : class that issues the draw calls; a subclass may observe."""

    def __init__(
        self,
        gl: GLContext,
        scene: Scene,
        config: RenderConfig,
        *,
        whole: bool = False,
        beside: Renderer | None = None,
        painter: type[Painter] = Painter,
    ):
        gl.resume()
        if beside is not None:
            scene = replace(beside.scene, rig=scene.rig)
        else:
            scene = without_collapsed_faces(scene)
        self.gl, self.scene, self.config, self.stats = gl, scene, config, RenderStats()
        self.width, self.height = scene.camera.width, scene.camera.height
        samples = samples_of(config.antialiasing)
        self._image_samples = samples_of(config.image_antialiasing, "render.image_antialiasing")
        self._beside = beside
        resources = (
            SceneResources(gl, scene, config.anisotropy, config.mip_bias)
            if beside is None
            else beside._painter.resources  # noqa: SLF001 - another of its own kind
        )
        self._painter = painter(gl, scene, resources, self.stats)
        self._painter.lens = Lens.of(gl, scene.camera)
        # A sky at infinity is around each camera; everything else is shared.
        shared = beside is not None and not any(o.at_infinity for o in scene.objects)
        self._moments = Moments(scene, self.items, beside._moments.bodies if shared else None)  # noqa: SLF001
        self._canvases: dict[tuple[Pass, int, int], Canvas] = {}
        self._common: dict[tuple[Pass, int, int], Canvas] = {} if beside is None else beside._common  # noqa: SLF001
        self._last: dict[Pass, Frame] = {} if beside is None else beside._last  # noqa: SLF001
        self._labels: Kept[PinHole | None, Labels] = Kept()
        # Useful when something besides the camera stands still; a scene of only moving objects is drawn completely.
        some_stand = any(o.is_static for o in scene.objects)
        lamps_stand = all(lamp.path.is_static for lamp in scene.light.lamps)
        # The maps of the rig's first camera, not equal ones: a sun's path has no equality, so maps are
        # identified by it.
        self._shadows: tuple[ShadowMap, ...] = ()
        if scene.light.shadows != "off":
            self._shadows = shadow_maps(scene, self.items) if beside is None else beside._shadows  # noqa: SLF001
        # The shadow of a moving object also changes surfaces at rest.
        shadows_stand = not (self._shadows and any(item.casts and item.moves for item in self.items))
        self.notes: tuple[str, ...] = ()  # what is drawn less well than it could be, a line each
        # A body under a pixel moves without a rectangle of its own.
        self._most: dict[int, int] = {}  # by the grid of samples
        self._specks = self._specks_of(samples)
        if not samples.shared and (small := len(self.moment(scene.t0_ns).specks(1, len(scene.objects))[0])):
            line = f"{small:,} bodies under a pixel shine only where they meet a pixel's centre"
            self.notes += (f"{line}: render.antialiasing edges draws them by their area, not {config.antialiasing}",)
        lights_stand = lamps_stand and not scene.waveforms
        stands = scene.camera_path.is_static and some_stand and lights_stand and shadows_stand and not self._specks
        self.whole = whole or not stands

    @property
    def antialiasing(self) -> str:
        """Return the anti-aliasing of event frames: the configured one, but that of :func:`crowded_as` for ``edges``
        and ``edges2`` where outlines crowd."""
        if not self.crowded:
            return self.config.antialiasing
        seen = self.scene.camera if self._painter.lens is None else self._painter.lens.flat
        return crowded_as(self.config.antialiasing, seen.width, seen.height)

    @cached_property
    def crowded(self) -> str:
        """Return why event frames are drawn with samples although ``edges`` was asked for, in words; "": they are
        not (:func:`crowding`)."""
        if not samples_of(self.config.antialiasing).edges:
            return ""
        moments = [self.moment(t_ns) for t_ns in self._some_times(_CROWD_LOOKS)]
        return crowding(moments, self._painter.line_drawer.lines, self.width, self.height)

    def _some_times(self, count: int) -> list[int]:
        """Return evenly spaced times of the scene, ns, its ends among them."""
        return np.linspace(self.scene.t0_ns, self.scene.t1_ns, count).astype(np.int64).tolist()

    def _specks_of(self, samples: Samples) -> int:
        """Return how many bodies under a pixel get their light by their area in a picture of these samples: half more
        than at the busiest time; 0 for one of a look-up each."""
        if not samples.shared:
            return 0
        if samples.grid not in self._most:
            grids = {samples.grid, self._image_samples.grid}  # an image may be drawn later
            every, counts = len(self.scene.objects), dict.fromkeys(grids, 0)
            for t_ns in self._some_times(_SPECK_LOOKS):
                moment = self.moment(t_ns)
                counts = {grid: max(n, len(moment.specks(grid, every)[0])) for grid, n in counts.items()}
            self._most |= counts
        most = self._most[samples.grid]
        if most > _MOST_SPECKS:
            line = f"{most:,} bodies under a pixel: the nearest {_MOST_SPECKS:,} shine by their area"
            line += ", the others where they meet the centre of a sample"
            self.notes += (line,) if line not in self.notes else ()
        return min(most + most // 2 + (most > 0), _MOST_SPECKS)

    def release(self) -> None:
        if self.gl.released:  # everything was released with the context
            return
        with self.gl.borrowed():
            self.forget()
            if self._painter.lens is not None:
                self._painter.lens.release()
            if self._beside is None:
                self._painter.resources.release()

    def forget(self) -> None:
        """Discard everything drawn or compiled before; called before the context's programs are replaced."""
        for canvas in (*self._canvases.values(), *self._common.values()):
            canvas.release()
        self._canvases = {}
        self._common.clear()
        self._last.clear()
        self._labels.clear()
        self._painter.forget()

    def look_through(self, camera: CameraModel) -> None:
        """Draw with another camera of the same size and path from now on: another part of the picture at the same cost.
        Earlier frames are not reused, and frames are drawn completely."""
        self.scene = self.scene.with_camera(camera)
        self._moments.look_through(camera)
        self.motion.camera = camera
        self._labels.clear()
        self.whole = True  # the static part of one picture is not valid for the other
        lens, new = self._painter.lens, Lens.of(self.gl, camera)
        if lens is not None:
            lens.release()
        self._painter.lens = new
        for key in [k for k, c in self._canvases.items() if lens is not new or isinstance(c, StillCanvas)]:
            self._canvases.pop(key).release()

    @property
    def items(self) -> Sequence[DrawItem]:
        """Return everything that can be drawn."""
        return self._painter.resources.items

    @property
    def triangles(self) -> int:
        """Return the number of triangles of the whole scene, before culling."""
        return self._painter.resources.triangles

    @cached_property
    def motion(self) -> Motion:
        """Return the speeds of the scene in the camera's picture, which are computed without drawing."""
        return Motion(self.scene, self.items, self._moments)

    def moment(self, t_ns: int) -> Moment:
        """Return the moment at t_ns, shared by all passes of that time."""
        return self._moments.at(t_ns)

    # ---- drawing -------------------------------------------------------------------------------------------------

    def draw(self, pass_: Pass, at: int | Moment, ends_ns: Mapping[str, int | Moment] | None = None) -> Frame:
        """Return the frame of any pass at a time, ns, or of a moment seen from elsewhere (``moment.from_place``); the
        passes that it reads are drawn first.

        ends_ns : further times that it uses, by name: {"forward": t1_ns}. A pass that draws the scene draws the pinhole
        picture of a lens with distortion; :meth:`seen` returns the lens's picture."""
        self.gl.resume()
        started = working_clock()
        ends = {name: self._moment(t) for name, t in (ends_ns or {}).items()}
        frame = self._drawn(pass_, self._moment(at), ends, {})
        self.stats.render_s += working_clock() - started
        return frame

    def _moment(self, at: int | Moment) -> Moment:
        return at if isinstance(at, Moment) else self.moment(at)

    def seen(self, pass_: Pass, smooth: bool = False) -> Pass:
        """Return a pass that draws the scene as the scene's camera sees it: itself, or its picture through a lens.

        smooth : light, which is averaged over pixels; other values are taken from one pixel."""
        if self.lens == "":
            return filtered(pass_) if smooth else pass_
        return Gather(one_value(pass_) if smooth else pass_, self.scene.camera, smooth)

    @property
    def lens(self) -> str:
        """Return the macro of the camera's distortion model; "" for a pinhole camera."""
        return "" if self._painter.lens is None else self.scene.camera.shader

    def geometry(self, names: tuple[str, ...]) -> Pass:
        """Return the pass of the labels of these names, in the pixels of the scene's camera."""
        return self.seen(Geometry(names, self.lens))

    def _drawn(self, pass_: Pass, moment: Moment, ends: Mapping[str, Moment], done: dict[Pass, Frame]) -> Frame:
        frame = done.get(pass_)
        if frame is None:
            # Another sensor of the rig has drawn it for this time.
            if pass_.common and (last := self._last.get(pass_)) is not None and pass_.serves(last.moment, moment):
                done[pass_] = last
                return last
            # A pass that several others read is drawn once: ``done`` holds it.
            inputs = {one.sampler: self._drawn(one.of, moment, ends, done) for one in pass_.inputs}
            seen = moment.view.camera  # labels may be of another picture than the rest
            canvases = self._common if pass_.common else self._canvases
            key = (pass_, 0, 0) if pass_.common else (pass_, seen.width, seen.height)
            canvas = canvases.get(key)
            if canvas is None:
                kind = StillCanvas if pass_.stands_still(self.whole) else Canvas
                canvas = canvases[key] = kind(pass_, self._painter, seen.width, seen.height)
            frame = done[pass_] = canvas.draw(Shot(pass_.seen(moment), canvas.target, self.scene, ends, inputs))
            if pass_.common:
                self._last[pass_] = frame
        return frame

    # ---- frames --------------------------------------------------------------------------------------------------

    def luminance(self, at: int | Moment) -> Frame:
        """Return linear luminance at a time, ns, or of a moment, (H, W) float32."""
        samples = samples_of(self.antialiasing)
        return self.draw(self.seen(Luminance(samples, self._shadows, self._specks), smooth=True), at)

    def brightness(self, t_ns: int, every: int = 1) -> Frame:
        """Return luminance and d(luminance)/dt per second, (h, w, 2) float32, on every n-th pixel in x and y, textures
        filtered as for the whole image. h = max(1, H // every), w likewise: the small picture covers the whole image,
        so its pixels are H / h and W / w pixels apart, a little more than ``every`` if that is no divisor."""
        return self.draw(self.seen(Brightness(every, self._shadows)), t_ns)

    @property
    def body_centres(self) -> np.ndarray:
        """Return the middles of the bodies' bounding spheres, (n, 4) float64, in their own axes."""
        centres = self._moments.stage.body_centre
        return np.column_stack([centres, np.ones(len(centres))])

    def specks(self, t_ns: int) -> tuple[np.ndarray, np.ndarray]:
        """Return the bodies under a pixel that event frames show by their area: their numbers in the scene, (n,) int64,
        the nearest first, and their diameters, (n,) float64 px."""
        grid = samples_of(self.antialiasing).grid
        bodies, places = self.moment(t_ns).specks(grid, self._specks) if self._specks else (np.empty(0, int), None)
        return bodies, np.empty(0) if places is None else places[:, 2] / grid

    def velocity(self, t_ns: int, every: int = 1) -> Frame:
        """Return image velocity at t_ns in px/s (of the full-size image), (h, w, 2) float32, 0 where nothing is hit, h
        and w as for :meth:`brightness`: a few pixels suffice to find the largest motion."""
        return self.draw(self.seen(Velocity(every, lens=self.lens)), t_ns)

    def velocity_of_movers(self, t_ns: int, every: int = 1) -> Frame:
        """Return the :meth:`velocity` that bounds a time step. Before a static camera only moving objects are drawn,
        hidden ones too, so it may be larger than that of the visible surfaces but not smaller."""
        return self.draw(self.seen(Velocity(every, not self.whole, self.lens)), t_ns)

    def colour(self, at: int | Moment, antialiasing: str | None = None) -> Frame:
        """Return linear radiance at a time, ns, or of a moment, (H, W, 3) float32; ``antialiasing`` overrides the
        configuration's."""
        samples = self._image_samples if antialiasing is None else samples_of(antialiasing)
        return self.draw(self.seen(Colour(samples, self._shadows, self._specks_of(samples)), smooth=True), at)

    def flat_colour(self, at: Moment) -> Frame:
        """Return the :meth:`colour` of a moment as a pinhole camera sees it, whatever the scene's camera is."""
        samples = self._image_samples
        return self.draw(filtered(Colour(samples, self._shadows, self._specks_of(samples))), at)

    def labels(
        self,
        t_ns: int,
        request: LabelRequest,
        t_forward_ns: int | None = None,
        t_backward_ns: int | None = None,
        camera: PinHole | None = None,
    ) -> LabelFrame:
        """Return ground truth at t_ns: flow_forward runs from t_ns to t_forward_ns, flow_backward to t_backward_ns.

        camera : whose pixels are used, at the place of the scene's camera; None: the scene's camera."""
        return self._labels_in(camera).frame(t_ns, request, t_forward_ns, t_backward_ns)

    def _labels_in(self, camera: PinHole | None) -> Labels:
        return self._labels.of(camera, lambda: Labels(self, camera))

    def shown_at(self, x: int, y: int, t_ns: int) -> str:
        """Return what is seen at the centre of pixel (x, y) at t_ns, as text for messages."""
        return self._labels_in(None).shown_at(x, y, t_ns)


_SPECK_LOOKS, _CROWD_LOOKS = 64, 5
"""Times at which a scene is searched for bodies under a pixel, and for outlines that crowd."""
_MOST_SPECKS = 32_000
"""Bodies under a pixel that get their light by their area; of more, the farthest are drawn as larger ones are. Their
portraits (passes/specks.py) fill the largest texture that every OpenGL 4.3 has."""
KEPT = 3
"""Number of times whose buffers are kept: neighbouring labels use the same moments."""


class Labels:
    """Makes the label frames of one renderer: draws the buffers of the label pass and finishes the labels' rows.

    camera : of another picture at the same place; None: the scene's."""

    def __init__(self, renderer: Renderer, camera: PinHole | None = None):
        self._renderer, self._view = renderer, None if camera is None else View.of(camera)
        self.scene = renderer.scene if camera is None else renderer.scene.with_camera(camera)
        self._kept: Recent[tuple[int, tuple[str, ...]], dict[str, np.ndarray]] = Recent(KEPT)

    def frame(self, t_ns: int, request: LabelRequest, forward_ns: int | None, backward_ns: int | None) -> LabelFrame:
        """Return the label frame; see :meth:`Renderer.labels`."""
        draw = self._renderer
        ends: dict[str, int] = {}
        for towards, end_ns in (("forward", forward_ns), ("backward", backward_ns)):
            if who := [name for name in request if LABELS[name].towards == towards]:
                if end_ns is None:
                    raise TypeError(f"label '{who[0]}' leads to another time: t_{towards}_ns")
                ends[towards] = end_ns
        there = {
            towards: self._buffers(end_ns, names)
            for towards, end_ns in ends.items()
            if (names := LabelRequest(*(name for name in request if LABELS[name].towards == towards)).there)
        }
        each = request.each
        # Each interval is a forward flow of its own from the same time.
        leading = {ns: self.frame(t_ns, each, t_ns + ns, None) for ns in request.intervals_ns} if each else {}
        drawn: dict[str, np.ndarray] = {}
        if names := request.buffers:
            drawn = _read(self._drawn(names, t_ns, ends), names)
        values: dict[str, object] = {}
        for name in request:
            # These come from the colour pass, not from the buffers of the label pass.
            if LABELS[name].anti_aliased:
                at = self._moment(t_ns)
                values[name] = (draw.colour(t_ns) if self._view is None else draw.flat_colour(at)).read()
        started = working_clock()
        for name in request:
            self._finished(name, Seen(t_ns, drawn, ends, there, leading, request.categories), values)
        draw.stats.render_s += working_clock() - started
        return LabelFrame(t_ns, {name: values[name] for name in request})

    def _finished(self, name: str, seen: Seen, values: dict[str, object]) -> object:
        if name not in values:
            label = LABELS[name]
            value = label.finish(DrawnLabel(label, self.scene, seen, lambda other: self._finished(other, seen, values)))
            camera = self.scene.camera
            if (wrong := label.wrong(value, camera.height, camera.width)) is not None:
                raise TypeError(f"label '{name}': `finish` gives {wrong}")
            values[name] = value
        return values[name]

    def shown_at(self, x: int, y: int, t_ns: int) -> str:
        """Return the text of :meth:`Renderer.shown_at`."""
        number = int(self._buffers(t_ns, LabelRequest("ids").buffers)["ids"][y, x])
        names = [
            f"object '{o.name}' (id {number})"
            for o in self._renderer.scene.objects
            if number and o.instance_id == number
        ]
        return names[0] if names else "the background"

    def _moment(self, t_ns: int) -> Moment:
        moment = self._renderer.moment(t_ns)
        return moment if self._view is None else moment.through(self._view)

    def _drawn(self, names: tuple[str, ...], t_ns: int, ends: dict[str, int]) -> Frame:
        draw = self._renderer
        pass_ = draw.geometry(names) if self._view is None else Geometry(names)
        return draw.draw(pass_, self._moment(t_ns), {name: self._moment(t) for name, t in ends.items()})

    def _buffers(self, t_ns: int, names: tuple[str, ...]) -> dict[str, np.ndarray]:
        """Return buffers of these labels at a time, as the shader wrote them."""
        return self._kept.of((t_ns, names), lambda: _read(self._drawn(names, t_ns, {}), names))


def _read(frame: Frame, names: tuple[str, ...]) -> dict[str, np.ndarray]:
    return {name: frame.read(name) for name in names}
