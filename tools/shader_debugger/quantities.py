"""Grading of each buffer: its unit, its error and the tolerance. :mod:`compare` chooses the pixels."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from trimesh.triangles import points_to_barycentric

from blinkgl.labels.grading import length, motion_per_interval
from blinkgl.labels.label import Label, View
from blinkgl.render import casting
from blinkgl.render.passes.own import OwnPass
from blinkgl.tools.shader_debugger.filters import EDGED, LENSED
from blinkgl.tools.shader_debugger.mipmaps import MISPLACED
from blinkgl.tools.shader_debugger.moments import MAPS, PASSES, OfLabels


@dataclass(frozen=True)
class Quantity:
    """Grading of one buffer. error : (what the GPU wrote, the reference, both moments) -> (H, W) >= 0 in ``unit``.

    statistic : "max" of the graded pixels' errors, or "mean" (the fraction of pixels, for
    masks), must not exceed ``tolerance``.
    fit : error, in tolerances, that may remain for a suspicion that explains the buffer.
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


def _pixels_of_texture(g, r, gpu, ref):
    """Return the shift of the texture, px: at a grazing angle float32's rounding spans as many repeats as a pixel does.
    Whole repeats are not a shift."""
    # A texture repeats: float32 gives the position in it, not the number of repeats.
    shift = g.astype(np.float64) - r
    return length((shift - np.rint(shift)) * ref["texture_size"]) / np.exp2(ref["level"])


def _beyond_the_range(g, r, gpu, ref):
    """Return how far a level is outside the range of OpenGL, shifted by the difference of ``r`` to the level itself;
    below 0 the texture is magnified, and all levels are equivalent."""
    with np.errstate(invalid="ignore"):
        # Both are infinite beside a horizon, where any level is right.
        moved = np.where(r == ref["level"], 0.0, r - ref["level"])
    low, high = (np.maximum(ref["levels"][..., k] + moved, 0.0) for k in (0, 2))
    return np.maximum(np.maximum(low - np.maximum(g, 0.0), g - high), 0.0)


def _of_the_lamps(g, r, gpu, ref):
    """Return the effect of a wrong shadow on the light: a shadow of a weak lamp is invisible."""
    return np.abs(g.astype(np.float64) - r) * np.minimum(ref["direct"], 1.0)


def _of_the_picture(g, r, gpu, ref):
    """Return the error relative to the pixel where it is bright, otherwise to the picture's mean."""
    # In the dark a small error would be large relative to the pixel.
    size = length(r)
    return length(g.astype(np.float64) - r) / np.maximum(max(size.mean(), 1e-12), size)


def _misplaced(g, r, gpu, ref):
    """Return (H, W) px from each pixel's centre to the drawn point by the true poses, or, if larger, from that point to
    the plane of the drawn triangle at that time; inf where it is not visible. It does not use the ray caster, so that a
    wrong pose or shape is separated from later errors."""
    part, scene, camera = gpu["part"], ref.scene, ref.scene.camera
    out = np.zeros(part.shape)
    for p, (body, one) in enumerate(casting.scene_parts(scene)):
        y, x = np.nonzero(part == p)
        local, pose = gpu["local"][y, x].astype(np.float64), casting.relative_pose_at(scene, body, ref.when.t_ns)
        there = local @ pose[:3, :3].T + pose[:3, 3]
        aside = np.linalg.norm(camera.project(there) - ref.frame.xy[y, x], axis=1)
        corners = casting.vertices_at(one.mesh, ref.when.t_ns)[one.mesh.faces[gpu["triangle"][y, x].astype(int) - 1]]
        with np.errstate(all="ignore"):
            # Of the plane, not of the triangle: ``aside`` is the distance along it.
            shares = points_to_barycentric(corners, local, method="cross")
            off = np.linalg.norm(local - np.einsum("nc,nck->nk", shares, corners), axis=1)
            off *= camera.px_per_slope / there[:, 2]
        # Of a triangle without width only its line is known.
        out[y, x] = np.nan_to_num(np.fmax(aside, off), nan=np.inf)
    return out


_MIPMAPPED = (
    "against a reference of mip-mapped sampling at the GPU's own uv and level; drivers may make mip maps differently"
)
_SHADING = "against the GPU's own albedo times its own light, and what it adds"
_MAPPED = "not graded where a map says how a surface shines, which the reference has without mip maps"
LOG2 = 1.0 - (1.0 + math.log(math.log(2.0))) / math.log(2.0) + 1e-3
"""Levels that a logarithm may be too small by that is linear between powers of two, as Mesa's software rasteriser
takes it: the largest of log2(1 + f) - f; and a thousandth for float32."""
_LEVEL = "outside of what OpenGL 4.6, section 8.14.1, allows"
_EDGES = (
    "soft ones against a float64 reference on the GPU's own map (lamps.py); hard ones against rays, not near an edge "
    "nor where light grazes: there a map is off by its texels"
)
_MAP = "off its silhouettes"
_GATHERED = "at all pixels, against the float64 mean of the GPU's own flat picture over each pixel of the lens"
_FILTERED = "at all pixels, against a float64 reference on the GPU's own unfiltered picture and depths (filters.py)"


def _shading(name: str, unit: str) -> tuple[Quantity, ...]:
    """Return the steps of one pass that shades."""
    return (
        Quantity(f"{name}_uv", "px of shifted texture", MISPLACED, _pixels_of_texture, fit=2.0),
        Quantity(f"{name}_level", "levels", LOG2, _beyond_the_range, note=_LEVEL, fit=1.0),
        # sRGB textures of 8 bits: llvmpipe rounds each of their mip levels to 8 bits again, 0.025 after ten
        Quantity(f"{name}_albedo", "linear", 0.05 if name == "colour" else 0.03, _absolute, note=_MIPMAPPED, fit=1.0),
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
        MISPLACED,
        _misplaced,
        same_triangle=False,
        note="how far from its pixel and its triangle the point that was drawn lies by the true poses and shapes",
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
    *(
        Quantity(name, "of the pixel or mean", 2e-3, _of_the_picture, same_triangle=False, note=_GATHERED)
        for name in LENSED
    ),
    Quantity(
        "velocity_pass",
        "px per label interval",
        0.01,
        lambda g, r, gpu, ref: motion_per_interval(g, r, gpu.when.interval_s),
    ),
)


def _of_label(label: Label, view: View) -> Quantity:
    def error(g, r, gpu, ref):
        return view.error(g, r, gpu.when.interval_s)

    return Quantity(
        name=view.name,
        unit=view.judged_in,
        tolerance=view.tolerance,
        error=error,
        statistic=view.statistic,
        same_triangle=view.same_triangle,
        note=view.note,
    )


def _of_own(own: OwnPass) -> Quantity | None:
    if own.reference is None:
        return None
    note = "against its own reference"
    return Quantity(own.name, own.unit, own.tolerance, _absolute, same_triangle=False, note=note)


QUANTITIES = OfLabels(_of_label, _of_own, _BEFORE, _SHADED)
"""In the order in which a pass computes them: the first wrong one is the place of the fault."""
