"""The GPU against the float64 reference over a whole image.

What is graded, and with which tolerance
----------------------------------------
Pixels in the silhouette band (``reference.silhouette_band``: within one pixel of an id change or a jump in depth) are
reported apart: there a pixel centre may fall on either side of an edge. Off the band a buffer is graded where both
sides see the same triangle; where they see neighbouring ones (a pixel centre on a shared
edge) only ids and masks are graded.

Order: the buffers are graded in the order in which a pass makes them: where the surface is (local position, depth, id),
what the pass looks up there (coordinates, level, albedo), the light, and their product. Each look-up is the pass's own,
shown by a variant of its own source (``include/lookup.glsl``), and what follows from an earlier step is graded with
that step as the GPU made it: the albedo against a CPU twin of mip-mapped sampling at the GPU's own coordinates and
level, the result against the GPU's own albedo times its own light. So the first buffer that fails is where the fault
is; ``verdict.py`` says so, object by object.

The reference has no mip maps, hence the twin, and a loose tolerance: drivers may make mip maps as they like. With
anisotropic filtering (``render.anisotropy`` > 1) level and albedo are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from dataclasses import dataclass, field

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.labels.grading import length
from blinkgl.labels.label import Label, View
from blinkgl.render import appearance, casting, reference
from blinkgl.scene.lights import is_coloured
from blinkgl.scene.types import Material
from blinkgl.shader_debugger.lamps import near_an_edge
from blinkgl.shader_debugger.mipmaps import mipmapped_albedo
from blinkgl.shader_debugger.moments import (
    MAPS,
    PASSES,
    GpuMoment,
    OfLabels,
    ReferenceMoment,
    buffers_of,
    check_pass,
    lookup_of,
    luma_of,
)
from blinkgl.shader_debugger.silhouettes import EDGED
from blinkgl.shader_debugger.suspicions import suspicions

WORST = 10  # objects told apart in a report
NOTHING = "nothing hit"


@dataclass(frozen=True)
class Quantity:
    """How one buffer is graded. error : (what the GPU wrote, the reference, both moments) -> (H, W) >= 0 in ``unit``.

    statistic : "max" of the graded pixels' errors, or "mean" (the fraction of pixels, for
    masks), must not exceed ``tolerance``.
    fit : error, in tolerances, that is left to a suspicion that explains the buffer.
    """

    name: str
    unit: str
    tolerance: float
    error: Callable
    statistic: str = "max"
    same_triangle: bool = True
    note: str = ""
    fit: float = 10.0

    @property
    def title(self) -> str:
        return PASSES[self.name].title

    @property
    def source(self) -> str:
        return PASSES[self.name].source


def _absolute(g, r, gpu, ref):
    return length(g.astype(np.float64) - r)


def _relative(g, r, gpu, ref):
    return length(g.astype(np.float64) - r) / np.maximum(1.0, length(r))


def _per_step(g, r, gpu, ref):
    return length(g.astype(np.float64) - r) * gpu.when.step_s


def _pixels_of_texture(g, r, gpu, ref):
    """How far the texture is shifted, in px: at a grazing angle one pixel spans many repeats, and so does float32's
    rounding. Whole repeats are no shift."""
    shift = g.astype(np.float64) - r
    return length((shift - np.rint(shift)) * ref["texture_size"]) / np.exp2(ref["level"])


def _of_the_lamps(g, r, gpu, ref):
    """What a wrong shadow does to the light: where a lamp hardly shines nobody sees its shadow."""
    return np.abs(g.astype(np.float64) - r) * np.minimum(ref["direct"], 1.0)


def _of_the_picture(g, r, gpu, ref):
    """Where it is bright of the pixel itself, else of what the picture has in the mean."""
    size = length(r)
    return length(g.astype(np.float64) - r) / np.maximum(max(size.mean(), 1e-12), size)


def _misplaced(g, r, gpu, ref):
    """(H, W) px from each pixel's centre to where the point drawn there lies by the true poses; inf where that is out
    of the camera's sight. Needs nothing of the ray caster, so that a wrong pose is told apart from what comes later."""
    part = gpu["part"]
    out = np.zeros((*part.shape, 2))
    for p, (thing, _) in enumerate(casting.scene_parts(ref.scene)):
        y, x = np.nonzero(part == p)
        pose = casting.relative_pose_at(ref.scene, thing, ref.when.t_ns)
        seen = ref.scene.camera.project(gpu["local"][y, x].astype(np.float64) @ pose[:3, :3].T + pose[:3, 3])
        out[y, x] = np.nan_to_num(seen - np.stack([x, y], axis=1), nan=np.inf)
    return length(out)


_TWIN = "against a CPU twin of mip-mapped sampling at the GPU's own uv and level; drivers may make mip maps differently"
_SHADING = "against the GPU's own albedo times its own light, and what it adds"
_MAPPED = "not graded where a map says how a surface shines, which the reference has without mip maps"
_LEVEL = "drivers may approximate the level (OpenGL 4.6, 8.14.1)"
_EDGES = "not graded near the edge of a shadow, nor where light grazes: there a map is off by its texels"
_MAP = "off its silhouettes"
_FILTERED = "at all pixels, against a float64 twin on the GPU's own unfiltered picture and depths (edges_twin.py)"
_MIPS = "against a CPU twin of mip-mapped sampling; drivers may make mip maps differently, hence the loose tolerance"


def _shading(name: str, unit: str) -> tuple[Quantity, ...]:
    """The steps of one pass that shades."""
    return (
        Quantity(f"{name}_uv", "px of shifted texture", 0.01, _pixels_of_texture, fit=2.0),
        Quantity(f"{name}_level", "levels", 0.6, _absolute, note=_LEVEL, fit=1.0),
        # sRGB textures of 8 bits: llvmpipe rounds each of their mip levels to 8 bits again, 0.025 after ten
        Quantity(f"{name}_albedo", "linear", 0.05 if name == "colour" else 0.03, _absolute, note=_TWIN, fit=1.0),
        Quantity(f"{name}_direct", "1", 1e-4, _relative, note=_MAPPED),
        Quantity(f"{name}_shadow", "light", 1e-3, _of_the_lamps, note=_EDGES),
        Quantity(f"{name}_around", "1", 1e-4, _relative, note=_MAPPED),
        Quantity(f"{name}_light", "1", 1e-4, _relative, note=_MAPPED),
        # a highlight is steep: float32's normal is 1e-7 off, and a mirror's lobe 0.0025 wide
        Quantity(f"{name}_mirrored", "linear", 2e-3, _relative, note=_MAPPED),
        Quantity(f"{name}_emission", "linear", 1e-4, _relative, note=_MAPPED),
        Quantity(name, unit, 1e-4, _absolute, note=_SHADING),
    )


_BEFORE = (
    Quantity(
        "local",
        "px of misplaced surface",
        0.01,
        _misplaced,
        same_triangle=False,
        note="how far from its pixel the point that was drawn lies by the true poses",
    ),
)
_SHADED = (
    *(Quantity(name, "depth", 1e-3, _absolute, same_triangle=False, note=_MAP) for name in MAPS),
    *_shading("luminance", "linear"),
    *_shading("colour", "linear radiance"),
    *(
        Quantity(name, "of the pixel or mean", 1e-4, _of_the_picture, same_triangle=False, note=_FILTERED)
        for name in EDGED
    ),
    Quantity("dL_dt", "luminance over the step", 0.05, _per_step, note=_MIPS),
)


def _of_label(label: Label, view: View) -> Quantity:
    def error(g, r, gpu, ref):
        return view.error(g, r, gpu.when.interval_s)

    return Quantity(view.name, view.judged_in, view.tolerance, error, view.statistic, view.same_triangle, view.note)


QUANTITIES = OfLabels(_of_label, _BEFORE, _SHADED)
"""In the order in which a pass makes them: the first that is wrong is where to look."""
LIT = ("direct", "shadow", "around", "light", "mirrored", "emission")
MAP_JUMP = 0.005
"""A second difference of a shadow map above this part of its depth is an edge."""
COLOURED = 10.0
"""In coloured light a term is weighed by the colours of the albedo, which mip maps of 8 bits know no better: so much
wider are tolerances."""
NEEDS_ISOTROPIC = ("luminance_level", "luminance_albedo", "colour_level", "colour_albedo", "dL_dt")


def parse_tolerances(texts: list[str], names: list[str]) -> dict[str, float]:
    """``["1e-3"]`` for every compared buffer, or ``["depth=1e-4", …]``. Raises ConfigError."""
    out: dict[str, float] = {}
    for text in texts:
        name, equals, number = text.rpartition("=")
        try:
            value = float(number)
        except ValueError:
            value = float("nan")
        if not value >= 0:
            raise ConfigError(
                "not a tolerance", where="--tolerance", value=text, accepted="a number >= 0, or BUFFER=number"
            )
        out |= {check_pass(name, QUANTITIES, "--tolerance"): value} if equals else dict.fromkeys(names, value)
    return out


@dataclass(eq=False)
class BufferReport:
    """Of one buffer. errors : (H, W) float64, nan where not comparable.   graded, band : (H, W) bool.
    value : the graded statistic.
    objects : of each object (the worst ten, worst first) its graded pixels, those over the tolerance, their median and
    largest error, and where the largest is: x, y, error, gpu, reference, triangle."""

    quantity: Quantity
    tolerance: float
    errors: np.ndarray
    graded: np.ndarray
    band: np.ndarray
    value: float
    objects: list[dict] = field(default_factory=list)
    suspicions: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return self.value <= self.tolerance

    @property
    def limit(self) -> float:
        """Of one pixel: a fraction of all says nothing about one."""
        return self.tolerance if self.quantity.statistic == "max" else 0.0

    def summary(self) -> dict:
        """Plain numbers, for JSON and for the table."""
        inside, band = self.errors[self.graded], self.errors[self.band & ~np.isnan(self.errors)]

        def stats(e):
            return {
                "pixels": int(e.size),
                "median": _at(e, 0.5),
                "p99": _at(e, 0.99),
                "max": _at(e, 1.0),
                "over_tolerance": int((e > self.limit).sum()),
            }

        return {
            "buffer": self.quantity.name,
            "unit": self.quantity.unit,
            "statistic": self.quantity.statistic,
            "value": self.value,
            "tolerance": self.tolerance,
            "passed": self.passed,
            "off_silhouettes": stats(inside),
            "silhouette_band": stats(band),
            "histogram": histogram(inside),
            "objects": self.objects,
            "suspicions": self.suspicions,
            "note": self.quantity.note,
        }


def _at(errors: np.ndarray, q: float) -> float:
    if not errors.size:
        return 0.0
    k = min(errors.size - 1, int(np.ceil(q * errors.size)) - 1 if q < 1 else errors.size - 1)
    return float(np.partition(errors, max(k, 0))[max(k, 0)])


def histogram(errors: np.ndarray) -> dict[str, int]:
    """Counts per decade: "0", "<1e-8", "1e-8", … (from this power of ten up to the next), "inf"."""
    finite = errors[(errors > 0) & np.isfinite(errors)]
    decades = np.clip(np.floor(np.log10(finite)).astype(int), -9, 9)
    out = {"0": int((errors == 0).sum())}
    for d in range(-9, 10):
        if n := int((decades == d).sum()):
            out["<1e-8" if d == -9 else f"1e{d:+d}"] = n
    if n := int(np.isinf(errors).sum()):
        out["inf"] = n
    return out


def is_mapped(material: Material) -> bool:
    """Whether more than its base colour comes from a picture."""
    gloss = material.gloss is not None and material.gloss.map is not None
    return material.bumps is not None or material.emission_map is not None or gloss


class Comparison:
    """Masks that all buffers share, and :meth:`report` for one of them. objects : names of
    the scene's objects, told apart."""

    def __init__(self, gpu: GpuMoment, ref: ReferenceMoment):
        self.gpu, self.ref = gpu, ref
        frame = ref.frame
        self.band = reference.silhouette_band(frame.instance, frame.depth)
        self._coloured = is_coloured(ref.scene.light)
        self._shadow_edges: dict[int, np.ndarray] = {}
        self.same_triangle = (gpu["part"] == ref["part"]) & ((gpu["triangle"] == ref["triangle"]) | ~frame.hit)
        things = [thing for thing, _ in casting.scene_parts(ref.scene)]
        names = [thing.name or f"object {thing.instance_id}" for thing in ref.scene.objects]
        self.objects = [
            name if names.count(name) == 1 else f"{name} (id {thing.instance_id})"
            for name, thing in zip(names, ref.scene.objects)
        ] + [NOTHING]
        index = {id(thing): i for i, thing in enumerate(ref.scene.objects)}
        self._object_of_part = np.array([index[id(thing)] for thing in things] + [len(names)], np.intp)

    def of(self, gpu: GpuMoment) -> Comparison:
        """The same of another picture of the same moment, whose surfaces lie where they were."""
        other = copy(self)
        other.gpu = gpu
        return other

    def owner(self, name: str) -> np.ndarray:
        """(H, W) number of the object that a pixel's error in buffer ``name`` is put down to: the one that should be
        there, or, for the local position, the one that was drawn."""
        return self._object_of_part[(self.gpu if name == "local" else self.ref)["part"]]

    def tolerance(self, name: str) -> float:
        """Of a buffer of this scene, where nobody says another."""
        wider = COLOURED if lookup_of(name)[1] in ("direct", "around", "light") and self._coloured else 1.0
        return wider * QUANTITIES[name].tolerance

    def shadow_edges(self, t_ns: int) -> np.ndarray:
        """(H, W) bool: where shadows are not graded."""
        if t_ns not in self._shadow_edges:
            frame, maps = self.ref.at(t_ns), self.ref.maps
            self._shadow_edges[t_ns] = (
                near_an_edge(self.ref.scene, frame, maps) if maps else np.zeros(frame.hit.shape, bool)
            )
        return self._shadow_edges[t_ns]

    def map_band(self, name: str) -> np.ndarray:
        """(texels, texels) bool: silhouettes of a shadow map."""
        depth = self.ref[name]
        with np.errstate(divide="ignore"):
            return reference.silhouette_band(depth > 0, 1.0 / depth, jump=MAP_JUMP)

    def names(self) -> list[str]:
        """Every buffer that can be graded here."""
        renderer = self.gpu.renderer
        isotropic, there = renderer.config.anisotropy <= 1, buffers_of(self.ref.scene, renderer.edged)
        return [name for name in QUANTITIES if name in there and (isotropic or name not in NEEDS_ISOTROPIC)]

    def pair(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(GPU, what it is graded against); equal shapes."""
        gpu, ref = self.gpu, self.ref
        of, what = lookup_of(name)
        if name in EDGED:
            return gpu[name], gpu[f"{name}_twin"]
        if what == "albedo":
            return gpu[name], self.twin(of)
        if name in ("luminance", "colour"):
            light = gpu["colour_light_rgb"] if name == "colour" else gpu["luminance_light"][..., None]
            shaded = gpu[f"{name}_albedo"].astype(np.float64) * light
            shaded = shaded + gpu[f"{name}_mirrored"] + gpu[f"{name}_emission"]
            shaded = appearance.seen_through_fog(ref.scene, ref.frame.hits(), shaded.reshape(-1, 3)).reshape(
                shaded.shape
            )
            shaded = shaded if name == "colour" else shaded[..., 0]
            hit = ref.frame.hit if name == "luminance" else ref.frame.hit[..., None]
            return gpu[name], np.where(hit, shaded, ref[name])
        if np.shape(gpu[name]) != np.shape(ref[name]):
            raise TypeError(f"label '{name}': `reference` gives {np.shape(ref[name])} and not {np.shape(gpu[name])}")
        return gpu[name], ref[name]

    def twin(self, of: str) -> np.ndarray:
        """(H, W, 3) float64 albedo that pass ``of`` should have found with its own coordinates and level; 0 where it
        drew nothing."""
        gpu, frame = self.gpu, self.ref.frame
        out = np.zeros((*gpu["part"].shape, 3))
        for p, (_, part) in enumerate(casting.scene_parts(self.ref.scene)):
            on = gpu["part"] == p
            uv, level = (gpu[f"{of}_{what}"][on].astype(np.float64) for what in ("uv", "level"))
            out[on] = mipmapped_albedo(part.material, np.nan_to_num(uv), level)
            if part.mesh.colours is not None:
                same = on & (frame.part == p)
                corners = part.mesh.colours[part.mesh.faces[frame.triangle[same]]].astype(np.float64)
                out[same] *= np.einsum("nc,nck->nk", frame.bary[same], corners)
        return out if of == "colour" else luma_of(out)

    def errors(self, name: str) -> np.ndarray:
        """(H, W) float64 in the quantity's unit; inf where the GPU wrote nan."""
        g, r = self.pair(name)
        error = QUANTITIES[name].error(g, r, self.gpu, self.ref)
        return np.where(np.isnan(error), np.inf, error)

    def report(self, name: str, tolerance: float | None = None) -> BufferReport:
        quantity = QUANTITIES[name]
        errors = self.errors(name)
        of_map = name in MAPS
        band = self.map_band(name) if of_map else np.zeros_like(self.band) if name in EDGED else self.band
        graded = ~band
        if quantity.same_triangle:
            graded &= self.same_triangle
        if lookup_of(name)[1] in ("shadow", "light", "mirrored"):
            graded &= ~self.shadow_edges(self.gpu.when.t_ns)
        if lookup_of(name)[1] in LIT:
            for p, (_, part) in enumerate(casting.scene_parts(self.ref.scene)):
                if is_mapped(part.material):
                    graded &= self.ref.frame.part != p
        if name == "dL_dt":
            for t_ns in (self.gpu.when.before_ns, self.gpu.when.after_ns):
                other, drawn = self.ref.at(t_ns), self.gpu.renderer.inspect(t_ns)
                graded &= ~reference.silhouette_band(other.instance, other.depth) & (other.part == self.ref["part"])
                graded &= (drawn["TRIANGLE"] == other.triangle + 1) & (drawn["LOCAL"][..., 3] == other.part + 1)
                graded &= ~self.shadow_edges(t_ns)
        if name == "local":
            graded &= self.gpu["part"] >= 0
        inside = errors[graded]
        value = (float(inside.mean()) if quantity.statistic == "mean" else float(inside.max())) if inside.size else 0.0
        report = BufferReport(
            quantity, self.tolerance(name) if tolerance is None else tolerance, errors, graded, band, value
        )
        report.objects = self._per_object(report)
        if not report.passed and not of_map and name != "local":
            report.suspicions = suspicions(self, report)
        return report

    def _per_object(self, report: BufferReport) -> list[dict]:
        name = report.quantity.name
        g, r = self.pair(name)
        owner = np.full(report.errors.shape, len(self.objects) - 1) if name in MAPS else self.owner(name)
        out = []
        for k in np.unique(owner[report.graded]):
            rows = np.flatnonzero((report.graded & (owner == k)).ravel())
            errors = report.errors.ravel()[rows]
            y, x = np.unravel_index(rows[errors.argmax()], owner.shape)
            out.append(
                {
                    "object": name if name in MAPS else self.objects[k],
                    "pixels": len(rows),
                    "over_tolerance": int((errors > report.limit).sum()),
                    "median": _at(errors, 0.5),
                    "max": float(errors.max()),
                    "x": int(x),
                    "y": int(y),
                    "error": float(errors.max()),
                    "gpu": g[y, x].tolist(),
                    "reference": r[y, x].tolist(),
                    "triangle": -1 if name in MAPS else int(self.ref["triangle"][y, x]) - 1,
                }
            )
        return sorted(out, key=lambda one: -one["max"])[:WORST]
