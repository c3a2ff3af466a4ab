"""The GPU against the float64 reference over a whole image.

What is graded, and with which tolerance
----------------------------------------
Pixels in the silhouette band (``reference.silhouette_band``: within one pixel of an id change or a jump in depth) are reported
apart: there a pixel centre may fall on either side of an edge. Off the band a buffer is graded where both sides see the same
triangle; where they see neighbouring ones (a pixel centre on a shared edge) only ids and masks are graded.

Light: the reference has no mip maps, so textured light is compared in two steps. ``albedo`` (and with it ``mip_level`` and
``dL_dt``) is compared with a CPU twin of mip-mapped sampling, loosely. ``luminance`` and ``colour`` are compared with the albedo
*that the GPU itself sampled* times the reference's irradiance, tightly. A wrong texture shows in the first, a wrong light or
normal in the second. With anisotropic filtering (``render.anisotropy`` > 1) the first step is left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from blinkgl.errors import ConfigError
from blinkgl.render import reference
from blinkgl.tools.shader_debugger.moments import GpuMoment, ReferenceMoment, check_pass
from blinkgl.tools.shader_debugger.suspicions import suspicions

WORST = 10


@dataclass(frozen=True)
class Quantity:
    """How one buffer is graded. error : (what the GPU wrote, the reference, both moments) -> (H, W) >= 0 in ``unit``.

    statistic : "max" of the graded pixels' errors, or "mean" (the fraction of pixels, for masks), must not exceed ``tolerance``.
    """

    name: str
    unit: str
    tolerance: float
    error: Callable
    statistic: str = "max"
    same_triangle: bool = True
    note: str = ""


def length(difference: np.ndarray) -> np.ndarray:
    return np.linalg.norm(difference, axis=-1) if difference.ndim == 3 else np.abs(difference)


def _absolute(g, r, gpu, ref):
    return length(g.astype(np.float64) - r)


def _relative(g, r, gpu, ref):
    with np.errstate(divide="ignore", invalid="ignore"):
        error = np.abs(g / r - 1.0)
    return np.where(np.isinf(g) & np.isinf(r), 0.0, error)


def _different(g, r, gpu, ref):
    return (g != r).astype(np.float64)


def _motion(g, r, gpu, ref):
    """px; of motions longer than 100 px, px per 100 px: float32 rounds them in proportion."""
    return length(g.astype(np.float64) - r) / np.maximum(1.0, length(r) / 100.0)


def _per_interval(g, r, gpu, ref):
    return _motion(g * gpu.when.interval_s, r * gpu.when.interval_s, gpu, ref)


def _per_step(g, r, gpu, ref):
    return length(g.astype(np.float64) - r) * gpu.when.step_s


def _pixels_of_texture(g, r, gpu, ref):
    """How far the texture is shifted, in px: at a grazing angle one pixel spans many repeats, and so does float32's rounding."""
    return length((g.astype(np.float64) - r) * ref["texture_size"]) / np.exp2(ref["mip_level"])


_SHADING = "against the GPU's own albedo times the reference's irradiance (the reference has no mip maps)"
_MIPS = "against a CPU twin of mip-mapped sampling; drivers may make mip maps differently, hence the loose tolerance"

QUANTITIES = {q.name: q for q in (
    Quantity("id", "mismatch", 0.0, _different, same_triangle=False),
    Quantity("depth", "relative", 1e-5, _relative),
    Quantity("flow_forward", "px", 1e-2, _motion),
    Quantity("flow_backward", "px", 1e-2, _motion),
    Quantity("velocity", "px per label interval", 1e-2, _per_interval),
    Quantity("valid_forward", "mismatch", 0.0, _different),
    Quantity("valid_backward", "mismatch", 0.0, _different),
    Quantity("occluded_forward", "fraction of pixels", 1e-2, _different, "mean", False,
             "off the band at t' as well: the mask rests on one depth sample per pixel there"),
    Quantity("occluded_backward", "fraction of pixels", 1e-2, _different, "mean", False,
             "off the band at t' as well: the mask rests on one depth sample per pixel there"),
    Quantity("normals", "of a unit vector", 1e-3, _absolute),
    Quantity("uv", "px of shifted texture", 0.05, _pixels_of_texture),
    Quantity("mip_level", "levels", 0.6, _absolute, note="drivers may approximate the level (OpenGL 4.6, 8.14.1)"),
    Quantity("albedo", "linear", 0.1, _absolute, note=_MIPS),
    Quantity("irradiance", "1", 1e-4, _absolute),
    Quantity("luminance", "linear", 1e-4, _absolute, note=_SHADING),
    Quantity("colour", "linear radiance", 1e-4, _absolute, note=_SHADING),
    Quantity("dL_dt", "luminance over the step", 0.05, _per_step, note=_MIPS),
)}
NEEDS_ISOTROPIC = ("mip_level", "albedo", "dL_dt")


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
            raise ConfigError("not a tolerance", where="--tolerance", value=text, accepted="a number >= 0, or BUFFER=number")
        out |= {check_pass(name, QUANTITIES, "--tolerance"): value} if equals else dict.fromkeys(names, value)
    return out


@dataclass(eq=False)
class Report:
    """Of one buffer. errors : (H, W) float64, nan where not comparable.   graded, band : (H, W) bool.
    value : the graded statistic.   worst : up to ten graded pixels, largest error first."""

    quantity: Quantity
    tolerance: float
    errors: np.ndarray
    graded: np.ndarray
    band: np.ndarray
    value: float
    worst: list[dict] = field(default_factory=list)
    suspicions: list[str] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        return self.value <= self.tolerance

    def summary(self) -> dict:
        """Plain numbers, for JSON and for the table."""
        inside, band = self.errors[self.graded], self.errors[self.band & ~np.isnan(self.errors)]

        def stats(e):
            limit = self.tolerance if self.quantity.statistic == "max" else 0.0  # a fraction says nothing about one pixel
            return {"pixels": int(e.size), "median": _at(e, 0.5), "p99": _at(e, 0.99), "max": _at(e, 1.0), "over_tolerance": int((e > limit).sum())}

        return {"buffer": self.quantity.name, "unit": self.quantity.unit, "statistic": self.quantity.statistic, "value": self.value,
                "tolerance": self.tolerance, "passed": self.passed, "off_silhouettes": stats(inside), "silhouette_band": stats(band),
                "histogram": histogram(inside), "worst": self.worst, "suspicions": self.suspicions, "note": self.quantity.note}


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
        if (n := int((decades == d).sum())):
            out["<1e-8" if d == -9 else f"1e{d:+d}"] = n
    if (n := int(np.isinf(errors).sum())):
        out["inf"] = n
    return out


class Comparison:
    """Masks that all buffers share, and :meth:`report` for one of them."""

    def __init__(self, gpu: GpuMoment, ref: ReferenceMoment):
        self.gpu, self.ref = gpu, ref
        frame = ref.frame
        self.band = reference.silhouette_band(frame.instance, frame.depth)
        self.same_triangle = (gpu["part"] == ref["part"]) & ((gpu["triangle"] == ref["triangle"]) | ~frame.hit)

    def names(self) -> list[str]:
        """Every buffer that can be graded here."""
        isotropic = self.gpu.renderer.config.anisotropy <= 1
        return [name for name in QUANTITIES if isotropic or name not in NEEDS_ISOTROPIC]

    def pair(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """(GPU, what it is graded against); equal shapes."""
        gpu, ref = self.gpu, self.ref
        if name == "luminance":
            return gpu[name], np.where(ref.frame.hit, gpu["shade"][..., 0].astype(np.float64) * ref["irradiance"], ref["luminance"])
        if name == "colour":
            shaded = gpu["albedo"].astype(np.float64) * ref["irradiance"][..., None]
            return gpu[name], np.where(ref.frame.hit[..., None], shaded, ref["colour"])
        return gpu[name], ref[name]

    def errors(self, name: str) -> np.ndarray:
        """(H, W) float64 in the quantity's unit; inf where the GPU wrote nan."""
        g, r = self.pair(name)
        error = QUANTITIES[name].error(g, r, self.gpu, self.ref)
        return np.where(np.isnan(error), np.inf, error)

    def report(self, name: str, tolerance: float | None = None) -> Report:
        quantity = QUANTITIES[name]
        errors = self.errors(name)
        graded = ~self.band
        if quantity.same_triangle:
            graded &= self.same_triangle
        if name.startswith("occluded_"):
            graded &= ~self._band_there(name.removeprefix("occluded_"))
        if name == "dL_dt":
            for t_ns in (self.gpu.when.before_ns, self.gpu.when.after_ns):
                other, drawn = self.ref.at(t_ns), self.gpu.renderer.inspect(t_ns)
                graded &= ~reference.silhouette_band(other.instance, other.depth) & (other.part == self.ref["part"])
                graded &= (drawn["TRIANGLE"] == other.triangle + 1) & (drawn["LOCAL"][..., 3] == other.part + 1)
        inside = errors[graded]
        value = (float(inside.mean()) if quantity.statistic == "mean" else float(inside.max())) if inside.size else 0.0
        report = Report(quantity, quantity.tolerance if tolerance is None else tolerance, errors, graded, self.band, value)
        report.worst = self._worst(name, errors, graded)
        if not report.passed:
            g, r = self.pair(name)
            report.suspicions = suspicions(name, g, r, graded, report.tolerance, self.gpu, self.ref)
        return report

    def _band_there(self, way: str) -> np.ndarray:
        """Pixels whose point lands, inside the image, in the silhouette band of t'."""
        flow = getattr(self.ref.frame, way)
        there = self.ref.at(flow.t_ns)
        band = reference.silhouette_band(there.instance, there.depth)
        height, width = band.shape
        xy = np.nan_to_num(flow.flow) + np.moveaxis(np.indices(band.shape)[::-1], 0, -1)
        x, y = (np.clip(np.rint(xy[..., k]), 0, n - 1).astype(int) for k, n in ((0, width), (1, height)))
        return band[y, x] & flow.valid & ~flow.outside

    def _worst(self, name: str, errors: np.ndarray, graded: np.ndarray) -> list[dict]:
        g, r = self.pair(name)
        masked = np.where(graded, errors, 0.0).ravel()
        order = np.argsort(-masked, kind="stable")[:WORST]
        parts, out = reference.scene_parts(self.ref.scene), []
        for k in order:
            if masked[k] <= 0:
                break
            y, x = np.unravel_index(k, errors.shape)
            p = int(self.ref["part"][y, x])
            out.append({"x": int(x), "y": int(y), "error": float(masked[k]), "gpu": g[y, x].tolist(), "reference": r[y, x].tolist(),
                        "object": parts[p][0].name if p >= 0 else "", "triangle": int(self.ref["triangle"][y, x]) - 1})
        return out
