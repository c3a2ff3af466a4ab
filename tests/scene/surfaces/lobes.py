"""The lobe of a surface that shines, integrated over made-up surroundings: what the table ``_LOOKS`` of
``blinkgl/scene/surfaces/gloss.py`` stands for.

A lobe seen from aside is no lobe seen along the normal, which is what surroundings are blurred by: it is longer in the
plane of eye and normal, and cut off at the horizon. Two looks at blurred surroundings, in two directions in that plane
and at two roughnesses, come nearest to it. The table was fitted once, by ``fitted`` of ``fit_gloss.py`` in commit
9e3961bf.
"""

from __future__ import annotations

import numpy as np

from blinkgl.scene.surfaces import gloss
from blinkgl.scene.surfaces.environment import pixel_directions

HEIGHT = 128
_SAMPLED = 0.2  # roughness below which a lobe is narrower than pixels: drawn by visible normals instead of summed
_DIRECTIONS, _SOLID = pixel_directions(HEIGHT, 2 * HEIGHT)


def surroundings(rng: np.random.Generator) -> np.ndarray:
    """(HEIGHT, 2 HEIGHT, 3) float32: three made-up surroundings of one channel each."""
    out = np.empty((*_DIRECTIONS.shape[:2], 3), np.float32)
    for channel in range(3):
        up = rng.normal(size=3) * np.array([0.05, 0.05, 1])
        picture = np.where(_DIRECTIONS @ (up / np.linalg.norm(up)) > 0, 1.0, rng.uniform(0.1, 0.6))
        for _ in range(25):
            towards, radius = rng.normal(size=3), 10 ** rng.uniform(-1.3, -0.1)
            bright = rng.uniform(0.05, 1.2) * (1 if rng.random() < 0.8 else 4)
            picture = np.where(_DIRECTIONS @ (towards / np.linalg.norm(towards)) > np.cos(radius), bright, picture)
        out[..., channel] = picture
    return out


def facing(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) normals, and unit vectors along the surface towards which the eye lies."""
    n = rng.normal(size=(count, 3))
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    along = np.cross(n, rng.normal(size=n.shape))
    return n, along / np.linalg.norm(along, axis=1, keepdims=True)


def integral(picture: np.ndarray, n: np.ndarray, along: np.ndarray, cosine: float, roughness: float) -> np.ndarray:
    """(N, C): the mean of a picture over the lobe, weighed by the cosine, of eyes at a cosine from N normals."""
    eye = cosine * n + np.sqrt(1 - cosine**2) * along
    if roughness < _SAMPLED:
        return _drawn(picture, n, along, cosine, roughness)
    flat, at = picture.reshape(-1, picture.shape[2]).astype(np.float64), _DIRECTIONS.reshape(-1, 3)
    solid = np.repeat(_SOLID, 2 * HEIGHT)
    out = np.empty((len(n), flat.shape[1]))
    for k in range(len(n)):
        nl = at @ n[k]
        on = np.flatnonzero(nl > 0)
        half = at[on] + eye[k]
        nh = np.clip((half @ n[k]) / np.linalg.norm(half, axis=1), 0, 1)
        weight = gloss.lobe(nl[on], np.float64(cosine), nh, np.float64(roughness)) * nl[on] * solid[on]
        out[k] = weight @ flat[on] / weight.sum()
    return out


def _drawn(picture, n, along, cosine, roughness, count=3000) -> np.ndarray:
    directions, weight = gloss.visible(np.array([cosine]), roughness, count)
    x, y, z = (d[0] for d in directions)
    weight = weight[0] / weight[0].sum()
    levels, out = picture[None].astype(np.float64), []
    for normal, way in zip(n, along):
        to = x[:, None] * way + y[:, None] * np.cross(normal, way) + z[:, None] * normal
        out.append(weight @ gloss.mirrored(np.concatenate([levels, levels]), to, np.zeros(count)))
    return np.array(out)
