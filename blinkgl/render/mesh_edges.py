"""The edges of an object's meshes, made once: the faces that meet at each, and whether the light may jump there."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.machine.kernels import kernel

if TYPE_CHECKING:
    from blinkgl.scene.types import Mesh

CREASE = np.cos(np.radians(20.0))
"""Cosine of the angle between the normals of two faces above which the light may jump."""
WELD = 2e-3
"""As a fraction of an object's size: up to this distance the borders of two of its parts are joined. Files whose parts
were compressed separately (Draco) have such cracks."""
NEIGHBOURS = 8
"""Number of border places examined around one: at most this many parts meet in a corner."""
BENT, TORN = 1, 2
"""Kinds of edges between two faces that are both visible: creases; seams."""


class Contour:
    """The edges of one object. Vertices at the same place are joined, also those of two parts, so there is no border
    where parts meet.

    corners : (V,) int64 index of each place in the parts' vertices, one part after the other.
    rest : (V, 3) float64 of the undeformed shape.   faces : (F, 3) int32 places.
    edges : (E, 4) int32: two places in the order of the first face, the first face, the second or -1.
    sharp : (E,) int8: :data:`BENT` where its faces meet at an angle or are of two parts, else :data:`TORN` where they
    meet in space and not in the texture, else 0.   culled : (F,) bool: faces that are drawn only from one side.
    planes : (F, 4) float64 of the rest shape: normal, any length, and its product with a point of the face."""

    def __init__(self, parts: Sequence[tuple[Mesh, bool]]):
        """Find the edges. parts : meshes, and whether both sides of their faces are drawn."""
        self.meshes = [mesh for mesh, _ in parts]
        self.deforms = any(mesh.deformer is not None for mesh in self.meshes)
        vertices = np.concatenate([np.asarray(mesh.vertices, np.float64) for mesh in self.meshes])
        # + 0.0 makes -0.0 and 0.0 one place.
        _, self.corners, place = np.unique(vertices + 0.0, axis=0, return_index=True, return_inverse=True)
        firsts = np.cumsum([0, *(len(mesh.vertices) for mesh in self.meshes)])
        corner_of = [mesh.faces + first for mesh, first in zip(self.meshes, firsts[:-1], strict=True)]
        places = [place.reshape(-1)[c].reshape(-1, 3).astype(np.int32) for c in corner_of]
        self.faces = np.ascontiguousarray(np.concatenate(places))
        self.culled = np.concatenate([np.full(len(mesh.faces), not both, np.bool_) for mesh, both in parts])
        self.rest = np.ascontiguousarray(vertices[self.corners])
        self.planes = np.empty((len(self.faces), 4))
        write_planes(self.rest, self.faces, self.planes)
        counts = np.cumsum([0, *(len(faces) for faces in places)])
        each = [_edges(faces, len(self.corners)) for faces in places]
        if len(each) > 1:
            welded = _welded(self.rest, [np.unique(e[e[:, 3] < 0, :2]) for e in each])
            self.faces = welded[self.faces]
            each = [np.column_stack([welded[e[:, :2]], e[:, 2:]]) for e in each]
        edges = np.concatenate([np.where(e >= 0, e + (0, 0, n, n), -1) for e, n in zip(each, counts[:-1], strict=True)])
        self.edges = _joined(edges.astype(np.int32), len(self.corners))
        self.sharp = self._sharp(np.concatenate(corner_of), np.repeat(np.arange(len(places)), np.diff(counts)))

    def positions(self, t_ns: int) -> np.ndarray:
        """Return the places at a time, (V, 3) float64."""
        moved = [
            mesh.vertices if mesh.deformer is None else mesh.deformer.positions(mesh, t_ns) for mesh in self.meshes
        ]
        return np.concatenate(moved)[self.corners]

    def _sharp(self, corner_of: np.ndarray, part: np.ndarray) -> np.ndarray:
        """Return the kind of each edge, (E,) int8. Bent: its two faces have different normals at both of its ends; a
        bent surface with smoothed normals shows no step. Torn: different texture coordinates, other than by whole
        repeats of the texture.
        corner_of : (F, 3) vertices of the faces; part : (F,) their parts."""
        normals, uvs = (np.concatenate([getattr(m, name) for m in self.meshes]) for name in ("normals", "uvs"))
        first, second = self.edges[:, 2], self.edges[:, 3]
        bent, torn = second >= 0, second >= 0
        # Only edges with two faces can be either; both ends have to agree.
        for end in (0, 1):
            # The vertex of each face that is at this end of the edge.
            one, other = (
                corner_of[face, (self.faces[face] == self.edges[:, end, None]).argmax(axis=1)]
                for face in (first, second)
            )
            bent &= (normals[one] * normals[other]).sum(axis=1) < CREASE
            # Whole repeats of the texture are no seam.
            apart = uvs[one] - uvs[other]
            torn &= np.abs(apart - np.round(apart)).max(axis=1) > 1e-5
        bent |= (second >= 0) & (part[first] != part[second])  # parts have different materials
        return np.where(bent, BENT, np.where(torn, TORN, 0)).astype(np.int8)


def _edges(faces: np.ndarray, places: int) -> np.ndarray:
    """Return (E, 4) int32, see :class:`Contour`. Where more than two faces meet, the sides of those after the
    second are borders."""
    # Every face's three sides, as (from, to) in the face's order.
    count = len(faces)
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]).astype(np.int64)
    face = np.tile(np.arange(count), 3)
    # Sides of no length belong to degenerate triangles.
    there = ends[:, 0] != ends[:, 1]
    ends, face = ends[there], face[there]
    # One number per unordered pair of places: equal ones are the same edge.
    key = ends.min(axis=1) * places + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    key, ends, face = key[order], ends[order], face[order]
    first = np.flatnonzero(np.r_[True, key[1:] != key[:-1]]) if len(key) else np.zeros(0, np.int64)
    # Index among its edge's sides: 0 the first, 1 the second.
    rank = np.arange(len(key)) - np.repeat(first, np.diff(np.r_[first, len(key)]))
    # The second side of an edge is stored in the row of the first; every other side begins a row.
    lead = np.flatnonzero(rank != 1)
    second = np.full(len(lead), -1)
    paired = (rank[lead] == 0) & (lead + 1 < len(key))
    paired[paired] = key[lead[paired] + 1] == key[lead[paired]]
    second[paired] = face[lead[paired] + 1]
    return np.ascontiguousarray(np.column_stack([ends[lead], face[lead], second]), np.int32)


def _welded(places: np.ndarray, borders: Sequence[np.ndarray]) -> np.ndarray:
    """Return (V,) int32: for each place the one that replaces it. Places on the borders of two parts are joined where
    each is the other's nearest, up to :data:`WELD`. borders : places on each part's borders."""
    # Objects of one part do not need SciPy.
    from scipy.sparse import csr_array
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import KDTree

    result = np.arange(len(places), dtype=np.int32)
    at, part = np.concatenate(borders), np.repeat(np.arange(len(borders)), [len(border) for border in borders])
    if not len(at):
        return result
    reach = WELD * float(np.ptp(places, axis=0).max())
    # One search for all parts; among the few nearest, the nearest of each other part.
    off, near = KDTree(places[at]).query(places[at], k=min(NEIGHBOURS, len(at)), distance_upper_bound=reach)
    off, near = off.reshape(len(at), -1), near.reshape(len(at), -1)
    mine, column = np.nonzero(np.isfinite(off))
    other, off = near[mine, column], off[mine, column]
    apart = part[mine] != part[other]
    mine, other, off = mine[apart], other[apart], off[apart]
    order = np.lexsort((off, part[other], mine))
    mine, other = mine[order], other[order]
    nearest = np.r_[True, (np.diff(mine) != 0) | (np.diff(part[other]) != 0)][: len(mine)]
    mine, other = mine[nearest], other[nearest]
    # A pair as one number, so that its reverse can be looked up: only mutual nearest neighbours are joined.
    back = np.isin(other.astype(np.int64) * len(at) + mine, mine.astype(np.int64) * len(at) + other)
    ends = at[mine[back]], at[other[back]]
    # Where three parts meet, pairs form chains; one place replaces all of a chain, so that no crack is left.
    pairs = csr_array((np.ones(len(ends[0]), np.bool_), ends), shape=(len(places), len(places)))
    _, chain = connected_components(pairs, directed=False)
    np.minimum.at(first := np.full(chain.max() + 1, len(places), np.int32), chain, result)
    return first[chain]


def _joined(edges: np.ndarray, places: int) -> np.ndarray:
    """Return (E, 4) int32 in which two borders that run in opposite directions between the same places are one edge."""
    border = np.flatnonzero(edges[:, 3] < 0)
    ends = edges[border, :2].astype(np.int64)
    # Both directions between two places have one key.
    key = ends.min(axis=1) * places + ends.max(axis=1)
    order = np.argsort(key, kind="stable")
    border, ends, key = border[order], ends[order], key[order]
    # Only for exactly two; more are surfaces that lie on each other.
    begins = np.r_[True, key[1:] != key[:-1]] if len(key) else np.zeros(0, np.bool_)
    alone = np.diff(np.r_[np.flatnonzero(begins), len(key)]) == 2
    first = np.flatnonzero(begins)[alone]
    # Neighbouring faces of one orientation run along their common side in opposite directions.
    first = first[ends[first, 0] == ends[first + 1, 1]]
    edges[border[first], 3] = edges[border[first + 1], 2]
    return np.ascontiguousarray(np.delete(edges, border[first + 1], axis=0))


@kernel
def write_planes(places: np.ndarray, faces: np.ndarray, out: np.ndarray) -> None:
    """Write (F, 4) float64, see :class:`Contour`."""
    # Normal by the cross product of two sides, of twice the triangle's area; its product with a corner.
    for f in range(len(faces)):
        a, b, c = places[faces[f, 0]], places[faces[f, 1]], places[faces[f, 2]]
        ux, uy, uz = b[0] - a[0], b[1] - a[1], b[2] - a[2]
        vx, vy, vz = c[0] - a[0], c[1] - a[1], c[2] - a[2]
        x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
        out[f, 0], out[f, 1], out[f, 2] = x, y, z
        out[f, 3] = x * a[0] + y * a[1] + z * a[2]
