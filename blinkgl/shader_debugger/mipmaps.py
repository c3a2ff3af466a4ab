"""A CPU twin of mip-mapped texture sampling, for grading the albedo where a pixel covers several texels.

The float64 reference samples textures at full resolution: mip maps are the GPU's way to anti-alias, not a property of
the scene. OpenGL leaves their making to the driver, so this twin (each level half the last one, resampled bilinearly,
which is the 2 x 2 mean where the size is even; then trilinear sampling, OpenGL 4.6 section 8.14.3) is compared with a
loose tolerance: it finds wrong coordinates, a wrong texture or a wrong level, not rounding.
"""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np

from blinkgl.render import appearance
from blinkgl.render.colour import linear_image
from blinkgl.scene.types import REPEAT, Material, Texture

_chains: WeakKeyDictionary = WeakKeyDictionary()


def mip_chain(texture: Texture) -> list[Texture]:
    """Linear-light float32 levels 0, 1, … down to 1 x 1."""
    if texture not in _chains:
        levels = [linear_image(texture.image)]
        while max(levels[-1].shape[:2]) > 1:
            levels.append(_half(_half(levels[-1]).swapaxes(0, 1)).swapaxes(0, 1))
        _chains[texture] = [Texture(np.ascontiguousarray(level), texture.name) for level in levels]
    return _chains[texture]


def _half(image: np.ndarray) -> np.ndarray:
    """Half as many rows (rounded down, at least one), sampled bilinearly at their centres."""
    size = len(image)
    if size == 1:
        return image
    new = size // 2
    at = (np.arange(new) + 0.5) * size / new - 0.5
    low = np.clip(np.floor(at).astype(int), 0, size - 2)
    part = (at - low).astype(np.float32)[:, None, None]
    return image[low] * (1 - part) + image[low + 1] * part


def sample_trilinear(texture: Texture, uv: np.ndarray, level: np.ndarray, wrap: tuple[str, str] = REPEAT) -> np.ndarray:
    """(N, 3) linear light at (N, 2) texture coordinates and (N,) levels (below 0: level 0)."""
    chain = mip_chain(texture)
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
    """(N, 3) linear albedo; ``uv`` already times uv_scale."""
    base = np.asarray(material.base_color, np.float64)
    if material.texture is None:
        return np.broadcast_to(base, (len(uv), 3)).copy()
    return sample_trilinear(material.texture, uv, level, material.wrap) * base
