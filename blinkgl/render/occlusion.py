"""Is the surface point seen at (x, y) still visible at the other end of its flow?"""

from __future__ import annotations

import numba as nb
import numpy as np


@nb.njit(cache=True, nogil=True)
def occlusion_mask(flow, w_next, valid, ids, depth_next, ids_next, tolerance=1e-3):
    """Valid pixels whose point is not visible at t'.

    flow : (H, W, 2) float32 px.   w_next : (H, W) float32 depth of the point at t'.   valid : (H, W) bool.
    ids : (H, W) uint32 at t.      depth_next, ids_next : (H, W) depth and ids rendered at t' (depth 0: nothing).
    tolerance : relative depth difference that still counts as the same surface.
    Returns (H, W) bool: the point leaves the image, or another surface (or another side of the same object) is
    nearer at its new place.

    Where the nearest pixel at t' shows another object, its depth decides. Where it shows the same one, the depth is
    interpolated in 1/Z (exact on a plane) from those of the four surrounding pixels that show that object.
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
            inverse = 1.0 / np.float64(w_next[y, x])
            xn, yn = int(np.floor(xt + 0.5)), int(np.floor(yt + 0.5))
            if ids_next[yn, xn] != ids[y, x]:
                z = np.float64(depth_next[yn, xn])
                occluded[y, x] = z > 0 and 1.0 / z > inverse * (1.0 + tolerance)
                continue
            x0, y0 = int(np.floor(xt)), int(np.floor(yt))
            ax, ay = xt - x0, yt - y0
            total = 0.0
            mean = 0.0
            low = np.inf
            high = 0.0
            for dy in range(2):
                for dx in range(2):
                    xn = min(max(x0 + dx, 0), width - 1)
                    yn = min(max(y0 + dy, 0), height - 1)
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
