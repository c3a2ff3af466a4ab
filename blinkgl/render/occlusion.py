"""Is the surface point seen at (x, y) still visible at the other end of its flow?"""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def occlusion_mask(
    flow: np.ndarray,
    w_next: np.ndarray,
    valid: np.ndarray,
    ids: np.ndarray,
    depth_next: np.ndarray,
    ids_next: np.ndarray,
    near: float = 0.0,
    tolerance: float = 1e-3,
) -> np.ndarray:
    """Valid pixels whose point is not visible at t'.

    flow : (H, W, 2) float32 px.   w_next : (H, W) float32 depth of the point at t'.   valid : (H, W) bool.
    ids : (H, W) uint32 at t.      depth_next, ids_next : (H, W) depth and ids rendered at t' (depth 0: nothing).
    near : depth of the near plane; a point in front of it is not drawn at t'.
    tolerance : relative depth difference that still counts as the same surface.
    Returns (H, W) bool: the point leaves the image, comes before the near plane, or another surface (or another side
    of the same object) is nearer at its new place.

    Where the nearest pixel at t' shows another object, its depth decides. Where it shows the same one, the depth is
    interpolated in 1/Z (exact on a plane, in the outermost half pixel too) from those of the four surrounding pixels
    that show that object.
    """
    height, width = valid.shape
    occluded = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            xt = np.float64(x) + flow[y, x, 0]
            yt = np.float64(y) + flow[y, x, 1]
            if not (-0.5 <= xt < width - 0.5 and -0.5 <= yt < height - 0.5):
                occluded[y, x] = True
                continue
            if w_next[y, x] < near:
                occluded[y, x] = True
                continue
            inverse = 1.0 / np.float64(w_next[y, x])
            xn, yn = int(np.floor(xt + 0.5)), int(np.floor(yt + 0.5))
            if ids_next[yn, xn] != ids[y, x]:
                z = np.float64(depth_next[yn, xn])
                occluded[y, x] = z > 0 and 1.0 / z > inverse * (1.0 + tolerance)
                continue
            # At the border the four pixels are the outermost ones and the weights extrapolate: a surface that is seen
            # at a slant would otherwise seem to lie nearer than its own point there.
            x0 = min(max(int(np.floor(xt)), 0), max(width - 2, 0))
            y0 = min(max(int(np.floor(yt)), 0), max(height - 2, 0))
            ax, ay = xt - x0, yt - y0
            complete = True
            for dy in range(2):
                for dx in range(2):
                    complete &= ids_next[min(y0 + dy, height - 1), min(x0 + dx, width - 1)] == ids[y, x]
            if not complete:
                ax, ay = min(max(ax, 0.0), 1.0), min(max(ay, 0.0), 1.0)
            total = 0.0
            mean = 0.0
            low = np.inf
            high = 0.0
            for dy in range(2):
                for dx in range(2):
                    xn, yn = min(x0 + dx, width - 1), min(y0 + dy, height - 1)
                    if ids_next[yn, xn] != ids[y, x]:
                        continue
                    weight = (ax if dx else 1.0 - ax) * (ay if dy else 1.0 - ay)
                    other = 1.0 / np.float64(depth_next[yn, xn])
                    total += weight
                    mean += weight * other
                    low = min(low, other)
                    high = max(high, other)
            # Curved and steep surfaces: allow part of the spread among the neighbours on top of the tolerance.
            occluded[y, x] = mean / total > inverse * (1.0 + tolerance) + 0.5 * (high - low)
    return occluded
