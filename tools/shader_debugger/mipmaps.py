"""A reference of mip-mapped texture sampling on the CPU, for grading the albedo where a pixel covers several texels.

The float64 reference samples textures at full resolution: mip maps are the GPU's method of anti-aliasing, not a part of
the scene. OpenGL does not define how drivers make them. So the tolerance is loose for it (each level half the
last one, resampled bilinearly, which is the 2 x 2 mean where the size is even; then trilinear sampling, OpenGL 4.6
section 8.14.3): it finds wrong coordinates, a wrong texture or a wrong level, not rounding.
"""

from __future__ import annotations

from itertools import product
from weakref import WeakKeyDictionary

import cv2
import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.render.colour import linear_image
from blinkgl.scene.types import REPEAT, Material, Texture
from blinkgl.tools.shader_debugger import appearance

_chains: WeakKeyDictionary = WeakKeyDictionary()


def mip_chain(texture: Texture) -> list[Texture]:
    """Return linear-light float32 levels 0, 1, … down to 1 x 1."""
    if texture not in _chains:
        # Mip maps are means of light, not of its sRGB code.
        levels = [linear_image(texture.image)]
        while max(levels[-1].shape[:2]) > 1:
            height, width = (max(1, size // 2) for size in levels[-1].shape[:2])
            levels.append(cv2.resize(levels[-1], (width, height), interpolation=cv2.INTER_LINEAR))
        _chains[texture] = [Texture(np.ascontiguousarray(level), texture.name) for level in levels]
    return _chains[texture]


def sample_trilinear(texture: Texture, uv: np.ndarray, level: np.ndarray, wrap: tuple[str, str] = REPEAT) -> np.ndarray:
    """Return the (N, 3) linear light at (N, 2) texture coordinates and (N,) levels (below 0: level 0)."""
    chain = mip_chain(texture)
    # A magnified texture has the finest level, and 1 x 1 is the last.
    level = np.clip(np.nan_to_num(level), 0.0, len(chain) - 1)
    low = np.floor(level).astype(int)
    out = np.empty((len(uv), 3))
    for k in np.unique(low):
        on = low == k
        part = (level[on] - k)[:, None]
        upper = chain[min(k + 1, len(chain) - 1)]
        out[on] = (
            appearance.sample_bilinear(chain[k], uv[on], wrap) * (1 - part)
            + appearance.sample_bilinear(upper, uv[on], wrap) * part
        )
    return out


def mipmapped_albedo(material: Material, uv: np.ndarray, level: np.ndarray) -> np.ndarray:
    """Return the (N, 3) linear albedo; ``uv`` is already multiplied by uv_scale."""
    base = np.asarray(material.base_color, np.float64)
    if material.texture is None:
        return np.broadcast_to(base, (len(uv), 3)).copy()
    return sample_trilinear(material.texture, uv, level, material.wrap) * base


def levels(points: np.ndarray, texels: np.ndarray, xy: np.ndarray, camera: CameraModel) -> np.ndarray:
    """(N, 3) least, usual and greatest level that OpenGL 4.6 allows for a look-up at (N, 2) pixels; -inf, inf, inf
    where a neighbour looks past the horizon of the triangle's plane.

    points : (N, 3, 3) corners, camera axes.   texels : (N, 3, 2) texture coordinates of the corners, in texels.

    Derivatives are differences between the 2 x 2 pixels of a quad, of either of its rows and columns (GLSL 4.60,
    section 8.14.1). Usual is log2 of the longer of the two (OpenGL 4.6, section 8.14.1, eq. 8.7). With m_u =
    max(|du/dx|, |du/dy|), and m_v likewise, it may be taken of anything from max(m_u, m_v) to m_u + m_v."""
    # With b = inv([A B C]) r the coordinates are (sum b_i u_i) / (sum b_i); the adjugate does, its scale cancels.
    rows, corner = np.cross(points[:, (1, 2, 0)], points[:, (2, 0, 1)]), 2 * (xy // 2)
    there, sides = {}, 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        for x, y in product((0, 1), repeat=2):
            weights = np.einsum("nij,nj->ni", rows, camera.rays(corner + [x, y]))
            total = weights.sum(axis=1)
            there[x, y] = np.einsum("ni,nik->nk", weights, texels) / total[:, None]
            sides = sides + np.sign(total)
        along = np.abs([there[1, k] - there[0, k] for k in (0, 1)])
        down = np.abs([there[k, 1] - there[k, 0] for k in (0, 1)])
        # Lower and upper bound over both rows and both columns.
        low = np.maximum(along.min(axis=0), down.min(axis=0)).max(axis=1)
        high = np.maximum(along.max(axis=0), down.max(axis=0)).sum(axis=1)
        usual = np.hypot(*np.moveaxis(np.array([along, down]), -1, 0)).mean(axis=1).max(axis=0)
        # The sign says which side of the plane is visible; different signs mean that the horizon lies between.
        whole = np.abs(sides)[:, None] == 4
        return np.log2(np.where(whole, np.stack([low, usual, high], axis=1), [0.0, np.inf, np.inf]))


MISPLACED = 0.01 + 2.0**-8.5
"""Tolerance of the position of a surface without needle-like triangles, px: rounding of float32, and half a diagonal
step of the grid of 1/256 px to which corners are snapped (guard.glsl)."""
_ROUNDING = 8 * 2.0**-24
"""Relative rounding error of the position of a corner: four products, three sums and one division."""


def needles(points: np.ndarray, camera: CameraModel) -> np.ndarray:
    """Return the factor on :data:`MISPLACED`, (N,) >= 1, for the surfaces of N triangles in float32.

    points : (N, 3, 3) corners, camera axes.
    If a corner is wrong by e, barycentric coordinates are wrong by e / height, and the surface by that times the
    longest side. Triangles through the near plane are clipped; they have 1."""
    whole = np.all(points[..., 2] > camera.near, axis=1)
    # A corner behind the camera has no pixel: use any point in front, since the result is not used.
    px = camera.project(np.where(whole[:, None, None], points, [0.0, 0.0, 1.0]))
    sides = px - np.roll(px, 1, axis=1)
    # Twice the area of a triangle is its longest side times its height.
    area = np.abs(sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0])
    extent = np.maximum(np.abs(px).max(axis=(1, 2)), max(camera.width, camera.height))
    off = _ROUNDING * extent * (sides**2).sum(axis=2).max(axis=1) / np.maximum(area, 1e-12)
    return np.where(whole, np.maximum(off / MISPLACED, 1.0), 1.0)
