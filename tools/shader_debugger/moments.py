"""All buffers at one time, by name. :class:`GpuMoment` reads them from OpenGL, :class:`ReferenceMoment` computes them
in float64. Names, shapes and conventions are the same; each buffer is computed at its first use."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol, TypeVar

import numpy as np

from blinkgl.camera.drawing import seen_through
from blinkgl.errors import ConfigError
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.labels.label import Label, View
from blinkgl.render import casting
from blinkgl.render.colour import LUMA
from blinkgl.render.passes.own import OWN, OwnPass
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.scene.lights import MAX_SHADOWS, lamps_of, shadowing
from blinkgl.scene.types import Part, Scene, SceneObject
from blinkgl.tools.shader_debugger import appearance, reference
from blinkgl.tools.shader_debugger.filters import FILTERED, drawn, places_of, reference_of
from blinkgl.tools.shader_debugger.lamps import map_of, near_an_edge
from blinkgl.tools.shader_debugger.mipmaps import levels, mipmapped_albedo, needles
from blinkgl.tools.shader_debugger.session import LOOKUPS as LOOKUP_PASSES, DebugRenderer, Subject, When


class _Named(Protocol):
    @property
    def name(self) -> str: ...


_T = TypeVar("_T", bound=_Named)


@dataclass(frozen=True)
class Pass:
    """Description of a buffer.

    kind : how it is shown: scalar, depth (logarithmic scale), signed, ids, mask, light (linear rgb), unit (vectors),
    uv, motion.
    source : the program and output that write it."""

    name: str
    title: str
    unit: str
    kind: str
    source: str


LOOKUPS = ("uv", "level", "albedo", "direct", "shadow", "around", "light", "mirrored", "emission")
"""Intermediate buffers of a lit pass, in the order of computation. Its result is albedo · light + mirrored + emission,
where the light of the diffuse part is direct · shadow + around."""
MAPS = tuple(f"shadow_map_{k}" for k in range(MAX_SHADOWS))
"""Buffers that are rendered from a lamp, not from the camera."""


def _lookups(name: str, program: str) -> tuple[Pass, ...]:
    source = f"{program} SHOW_LOOKUP"
    return (
        Pass(f"{name}_uv", f"uv of {name}", "texture repeats", "uv", source),
        Pass(f"{name}_level", f"level of {name}", "log2(texels per px)", "scalar", source),
        Pass(f"{name}_albedo", f"albedo of {name}", "linear", "light", source),
        Pass(f"{name}_direct", f"lamps of {name}", "irradiance factor", "scalar", f"{program}, include/lights.glsl"),
        Pass(
            f"{name}_shadow",
            f"shadow factor of {name}",
            "share of the lamps' light",
            "scalar",
            f"{program}, include/shadows.glsl",
        ),
        Pass(
            f"{name}_around", f"environment of {name}", "irradiance factor", "scalar", f"{program}, include/lights.glsl"
        ),
        Pass(f"{name}_light", f"light of {name}", "irradiance factor", "scalar", f"{program}, include/light.glsl"),
        Pass(f"{name}_mirrored", f"mirrored light of {name}", "linear", "light", f"{program}, include/surface.glsl"),
        Pass(f"{name}_emission", f"emission of {name}", "linear", "light", source),
    )


_BEFORE = (
    Pass("triangle", "triangle of its part", "0: nothing hit", "ids", "debug.glsl OUT_TRIANGLE"),
    Pass("local", "local position", "object axes", "scalar", "include/vertex.glsl, include/deform"),
)
_SHADED = (
    *(Pass(name, name.replace("_", " "), "depth, 0: nothing casts", "scalar", "shadow.glsl") for name in MAPS),
    *_lookups("luminance", LOOKUP_PASSES["luminance"].program),
    Pass("luminance", "luminance", "linear", "scalar", "luminance.glsl, include/fog.glsl"),
    *_lookups("colour", LOOKUP_PASSES["colour"].program),
    Pass("colour", "colour", "linear radiance", "light", "colour.glsl, include/fog.glsl"),
    Pass("luminance_lens", "luminance, lens", "linear", "scalar", "gather.glsl"),
    Pass("colour_lens", "colour, lens", "linear radiance", "light", "gather.glsl"),
    Pass("luminance_edges", "luminance, edges", "linear", "scalar", "edges.glsl"),
    Pass("colour_edges", "colour, edges", "linear radiance", "light", "edges.glsl"),
    Pass(
        "velocity_pass",
        "velocity for the time sampling",
        "px/s",
        "motion",
        "velocity.glsl, include/motion.glsl, include/lens.glsl",
    ),
)


class OfLabels(Mapping[str, _T]):
    """Values by the name of a buffer: one for every view of all labels and every pass of a plug-in that are registered
    now, and fixed ones.

    The order is that of computation, so that a mistake shows first where it was made: where the surface is (``before``,
    and labels of one time), its appearance (``shaded``), its motion, and what plug-ins make of it.
    made : returns the value for a label and one of its views.   own : the same for a pass of a plug-in, or None.
    before, shaded : the fixed values."""

    def __init__(
        self,
        made: Callable[[Label, View], _T],
        own: Callable[[OwnPass], _T | None],
        before: Iterable[_T],
        shaded: Iterable[_T],
    ):
        self._made, self._own, self._before, self._shaded = made, own, tuple(before), tuple(shaded)

    def _all(self) -> dict[str, _T]:
        views = [
            (label.towards is None and view.kind != "motion", self._made(label, view))
            for label in LABELS.values()
            for view in label.views
        ]
        # Motion comes last: it depends on everything before it.
        surface, motion = ([one for early, one in views if early is which] for which in (True, False))
        own = [made for one in OWN.values() if (made := self._own(one)) is not None]
        return {one.name: one for one in (*self._before, *surface, *self._shaded, *motion, *own)}

    def __getitem__(self, name: str) -> _T:
        return self._all()[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all())

    def __len__(self) -> int:
        return len(self._all())


def _of_label(label: Label, view: View) -> Pass:
    return Pass(
        view.name,
        view.title,
        view.unit,
        view.kind,
        f"include/labels/{label.name}.glsl" if label.buffer else f"labels/{label.name}",
    )


def _of_own(own: OwnPass) -> Pass:
    return Pass(own.name, own.title, own.unit, own.kind, own.pass_.program)


PASSES = OfLabels(_of_label, _of_own, _BEFORE, _SHADED)


def buffers_of(scene: Scene, filtered: tuple[str, ...] = ()) -> dict[str, Pass]:
    """Return the :data:`PASSES` that a scene has: without shadows no shadow maps, and so on.

    filtered : names of :data:`filters.FILTERED` to include."""
    # A lamp has no map if no body casts a shadow.
    maps = len(shadowing(scene.light)) if appearance.casts(scene) else 0
    materials = [part.material for _, part in casting.scene_parts(scene) if not part.material.unlit]
    there = {
        "shadow": maps > 0,
        "mirrored": any(material.gloss is not None for material in materials),
        "emission": any(any(material.emission) for material in materials),
    }
    return {
        name: info
        for name, info in PASSES.items()
        if there.get(lookup_of(name)[1], True)
        and name not in MAPS[maps:]
        and (name not in FILTERED or name in filtered)
        and ((shown := view_of(name)) is None or shown[0].can_be_of(scene))
    }


def view_of(name: str) -> tuple[Label, View] | None:
    """Return the label of a buffer and its view, or None."""
    return next(((label, view) for label in LABELS.values() for view in label.views if view.name == name), None)


def lookup_of(name: str) -> tuple[str, str]:
    """Return ("luminance", "uv") for "luminance_uv", and ("", "") for a buffer that is not a lookup."""
    pass_name, _, what = name.rpartition("_")
    return (pass_name, what) if pass_name in LOOKUP_PASSES and what in LOOKUPS else ("", "")


def check_pass(name: str, known: Any = PASSES, where: str = "--pass") -> str:
    """Return ``name`` if it is one of ``known``. Raises ConfigError."""
    if name not in known:
        raise ConfigError("unknown pass", where=where, value=name, accepted="one of " + ", ".join(known))
    return name


class _Lazy:
    """Buffers by name; ``_make`` computes a group of them when one is first used."""

    def __init__(self):
        self._made: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._made:
            self._made.update(self._make(name))
        return self._made[name]

    def _make(self, name: str) -> dict[str, np.ndarray]:
        raise NotImplementedError


class GpuMoment(_Lazy):
    """Buffers that the GPU wrote.

    Besides those of :data:`PASSES`: part (H, W) int32, -1 where nothing is hit; window (H, W, 4), gl_FragCoord;
    next_depth_forward and next_depth_backward (H, W), the depth at t' that the flow program returns; luminance_count
    and colour_count (H, W), the number of texture look-ups at the pixel; colour_light_rgb (H, W, 3), its light in
    colour; NAME_plain and NAME_reference for the names of :data:`filters.FILTERED`.

    With a lens, labels are in the pixels of the lens. Buffers drawn as a flat picture are sampled at the flat pixel
    that each pixel of the lens shows.

    Where nothing is hit depth is inf, and flow, velocity and id are 0.
    """

    def __init__(self, renderer: DebugRenderer, when: When):
        super().__init__()
        self.renderer, self.when = renderer, when

    def _make(self, name):
        draw, when = self.renderer, self.when
        if name in ("colour", "luminance"):
            return {name: draw.picture(name, when.t_ns)}
        if name == "velocity_pass":
            return {name: draw.velocity(when.t_ns).read()}
        if name in OWN:
            return {name: draw.at_pixels(draw.draw(OWN[name].pass_, when.t_ns).read(OWN[name].output))}
        # ``edges`` writes a flat picture, a lens pass the pixels of the lens.
        own = draw.at_pixels if name.partition("_")[2].startswith("edges") else np.asarray
        if name in FILTERED:
            return {name: own(drawn(draw, name, when.t_ns))}
        if (of := name.removesuffix("_plain").removesuffix("_reference")) in FILTERED:
            plain, true = reference_of(draw, of, when.t_ns)
            return {f"{of}_plain": own(plain), f"{of}_reference": own(true)}
        if name in MAPS:
            return {name: draw.shadow_map(MAPS.index(name), when.t_ns)}
        if name in ("triangle", "part", "local", "window"):
            out = draw.inspect(when.t_ns)
            return {
                "triangle": out["TRIANGLE"],
                "part": out["LOCAL"][..., 3].astype(np.int32) - 1,
                "local": out["LOCAL"][..., :3],
                "window": out["WINDOW"],
            }
        if name.endswith(("_count", "_light_rgb")) or lookup_of(name)[0]:
            of = name.partition("_")[0]
            shown = draw.lookups(of, when.t_ns)
            return {f"{of}_{key}": shown[key] for key in (*LOOKUPS, "light_rgb", "count")}
        if name.startswith("next_depth_"):
            way = name.removeprefix("next_depth_")
            raw = draw.raw(when.t_ns, f"flow_{way}", forward_ns=when.forward_ns, backward_ns=when.backward_ns)
            return {name: raw[f"flow_{way}"][..., 2]}
        return self._labels()

    def _labels(self):
        when = self.when
        # One request for all labels, so that they are drawn together.
        ask = LabelRequest(*(name for name, label in LABELS.items() if label.views))
        frame = self.renderer.labels(when.t_ns, ask, when.forward_ns, when.backward_ns)
        return {view.name: view.of(frame.values[name]) for name in ask for view in LABELS[name].views}


class ReferenceMoment(_Lazy):
    """Buffers that the GPU should have written, in float64, by :mod:`blinkgl.tools.shader_debugger.reference`.

    scene : with the camera that draws; with a lens, that of the flat picture.   seen : with the camera itself.
    maps : shadow maps.

    The level of a look-up is log2 of the longer of the texel footprints of one pixel step in x and y (OpenGL 4.6,
    section 8.14, eq. 8.7), from the exact derivatives of uv on the plane of the triangle, plus ``mip_bias``; a GPU
    takes differences over 2 x 2 pixels. :mod:`mipmaps` samples the albedo at that level, and colour and luminance
    follow from it. The reference itself has no mip maps: its values, at full resolution, are albedo_level0,
    colour_level0 and luminance_level0.
    texture_size : (H, W, 2) texels, 1 without a texture.
    lamps : (H, W, lamps), light of each lamp without shadows.   matt : diffuse over arriving light; below 1 with gloss.
    light, and its terms : weighted by the colours that the surface reflects.
    uv, level, albedo, light … : for both passes; luminance_albedo is the luminance of albedo.
    shadow_map_0 … : at the poses of ``maps``, those of the renderer.
    """

    def __init__(self, scene: Scene, when: When, mip_bias: float = 0.0, maps: tuple[ShadowMap, ...] = ()):
        super().__init__()
        self.maps = maps
        self.seen, self.when, self.mip_bias = scene, when, mip_bias
        self._places = places_of(scene.camera)
        self.scene = scene if self._places is None else scene.with_camera(seen_through(scene.camera))

    @cached_property
    def labels(self) -> reference.ReferenceFrame:
        """Labels at the pixels of the camera, with flow."""
        when = self.when
        return reference.render(self.seen, when.t_ns, forward_ns=when.forward_ns, backward_ns=when.backward_ns)

    @cached_property
    def shadow_edges(self) -> np.ndarray:
        """(H, W) bool: pixels where shadows of maps may differ from shadows of rays."""
        return near_an_edge(self.scene, self.frame, self.maps)

    @cached_property
    def frame(self) -> reference.ReferenceFrame:
        """The frame that is drawn; without a lens it is :attr:`labels`."""
        if self._places is None:
            return self.labels
        return reference.render(self.scene, self.when.t_ns, xy=self._places.astype(np.float64))

    def _make(self, name):
        if (shown := view_of(name)) is not None:
            label, view = shown
            try:
                return {name: np.asarray(view.reference(self.seen, self.labels))}
            except Exception as error:
                raise TypeError(f"label '{label.name}': `reference` fails: {error}") from error
        frame = self.frame
        if name in OWN:
            return {name: self._own(OWN[name])}
        if name.endswith("_level0"):
            return {name: getattr(frame, name.removesuffix("_level0"))}
        if name in MAPS:
            return {name: map_of(self.scene, self.when.t_ns, self.maps[MAPS.index(name)])[0]}
        if name in ("triangle", "part", "local"):
            local = np.where(frame.hit[..., None], frame.local, 0.0)
            return {"triangle": frame.triangle + 1, "part": frame.part, "local": local}
        if name == "velocity_pass":
            return {name: self["velocity"] if self._places is None else self._velocity_drawn()}
        of, what = lookup_of(name)
        # The event pass has textures of one channel.
        if of:
            grey = of == "luminance" and what in ("albedo", "mirrored", "emission")
            return {name: luma_of(self[what]) if grey else self[what]}
        if name in (*_COMPONENTS, "lamps", "matt", "colour", "luminance"):
            return self._surface()
        return {
            f"next_depth_{way}": np.where(self.labels.hit, getattr(self.labels, way).depth, 0.0)
            for way in ("forward", "backward")
        }

    def _own(self, own: OwnPass) -> np.ndarray:
        if own.reference is None:
            accepted = "register(…, reference=…)"
            raise ConfigError("the plug-in gives no reference", where=f"pass {own.name}", accepted=accepted)
        try:
            return np.asarray(own.reference(self.scene, self.frame))
        except Exception as error:
            raise ConfigError(f"its reference fails: {error}", where=f"pass {own.name}") from error

    def _velocity_drawn(self) -> np.ndarray:
        """Return velocity (H, W, 2), px/s in pixels of the lens, at the pixel centres of the flat picture."""
        # Position in the lens of each flat pixel, px.
        xy = self.seen.camera.project(self.scene.camera.rays(self._places.astype(np.float64)))
        hits = casting.cast(self.seen, self.when.t_ns, xy.reshape(-1, 2))
        return np.nan_to_num(casting.velocity(self.seen, hits)).reshape(xy.shape)

    def _surface(self) -> dict[str, np.ndarray]:
        frame = self.frame
        out = {name: np.zeros((*frame.hit.shape, n) if n else frame.hit.shape) for name, n in _COMPONENTS.items()}
        out["texture_size"][:] = out["needles"][:] = 1.0
        out["lamps"] = np.zeros((*frame.hit.shape, len(lamps_of(self.scene.light))))
        out["matt"] = np.ones(frame.hit.shape)
        for p, (body, part) in enumerate(casting.scene_parts(self.scene)):
            on = frame.part == p
            if on.any():
                self._look_up(out, frame, body, part, on)
                self._light_up(out, frame, part, on)
        radiance = out["lit"] + out["mirrored"] + out["emission"]
        # Fog is between the surface and the camera: apply it after all light.
        in_fog = appearance.seen_through_fog(self.scene, frame.hits(), radiance.reshape(-1, 3)).reshape(radiance.shape)
        out["colour"] = np.where(frame.hit[..., None], in_fog, frame.colour)
        out["luminance"] = out["colour"] @ LUMA
        return out

    def _look_up(
        self,
        out: dict[str, np.ndarray],
        frame: reference.ReferenceFrame,
        body: SceneObject,
        part: Part,
        on: np.ndarray,
    ) -> None:
        """Write the texture coordinates of the pixels ``on`` of a part, and the albedo there."""
        scene, mesh, material = self.scene, part.mesh, part.material
        corners = mesh.faces[frame.triangle[on]]
        pose = casting.relative_pose_at(scene, body, frame.t_ns)
        # In the axes of the camera, with the shape at this time.
        points = casting.vertices_at(mesh, frame.t_ns)[corners] @ pose[:3, :3].T + pose[:3, 3]
        out["needles"][on] = needles(points, scene.camera)
        if material.texture is not None:  # otherwise the GPU has no coordinates either
            out["uv"][on] = frame.uv[on] * material.uv_scale
            size = material.texture.image.shape[1::-1]
            out["texture_size"][on] = size
            texels, xy = mesh.uvs[corners].astype(np.float64) * material.uv_scale * size, frame.xy[on]
            out["levels"][on] = levels(points, texels, xy, scene.camera) + self.mip_bias
            out["level"][on] = out["levels"][on][:, 1]
        out["albedo"][on] = mipmapped_albedo(material, out["uv"][on], out["level"][on])
        if mesh.colours is not None:
            out["albedo"][on] *= np.einsum("nc,nck->nk", frame.bary[on], mesh.colours[corners].astype(np.float64))

    def _light_up(
        self, out: dict[str, np.ndarray], frame: reference.ReferenceFrame, part: Part, on: np.ndarray
    ) -> None:
        """Write the light of the pixels ``on`` of a part, and its terms. Their albedo must be known."""
        albedo = out["albedo"][on]
        out["lit"][on], out["light"][on], out["shadow"][on] = albedo, 1.0, 1.0
        if part.material.unlit:
            return
        rows = np.flatnonzero(on.ravel())
        sent = appearance.radiated(self.scene, frame.hits(), rows, albedo, frame.normal[on], frame.uv[on])
        out["lit"][on] *= sent.matt
        # Light is reported as the luminance of its surface: each colour counts as much as the surface reflects it.
        weights = albedo * LUMA
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)

        def seen(light):
            return (light * weights).sum(axis=1)

        direct, arrives, around = (
            seen(one) for one in (sent.light.open.sum(axis=0), sent.light.direct.sum(axis=0), sent.light.around)
        )
        light = seen(sent.matt)
        out["light"][on], out["around"][on], out["direct"][on] = light, around, direct
        # Each lamp separately, so that the fractions of soft shadows can be inserted.
        out["lamps"][on] = np.einsum("knc,nc->nk", sent.light.open, weights)
        terms = sent.light.open.sum(axis=0), sent.light.around, sent.matt
        spread = np.max([np.ptp(one, axis=1) for one in terms], axis=0)
        out["spread"][on] = spread / np.maximum(albedo @ LUMA, 1e-30)
        out["matt"][on] = np.where(arrives + around > 0, light / np.maximum(arrives + around, 1e-30), 1.0)
        out["shadow"][on] = np.where(direct > 0, arrives / np.maximum(direct, 1e-30), 1.0)
        out["mirrored"][on], out["emission"][on] = sent.mirrored, sent.emission


_COMPONENTS = {
    **dict.fromkeys(("level", "direct", "shadow", "around", "light", "spread", "needles"), 0),
    **dict.fromkeys(("uv", "texture_size"), 2),
    **dict.fromkeys(("levels", "albedo", "mirrored", "emission", "lit"), 3),
}
"""Channels of the buffers of :meth:`ReferenceMoment._surface`; 0: (H, W)."""


def open_reference(subject: Subject, when: When, maps: tuple[ShadowMap, ...] = ()) -> ReferenceMoment:
    """Return the reference buffers of a subject. maps : shadow maps of its renderer."""
    return ReferenceMoment(subject.scene, when, subject.config.render.mip_bias, maps)


def luma_of(albedo: np.ndarray) -> np.ndarray:
    """Return the (..., 3) grey of the luminance of (..., 3) albedo: the albedo of the event pass, whose textures have
    one channel."""
    return np.repeat((albedo @ LUMA)[..., None], 3, axis=-1)
