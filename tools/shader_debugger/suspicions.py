"""Likely causes of an error: common mistakes that change the right buffer to the GPU's.

Each candidate is the buffer that a correct pipeline with one mistake would give. A candidate is reported if it explains
nearly every wrong pixel, and far better than the right values do."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import product
from typing import Any

import numpy as np

from blinkgl.render import casting
from blinkgl.render.colour import LUMA
from blinkgl.srgb import linear_from_srgb, srgb_from_linear
from blinkgl.tools.shader_debugger.moments import PASSES, lookup_of

EXPLAINED = 0.9  # of the wrong pixels
CLOSE = 1e-3  # relative: a candidate need not match exactly, because other errors may be present
BETTER = 0.5  # error of an explained pixel, as a fraction of its error before
MOST = 3  # suspicions of one buffer
SEEN = 0.5  # of the pixels that a mistake would make wrong, the fraction that is wrong

Candidates = Iterator[tuple[str, np.ndarray]]


def suspicions(comparison: Any, report: Any) -> list[str]:
    """Return one line per candidate that fits; best first, at most three.

    comparison : of the moment.   report : of one buffer that is over its tolerance."""
    name = report.quantity.name
    gpu, right = comparison.pair(name)
    wrong = report.graded & (report.errors > report.limit)
    if PASSES[name].kind in ("mask", "ids") or not wrong.any():
        return []
    owner = comparison.owner(name)
    # A mistake affects a whole object, not only the pixels at which it is visibly wrong.
    about = report.graded & np.isin(owner, np.unique(owner[wrong]))
    g, r = gpu.astype(np.float64)[about], np.asarray(right, np.float64)[about]
    with np.errstate(all="ignore"):
        # Known mistakes come before those with fitted numbers.
        for candidates in (
            _mistakes(comparison, name, r, g, about),
            _fitted(name, r[wrong[about]], g[wrong[about]], r),
        ):
            shares = [(_share(comparison, report, gpu, right, about, made), text) for text, made in candidates]
            likely = sorted((one for one in shares if one[0] >= EXPLAINED), key=lambda one: -one[0])
            if likely:
                return [f"{text} (fits {100 * share:.1f} % of the wrong pixels)" for share, text in likely[:MOST]]
    return []


def _share(comparison, report, gpu, right, about, candidate) -> float:
    """Return the fraction of the wrong pixels that a candidate explains; 0 if it would make far more pixels wrong than
    are.

    about : (H, W) bool, the pixels to which the candidate applies."""
    quantity, before = report.quantity, report.errors[about]
    image = np.array(right, np.float64)
    # Take the candidate as right: how much of the error remains?
    candidate = np.broadcast_to(candidate, image[about].shape)
    image[about] = candidate
    error = quantity.error(gpu, image, comparison.gpu, comparison.ref)[about]
    fits = error <= quantity.fit * (report.tolerance or np.finfo(np.float32).eps)
    # Lookups have their own units, and zeros without meaning.
    if lookup_of(quantity.name)[1] not in ("uv", "level", "albedo"):
        fits |= _size(gpu.astype(np.float64)[about] - candidate) <= CLOSE * _size(candidate)
    # A mistake that would affect all pixels, but affects few, is another one.
    wrong = before > report.limit
    meant = quantity.error(image, np.asarray(right, np.float64), comparison.gpu, comparison.ref)[about] > report.limit
    if wrong.sum() < SEEN * meant.sum():
        return 0.0
    return float((fits & ((error < BETTER * before) | np.isinf(before)))[wrong].mean())


def _size(values: np.ndarray) -> np.ndarray:
    return np.abs(values) if values.ndim == 1 else np.linalg.norm(values, axis=1)


def _mistakes(comparison, name, r, g, on) -> Candidates:
    """Return (text, what the GPU would have written) pairs; r, g : (N[, C]), right and written, at the pixels
    ``on``."""
    what = lookup_of(name)[1]
    specific = _SPECIFIC.get(what or name)
    if specific is not None:
        yield from specific(comparison, name, r, g, on)
    yield ("the pass reads no texture here" if what in ("uv", "level") else "everything is zero"), np.zeros_like(r)
    if what in ("uv", "level"):
        return
    yield "the sign is wrong", -r
    yield "twice the right value (a factor 0.5 is missing)", 2 * r
    yield "half the right value (one factor 0.5 too many)", r / 2
    if r.ndim == 2 and r.shape[1] == 2:
        yield "the sign of x is wrong", r * [-1, 1]
        yield "the sign of y is wrong", r * [1, -1]
        yield "x and y are exchanged", r[:, ::-1]


def _fitted(name, r, g, everywhere) -> Candidates:
    """Return candidates with numbers fitted to the wrong pixels themselves, ``r`` and ``g``, for less common mistakes.
    everywhere : right values of all their pixels."""
    if lookup_of(name)[1] in ("uv", "level"):
        return
    # A ratio of two zeros has no information.
    ratios = _typical(np.where(np.abs(r) > 1e-6, g / r, np.nan))
    if r.ndim == 2 and r.shape[1] == 2:
        yield f"x is {ratios[0]:.4g} times, y {ratios[1]:.4g} times the right value", everywhere * ratios
        return
    factor = float(np.median(ratios))
    yield f"{factor:.4g} times the right value", everywhere * factor


def _typical(values: np.ndarray) -> np.ndarray:
    """Return the median of each column, of its finite values."""
    columns = values.reshape(len(values), -1).T
    return np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in columns])


# ------------------------------------------------------------------------------------------------- where the surface is


def _depth(comparison, name, r, g, on) -> Candidates:
    camera = comparison.ref.scene.camera
    yield f"near = {camera.near:g} is subtracted from the depth", r - camera.near
    yield f"near = {camera.near:g} is added to the depth", r + camera.near
    yield "window depth near / Z instead of Z", camera.near / r
    y, x = np.nonzero(on)
    rays = camera.rays(np.stack([x, y], axis=1))
    # Length of the ray (X, Y, Z) / Z.
    along = np.linalg.norm(rays, axis=1) / rays[:, 2]
    yield "distance along the ray instead of depth along the optical axis", r * along


def _normals(comparison, name, r, g, on) -> Candidates:
    rotation = comparison.ref.scene.camera_path.pose(comparison.gpu.when.t_ns)[:3, :3]
    yield "in world axes, not in camera axes", r @ rotation.T
    yield "the normal points the other way (not turned towards the camera, or turned twice)", -r


# ------------------------------------------------------------------------------------------------- what is looked up


def _uv(comparison, name, r, g, on) -> Candidates:
    size = comparison.ref["texture_size"][on]
    for x, y in product((0.5, -0.5, 0.0), repeat=2):
        if x or y:
            yield f"uv is shifted by half a texel ({x:+g}, {y:+g})", r + np.array([x, y]) / size
    yield "u and v are exchanged", r[:, ::-1]


def _level(comparison, name, r, g, on) -> Candidates:
    bias = float(np.round(_typical(g - r)[0], 2))
    # A driver's own logarithm is up to 0.086 too small.
    bias = round(bias) if abs(bias - round(bias)) < 0.15 else bias
    than = "coarser" if bias > 0 else "finer"
    yield f"a mip bias of {bias:+g} (levels {than} than one texel per pixel)", r + bias
    yield "always level 0: no mip maps", np.zeros_like(r)


def _albedo(comparison, name, r, g, on) -> Candidates:
    yield "sRGB is decoded twice (the linear value is decoded again)", linear_from_srgb(np.clip(r, 0, 1))
    yield "sRGB is not decoded", srgb_from_linear(np.clip(r, 0, 1)).astype(np.float64)
    if lookup_of(name)[0] == "colour":
        yield "red and blue are exchanged", r[:, ::-1]
        yield "the luminance instead of the colour", np.repeat((r @ LUMA)[:, None], 3, axis=1)


def _light(comparison, name, r, g, on) -> Candidates:
    """Return candidates for the light as a whole, and for its terms."""
    scene, normal = comparison.ref.scene, -comparison.ref.frame.normal[on]
    if scene.light.plain:
        direct = scene.light.sun * np.maximum(0.0, normal @ np.asarray(scene.light.sun_direction))
        around = scene.light.sky * (0.5 + 0.5 * normal[:, 2])
        mistaken = {"direct": direct, "around": around}.get(lookup_of(name)[1], direct + around)
        yield "the normal points the other way (not turned towards the camera, or turned twice)", mistaken
    yield "unlit: the light is always 1", np.ones_like(r)


def _shadow(comparison, name, r, g, on) -> Candidates:
    yield "shadows are missing", np.ones_like(r)
    yield "lit and shadowed areas are exchanged", 1 - r


def _shaded(comparison, name, r, g, on) -> Candidates:
    albedo = comparison.gpu[f"{name}_albedo"][on].astype(np.float64)
    light = comparison.gpu[f"{name}_light"][on].astype(np.float64)
    albedo, light = (albedo[:, 0], light) if name == "luminance" else (albedo, light[:, None])
    yield "the light is missing (albedo alone)", albedo
    yield "the light is applied twice", albedo * light**2
    yield "the albedo is missing (light alone)", np.broadcast_to(light, r.shape)
    yield "encoded as sRGB: the light is not linear", srgb_from_linear(np.clip(r, 0, 1)).astype(np.float64)
    if (fog := comparison.ref.scene.fog) is not None:
        depth = comparison.ref.frame.depth[on]
        rays = casting.rays_of(comparison.ref.scene.camera, comparison.ref.frame.xy[on])
        distance = depth * np.linalg.norm(rays, axis=1)
        arrives, of_depth = (np.exp(-fog.density * way).reshape(-1, *[1] * (r.ndim - 1)) for way in (distance, depth))
        # Solved for the light before the fog: L' = L T + F (1 - T).
        clear = (r - fog.radiance * (1 - arrives)) / arrives
        yield "the fog is missing", clear
        yield "fog by depth instead of distance", fog.radiance + (clear - fog.radiance) * of_depth
        yield "transmittance of the fog T is used as 1 - T", fog.radiance + (clear - fog.radiance) * (1 - arrives)


def _edges(comparison, name, r, g, on) -> Candidates:
    plain = comparison.gpu[f"{name}_plain"].astype(np.float64)[on]
    yield "nothing is filtered: the picture is the unfiltered one", plain


# ------------------------------------------------------------------------------------------------- motion


def _motion(comparison, name, r, g, on) -> Candidates:
    gpu, ref, camera = comparison.gpu, comparison.ref, comparison.ref.scene.camera
    yield "in clip units instead of px (0.5 * image_size is missing)", r * 2 / np.array([camera.width, camera.height])
    if name.startswith("velocity"):
        yield "the perspective division is missing (not divided by Z)", r * ref["depth"][on][:, None]
        yield "px per label interval instead of px/s", r * gpu.when.interval_s
        return
    way, other = ("forward", "backward") if name == "flow_forward" else ("backward", "forward")
    yield "the perspective division is missing (not divided by Z')", r * ref[f"next_depth_{way}"][on][:, None]
    yield f"the {other} flow", ref[f"flow_{other}"][on]


_SPECIFIC = {
    "depth": _depth,
    "normals": _normals,
    "uv": _uv,
    "level": _level,
    "albedo": _albedo,
    "light": _light,
    "direct": _light,
    "around": _light,
    "shadow": _shadow,
    "luminance": _shaded,
    "colour": _shaded,
    **dict.fromkeys(("luminance_edges", "rate_edges", "colour_edges"), _edges),
    **dict.fromkeys(("velocity", "velocity_pass", "flow_forward", "flow_backward"), _motion),
}
"""Mistakes of a lookup, or of a buffer, by its name."""
