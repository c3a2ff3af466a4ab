"""Where vertices are, and what faces say by their corners."""

import numpy as np


def points_at(obj, t_ns: int = 0) -> np.ndarray:
    """(V, 3) of all parts, world."""
    T = obj.path.pose(t_ns)
    at = [p.mesh.vertices if p.mesh.deformer is None else p.mesh.deformer.positions(p.mesh, t_ns) for p in obj.parts]
    return np.concatenate(at) @ T[:3, :3].T + T[:3, 3]


def vectors(vertices, faces) -> np.ndarray:
    """(F, 3) outward vectors of twice the area."""
    a, b, c = np.moveaxis(np.asarray(vertices)[faces], 1, 0)
    return np.cross(b - a, c - a)


def outwards(vertices, faces) -> np.ndarray:
    """(F,) six times the volume over the origin: above 0 for faces that look away from it."""
    return (vectors(vertices, faces) * np.asarray(vertices)[faces].mean(axis=1)).sum(axis=1)


def area(mesh) -> float:
    return float(np.linalg.norm(vectors(mesh.vertices, mesh.faces), axis=1).sum() / 2)


def volume(mesh) -> float:
    return float(outwards(mesh.vertices, mesh.faces).sum() / 6)


def uv_turns(mesh) -> np.ndarray:
    """(F,) twice the area in the texture, below 0 where u x (-v) points outwards: v grows downwards."""
    a, b, c = np.moveaxis(mesh.uvs[mesh.faces].astype(float), 1, 0)
    return (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
