"""Comparison of the GPU with the float64 reference over a whole image.

Graded pixels and tolerances
----------------------------
Pixels in the silhouette band (``reference.silhouette_band``: within one pixel of an id change or a jump in depth) are
reported separately: there a pixel centre may fall on either side of an edge. Outside the band a buffer is graded where
both sides see the same triangle; where they see neighbouring ones (a pixel centre on a shared
edge) only ids and masks are graded. Pictures made from other pictures (:mod:`filters`) are graded at every pixel.

Order: the buffers are graded in the order in which a pass computes them: the surface's place (local position, depth,
id), the texture lookups there (coordinates, level, albedo), the light, and their product. Each lookup is the pass's
own, shown by a variant of its own source (``include/lookup.glsl``). A result that depends on an earlier step is graded
with the GPU's value of that step: the albedo against a reference of mip-mapped sampling at the GPU's own coordinates
and level, the result against the GPU's own albedo times its own light. So the first buffer that fails contains the
fault; the verdict names it, object by object.

The frame of the reference has no mip maps, hence :mod:`mipmaps`, and a loose tolerance: OpenGL does not define how
drivers make them. With anisotropic filtering (``render.anisotropy`` > 1) level and albedo are not graded.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.render import casting
from blinkgl.render.colour import LUMA
from blinkgl.render.passes.own import OWN
from blinkgl.scene.lights import lamps_of, shadowing
from blinkgl.scene.types import Material
from blinkgl.tools.shader_debugger import appearance, reference
from blinkgl.tools.shader_debugger.filters import FILTERED
from blinkgl.tools.shader_debugger.lamps import share_range
from blinkgl.tools.shader_debugger.mipmaps import mipmapped_albedo
from blinkgl.tools.shader_debugger.moments import (
    MAPS,
    GpuMoment,
    ReferenceMoment,
    buffers_of,
    check_pass,
    lookup_of,
    luma_of,
    view_of,
)
from blinkgl.tools.shader_debugger.quantities import QUANTITIES, Quantity
from blinkgl.tools.shader_debugger.suspicions import suspicions

WORST = 10  # objects listed in a report
NOTHING = "nothing hit"
NEVER = 2.0
"""A second difference is at most twice the largest of its values."""
SIDE = 1e-4
"""Fraction of a corner below which a point may count as one of the neighbouring triangle."""
LIT = ("direct", "shadow", "around", "light", "mirrored", "emission")
MAP_JUMP = 0.005
"""A second difference of a shadow map above this part of its depth is an edge."""
NEEDS_ISOTROPIC = ("luminance_level", "luminance_albedo", "colour_level", "colour_albedo")


def parse_tolerances(texts: list[str], names: list[str]) -> dict[str, float]:
    """Return the tolerances of ``["1e-3"]`` (every compared buffer) or ``["depth=1e-4", …]``. Raises ConfigError."""
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
    """The result for one buffer. errors : (H, W) float64, nan where not comparable.   graded, band : (H, W) bool.
    value : the graded statistic.
    objects : for each object (the worst ten, worst first) its graded pixels, those over the tolerance, their median and
    largest error, and the place of the largest: x, y, error, gpu, reference, triangle."""

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
        """Limit for one pixel; a limit on a fraction of all pixels does not apply to one."""
        return self.tolerance if self.quantity.statistic == "max" else 0.0

    def summary(self) -> dict:
        """Return plain numbers, for JSON and for the table."""
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
            "not_graded": int((~self.graded).sum()),
            "histogram": histogram(inside),
            "objects": self.objects,
            "suspicions": self.suspicions,
            "note": self.quantity.note,
        }


def _at(errors: np.ndarray, q: float) -> float:
    # One of the errors themselves, because inf cannot be interpolated.
    return float(np.quantile(errors, q, method="inverted_cdf")) if errors.size else 0.0


def histogram(errors: np.ndarray) -> dict[str, int]:
    """Return counts per decade: "0", "<1e-8", "1e-8", … (from this power of ten up to the next), "inf"."""
    finite = errors[(errors > 0) & np.isfinite(errors)]
    decades, counts = np.unique(np.clip(np.floor(np.log10(finite)), -9, 9).astype(int), return_counts=True)
    named = {"<1e-8" if d == -9 else f"1e{d:+d}": int(n) for d, n in zip(decades, counts)}
    beyond = int(np.isinf(errors).sum())
    return {"0": int((errors == 0).sum())} | named | ({"inf": beyond} if beyond else {})


def is_mapped(material: Material) -> bool:
    """Return whether more than its base colour comes from a picture."""
    gloss = material.gloss is not None and material.gloss.map is not None
    return material.bumps is not None or material.emission_map is not None or gloss


class Comparison:
    """Masks common to all buffers, and :meth:`report` for one of them. objects : distinct names of the scene's
    objects."""

    def __init__(self, gpu: GpuMoment, ref: ReferenceMoment):
        self.gpu, self.ref = gpu, ref
        flat, seen = ref.frame, ref.labels
        self.band = reference.silhouette_band(seen.instance, seen.depth)
        self.same_triangle = (gpu["part"] == ref["part"]) & ((gpu["triangle"] == ref["triangle"]) | ~flat.hit)
        self._same_label = self.same_triangle
        if seen is not flat:
            # Pixels that a lens reads have unequal distances: only the lens's own depths show where they jump.
            self.band |= reference.silhouette_band(flat.instance, flat.depth, jump=NEVER)
            # No buffer has the triangle that a lens's ray met on the GPU; away from the sides both met the same one.
            self._same_label = (seen.bary.min(axis=-1) > SIDE) | ~seen.hit
        names = [body.name or f"object {body.instance_id}" for body in ref.scene.objects]
        self.objects = [
            name if names.count(name) == 1 else f"{name} (id {body.instance_id})"
            for name, body in zip(names, ref.scene.objects)
        ] + [NOTHING]
        # In the order of casting.scene_parts; the last is that of part -1.
        of_parts = [i for i, body in enumerate(ref.scene.objects) for _ in body.parts]
        self._object_of_part = np.array([*of_parts, len(names)], np.intp)

    def owner(self, name: str) -> np.ndarray:
        """Return the (H, W) number of the object to which a pixel's error in buffer ``name`` is assigned: the one that
        should be visible, or, for the local position, the one that was drawn."""
        part = self.gpu["part"] if name == "local" else self._frame(name).part
        return self._object_of_part[part]

    def _frame(self, name: str) -> reference.ReferenceFrame:
        return self.ref.frame if view_of(name) is None else self.ref.labels

    @cached_property
    def shares(self) -> np.ndarray | None:
        """(2, lamps, H, W) smallest and largest visible fraction of each lamp with soft shadows; None where there are
        none."""
        ref, lamps = self.ref, lamps_of(self.ref.scene.light)
        # Either all maps of a scene are soft or none is.
        if not any(one.soft for one in ref.maps):
            return None
        out = np.ones((2, len(lamps), *ref.frame.hit.shape))
        for one, k, name in zip(ref.maps, shadowing(ref.scene.light), MAPS):
            out[:, k] = share_range(ref.scene, ref.frame, one, self.gpu[name])
        return out

    @cached_property
    def shadow_edges(self) -> np.ndarray:
        """(H, W) bool: where shadows of maps differ from those of rays, because of texels or of softness."""
        if self.shares is None:
            return self.ref.shadow_edges
        # A highlight may come from a lamp that is weak among all: the penumbras of all lamps are left out.
        penumbra = ((self.shares[0] > 0) & (self.shares[1] < 1)).any(axis=0)
        return penumbra | (np.abs(self._seen_past(self.shares[0]) - self.ref["shadow"]) > 1e-4)

    def _seen_past(self, shares: np.ndarray) -> np.ndarray:
        """Return the (H, W) fraction of all lamps' light, from (lamps, H, W) fractions of each."""
        each = self.ref["lamps"]
        total = each.sum(axis=-1)
        arrives = (each * np.moveaxis(shares, 0, -1)).sum(axis=-1)
        return np.where(total > 0, arrives / np.maximum(total, 1e-30), 1.0)

    def names(self) -> list[str]:
        """Return every buffer that can be graded here."""
        left_out = self.left_out()
        return [name for name in self._there if name not in left_out]

    def left_out(self) -> list[str]:
        """Return the buffers that cannot be graded here, because anisotropic filtering depends on the driver."""
        isotropic = self.gpu.renderer.config.anisotropy <= 1
        return [name for name in self._there if not isotropic and name in NEEDS_ISOTROPIC]

    @cached_property
    def _there(self) -> list[str]:
        there = buffers_of(self.ref.seen, self.gpu.renderer.filtered)
        # A pass that reads its neighbours has others in the flat picture that a lens looks at.
        flat = self.ref.scene is self.ref.seen
        return [name for name in QUANTITIES if name in there and (flat or name not in OWN)]

    def pair(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return (GPU, the values to grade it against); equal shapes."""
        gpu, ref = self.gpu, self.ref
        of, what = lookup_of(name)
        if name in FILTERED:
            return gpu[name], gpu[f"{name}_reference"]
        if what == "albedo":
            return gpu[name], self.reference_albedo(of)
        if what == "shadow" and self.shares is not None:
            low, high = (self._seen_past(shares) for shares in self.shares)
            return gpu[name], np.clip(gpu[name], low, high)
        if what == "light" and ref.maps:
            # With the pass's own shadows, which are graded before.
            darker = ref["direct"] * (gpu[f"{of}_shadow"] - ref["shadow"])
            return gpu[name], ref["light"] + ref["matt"] * darker
        if name in ("luminance", "colour"):
            return gpu[name], self._shaded(name)
        if np.shape(gpu[name]) != np.shape(ref[name]):
            raise TypeError(f"'{name}': `reference` gives {np.shape(ref[name])} and not {np.shape(gpu[name])}")
        return gpu[name], ref[name]

    def _shaded(self, name: str) -> np.ndarray:
        """Return the product of a pass's own albedo and its own light, plus what it adds."""
        gpu, ref = self.gpu, self.ref
        light = gpu["colour_light_rgb"] if name == "colour" else gpu["luminance_light"][..., None]
        shaded = gpu[f"{name}_albedo"].astype(np.float64) * light
        shaded = shaded + gpu[f"{name}_mirrored"] + gpu[f"{name}_emission"]
        in_fog = appearance.seen_through_fog(ref.scene, ref.frame.hits(), shaded.reshape(-1, 3)).reshape(shaded.shape)
        if name == "luminance":
            return np.where(ref.frame.hit, in_fog[..., 0], ref[name])
        return np.where(ref.frame.hit[..., None], in_fog, ref[name])

    def reference_albedo(self, of: str) -> np.ndarray:
        """Return the (H, W, 3) float64 albedo that pass ``of`` should have found with its own coordinates and level; 0
        where it drew nothing."""
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
        """Return the (H, W) float64 errors in the quantity's unit; inf where the GPU wrote nan. On very thin triangles
        they are reduced by how much farther float32 may misplace the surface."""
        g, r = self.pair(name)
        error = QUANTITIES[name].error(g, r, self.gpu, self.ref)
        error = np.where(np.isnan(error), np.inf, error)
        if lookup_of(name)[1] in ("direct", "around", "light"):
            # Coloured light is reported as the luminance of its surface: a mean over three channels, weighted by an
            # albedo that is graded separately. Other weights change the mean by the channels' spread at most.
            of, albedo = lookup_of(name)[0], self.ref["albedo"]
            weights = np.abs(self.gpu["colour_albedo"] - albedo) @ LUMA
            if of == "luminance":  # its own albedo is grey, so only the sum of its colours is known
                weights = weights + np.abs(self.gpu["luminance_albedo"] - luma_of(albedo))[..., 0]
            error = np.maximum(error - self.ref["spread"] * weights, 0.0)
        return error / self.ref["needles"] if name == "local" or QUANTITIES[name].same_triangle else error

    def graded(self, name: str) -> np.ndarray:
        """Return (H, W) bool: pixels at which a buffer is graded."""
        if name in MAPS:
            depth = self.ref[name]
            with np.errstate(divide="ignore"):
                return ~reference.silhouette_band(depth > 0, 1.0 / depth, jump=MAP_JUMP)
        if name in FILTERED:
            return np.ones_like(self.band)
        graded = ~self.band
        if QUANTITIES[name].same_triangle:
            graded &= self.same_triangle if view_of(name) is None else self._same_label
        of, what = lookup_of(name)
        if what in LIT:
            # The reference reads maps at full resolution, a GPU from mip maps.
            mapped = [p for p, (_, part) in enumerate(casting.scene_parts(self.ref.scene)) if is_mapped(part.material)]
            graded &= ~np.isin(self.ref.frame.part, mapped)
            # Light is reported as the luminance of its surface: on a black one it is zero.
            graded &= ~self.ref.frame.hit | (self.ref["albedo"].any(axis=-1) & self.gpu[f"{of}_albedo"].any(axis=-1))
        if what == "mirrored" or (what == "shadow" and self.shares is None):
            graded &= ~self.shadow_edges
        return graded

    def report(self, name: str, tolerance: float | None = None) -> BufferReport:
        quantity, errors, graded = QUANTITIES[name], self.errors(name), self.graded(name)
        band = ~graded if name in MAPS else self.band & ~graded
        inside = errors[graded]
        # Without graded pixels there is no error; the verdict counts it.
        value = (float(inside.mean()) if quantity.statistic == "mean" else float(inside.max())) if inside.size else 0.0
        report = BufferReport(
            quantity, quantity.tolerance if tolerance is None else tolerance, errors, graded, band, value
        )
        report.objects = self._per_object(report)
        if not report.passed and name not in (*MAPS, "local"):
            report.suspicions = suspicions(self, report)
        return report

    def _per_object(self, report: BufferReport) -> list[dict]:
        name = report.quantity.name
        g, r = self.pair(name)
        owner = np.full(report.errors.shape, len(self.objects) - 1) if name in MAPS else self.owner(name)
        out = []
        # Objects are listed separately, because a mistake in one variant affects only some objects.
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
                    "triangle": -1 if name in MAPS else int(self._frame(name).triangle[y, x]),
                }
            )
        return sorted(out, key=lambda one: -one["max"])[:WORST]


# ---------------------------------------------------------------------------------------------------------------------
# The place of the fault: the first wrong buffer, in the order in which a pass computes them, object by object.


def verdict(reports: list[BufferReport], unused: Iterable[tuple[str, str]] = (), left_out: Iterable[str] = ()) -> dict:
    """Return the verdict as plain data (JSON).

    passed : every buffer is within its tolerance, and nothing is unused.
    unused : sorted (program, name) of uniforms and attributes that a run sets and that the programs do not use.
    not_graded : one line: the pixels and buffers (``left_out``) that are not graded.
    first : {buffer, title, source, objects, suspicions} of the first that is not.
    objects : per object that is over a tolerance, in the order of ``first``: object, first (buffer), x, y (the worst
    pixel there), over_tolerance and pixels (of that buffer), then (the other buffers that are
    wrong), suspicion ("" when none fits)."""
    order = list(QUANTITIES)
    failed = sorted((r for r in reports if not r.passed), key=lambda r: order.index(r.quantity.name))
    rows: dict[str, dict] = {}
    for report in failed:
        # Each object with the first buffer that is wrong on it, then its others.
        for one in report.objects:
            if not one["over_tolerance"]:
                continue
            name = report.quantity.name
            row = rows.setdefault(
                one["object"],
                {
                    "object": one["object"],
                    "first": name,
                    "x": one["x"],
                    "y": one["y"],
                    "pixels": one["pixels"],
                    "over_tolerance": one["over_tolerance"],
                    "then": [],
                    "suspicion": next(iter(report.suspicions), ""),
                },
            )
            if row["first"] != name:
                row["then"].append(name)
    first = None
    if failed:
        top = failed[0].quantity
        first = {
            "buffer": top.name,
            "title": top.title,
            "source": top.source,
            "suspicions": failed[0].suspicions,
            "objects": [row["object"] for row in rows.values() if row["first"] == top.name],
        }
    gone = sorted(unused)
    return {
        "passed": not failed and not gone,
        "unused": gone,
        "not_graded": _not_graded(reports, list(left_out)),
        "first": first,
        "objects": list(rows.values()),
    }


def _not_graded(reports: list[BufferReport], left_out: list[str]) -> str:
    """Return one line: how many pixels most buffers leave out, and the buffers that leave out more."""
    counts = {report.quantity.name: (int((~report.graded).sum()), report.graded.size) for report in reports}
    # Most buffers leave out silhouettes; those that leave out more are named.
    shares = [count / size for count, size in counts.values()]
    # Up to a hundredth more are pixels on the sides of triangles.
    usual = float(np.median(shares)) + 0.01
    most = max((one for one in counts.values() if one[0] <= usual * one[1]), key=lambda one: one[0] / one[1])
    line = f"not graded: up to {most[0]} of {most[1]} px of a buffer"
    more = [f"{name} {count} of {size}" for name, (count, size) in counts.items() if count > usual * size]
    whole = [f"{name} not at all (anisotropic filtering is the driver's own)" for name in left_out]
    return "; ".join([line, *more, *whole])


def as_text(result: dict) -> list[str]:
    """Return the verdict as lines."""
    lines = [f"{program}: the shader no longer uses '{name}'" for program, name in result["unused"]]
    first = result["first"]
    if first is None:
        return lines
    lines += [
        f"The first that is wrong: {first['title']} ({first['source']})"
        + (f", on {', '.join(first['objects'])}" if first["objects"] else "")
    ]
    lines += [f"  it looks as if: {text}" for text in first["suspicions"]]
    lines += ["", f"  {'object':<16} {'first wrong':<22} {'over':>7} {'of px':>7}  {'worst at':<12} then also; why"]
    for row in result["objects"]:
        place = f"({row['x']}, {row['y']})"
        more = ", ".join(row["then"]) or "nothing"
        lines.append(
            f"  {row['object']:<16} {QUANTITIES[row['first']].title:<22} {row['over_tolerance']:>7} "
            f"{row['pixels']:>7}  {place:<12} {more}"
            + (f"; {row['suspicion']}" if row["suspicion"] and row["suspicion"] not in first["suspicions"] else "")
        )
    return lines
