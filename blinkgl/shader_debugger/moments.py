"""Every buffer of one moment by name: :class:`GpuMoment` reads them from OpenGL, :class:`ReferenceMoment` computes them
in float64. Both hand out the same names, shapes and conventions, each computed when it is first asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.labels import LABELS, LabelRequest
from blinkgl.labels.label import Label, View
from blinkgl.render import appearance, casting, reference
from blinkgl.render.colour import LUMA
from blinkgl.render.passes.shadow import ShadowMap
from blinkgl.scene.lights import MAX_SHADOWS, shadowing
from blinkgl.scene.types import Scene
from blinkgl.shader_debugger.lamps import map_of
from blinkgl.shader_debugger.mipmaps import mipmapped_albedo
from blinkgl.shader_debugger.session import LOOKUPS as LOOKUP_PASSES, DebugRenderer, Subject, When
from blinkgl.shader_debugger.silhouettes import EDGED, edged, twin_of

_T = TypeVar("_T")


@dataclass(frozen=True)
class Pass:
    """kind : how it is shown: scalar, depth (on a logarithmic scale), signed, ids, mask, light
    (linear rgb), unit (vectors), uv, motion.
    source : the program and output that write it."""

    name: str
    title: str
    unit: str
    kind: str
    source: str


LOOKUPS = ("uv", "level", "albedo", "direct", "shadow", "around", "light", "mirrored", "emission")
"""What a pass that is lit shows of its way to the result, in the order in which it happens: albedo · light + mirrored +
emission, where the light of what is matt is direct · shadow + around."""
MAPS = tuple(f"shadow_map_{k}" for k in range(MAX_SHADOWS))
"""Buffers that are a lamp's picture, not the camera's."""


def _lookups(name: str, program: str) -> tuple[Pass, ...]:
    source = f"{program} SHOW_LOOKUP"
    return (
        Pass(f"{name}_uv", f"uv of {name}", "texture repeats", "uv", source),
        Pass(f"{name}_level", f"level of {name}", "log2(texels per px)", "scalar", source),
        Pass(f"{name}_albedo", f"albedo of {name}", "linear", "light", source),
        Pass(f"{name}_direct", f"lamps of {name}", "irradiance factor, without shadows", "scalar", source),
        Pass(f"{name}_shadow", f"shadow factor of {name}", "share of the lamps' light", "scalar", source),
        Pass(f"{name}_around", f"environment of {name}", "irradiance factor", "scalar", source),
        Pass(f"{name}_light", f"light of {name}", "irradiance factor", "scalar", source),
        Pass(f"{name}_mirrored", f"mirrored light of {name}", "linear", "light", source),
        Pass(f"{name}_emission", f"emission of {name}", "linear", "light", source),
    )


_BEFORE = (
    Pass("triangle", "triangle of its part", "0: nothing hit", "ids", "debug.glsl OUT_TRIANGLE"),
    Pass("local", "local position", "object axes", "scalar", "debug.glsl OUT_LOCAL"),
)
_SHADED = (
    *(Pass(name, name.replace("_", " "), "depth, 0: nothing casts", "scalar", "shadow.glsl") for name in MAPS),
    *_lookups("luminance", LOOKUP_PASSES["luminance"].program),
    Pass("luminance", "luminance", "linear", "scalar", "luminance.glsl"),
    *_lookups("colour", LOOKUP_PASSES["colour"].program),
    Pass("colour", "colour", "linear radiance", "light", "colour.glsl"),
    Pass("luminance_edges", "luminance, edges", "linear", "scalar", "edges.glsl"),
    Pass("colour_edges", "colour, edges", "linear radiance", "light", "edges.glsl"),
    Pass("log_luminance", "log luminance", "ln(L + log_eps)", "scalar", "luminance.glsl, then the logarithm"),
    Pass("dL_dt", "dL/dt", "1/s", "signed", "luminance.glsl at two times, difference quotient"),
)


class OfLabels(Mapping[str, _T]):
    """By the name of a buffer: one of every view of the labels that are registered now, among fixed ones, in the order
    in which a mistake shows: where the surface is (``before``, and labels of one time), what it
    looks like (``shaded``), how it moves.

    made : entry of a label and one of its views.   before, shaded : the fixed ones."""

    def __init__(self, made: Callable[[Label, View], _T], before: Iterable[_T], shaded: Iterable[_T]):
        self._made, self._before, self._shaded = made, tuple(before), tuple(shaded)

    def _all(self) -> dict[str, _T]:
        views = [
            (label.towards is None and view.kind != "motion", self._made(label, view))
            for label in LABELS.values()
            for view in label.views
        ]
        surface, motion = ([one for early, one in views if early is which] for which in (True, False))
        return {one.name: one for one in (*self._before, *surface, *self._shaded, *motion)}

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


PASSES = OfLabels(_of_label, _BEFORE, _SHADED)


def buffers_of(scene: Scene, edged: tuple[str, ...] = ()) -> dict[str, Pass]:
    """Those of :data:`PASSES` that a scene has: of one without shadows no shadow maps, and so on.

    edged : pictures with filtered silhouettes that are among them."""
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
        and (name not in EDGED or name in edged)
        and ((found := view_of(name)) is None or found[0].can_be_of(scene))
    }


def view_of(name: str) -> tuple[Label, View] | None:
    """The label that has this buffer, and its view; None: it is no label's."""
    return next(((label, view) for label in LABELS.values() for view in label.views if view.name == name), None)


def lookup_of(name: str) -> tuple[str, str]:
    """("luminance", "uv") of "luminance_uv"; ("", "") of what is no look-up."""
    pass_name, _, what = name.rpartition("_")
    return (pass_name, what) if pass_name in LOOKUP_PASSES and what in LOOKUPS else ("", "")


def check_pass(name: str, known: Any = PASSES, where: str = "--pass") -> str:
    """``name`` if it is one of ``known``. Raises ConfigError."""
    if name not in known:
        raise ConfigError("unknown pass", where=where, value=name, accepted="one of " + ", ".join(known))
    return name


class _Lazy:
    """``self[name]``, computed by the method that makes its group of buffers."""

    def __init__(self):
        self._made: dict[str, np.ndarray] = {}

    def __getitem__(self, name: str) -> np.ndarray:
        if name not in self._made:
            self._made.update(self._make(name))
        return self._made[name]

    def keep(self, other: _Lazy, names: Iterable[str]) -> None:
        """Takes these buffers from another moment in place of making them."""
        self._made |= {name: other[name] for name in names}

    def _make(self, name: str) -> dict[str, np.ndarray]:
        raise NotImplementedError


class GpuMoment(_Lazy):
    """What the GPU wrote. Besides :data:`PASSES`: part (H, W) int32, -1: nothing hit; window (H, W, 4) gl_FragCoord;
    next_depth_forward|backward (H, W), the depth at t' that the flow program returns; luminance_count, colour_count (H,
    W), the number of texture look-ups at the pixel; colour_light_rgb (H, W, 3), its light in colour; NAME_plain and
    NAME_twin of what :data:`silhouettes.EDGED` has.

    Conventions: depth inf, flow 0 and id 0 where nothing is hit; velocity 0 there.
    """

    def __init__(self, renderer: DebugRenderer, when: When, log_eps: float):
        super().__init__()
        self.renderer, self.when, self.log_eps = renderer, when, log_eps

    def _make(self, name):
        draw, when = self.renderer, self.when
        if name == "colour":
            return {name: draw.colour(when.t_ns).read()}
        if name == "luminance":
            return {name: draw.luminance(when.t_ns).read()}
        if name == "log_luminance":
            return {name: np.log(self["luminance"] + np.float32(self.log_eps))}
        if name == "dL_dt":
            change = draw.luminance(when.after_ns).read() - draw.luminance(when.before_ns).read()
            return {name: change / np.float32(when.step_s)}
        if name in EDGED:
            return {name: edged(draw, name, when.t_ns)}
        if (of := name.removesuffix("_plain").removesuffix("_twin")) in EDGED:
            plain, twin = twin_of(draw, of, when.t_ns)
            return {f"{of}_plain": plain, f"{of}_twin": twin}
        if name in MAPS:
            return {name: draw.shadow_map(MAPS.index(name), when.t_ns)}
        if name in ("triangle", "part", "local", "window"):
            return self._inspect()
        if name.endswith(("_count", "_light_rgb")) or lookup_of(name)[0]:
            of = name.partition("_")[0]
            shown = draw.lookups(of, when.t_ns)
            return {f"{of}_{key}": shown[key] for key in (*LOOKUPS, "light_rgb", "count")}
        if name.startswith("next_depth_"):
            way = name.removeprefix("next_depth_")
            raw = draw.raw(when.t_ns, f"flow_{way}", forward_ns=when.forward_ns, backward_ns=when.backward_ns)
            return {name: raw[f"flow_{way}"][..., 2]}
        return self._labels()

    def _inspect(self):
        out = self.renderer.inspect(self.when.t_ns)
        return {
            "triangle": out["TRIANGLE"],
            "part": out["LOCAL"][..., 3].astype(np.int32) - 1,
            "local": out["LOCAL"][..., :3],
            "window": out["WINDOW"],
        }

    def _labels(self):
        when = self.when
        ask = LabelRequest(*(name for name, label in LABELS.items() if label.views))
        frame = self.renderer.labels(when.t_ns, ask, when.forward_ns, when.backward_ns)
        return {view.name: view.of(frame.values[name]) for name in ask for view in LABELS[name].views}


class ReferenceMoment(_Lazy):
    """What the GPU should have written, float64, by :mod:`blinkgl.render.reference`.
    ``frame``: the reference's own frame.

    The level of a look-up is log2 of the longer of the texel footprints of one pixel step in x and y (OpenGL 4.6,
    section 8.14, eq. 8.7), from the exact derivatives of uv on the triangle's plane, plus ``mip_bias``; a GPU takes it
    from 2 x 2 pixels. The albedo, and what follows from it (colour, luminance, log_luminance, dL_dt), is sampled at
    that level by the CPU twin in :mod:`mipmaps`, because the reference itself has no mip maps; its own values, at full
    resolution, are albedo_level0, colour_level0 and luminance_level0.   texture_size : (H, W,
    2) texels, 1 where there is no texture.
    light, and its terms : of the luminance of what the surface is made of: coloured light takes of each colour as much
    as it has.
    uv, level, albedo, light … : what both passes should look up; luminance_albedo is the luminance of albedo.
    shadow_map_0 … : as ``maps``, those of the renderer, lie.
    """

    def __init__(
        self, scene: Scene, when: When, log_eps: float, mip_bias: float = 0.0, maps: tuple[ShadowMap, ...] = ()
    ):
        super().__init__()
        self.maps = maps
        self.scene, self.when, self.log_eps, self.mip_bias = scene, when, log_eps, mip_bias
        self._frame: reference.ReferenceFrame | None = None
        self._others: dict[int, reference.ReferenceFrame] = {}

    @property
    def frame(self) -> reference.ReferenceFrame:
        if self._frame is None:
            self._frame = reference.render(
                self.scene, self.when.t_ns, forward_ns=self.when.forward_ns, backward_ns=self.when.backward_ns
            )
        return self._frame

    def at(self, t_ns: int) -> reference.ReferenceFrame:
        """The frame of another time, without flow."""
        if t_ns == self.when.t_ns:
            return self.frame
        if t_ns not in self._others:
            self._others[t_ns] = reference.render(self.scene, t_ns)
        return self._others[t_ns]

    def _make(self, name):
        frame = self.frame
        if (found := view_of(name)) is not None:
            label, view = found
            try:
                return {name: np.asarray(view.reference(self.scene, frame))}
            except Exception as error:
                raise TypeError(f"label '{label.name}': `reference` fails: {error}") from error
        if name.endswith("_level0"):
            return {name: getattr(frame, name.removesuffix("_level0"))}
        if name in MAPS:
            return {name: map_of(self.scene, self.when.t_ns, self.maps[MAPS.index(name)])[0]}
        if name == "triangle":
            return {name: frame.triangle + 1}
        if name == "part":
            return {name: frame.part}
        if name == "local":
            return {name: np.where(frame.hit[..., None], frame.local, 0.0)}
        if name == "log_luminance":
            return {name: np.log(self["luminance"] + self.log_eps)}
        if name == "dL_dt":
            before, after = (self._surface(t)["luminance"] for t in (self.when.before_ns, self.when.after_ns))
            return {name: (after - before) / self.when.step_s}
        of, what = lookup_of(name)
        if of:
            grey = of == "luminance" and what in ("albedo", "mirrored", "emission")
            return {name: luma_of(self[what]) if grey else self[what]}
        if name in (*LOOKUPS, "colour", "luminance", "texture_size"):
            return self._surface(self.when.t_ns)
        return {
            f"next_depth_{way}": np.where(frame.hit, getattr(frame, way).depth, 0.0) for way in ("forward", "backward")
        }

    def _surface(self, t_ns: int) -> dict[str, np.ndarray]:
        frame, scene = self.at(t_ns), self.scene
        shape = frame.hit.shape
        uv, light, level, albedo, size = (
            np.zeros((*shape, 2)),
            np.zeros(shape),
            np.zeros(shape),
            np.zeros((*shape, 3)),
            np.ones((*shape, 2)),
        )
        lit, mirrored, emission = (albedo.copy() for _ in range(3))
        direct, around, shadow = (light.copy() for _ in range(3))
        xy = casting.pixel_grid(scene.camera).reshape(*shape, 2)
        for p, (thing, part) in enumerate(casting.scene_parts(scene)):
            on = frame.part == p
            if not on.any():
                continue
            if part.material.texture is not None:  # else the GPU has no coordinates either
                uv[on] = frame.uv[on] * part.material.uv_scale
                size[on] = part.material.texture.image.shape[1::-1]
                corners = part.mesh.faces[frame.triangle[on]]
                pose = casting.relative_pose_at(scene, thing, t_ns)
                points = casting.vertices_at(part.mesh, t_ns)[corners] @ pose[:3, :3].T + pose[:3, 3]
                texels = (
                    part.mesh.uvs[corners].astype(np.float64)
                    * part.material.uv_scale
                    * part.material.texture.image.shape[1::-1]
                )
                level[on] = (
                    footprint(points, texels, scene.camera.rays(xy[on]), scene.camera.ray_jacobian(xy[on]))
                    + self.mip_bias
                )
            albedo[on] = mipmapped_albedo(part.material, uv[on], level[on])
            if part.mesh.colours is not None:
                corners = part.mesh.colours[part.mesh.faces[frame.triangle[on]]].astype(np.float64)
                albedo[on] *= np.einsum("nc,nck->nk", frame.bary[on], corners)
            lit[on], light[on], shadow[on] = albedo[on], 1.0, 1.0
            if not part.material.unlit:
                hits, rows = frame.hits(), np.flatnonzero(on.ravel())
                sent = appearance.radiated(scene, hits, rows, albedo[on], frame.normal[on], frame.uv[on])
                lit[on] *= sent.matt
                weights = albedo[on] * LUMA
                weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-30)

                def seen(light, weights=weights):
                    return (light * weights).sum(axis=1)

                light[on], around[on], direct[on] = (
                    seen(one) for one in (sent.matt, sent.light.around, sent.light.open.sum(axis=0))
                )
                arrives = seen(sent.light.direct.sum(axis=0))
                shadow[on] = np.where(direct[on] > 0, arrives / np.maximum(direct[on], 1e-30), 1.0)
                mirrored[on], emission[on] = sent.mirrored, sent.emission
        radiance = lit + mirrored + emission
        in_fog = appearance.seen_through_fog(scene, frame.hits(), radiance.reshape(-1, 3)).reshape(radiance.shape)
        colour = np.where(frame.hit[..., None], in_fog, frame.colour)
        return {
            "uv": uv,
            "light": light,
            "level": level,
            "albedo": albedo,
            "direct": direct,
            "shadow": shadow,
            "around": around,
            "mirrored": mirrored,
            "emission": emission,
            "colour": colour,
            "luminance": colour @ LUMA,
            "texture_size": size,
        }


def open_reference(subject: Subject, when: When, maps: tuple[ShadowMap, ...] = ()) -> ReferenceMoment:
    """What the GPU should write for this subject. maps : of the renderer that draws it."""
    return ReferenceMoment(subject.scene, when, subject.log_eps, subject.config.render.mip_bias, maps)


def luma_of(albedo: np.ndarray) -> np.ndarray:
    """(..., 3) grey of the luminance of (..., 3) albedo: what the event pass, whose textures
    have one channel, shows as its albedo."""
    return np.repeat((albedo @ LUMA)[..., None], 3, axis=-1)


def footprint(points: np.ndarray, texels: np.ndarray, rays: np.ndarray, slopes: np.ndarray) -> np.ndarray:
    """(N,) log2 of the texels that one pixel step covers on the planes of N triangles.

    points : (N, 3, 3) corners, camera axes.   texels : (N, 3, 2) texture coordinates of the corners, in texels.
    rays : (N, 3) through the pixels.   slopes : (N, 3, 2) their derivatives by x and y, 1/px.
    With b = inv([A B C]) r the coordinates are (sum b_i u_i) / (sum b_i); the adjugate does, its scale cancels."""
    a, b, c = points[:, 0], points[:, 1], points[:, 2]
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    weights = np.einsum("nij,nj->ni", rows, rays)
    total = weights.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        here = np.einsum("ni,nik->nk", weights, texels) / total[:, None]
        steps = []
        for axis in (0, 1):
            slope = np.einsum("nij,nj->ni", rows, slopes[:, :, axis])  # d weights / d pixel
            change = np.einsum("ni,nik->nk", slope, texels) - here * slope.sum(axis=1)[:, None]
            steps.append(np.linalg.norm(change / total[:, None], axis=1))
        return np.log2(np.maximum(steps[0], steps[1]))
