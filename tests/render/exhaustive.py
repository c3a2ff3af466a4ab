"""The slow twin of the ray caster's tree: every triangle against every ray."""

import numba as nb
import numpy as np

from blinkgl.render.raycast import Forest, _is_hole, _local_ray, _shear, _triangle


@nb.njit(nogil=True, error_model="numpy")
def nearest_exhaustive(
    forest: Forest,
    origins: np.ndarray,
    axes: np.ndarray,
    rays: np.ndarray,
    near: float,
    far: np.ndarray,
    skip: np.ndarray,
    hit: np.ndarray,
    bary: np.ndarray,
    depth: np.ndarray,
    any_will_do: bool = False,
) -> None:
    """The slow twin of :func:`nearest_tree`: every triangle against every ray; the same arguments and answer."""
    triangles, face, _, _, _, _, root, first, size, side, _, mask, uvs, masks, cutoffs, texels = forest
    d = np.empty(3)
    for i in range(rays.shape[0]):
        depth[i] = np.inf
        hit[i] = -1
        for p in range(root.shape[0]):
            _local_ray(axes[p], rays[i, 0], rays[i, 1], d)
            kx, ky, kz, sx, sy, sz = _shear(d)
            for j in range(first[p], first[p] + size[p]):
                if skip[i, 0] == p and skip[i, 1] == face[j]:
                    continue
                s, u, v, w, front = _triangle(triangles[j], origins[p], kx, ky, kz, sx, sy, sz)
                # The same conditions as in nearest_tree, with depth[i] as the best.
                if not (near <= s <= depth[i] and s < far[i]) or (side[p] != 0 and (side[p] > 0) != front):
                    continue
                if s == depth[i] and (hit[i, 0] < p or hit[i, 1] < face[j]):
                    continue
                k = mask[p]
                if k >= 0 and _is_hole(masks[k], uvs, cutoffs[k], texels, face[j], u, v, w):
                    continue
                depth[i] = s
                hit[i, 0], hit[i, 1], hit[i, 2] = p, face[j], front
                bary[i, 0], bary[i, 1], bary[i, 2] = u, v, w
