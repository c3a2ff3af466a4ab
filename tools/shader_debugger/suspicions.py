"""What an error looks like: usual mistakes that turn the reference into what the GPU wrote.

Each candidate is the image that a correct pipeline with one mistake would give. A candidate that explains nearly every graded
pixel, though the correct values do not, is named."""

from __future__ import annotations

import numpy as np

EXPLAINED = 0.9  # of the pixels that are wrong
CLOSE = 1e-3  # relative: a candidate need not match to the last bit, other errors may be there, too


def suspicions(name: str, gpu: np.ndarray, ref: np.ndarray, graded: np.ndarray, tolerance: float, gpu_moment, ref_moment) -> list[str]:
    """One line per candidate that fits; best first, at most three.

    gpu, ref : (H, W[, C]) what was compared.   graded : (H, W) bool.   tolerance : absolute, in the buffer's unit."""
    if ref.dtype == bool or name in ("id", "triangle"):
        return []
    g = gpu.astype(np.float64)[graded]
    r = np.asarray(ref, np.float64)[graded]
    found = []
    with np.errstate(all="ignore"):
        wrong = ~_close(g, r, tolerance)
        if not wrong.any():
            return []
        for text, candidate in _candidates(name, r, g, graded, gpu_moment, ref_moment):
            share = _close(g, candidate, 10 * tolerance)[wrong].mean()
            if share >= EXPLAINED:
                found.append((share, text))
    found.sort(key=lambda pair: -pair[0])
    return [f"{text} (fits {100 * share:.1f} % of the wrong pixels)" for share, text in found[:3]]


def _close(g, r, tolerance):
    error, size = np.abs(g - r), np.abs(r)
    if g.ndim == 2:
        error, size = np.linalg.norm(g - r, axis=1), np.linalg.norm(r, axis=1)
    return (error <= tolerance + CLOSE * size) | (np.isinf(g) & np.isinf(r) if g.ndim == 1 else False)


def _candidates(name, r, g, graded, gpu, ref):
    """(text, what the GPU would have written) pairs; r, g : (N[, C])."""
    vector = r.ndim == 2
    yield "everything is zero", np.zeros_like(r)
    yield "the sign is wrong", -r
    yield "twice the right value (a factor 0.5 is missing)", 2 * r
    yield "half the right value (a factor 0.5 too many)", r / 2
    if vector and r.shape[1] == 2:
        yield "the sign of x is wrong", r * [-1, 1]
        yield "the sign of y is wrong", r * [1, -1]
        yield "x and y are exchanged", r[:, ::-1]
    camera = ref.scene.camera
    if name == "depth":
        finite = np.isfinite(r)
        yield f"off by the near plane: near = {camera.near:g} is subtracted", r - camera.near
        yield f"off by the near plane: near = {camera.near:g} is added", r + camera.near
        yield "window depth near / Z instead of Z", camera.near / r
        yield "1 / Z instead of Z", 1 / r
        y, x = np.nonzero(graded)
        ray = np.stack([(x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy, np.ones(len(x))], axis=1)
        yield "distance along the ray instead of depth along the optical axis", r * np.linalg.norm(ray, axis=1)
        offset = np.median((g - r)[finite]) if finite.any() else 0.0
        yield f"a constant {offset:+.6g} too much", r + offset
    if name in ("flow_forward", "flow_backward", "velocity"):
        size = np.array([camera.width, camera.height])
        yield "in clip units instead of px (0.5 * image_size is missing)", r * 2 / size
        now = ref["depth"][graded][:, None]
        if name == "velocity":
            yield "the perspective division is missing (not divided by Z)", r * now
            yield "per label interval instead of per second", r * gpu.when.interval_s
            return
        way, other = ("forward", "backward") if name == "flow_forward" else ("backward", "forward")
        then = ref[f"next_depth_{way}"][graded][:, None]
        yield "the perspective division is missing (not divided by Z')", r * then
        yield "divided by the depth at t instead of the depth at t'", r * then / now
        yield "the velocity times the interval, not the displacement", ref["velocity"][graded] * gpu.when.interval_s * (1 if way == "forward" else -1)
        yield f"the {other} flow", ref[f"flow_{other}"][graded]
    if name == "normals":
        yield "not turned into the camera's axes (world axes)", r @ ref.scene.camera.path.pose(gpu.when.t_ns)[:3, :3].T
    if name in ("luminance", "colour", "irradiance"):
        yield "the light is missing (albedo alone)", r / np.maximum(ref["irradiance"][graded][:, None] if vector else ref["irradiance"][graded], 1e-9)
    if name == "uv":
        yield "v runs upwards (1 - v)", np.stack([r[:, 0], 1 - r[:, 1]], axis=1)
        yield "u and v are exchanged", r[:, ::-1]
