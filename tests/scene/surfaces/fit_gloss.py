"""Where a surface that shines looks at its surroundings: the table ``_LOOKS`` of ``blinkgl/scene/surfaces/gloss.py``.

A lobe seen from aside is no lobe seen along the normal, which is what surroundings are blurred by: it is longer in the
plane of eye and normal, and cut off at the horizon. Two looks at blurred surroundings, in two directions in that plane
and at two roughnesses, stand for it. For each roughness and cosine their directions, roughnesses and weights are those
that come nearest to the integral over the lobe, in float64, by the mean of relative differences, over made-up
surroundings (a horizon, patches, windows) and random ways to face them.
``fitted(default_rng(1), pictures, levels, 130, 220)`` of three surroundings made the table, in thousandths.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np
from scipy.optimize import minimize

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


def looks(levels: np.ndarray, n: np.ndarray, along: np.ndarray, cosine: float, cell: np.ndarray) -> np.ndarray:
    """(N, C): what two looks see, by the five numbers of a cell of the table."""
    away = cosine * n - np.sqrt(1 - cosine**2) * along
    return sum(
        weight * gloss.mirrored(levels, way, roughness)
        for way, roughness, weight in gloss.both(n, away, np.broadcast_to(cell, (len(n), 5)))
    )


def fitted(
    rng: np.random.Generator,
    picture: np.ndarray,
    levels: np.ndarray,
    frames: int,
    iterations: int,
    cells: Container[tuple[int, int]] | None = None,
) -> np.ndarray:
    """(LEVELS, COSINES, 5). picture, levels : (HEIGHT, 2 HEIGHT, C), and what :func:`gloss.blurred` makes of it.
    cells : (roughness, cosine) that are looked for; None: all; others are 0."""
    rows, columns = gloss.LEVELS, gloss.COSINES
    table = np.zeros((rows, columns, 5))
    for j in range(1, rows):
        roughness = j / (rows - 1)
        for i in range(columns - 1, -1, -1):
            if cells is not None and (j, i) not in cells:
                continue
            cosine = min(max(i / (columns - 1), 0.03), 0.995)
            n, along = facing(rng, frames)
            true = integral(picture, n, along, cosine, roughness)
            floor = 0.03 * true.mean(axis=0)
            starts = [table[j, i + 1]] if i + 1 < columns else []
            starts += [table[j - 1, i] * [1, j / (j - 1), 1, j / (j - 1), 1]] if j > 1 else []
            starts = [start for start in starts if start.any()]
            if j == 1 or not starts:
                starts.append(np.array([1.02, 0.8 * roughness, 0.95, roughness, 0.6]))
            near = starts[0]

            def short_of(cell, near=near, true=true, floor=floor, n=n, along=along, cosine=cosine):
                allowed = _allowed(cell)
                seen = looks(levels, n, along, cosine, allowed)
                # of cells that are as good the one that is like its neighbour: between them the table is linear
                return (
                    (np.abs(seen - true) / (true + floor)).mean()
                    + np.abs(allowed - cell).sum()
                    + 6e-4 * ((cell - near) ** 2).sum()
                )

            steps = np.diag([0.12, 0.15 * roughness + 0.02, -0.12, 0.15 * roughness + 0.02, 0.15])
            found = [
                minimize(
                    short_of,
                    start,
                    method="Nelder-Mead",
                    options={
                        "maxiter": iterations,
                        "xatol": 2e-3,
                        "fatol": 5e-5,
                        "initial_simplex": np.concatenate([start[None], start + steps]),
                    },
                )
                for start in starts
            ]
            best = min(found, key=lambda one: one.fun)
            table[j, i] = _allowed(best.x)
    table[0] = table[1]  # a mirror looks once
    table[0, :, [0, 2]], table[0, :, [1, 3]] = 1.0, 0.0
    return table


def _allowed(cell: np.ndarray) -> np.ndarray:
    first, r1, second, r2, weight = cell
    return np.array([
        np.clip(first, 0.0, 1.5), np.clip(r1, 0, 1), np.clip(second, 0.0, min(first, 1.5)), np.clip(r2, 0, 1),
        np.clip(weight, 0.05, 0.95),
    ])  # fmt: skip
