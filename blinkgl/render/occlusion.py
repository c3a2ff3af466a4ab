"""Whether the surface point seen at (x, y) is still visible at the other end of its flow.

Nearly everywhere the four pixels around its new position decide. Where they disagree, beside silhouettes and where a
surface turns away, a ray decides (:func:`blinkgl.render.casting.is_hidden`): for about two pixels in a hundred of a
crowded picture. Objects thinner than a pixel can pass between four pixels, so near objects drawn one or two pixels wide
(:func:`near_thin`) four equal pixels do not suffice, either.
"""

from __future__ import annotations

import numpy as np
from numba.extending import register_jitable

from blinkgl.machine.kernels import kernel
from blinkgl.render import casting
from blinkgl.scene.types import Scene

SEEN, HIDDEN, UNDECIDED = 0, 1, 2

# Relative differences of 1/Z. Another surface is in front when it is nearer by the first one: a pixel beside the
# point's position shows another place of its surface. The point's own surface is visible when it is this near to the
# plane through the four samples; a ray decides where it bends more. Where the samples themselves differ by the third,
# they may be parts of the object one behind the other, with the point between them.
_IN_FRONT = 1e-3
_SAME = 3e-4
_STEEP = 0.05
# A ray ends this much before the point. Flow is float32: its end is off by up to some 1e-3 px, which on a slanted
# surface is this much of its depth.
SLACK = 1e-4


NARROW = 2
"""Pixels: an object this narrow may lie between pixel centres elsewhere in the same picture."""
REACH = 4
"""Pixels around it in which it may continue invisibly: a wire of a third of a pixel meets a centre that often."""


@kernel
def near_thin(ids: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Return (H, W) bool: whether, within :data:`REACH` px (in x and y), an object is drawn that is at most
    :data:`NARROW` px wide there, across or down, between others that are farther away.

    ids : (H, W) uint32.   depth : (H, W), 0 where nothing is."""
    height, width = ids.shape
    near = np.zeros((height, width), np.bool_)
    # Twice: along rows, then along columns.
    for down in range(2):
        dx, dy = 1 - down, down
        lines, length = (width, height) if down else (height, width)
        for line in range(lines):
            start = 0
            while start < length:
                y, x = (start, line) if down else (line, start)
                # A run of one object: adjacent pixels.
                own = ids[y, x]
                end = start + 1
                while end < length and ids[y + (end - start) * dy, x + (end - start) * dx] == own:
                    end += 1
                width_here = end - start
                # Narrow, with something farther away on both sides: it may be invisible in the next row.
                if width_here <= NARROW and start > 0 and end < length and depth[y, x] > 0:
                    before = depth[y - dy, x - dx]
                    after = depth[y + width_here * dy, x + width_here * dx]
                    last = depth[y + (width_here - 1) * dy, x + (width_here - 1) * dx]
                    if (before == 0 or before > depth[y, x]) and (after == 0 or after > last):
                        y1, x1 = y + (width_here - 1) * dy, x + (width_here - 1) * dx
                        for yn in range(max(y - REACH, 0), min(y1 + REACH + 1, height)):
                            for xn in range(max(x - REACH, 0), min(x1 + REACH + 1, width)):
                                near[yn, xn] = True
                start = end
    return near


@kernel(error_model="numpy")
def _nearness(depth):
    """Return 1/Z once per pixel instead of once per sample: a point has four of these, and divisions dominate."""
    nearness = np.empty(depth.shape)
    for y in range(depth.shape[0]):
        for x in range(depth.shape[1]):
            nearness[y, x] = 1.0 / np.float64(depth[y, x]) if depth[y, x] > 0 else 0.0
    return nearness


@register_jitable
def _on_surface(four, ax, ay, inverse):
    """Return whether a point of this 1/Z is on the surface through the four pixels around it, and that is not steep."""
    n00, n01, n10, n11 = four
    between = (1.0 - ay) * ((1.0 - ax) * n00 + ax * n01) + ay * ((1.0 - ax) * n10 + ax * n11)
    steep = max(n00, n01, n10, n11) - min(n00, n01, n10, n11) > _STEEP * inverse
    return not (abs(between - inverse) > _SAME * inverse or steep)


@kernel(error_model="numpy")
def judged_by_samples(
    flow: np.ndarray,
    z_there: np.ndarray,
    valid: np.ndarray,
    ids: np.ndarray,
    depth_there: np.ndarray,
    ids_there: np.ndarray,
    near: float = 0.0,
) -> np.ndarray:
    """Return the verdict of the picture at t' on each point: (H, W) uint8 of SEEN, HIDDEN, UNDECIDED; SEEN where not
    valid.

    flow : (H, W, 2) float32 px.   z_there : (H, W) float32 depth of the point at t'.   valid : (H, W) bool.
    ids : (H, W) uint32 at t.   depth_there, ids_there : (H, W) depth and ids drawn at t' (depth 0: nothing).
    near : depth of the near plane; nothing before it is drawn at t'.

    HIDDEN: outside the image, before the near plane, or all four pixels around the new position show other, nearer
    objects. SEEN: all four show the point's own object, nothing thin is near (:func:`near_thin`), and their depths,
    interpolated in 1/Z (exact on a plane), are the point's and differ little. UNDECIDED: the rest, and the outer half
    pixel of the image.
    """
    height, width = valid.shape
    thin, nearness = near_thin(ids_there, depth_there), _nearness(depth_there)
    verdict = np.zeros((height, width), np.uint8)
    last_x, last_y = max(width - 2, 0), max(height - 2, 0)
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            # Where the point is at t'; pixel centres are at integers.
            xt, yt = np.float64(x) + flow[y, x, 0], np.float64(y) + flow[y, x, 1]
            if not (-0.5 <= xt < width - 0.5 and -0.5 <= yt < height - 0.5) or z_there[y, x] < near:
                verdict[y, x] = HIDDEN
                continue
            # Outside the outermost pixel centres the picture says nothing.
            if not (0.0 <= xt <= width - 1.0 and 0.0 <= yt <= height - 1.0):
                verdict[y, x] = UNDECIDED
                continue
            inverse = 1.0 / np.float64(z_there[y, x])
            x0 = min(max(int(np.floor(xt)), 0), last_x)
            y0 = min(max(int(np.floor(yt)), 0), last_y)
            x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
            ax, ay, own = xt - x0, yt - y0, ids[y, x]
            shown = ids_there[y0, x0], ids_there[y0, x1], ids_there[y1, x0], ids_there[y1, x1]
            # All four show its own object: visible, if the point is on the interpolated surface.
            if shown[0] == own and shown[1] == own and shown[2] == own and shown[3] == own:
                four = nearness[y0, x0], nearness[y0, x1], nearness[y1, x0], nearness[y1, x1]
                if thin[y0, x0] or not _on_surface(four, ax, ay, inverse):
                    verdict[y, x] = UNDECIDED
                continue
            # Otherwise hidden, unless some pixel shows its own object or something that is not nearer.
            limit = inverse * (1.0 + _IN_FRONT)
            verdict[y, x] = HIDDEN
            for dy in range(2):
                for dx in range(2):
                    yn, xn = y1 if dy else y0, x1 if dx else x0
                    if ids_there[yn, xn] == own or not nearness[yn, xn] > limit:
                        verdict[y, x] = UNDECIDED
    return verdict


def occlusion_mask(
    scene: Scene,
    t_ns: int,
    flow: np.ndarray,
    z_there: np.ndarray,
    valid: np.ndarray,
    ids: np.ndarray,
    depth_there: np.ndarray,
    ids_there: np.ndarray,
) -> np.ndarray:
    """Return (H, W) bool: valid pixels whose point is not visible at t_ns, the time at the end of their flow.

    scene : what was drawn.   The rest as in :func:`judged_by_samples`.
    """
    camera = scene.camera
    verdict = judged_by_samples(flow, z_there, valid, ids, depth_there, ids_there, camera.near)
    where, place, depth = undecided(verdict, flow, z_there)
    if len(where):
        verdict.reshape(-1)[where] = casting.is_hidden(scene, t_ns, place, depth, SLACK)
    return verdict == HIDDEN


@kernel
def undecided(verdict: np.ndarray, flow: np.ndarray, z_there: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return, for the points whose ``verdict`` is UNDECIDED, row by row: (N,) number of the pixel, (N, 2) float64 px of
    their position then, (N,) float64 depth."""
    width = verdict.shape[1]
    flat = verdict.reshape(-1)
    # Two passes: the first counts, so that arrays have the right size.
    count = 0
    for k in range(len(flat)):
        count += flat[k] == UNDECIDED
    where, place, depth = np.empty(count, np.int64), np.empty((count, 2)), np.empty(count)
    n = 0
    for k in range(len(flat)):
        if flat[k] == UNDECIDED:
            y, x = k // width, k % width
            where[n] = k
            place[n, 0] = x + np.float64(flow[y, x, 0])
            place[n, 1] = y + np.float64(flow[y, x, 1])
            depth[n] = z_there[y, x]
            n += 1
    return where, place, depth


@kernel
def flow_and_reach(raw: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (H, W, 2) float32 px, 0 where not valid, and (H, W) bool of the shader's (H, W, 4): u, v, Z at the other
    time, which must be above 0, and whether something is hit."""
    height, width = raw.shape[:2]
    flow, valid = np.empty((height, width, 2), np.float32), np.empty((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            there = raw[y, x, 3] > 0.0 and raw[y, x, 2] > 0.0
            valid[y, x] = there
            flow[y, x, 0] = raw[y, x, 0] if there else 0.0
            flow[y, x, 1] = raw[y, x, 1] if there else 0.0
    return flow, valid
