"""What an error looks like: usual mistakes that turn the right buffer into what the GPU wrote.

Each candidate is the buffer that a correct pipeline with one mistake would give. A candidate that explains nearly every
wrong pixel, and far better than the right values do, is named; first for the whole image, then,
where nothing fits all, for single objects."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np

from blinkgl.render import reference
from blinkgl.render.colour import LUMA
from blinkgl.scene.shapes.deformer import normals_at
from blinkgl.shader_debugger.moments import PASSES, lookup_of
from blinkgl.srgb import srgb_from_linear

EXPLAINED = 0.9  # of the pixels that are wrong
CLOSE = 1e-3  # relative: a candidate need not match to the last bit, other errors may be there, too
BETTER = 0.5  # an explained pixel's error, as a part of what it was
MOST = 3  # suspicions of one buffer, and objects looked at on their own
FEWEST = 5  # wrong pixels of an object that can carry a suspicion of its own


def suspicions(comparison: Any, report: Any) -> list[str]:
    """One line per candidate that fits; best first, at most three.

    comparison : of the moment.   report : of one buffer that is over its tolerance."""
    name = report.quantity.name
    gpu, right = comparison.pair(name)
    if PASSES[name].kind in ("mask", "ids"):
        return []
    wrong = report.graded & (report.errors > report.limit)
    found = _explain(comparison, report, gpu, right, wrong)
    if not found:
        owner = comparison.owner(name)
        for one in [o for o in report.objects if o["over_tolerance"] >= FEWEST][:MOST]:
            mine = wrong & (owner == comparison.objects.index(one["object"]))
            if mine.sum() < wrong.sum():
                found += [f"{one['object']}: {text}" for text in _explain(comparison, report, gpu, right, mine)[:1]]
    return found


def _explain(comparison, report, gpu, right, wrong) -> list[str]:
    g, r = gpu.astype(np.float64)[wrong], np.asarray(right, np.float64)[wrong]
    if not len(g):
        return []
    quantity, before = report.quantity, report.errors[wrong]
    limit = quantity.fit * (report.tolerance or np.finfo(np.float32).eps)
    # Those have a unit of their own, and zeros that mean nothing.
    relative = lookup_of(quantity.name)[1] not in ("uv", "level", "albedo")
    image = np.array(right, np.float64)
    found = []
    with np.errstate(all="ignore"):
        for kind in (_candidates, _fitted):
            for text, candidate in kind(comparison, report, r, g, wrong):
                candidate = np.broadcast_to(candidate, r.shape)
                image[wrong] = candidate
                error = quantity.error(gpu, image, comparison.gpu, comparison.ref)[wrong]
                fits = error <= limit
                if relative:
                    fits |= _size(g - candidate) <= CLOSE * _size(candidate)
                share = float((fits & ((error < BETTER * before) | np.isinf(before))).mean())
                if share >= EXPLAINED:
                    found.append((share, text))
            if found:
                break
    found.sort(key=lambda pair: -pair[0])
    return [f"{text} (fits {100 * share:.1f} % of the wrong pixels)" for share, text in found[:MOST]]


def _size(values: np.ndarray) -> np.ndarray:
    return np.abs(values) if values.ndim == 1 else np.linalg.norm(values, axis=1)


Candidates = Iterator[tuple[str, np.ndarray]]


def _candidates(comparison, report, r, g, on) -> Candidates:
    """(text, what the GPU would have written) pairs; r, g : (N[, C]) at the pixels ``on``."""
    name = report.quantity.name
    _, what = lookup_of(name)
    specific = {
        "uv": _uv,
        "level": _level,
        "albedo": _albedo,
        "light": _light,
        "direct": _light,
        "around": _light,
        "shadow": _shadow,
    }.get(what) or {
        "depth": _depth,
        "normals": _normals,
        "luminance_edges": _edges,
        "rate_edges": _edges,
        "colour_edges": _edges,
        "luminance": _shaded,
        "colour": _shaded,
        "velocity": _velocity,
        "flow_forward": _flow,
        "flow_backward": _flow,
    }.get(name)
    if specific is not None:
        yield from specific(comparison, name, r, g, on)
    yield ("the pass looks nothing up here" if what in ("uv", "level") else "everything is zero"), np.zeros_like(r)
    if what in ("uv", "level"):
        return
    yield "the sign is wrong", -r
    yield "twice the right value (a factor 0.5 is missing)", 2 * r
    yield "half the right value (a factor 0.5 too many)", r / 2
    if r.ndim == 2 and r.shape[1] == 2:
        yield "the sign of x is wrong", r * [-1, 1]
        yield "the sign of y is wrong", r * [1, -1]
        yield "x and y are exchanged", r[:, ::-1]


def _edges(comparison, name, r, g, on) -> Candidates:
    plain = comparison.gpu[f"{name}_plain"].astype(np.float64)[on]
    yield "nothing is filtered: the picture is as it was", plain
    yield "what the lines change has the wrong sign", 2 * plain - r
    yield "what the lines change is there alone, without the picture", r - plain
    yield "what the lines change is there twice", 2 * r - plain


def _fitted(comparison, report, r, g, on) -> Candidates:
    """Candidates with numbers taken from the wrong pixels themselves: for what is no usual mistake."""
    what = lookup_of(report.quantity.name)[1]
    if what == "uv":
        yield from _uv_fitted(comparison, r, g, on)
    elif what != "level" and r.ndim == 2 and r.shape[1] == 2:
        factor = _typical(np.where(np.abs(r) > 1e-6, g / r, np.nan))
        yield f"x is {factor[0]:.4g} times, y {factor[1]:.4g} times the right value", r * factor
    elif what != "level":
        factor = np.median(_typical(np.where(np.abs(r) > 1e-6, g / r, np.nan)))
        yield f"{factor:.4g} times the right value", r * factor
        offset = _typical(g - r)
        yield f"a constant {_numbers(offset)} too much", r + offset


def _typical(values: np.ndarray) -> np.ndarray:
    columns = values.reshape(len(values), -1).T
    out = np.array([np.median(c[np.isfinite(c)]) if np.isfinite(c).any() else 0.0 for c in columns])
    return out if values.ndim > 1 else out[0]


def _numbers(values) -> str:
    return "(" + ", ".join(f"{v:+.4g}" for v in values) + ")" if np.ndim(values) else f"{values:+.6g}"


# ------------------------------------------------------------------------------------------------- where the surface is


def _depth(comparison, name, r, g, on) -> Candidates:
    camera = comparison.ref.scene.camera
    yield f"off by the near plane: near = {camera.near:g} is subtracted", r - camera.near
    yield f"off by the near plane: near = {camera.near:g} is added", r + camera.near
    yield "window depth near / Z instead of Z", camera.near / r
    yield "1 / Z instead of Z", 1 / r
    y, x = np.nonzero(on)
    rays = camera.rays(np.stack([x, y], axis=1))
    yield (
        "distance along the ray instead of depth along the optical axis",
        r * np.linalg.norm(rays, axis=1) / rays[:, 2],
    )


def _screen_weights(comparison, on) -> np.ndarray:
    """(N, 3) weights of the triangle's corners when they are interpolated linearly on the
    screen, as ``noperspective`` does."""
    ref = comparison.ref
    frame = ref.frame
    depths = np.ones((int(on.sum()), 3))
    part, triangle = frame.part[on], frame.triangle[on]
    for p, (thing, own) in enumerate(reference.scene_parts(ref.scene)):
        rows = part == p
        pose = reference.relative_pose_at(ref.scene, thing, ref.when.t_ns)
        corners = reference.vertices_at(own.mesh, ref.when.t_ns)[own.mesh.faces[triangle[rows]]]
        depths[rows] = (corners @ pose[:3, :3].T + pose[:3, 3])[..., 2]
    weights = frame.bary[on] * depths
    return weights / weights.sum(axis=1, keepdims=True)


def _on_screen(comparison, on, attribute: str) -> np.ndarray:
    """:func:`_interpolated` linearly on the screen."""
    return _interpolated(comparison, on, attribute, _screen_weights(comparison, on))


def _interpolated(comparison, on, attribute: str, weights: np.ndarray) -> np.ndarray:
    """(N, C) "uvs" (times uv_scale), "normals" or "vertices" of the mesh, weighted by (N, 3) weights of the corners."""
    ref = comparison.ref
    part, triangle = ref.frame.part[on], ref.frame.triangle[on]
    out = np.full((len(part), 2 if attribute == "uvs" else 3), np.nan)
    for p, (_, own) in enumerate(reference.scene_parts(ref.scene)):
        rows = part == p
        values = {
            "vertices": lambda mesh: reference.vertices_at(mesh, ref.when.t_ns),
            "normals": lambda mesh: normals_at(mesh, ref.when.t_ns),
        }.get(attribute, lambda mesh: mesh.uvs)(own.mesh)
        corners = values[own.mesh.faces[triangle[rows]]].astype(np.float64)
        out[rows] = np.einsum("nc,nck->nk", weights[rows], corners) * (
            own.material.uv_scale if attribute == "uvs" else 1.0
        )
    return out


def _turned(comparison, on, vectors: np.ndarray, transposed: bool = False) -> np.ndarray:
    """(N, 3) vectors from each pixel's object to the world, or back."""
    ref = comparison.ref
    out, part = np.array(vectors, np.float64), ref.frame.part[on]
    for p, (thing, _) in enumerate(reference.scene_parts(ref.scene)):
        rotation = thing.path.pose(ref.when.t_ns)[:3, :3]
        out[part == p] = out[part == p] @ (rotation if transposed else rotation.T)
    return out


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-15)


def _normals_seen(comparison, on) -> Iterator[tuple[str, np.ndarray]]:
    """Mistaken unit normals in world axes."""
    right = comparison.ref.frame.normal[on]
    yield "the normal points the other way (not turned towards the camera, or turned twice)", -right
    yield "the normal stays in the object's axes", _turned(comparison, on, right, transposed=True)
    flat = _turned(comparison, on, _unit(_on_screen(comparison, on, "normals")))
    yield (
        "the normal is interpolated without perspective (noperspective)",
        flat * np.sign((flat * right).sum(axis=1, keepdims=True)),
    )


def _normals(comparison, name, r, g, on) -> Candidates:
    rotation = comparison.ref.scene.camera_path.pose(comparison.gpu.when.t_ns)[:3, :3]
    yield "not turned into the camera's axes (world axes)", r @ rotation.T
    for text, normal in _normals_seen(comparison, on):
        yield text, normal @ rotation
    yield "not turned into the camera's axes (object axes)", _turned(comparison, on, r @ rotation.T, transposed=True)


# ------------------------------------------------------------------------------------------------- what is looked up


def _uv(comparison, name, r, g, on) -> Candidates:
    ref = comparison.ref
    yield "uv is interpolated without perspective (noperspective)", _on_screen(comparison, on, "uvs")
    size = ref["texture_size"][on]
    for x, y in product((0.5, -0.5, 0.0), repeat=2):
        if x or y:
            yield f"uv is shifted by half a texel ({x:+g}, {y:+g})", r + np.array([x, y]) / size
    scale = np.ones_like(r)
    part = ref.frame.part[on]
    for p, (_, own) in enumerate(reference.scene_parts(ref.scene)):
        scale[part == p] = own.material.uv_scale
    yield "v runs upwards (1 - v)", np.stack([r[:, 0], scale[:, 1] - r[:, 1]], axis=1)
    yield "u runs leftwards (1 - u)", np.stack([scale[:, 0] - r[:, 0], r[:, 1]], axis=1)
    yield "u and v are exchanged", r[:, ::-1]
    yield "uv_scale is not applied", r / scale
    yield "uv_scale is applied twice", r * scale


def _uv_fitted(comparison, r, g, on) -> Candidates:
    size = comparison.ref["texture_size"][on]
    texels = _typical((g - r) * size)
    yield f"uv is shifted by ({texels[0]:+.3g}, {texels[1]:+.3g}) texels", r + texels / size
    shift = _typical(g - r)
    yield f"uv is shifted by ({shift[0]:+.4g}, {shift[1]:+.4g})", r + shift
    slope, offset = np.ones(2), np.zeros(2)
    for k in (0, 1):
        if np.isfinite(g[:, k]).all() and np.ptp(r[:, k]) > 0:
            slope[k], offset[k] = np.polyfit(r[:, k], g[:, k], 1)
    yield (f"u is {slope[0]:.4g} u {offset[0]:+.4g}, v is {slope[1]:.4g} v {offset[1]:+.4g}"), r * slope + offset


def _level(comparison, name, r, g, on) -> Candidates:
    bias = float(np.round(_typical(g - r), 2))
    bias = round(bias) if abs(bias - round(bias)) < 0.15 else bias  # drivers approximate the level
    yield (
        f"a mip bias of {bias:+g} (levels that are {'coarser' if bias > 0 else 'finer'} than one texel a pixel)",
        r + bias,
    )
    yield "always level 0: no mip maps", np.zeros_like(r)
    constant = float(np.round(_typical(g), 2))
    yield f"always level {constant:g}", np.full_like(r, constant)
    yield "half the level (the root of the footprint)", r / 2
    yield "twice the level (the square of the footprint)", 2 * r


def _albedo(comparison, name, r, g, on) -> Candidates:
    of, _ = lookup_of(name)
    ref = comparison.ref
    yield "sRGB is decoded twice (the linear value is decoded again)", reference.srgb_to_linear(np.clip(r, 0, 1))
    if of == "luminance":
        twice = reference.srgb_to_linear(np.clip(comparison.twin_colour(of)[on], 0, 1)) @ LUMA
        yield "sRGB is decoded twice (before r, g, b are weighed)", np.repeat(twice[:, None], 3, axis=1)
    yield "sRGB is not decoded", srgb_from_linear(np.clip(r, 0, 1)).astype(np.float64)
    for steps in (1, -1, 2, -2):
        yield (
            (
                f"sampled {abs(steps)} mip level{'s' * (abs(steps) > 1)} {'coarser' if steps > 0 else 'finer'} than "
                "its level says"
            ),
            comparison.twin(of, level=steps)[on],
        )
    for x, y in product((0.5, -0.5, 0.0), repeat=2):
        if x or y:
            yield f"sampled half a texel aside ({x:+g}, {y:+g})", comparison.twin(of, texels=(x, y))[on]
    base = np.ones_like(r)
    part = ref.frame.part[on]
    for p, (_, own) in enumerate(reference.scene_parts(ref.scene)):
        base[part == p] = own.material.base_color
    if of == "colour":
        yield "base_color is missing", r / base
        yield "base_color is applied twice", r * base
        yield "the texture is missing (base_color alone)", base
        yield "red and blue are exchanged", r[:, ::-1]
        yield "the luminance instead of the colour", np.repeat((r @ LUMA)[:, None], 3, axis=1)
    else:
        for text, weights in (
            ("the mean of r, g, b instead of their luminance", (1 / 3, 1 / 3, 1 / 3)),
            ("red alone instead of the luminance", (1, 0, 0)),
            ("Rec. 601 weights instead of Rec. 709", (0.299, 0.587, 0.114)),
            ("the weights are those of b, g, r", LUMA[::-1]),
        ):
            yield text, np.repeat((comparison.twin_colour(of)[on] @ np.asarray(weights))[:, None], 3, axis=1)
    light = ref["light"][on][:, None]
    yield "the light is multiplied in already", r * light
    seen = set()
    for thing, own in reference.scene_parts(ref.scene):
        if own.material.texture is not None and id(own.material) not in seen:
            seen.add(id(own.material))
            yield (
                f"the texture of {thing.name or f'object {thing.instance_id}'}",
                comparison.twin(of, material=own.material)[on],
            )


def _shadow(comparison, name, r, g, on) -> Candidates:
    yield "no shadow falls", np.ones_like(r)
    yield "light and shadow are exchanged", 1 - r


def _light(comparison, name, r, g, on) -> Candidates:
    """Of the light as a whole, and of its terms, of which one alone is asked for: the light without the other."""
    ref, what = comparison.ref, lookup_of(name)[1]
    light, normal, scene = ref.scene.light, ref.frame.normal[on], ref.scene
    light = replace(light, **{"direct": {"sky": 0.0}, "around": {"sun": 0.0}}.get(what, {}))
    scene = replace(scene, light=light)
    facing, up = normal @ np.asarray(light.sun_direction), normal[:, 2]
    if not light.plain:  # what follows are mistakes in the formula of the plain sun and sky
        yield "unlit: the light is always 1", np.ones_like(r)
        return
    for text, mistaken in _normals_seen(comparison, on):
        yield text, reference.received(scene, ref.when.t_ns, np.zeros_like(mistaken), mistaken).total[:, 0]
    yield "the sun is missing", light.sky * (0.5 + 0.5 * up)
    yield "the sky is missing", light.sun * np.maximum(0.0, facing)
    yield (
        "surfaces that face away from the sun are lit by it, too (|n.s|)",
        light.sun * np.abs(facing) + light.sky * (0.5 + 0.5 * up),
    )
    yield (
        "surfaces that face away from the sun lose light (n.s below 0)",
        light.sun * facing + light.sky * (0.5 + 0.5 * up),
    )
    yield "the sun shines from the other side", light.sun * np.maximum(0.0, -facing) + light.sky * (0.5 + 0.5 * up)
    yield "the sky lights from below", light.sun * np.maximum(0.0, facing) + light.sky * (0.5 - 0.5 * up)
    yield "the same sky light everywhere", light.sun * np.maximum(0.0, facing) + light.sky
    blend = _interpolated(comparison, on, "normals", ref.frame.bary[on])
    length = np.linalg.norm(blend, axis=1)
    yield (
        "the interpolated normal is not normalised",
        light.sun * np.maximum(0.0, facing * length) + light.sky * (0.5 + 0.5 * up * length),
    )
    # in a frame of its own each: what the sun or the zenith is when it is left in world axes while the normal is in the
    # object's
    local = _turned(comparison, on, normal, transposed=True)
    yield (
        "the sun's direction is not turned into the object's axes",
        light.sun * np.maximum(0.0, local @ np.asarray(light.sun_direction)) + light.sky * (0.5 + 0.5 * up),
    )
    yield (
        "the zenith is not turned into the object's axes",
        light.sun * np.maximum(0.0, facing) + light.sky * (0.5 + 0.5 * local[:, 2]),
    )
    yield "unlit: the light is always 1", np.ones_like(r)


def _shaded(comparison, name, r, g, on) -> Candidates:
    gpu = comparison.gpu
    albedo = gpu[f"{name}_albedo"][on].astype(np.float64)
    light = gpu[f"{name}_light"][on].astype(np.float64)
    albedo, light = (albedo[:, 0], light) if name == "luminance" else (albedo, light[:, None])
    yield "the light is missing (albedo alone)", albedo
    yield "the light is multiplied twice", albedo * light**2
    yield "the albedo is missing (light alone)", np.broadcast_to(light, r.shape)
    yield "the albedo is multiplied twice", albedo**2 * light
    yield "encoded as sRGB: the light is not linear", srgb_from_linear(np.clip(r, 0, 1)).astype(np.float64)
    yield "decoded as sRGB once more", reference.srgb_to_linear(np.clip(r, 0, 1))


# ------------------------------------------------------------------------------------------------- motion


def _velocity(comparison, name, r, g, on) -> Candidates:
    gpu, ref = comparison.gpu, comparison.ref
    yield from _motion_units(comparison, r)
    yield "the perspective division is missing (not divided by Z)", r * ref["depth"][on][:, None]
    yield "per label interval instead of per second", r * gpu.when.interval_s


def _motion_units(comparison, r) -> Candidates:
    camera = comparison.ref.scene.camera
    yield "in clip units instead of px (0.5 * image_size is missing)", r * 2 / np.array([camera.width, camera.height])


def _flow(comparison, name, r, g, on) -> Candidates:
    gpu, ref = comparison.gpu, comparison.ref
    yield from _motion_units(comparison, r)
    way, other = ("forward", "backward") if name == "flow_forward" else ("backward", "forward")
    now, then = ref["depth"][on][:, None], ref[f"next_depth_{way}"][on][:, None]
    yield "the perspective division is missing (not divided by Z')", r * then
    yield "divided by the depth at t instead of the depth at t'", r * then / now
    yield (
        "the velocity times the interval, not the displacement",
        ref["velocity"][on] * gpu.when.interval_s * (1 if way == "forward" else -1),
    )
    yield f"the {other} flow", ref[f"flow_{other}"][on]
    yield "the local position is interpolated without perspective (noperspective)", _flow_of(comparison, way, on)


def _flow_of(comparison, way: str, on) -> np.ndarray:
    """(N, 2) what motion.glsl makes of a local position that was interpolated linearly on the screen."""
    ref = comparison.ref
    camera, when, frame = ref.scene.camera, ref.when, ref.frame
    local = _on_screen(comparison, on, "vertices")
    change, part = np.zeros((len(local), 3)), frame.part[on]
    for p, (thing, _) in enumerate(reference.scene_parts(ref.scene)):
        rows = part == p
        step = reference.relative_pose_at(ref.scene, thing, getattr(when, f"{way}_ns")) - reference.relative_pose_at(
            ref.scene, thing, when.t_ns
        )
        change[rows] = local[rows] @ step[:3, :3].T + step[:3, 3]
    y, x = np.nonzero(on)
    return camera.displacement(camera.rays(np.stack([x, y], axis=1)), frame.depth[on], change)
