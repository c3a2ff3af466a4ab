"""Nearest points of a triangle mesh, found by walking over it from a triangle that is known to be near."""

from __future__ import annotations

import numba
import numpy as np

_JIT = dict(cache=True, nogil=True)


def incident_faces(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(first (count + 1,), face (3F,)) int64: the faces at vertex v are ``face[first[v]:first[v + 1]]``."""
    order = np.argsort(faces.ravel(), kind="stable")
    return np.concatenate([[0], np.cumsum(np.bincount(faces.ravel(), minlength=count))]).astype(np.int64), order // 3


@numba.njit(**_JIT)
def walk_to_nearest(
    points: np.ndarray,
    start: np.ndarray,
    vertices: np.ndarray,
    faces: np.ndarray,
    first: np.ndarray,
    face_at: np.ndarray,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(distance (n,), face (n,), weights (n, 3)) of the nearest point of the mesh to each point (n, 3): from face
    ``start`` (n,) to the nearest of the faces that share a vertex with it, as long as one is nearer. A local minimum,
    never on a part of the mesh that is not connected with the start: on the far side of a
    texture seam, say. Weights are barycentric."""
    n = len(points)
    distance, found, weights = np.empty(n), np.empty(n, np.int64), np.empty((n, 3))
    trial = np.empty(3)
    for i in range(n):
        best_face = start[i]
        best = _to_triangle(points[i], vertices, faces[best_face], weights[i])
        here = -1
        while here != best_face:
            here = best_face
            for corner in range(3):
                v = faces[here, corner]
                for k in range(first[v], first[v + 1]):
                    f = face_at[k]
                    if f != here:
                        squared = _to_triangle(points[i], vertices, faces[f], trial)
                        if squared < best:
                            best, best_face = squared, f
                            weights[i] = trial
        distance[i], found[i] = np.sqrt(best), best_face
    return distance, found, weights


@numba.njit(**_JIT)
def _to_triangle(p, vertices, face, weights):
    """Squared distance of ``p`` to a triangle; fills the weights of its nearest point: the foot of the perpendicular
    when that is inside, else the nearest of the feet on the edges."""
    uu = uv = vv = uw = vw = ww = 0.0
    for k in range(3):
        a = vertices[face[0], k]
        u, v, w = vertices[face[1], k] - a, vertices[face[2], k] - a, p[k] - a
        uu, uv, vv, uw, vw, ww = uu + u * u, uv + u * v, vv + v * v, uw + u * w, vw + v * w, ww + w * w
    determinant = uu * vv - uv * uv
    if determinant > 1e-20 * uu * vv:
        s, t = (vv * uw - uv * vw) / determinant, (uu * vw - uv * uw) / determinant
        if s >= 0 and t >= 0 and s + t <= 1:
            weights[0], weights[1], weights[2] = 1 - s - t, s, t
            return max(ww - s * uw - t * vw, 0.0)
    best = np.inf
    for k in range(3):
        i, j = face[k], face[(k + 1) % 3]
        along = length = 0.0
        for c in range(3):
            edge = vertices[j, c] - vertices[i, c]
            along += (p[c] - vertices[i, c]) * edge
            length += edge * edge
        along = min(max(along / length, 0.0), 1.0) if length > 0 else 0.0
        squared = 0.0
        for c in range(3):
            squared += (vertices[i, c] + along * (vertices[j, c] - vertices[i, c]) - p[c]) ** 2
        if squared < best:
            best = squared
            weights[k], weights[(k + 1) % 3], weights[(k + 2) % 3] = 1 - along, along, 0.0
    return best
