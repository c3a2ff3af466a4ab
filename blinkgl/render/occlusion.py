"""Is the surface point seen at (x, y) still visible at the other end of its flow?

Nearly everywhere the four pixels around its new place say so. Where they do not agree, beside silhouettes and where a
surface turns away, a ray decides (:func:`blinkgl.render.reference.is_hidden`): about two pixels in a hundred of a
crowded picture.
"""

from __future__ import annotations

import numba as nb
import numpy as np

from blinkgl.render import reference
from blinkgl.scene.types import Scene

SEEN, HIDDEN, UNDECIDED = 0, 1, 2

# Relative differences of 1/Z. Another surface counts as in front when it is nearer by the first one: a pixel next to
# the point's place shows its surface elsewhere. The point's own surface counts as the one that is seen when it comes
# this near to the plane through the four samples; what bends more is asked by a ray.
_IN_FRONT = 1e-3
_SAME = 3e-4
# A ray ends this much before the point. Flow is float32: its end lies up to some 1e-3 px off, which on a surface that
# is seen at a slant is this much of its depth.
SLACK = 1e-4


@nb.njit(cache=True, nogil=True)
def judged_by_samples(
    flow: np.ndarray,
    z_there: np.ndarray,
    valid: np.ndarray,
    ids: np.ndarray,
    depth_there: np.ndarray,
    ids_there: np.ndarray,
    near: float = 0.0,
) -> np.ndarray:
    """What the picture at t' says of each point: (H, W) uint8 of SEEN, HIDDEN, UNDECIDED; SEEN where not valid.

    flow : (H, W, 2) float32 px.   z_there : (H, W) float32 depth of the point at t'.   valid : (H, W) bool.
    ids : (H, W) uint32 at t.   depth_there, ids_there : (H, W) depth and ids drawn at t' (depth 0: nothing).
    near : depth of the near plane; what is before it is not drawn at t'.

    HIDDEN: outside the image, before the near plane, or all four pixels around the new place show other objects that
    are nearer. SEEN: all four show the point's own object, and their depths, interpolated in 1/Z (exact on a plane, in
    the outermost half pixel, too), are not in front of it. UNDECIDED: the rest.
    """
    height, width = valid.shape
    verdict = np.zeros((height, width), np.uint8)
    for y in range(height):
        for x in range(width):
            if not valid[y, x]:
                continue
            xt = np.float64(x) + flow[y, x, 0]
            yt = np.float64(y) + flow[y, x, 1]
            if not (-0.5 <= xt < width - 0.5 and -0.5 <= yt < height - 0.5) or z_there[y, x] < near:
                verdict[y, x] = HIDDEN
                continue
            inverse = 1.0 / np.float64(z_there[y, x])
            # At the border the four pixels are the outermost ones and the weights extrapolate: a surface that is seen
            # at a slant would otherwise seem to lie nearer than its own point there.
            x0 = min(max(int(np.floor(xt)), 0), max(width - 2, 0))
            y0 = min(max(int(np.floor(yt)), 0), max(height - 2, 0))
            ax, ay = xt - x0, yt - y0
            own, others_in_front, mean = 0, 0, 0.0
            for dy in range(2):
                for dx in range(2):
                    xn, yn = min(x0 + dx, width - 1), min(y0 + dy, height - 1)
                    z = np.float64(depth_there[yn, xn])
                    if ids_there[yn, xn] == ids[y, x]:
                        own += 1
                        mean += (ax if dx else 1.0 - ax) * (ay if dy else 1.0 - ay) / z
                    elif z > 0 and 1.0 / z > inverse * (1.0 + _IN_FRONT):
                        others_in_front += 1
            if others_in_front == 4:
                verdict[y, x] = HIDDEN
            elif own < 4 or mean > inverse * (1.0 + _SAME):
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
    """(H, W) bool: valid pixels whose point is not visible at t_ns, the time that their flow leads to.

    scene : what was drawn.   The rest as in :func:`judged_by_samples`.
    """
    camera = scene.camera
    verdict = judged_by_samples(flow, z_there, valid, ids, depth_there, ids_there, camera.near)
    y, x = np.nonzero(verdict == UNDECIDED)
    if len(x):
        place = np.stack([x, y], axis=1) + flow[y, x].astype(np.float64)
        verdict[y, x] = reference.is_hidden(scene, t_ns, place, z_there[y, x].astype(np.float64), SLACK)
    return verdict == HIDDEN
