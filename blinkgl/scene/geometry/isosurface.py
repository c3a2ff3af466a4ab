"""A closed surface round whatever a function says is inside: naive surface nets (Gibson 1998), then Newton's method.

points, faces, normals = isosurface(distance, low, high, step)
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np

# The twelve edges of a cell, from the lower to the upper corner.
_EDGES = [
    (np.array(a), np.array(b))
    for a in np.ndindex(2, 2, 2)
    for b in np.ndindex(2, 2, 2)
    if sum(b) - sum(a) == 1 and all(q >= p for p, q in zip(a, b))
]


def isosurface(
    distance: Callable[[np.ndarray], np.ndarray], low: np.ndarray, high: np.ndarray, step: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """((V, 3) points, (F, 3) int32 faces, (V, 3) unit normals) of where ``distance`` ((N, 3) points to (N,)) is zero;
    it is negative inside, changes by at most 1.2 per unit and need not be exact. Cells of edge ``step`` fill the box
    low to high, (3,); its outermost cells have to lie outside. Faces are counter-clockwise seen from outside."""
    shape = np.ceil((np.asarray(high) - low) / step).astype(int) + 1
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in shape), indexing="ij"), -1)
    values = _values(distance, low + step * grid, step)
    inside = values < 0
    # How many of a cell's eight corners are inside: 1 to 7 where the surface passes.
    count = sum(
        inside[tuple(slice(o, n - 1 + o) for o, n in zip(corner, shape))].astype(int) for corner in np.ndindex(2, 2, 2)
    )
    cells = np.argwhere((count > 0) & (count < 8))
    number = np.full(shape - 1, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    # Its vertex is the mean of the places at which the surface crosses its edges.
    total, crossings = np.zeros((len(cells), 3)), np.zeros(len(cells))
    for a, b in _EDGES:
        u, v = values[tuple((cells + a).T)], values[tuple((cells + b).T)]
        crossed = (u < 0) != (v < 0)
        share = np.where(crossed, u / np.where(crossed, u - v, 1.0), 0.0)
        total += np.where(crossed[:, None], a + share[:, None] * (b - a), 0.0)
        crossings += crossed
    points = low + step * (cells + total / crossings[:, None])
    faces = []
    # Where the function changes sign between neighbours on the grid the four cells around that edge
    # make a quadrilateral.
    for axis in range(3):
        turned = [axis, (axis + 1) % 3, (axis + 2) % 3]
        solid, cell = np.transpose(inside, turned), np.transpose(number, turned)
        out, back = solid[:-1] & ~solid[1:], ~solid[:-1] & solid[1:]
        for way, mask in ((1, out), (-1, back)):
            i, j, k = np.nonzero(mask[:, 1:-1, 1:-1])
            faces.append(
                np.stack([cell[i, j, k], cell[i, j + 1, k], cell[i, j + 1, k + 1], cell[i, j, k + 1]], 1)[:, ::way]
            )
    quads = np.concatenate(faces)
    # Newton's method along the gradient, at most half a cell at a time.
    for _ in range(2):
        gradient = _gradient(distance, points, 1e-3 * step)
        move = distance(points) / np.maximum((gradient**2).sum(axis=1), 1e-12)
        points = points - np.clip(move, -step / 2, step / 2)[:, None] * gradient
    # Cut along the shorter diagonal.
    a, b, c, d = (points[quads[:, k]] for k in range(4))
    short = ((a - c) ** 2).sum(axis=1) < ((b - d) ** 2).sum(axis=1)
    halves = [(0, 1, 2), (0, 2, 3)], [(0, 1, 3), (1, 2, 3)]
    triangles = [quads[mask][:, half] for mask, pair in zip((short, ~short), halves) for half in pair]
    normals = _gradient(distance, points, 1e-2 * step)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return points, np.concatenate(triangles).astype(np.int32), normals


def _values(distance: Callable[[np.ndarray], np.ndarray], grid: np.ndarray, step: float) -> np.ndarray:
    """Return the values at the points of a (X, Y, Z, 3) grid: exact where a block of them can be near the surface,
    of the right sign elsewhere."""
    # Blocks of four points a side are judged by one in their middle.
    shape, middles = grid.shape[:3], [np.minimum(np.arange(2, n + 4, 4), n - 1) for n in grid.shape[:3]]
    coarse = distance(grid[np.ix_(*middles)].reshape(-1, 3)).reshape([len(m) for m in middles])
    blocks = [np.arange(n) // 4 for n in shape]
    values = coarse[np.ix_(*blocks)]
    # Values change by at most 1.2 per unit: farther than 1.2 diagonals of a block its sign is certain.
    near = np.abs(values) < 1.2 * 4 * math.sqrt(3) * step
    values[near] = distance(grid[near])
    return values


def _gradient(distance: Callable[[np.ndarray], np.ndarray], points: np.ndarray, h: float) -> np.ndarray:
    steps = np.eye(3) * h
    return np.stack([(distance(points + e) - distance(points - e)) / (2 * h) for e in steps], axis=1)
