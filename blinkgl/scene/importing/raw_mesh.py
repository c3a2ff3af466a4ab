"""Triangles as a file has them, before they are checked and become a :class:`~blinkgl.scene.types.Mesh`."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from blinkgl.scene.types import Material

# Columns: the file's x, y, z axes in a z-up world.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Raw triangles. normals, uvs (v down) and material may be None.

    binding : (V, k) joints of the node's skin and (V, k) weights; None: it has no skin.
    targets : morph targets, (n, V, 3) positions, likewise normals or None; None: it has none.
    colours : (V, 3) linear factors on the albedo; None: it has none."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material: Material | None = None
    binding: tuple[np.ndarray, np.ndarray] | None = None
    targets: tuple[np.ndarray, np.ndarray | None] | None = None
    colours: np.ndarray | None = None


def transformed(raw: RawMesh, matrix: np.ndarray) -> RawMesh:
    """The triangles under an affine (4, 4) map; a mirroring one turns the faces round, so that they keep facing out."""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    vertices = raw.vertices @ linear.T + matrix[:3, 3]
    # Cofactors instead of the inverse: also right for a map that flattens the mesh.
    cofactors = np.stack(
        [np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])]
    )
    normals = None if raw.normals is None else raw.normals @ cofactors.T * (1.0 if determinant >= 0 else -1.0)
    return replace(raw, vertices=vertices, normals=normals, faces=raw.faces if determinant >= 0 else raw.faces[:, ::-1])
