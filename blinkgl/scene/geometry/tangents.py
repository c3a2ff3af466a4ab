"""Tangents: the direction of a texture on a surface, which a normal map's x and y need.

They come from the texture coordinates alone, not from a file's tangents: at a vertex the mean over its triangles of
dp/du, weighted by angle, made perpendicular to the normal when it is used. y is upwards in the image, against v.
"""

from __future__ import annotations

from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np

from blinkgl.scene.geometry.meshes import corner_angles
from blinkgl.scene.types import Mesh

_kept: WeakKeyDictionary[Mesh, np.ndarray] = WeakKeyDictionary()


def tangents(mesh: Mesh) -> np.ndarray:
    """Return (V, 4) float32 unit tangents, object axes, of the mesh at rest, and 1 or -1: with n and t the bitangent is
    this times n x t. Where the coordinates are degenerate, any direction in the surface. Stored with the mesh."""
    if mesh not in _kept:
        _kept[mesh] = _tangents(mesh)
    return _kept[mesh]


def _of_faces(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Return (F, 3) dp/du, of any length, and the (F,) area in (u, -v), below 0 where the image is mirrored."""
    p, uv = mesh.vertices[mesh.faces], mesh.uvs[mesh.faces].astype(np.float64)
    # dp/du from p = p0 + u dp/du + v dp/dv at the triangle's two sides.
    e1, e2 = p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]
    (u1, v1), (u2, v2) = (uv[:, 1] - uv[:, 0]).T, (uv[:, 2] - uv[:, 0]).T
    # v points downwards.
    area = u2 * v1 - u1 * v2
    # e2 v1 - e1 v2 is dp/du times the signed area.
    return (e2 * v1[:, None] - e1 * v2[:, None]) * np.sign(area)[:, None], area


def _tangents(mesh: Mesh) -> np.ndarray:
    along, area = _of_faces(mesh)
    n = mesh.normals.astype(np.float64)
    angles = corner_angles(mesh.vertices[mesh.faces])
    sums, sign = np.zeros((len(n), 3)), np.zeros(len(n))
    # Weighted by the angle at the corner, as normals are.
    for at, angle in zip(mesh.faces.T, angles.T):
        flat = along - n[at] * (along * n[at]).sum(axis=1, keepdims=True)
        length = np.linalg.norm(flat, axis=1, keepdims=True)
        unit = np.divide(flat, length, out=np.zeros_like(flat), where=length > 0)
        np.add.at(sums, at, unit * angle[:, None])
        # Where plain and mirrored faces meet, the wider angle decides.
        np.add.at(sign, at, np.sign(area) * angle)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    # The axis farthest from the normal, made perpendicular: any direction will do.
    aside = np.eye(3)[np.abs(n).argmin(axis=1)]
    aside -= n * (aside * n).sum(axis=1, keepdims=True)
    known = length > 1e-6
    unit = np.where(known, sums / np.where(known, length, 1.0), aside / np.linalg.norm(aside, axis=1, keepdims=True))
    return np.column_stack([unit, np.where(sign < 0, -1.0, 1.0)]).astype(np.float32)


def split_mirrored(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """Return the mesh with two vertices in place of each at which an image meets its mirror image, where tangents would
    cancel, and (W,) int64, the index of the given vertex of each. The mesh must not have a deformer."""
    _, area = _of_faces(mesh)
    mirrored, n = area < 0, len(mesh.vertices)
    # Vertices that faces of both kinds use are copied for the mirrored ones.
    plain, other = (np.zeros(n, bool) for _ in range(2))
    plain[mesh.faces[~mirrored]] = True
    other[mesh.faces[mirrored]] = True
    both = np.flatnonzero(plain & other)
    index = np.concatenate([np.arange(n), both])
    if not len(both):
        return mesh, index
    number = np.arange(n)
    number[both] = n + np.arange(len(both))
    faces = mesh.faces.copy()
    faces[mirrored] = number[faces[mirrored]]
    colours = None if mesh.colours is None else mesh.colours[index]
    made = replace(mesh, vertices=mesh.vertices[index], faces=faces, normals=mesh.normals[index], uvs=mesh.uvs[index])
    return replace(made, colours=colours), index
