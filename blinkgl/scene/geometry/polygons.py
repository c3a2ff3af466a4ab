"""Triangles of polygons: convex ones by a fan, all others by ear clipping."""

from __future__ import annotations

import numpy as np


def triangulate(points: np.ndarray, places: np.ndarray, sizes: np.ndarray) -> tuple[np.ndarray, np.ndarray, int]:
    """Return ((T, 3) numbers of corners, (T,) the polygon of each triangle, the number of corners left out).

    points : (V, 3).   places : (C,) index in ``points`` of all corners, polygon after polygon.   sizes : (P,) corners
    of each polygon. A corner at the place of the one before it is left out. Triangles have their polygon's winding."""
    polygon = np.repeat(np.arange(len(sizes)), sizes)
    starts = np.cumsum(sizes) - sizes
    before = np.arange(len(places)) - 1
    before[starts[sizes > 0]] += sizes[sizes > 0]  # the first corner follows the last one
    corners = np.flatnonzero(places != places[before])
    sizes = np.bincount(polygon[corners], minlength=len(sizes))
    starts = np.cumsum(sizes) - sizes
    triangles, owners = [np.empty((0, 3), np.int64)], [np.empty(0, np.int64)]
    for size in np.unique(sizes[sizes > 2]).tolist():
        chosen = np.flatnonzero(sizes == size)
        rows = corners[starts[chosen][:, None] + np.arange(size)]
        made, fits = _fans(points[places[rows]], rows)
        if size == 4 and not fits.all():
            # A concave quadrilateral is split at its other diagonal.
            turned = np.roll(rows, -1, axis=1)
            other, better = _fans(points[places[turned]], turned)
            better &= ~fits
            made[better], fits = other[better], fits | better
        triangles.append(made[fits].reshape(-1, 3))
        owners.append(np.repeat(chosen[fits], size - 2))
        for row, owner in zip(rows[~fits], chosen[~fits].tolist(), strict=True):
            clipped = row[_ears(points[places[row]])]
            triangles.append(clipped)
            owners.append(np.full(len(clipped), owner))
    ears, owner = np.concatenate(triangles), np.concatenate(owners)
    order = np.argsort(owner, kind="stable")  # as in the file
    return ears[order], owner[order], len(places) - len(corners)


def _fans(points: np.ndarray, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ((P, n - 2, 3) triangles around the first corners, (P,) bool: they all face the polygon's way) of polygons
    (P, n, 3) ``points`` with the corners (P, n) ``rows``."""
    arms = points[:, 1:] - points[:, :1]
    cross = np.cross(arms[:, :-1], arms[:, 1:])
    whole = cross.sum(axis=1)  # twice the area, along the normal (Newell)
    along = np.einsum("pnk,pk->pn", cross, whole)
    # A little below 0 is allowed, because corners on a straight line give rounding errors of either sign.
    fits = (along >= -1e-9 * (whole**2).sum(axis=1, keepdims=True)).all(axis=1)
    # A triangle needs no choice, and coordinates that are no numbers are refused later.
    fits |= (rows.shape[1] == 3) | ~np.isfinite(whole).all(axis=1)
    first = np.broadcast_to(rows[:, :1], (len(rows), rows.shape[1] - 2))
    return np.stack([first, rows[:, 1:-1], rows[:, 2:]], axis=2), fits


def face_cross(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (F, 3) vectors of twice the area of (F, 3) faces, outwards as they are wound."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    return np.cross(b - a, c - a)


def _ears(points: np.ndarray) -> np.ndarray:
    """Return (T, 3) indices of the triangles of one polygon, (n, 3), seen along the axis that is nearest its normal."""
    import mapbox_earcut

    flat = points - points[0]
    normal = np.cross(flat[1:-1], flat[2:]).sum(axis=0)
    axis = int(np.abs(normal).argmax())
    seen = np.delete(flat, axis, axis=1) / (np.abs(flat).max() or 1.0)
    ears = mapbox_earcut.triangulate_float64(seen, np.array([len(seen)], np.uint32)).reshape(-1, 3).astype(np.int64)
    # Triangles have the winding that is seen along the axis, which may be opposite to the polygon's.
    behind = (face_cross(flat, ears) @ normal) < 0
    ears[behind] = ears[behind, ::-1]
    return ears
