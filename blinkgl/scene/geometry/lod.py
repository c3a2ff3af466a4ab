"""Level of detail: meshes with fewer triangles where the camera never comes near enough to show the difference.

A level is chosen once per mesh, object and sequence, from the nearest that the object comes while it is in view. It
never changes within a sequence, so it cannot make events; frames and ground truth are
drawn from the same scene and agree.

Level k has about 2^(-k/2) of the triangles. It is made by quadric edge collapse (fast-simplification) of the mesh as it
is drawn: vertices that differ in normal or texture coordinates are different vertices there, so seams and creases are
open borders, and borders are not touched. No crack can open and no texture can bleed over a seam. What a level got
wrong is measured, and a level that would be wrong by more than ``error_px`` in the image is not used.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, replace

import fast_simplification
import numpy as np

from blinkgl.config.lod import LodConfig
from blinkgl.scene.geometry.nearest import incident_faces, walk_to_nearest
from blinkgl.scene.types import Mesh, Part, Scene, SceneObject

TIMES = 129
"""Poses looked at in a sequence. Something nearer for a moment in between is drawn a
little too coarse, but steadily so."""
MIN_FACES = 128
_CACHE_BYTES = 256_000_000
_cache: OrderedDict[tuple[str, int], Level] = OrderedDict()


@dataclass(frozen=True, eq=False)
class Level:
    """A decimated mesh in a frame in which the original has bounding radius 1 and its box's centre at 0.

    vertices (V, 3) float64, faces (F, 3) int32, normals (V, 3) float32, uvs (V, 2) float32.
    origin : (V,) int64, the original vertex that this one is, unmoved; -1: a new one.
    error  : how far the level lies from the original, bounding radii: the larger of the largest
    distance from a vertex of either to the
             surface of the other, and the root mean square distance on the surface by which the
             texture is off at the original's vertices."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray
    uvs: np.ndarray
    origin: np.ndarray
    error: float

    @property
    def nbytes(self) -> int:
        return sum(a.nbytes for a in (self.vertices, self.faces, self.normals, self.uvs, self.origin))


def at_level_of_detail(scene: Scene, config: LodConfig) -> Scene:
    """The scene with meshes no finer than it needs, and a line in its log; the scene itself
    when ``config.enabled`` is false."""
    if not config.enabled:
        return scene
    objects, before, after = [], 0, 0
    for obj in scene.objects:
        parts = tuple(
            replace(part, mesh=_fitting(part.mesh, largest_scale(scene, obj, part), config)) for part in obj.parts
        )
        before += sum(len(part.mesh.faces) for part in obj.parts)
        after += sum(len(part.mesh.faces) for part in parts)
        objects.append(replace(obj, parts=parts))
    return replace(scene, objects=tuple(objects), log=(*scene.log, f"level of detail: {after} of {before} triangles"))


def largest_scale(scene: Scene, obj: SceneObject, part: Part) -> float:
    """Pixels in the image per unit of the part's surface, at most, while its bounding sphere is in view: a displacement
    d of any direction at depth Z moves the image by at most f d / Z sqrt(1 + tan²) (pin-hole), with the tangent of the
    angle to the optical axis. inf when the camera is as near as the near plane, 0 when the part never is in view."""
    times = np.linspace(scene.t0_ns, scene.t1_ns, TIMES).astype(np.int64)
    T_world_cam, T_world_obj = scene.camera_path.poses(times), obj.path.poses(times)
    centre, radius = bounding_sphere(part.mesh)
    world = T_world_obj[:, :3, :3] @ centre + T_world_obj[:, :3, 3]
    seen = np.einsum("nji,nj->ni", T_world_cam[:, :3, :3], world - T_world_cam[:, :3, 3])
    return float(scene.camera.pixels_per_unit(seen, radius).max())


def bounding_sphere(mesh: Mesh) -> tuple[np.ndarray, float]:
    """((3,) centre of the bounding box, radius about it), mesh frame."""
    centre = (mesh.vertices.min(axis=0) + mesh.vertices.max(axis=0)) / 2
    return centre, float(np.sqrt(((mesh.vertices - centre) ** 2).sum(axis=1).max()))


def _fitting(mesh: Mesh, scale: float, config: LodConfig) -> Mesh:
    """The coarsest level whose edges are at most ``edge_px`` (in the mean) and which is wrong
    by at most ``error_px``. A mesh that deforms stays as it is: a level is measured on one shape, and has no
    weights; so does one whose vertices have colours, which a level would smear."""
    if (
        mesh.deformer is not None
        or mesh.colours is not None
        or not 0 < scale < np.inf
        or len(mesh.faces) < 2 * MIN_FACES
    ):
        return mesh
    centre, radius = bounding_sphere(mesh)
    k = int(2 * np.log2(len(mesh.faces) / max(faces_of_edge(mesh, config.edge_px / scale), MIN_FACES)))
    level, fits, tried = None, 0, k
    while tried > fits:  # bisection: coarser levels are more wrong
        candidate = level_of(mesh, tried)
        if candidate.error * radius * scale <= config.error_px and len(candidate.faces) < len(mesh.faces):
            level, fits = candidate, tried
        else:
            k = tried - 1
        tried = (fits + k + 1) // 2
    if level is None:
        return mesh
    vertices = level.vertices * radius + centre
    kept = level.origin >= 0
    vertices[kept] = mesh.vertices[level.origin[kept]]  # exactly, or a crack would open towards the neighbouring part
    return replace(mesh, vertices=vertices, faces=level.faces, normals=level.normals, uvs=level.uvs)


def faces_of_edge(mesh: Mesh, edge: float) -> float:
    """Equilateral triangles of this edge that the surface would take."""
    return area(mesh.vertices[mesh.faces]).sum() / (np.sqrt(3) / 4 * edge**2)


def area(corners: np.ndarray) -> np.ndarray:
    """(F,) of (F, 3, 2 or 3) corners."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    squared = (a * a).sum(1) * (b * b).sum(1) - (a * b).sum(1) ** 2
    return 0.5 * np.sqrt(np.maximum(squared, 0.0))


def level_of(mesh: Mesh, k: int) -> Level:
    """Level k >= 1, from the process's cache of levels by content. Two meshes that differ in place and size only share
    it: their vertices are rounded to 1e-9 radii first, so that the level does not depend on
    which of them came first."""
    centre, radius = bounding_sphere(mesh)
    unit = np.round((mesh.vertices - centre) / radius, 9) + 0.0
    digest = hashlib.blake2b(digest_size=16)
    for array in (unit, mesh.faces, mesh.normals, mesh.uvs):
        digest.update(np.ascontiguousarray(array).tobytes())
    key = (digest.hexdigest(), k)
    if key not in _cache:
        _cache[key] = _decimated(replace(mesh, vertices=unit), int(len(mesh.faces) * 0.5 ** (k / 2)))
        while sum(level.nbytes for level in _cache.values()) > _CACHE_BYTES and len(_cache) > 1:
            _cache.popitem(last=False)
    _cache.move_to_end(key)
    return _cache[key]


def _decimated(mesh: Mesh, faces: int) -> Level:
    used = np.unique(mesh.faces)  # what no face uses has no surface to be far from
    renumbered = np.zeros(len(mesh.vertices), np.int32)
    renumbered[used] = np.arange(len(used))
    old, triangles = mesh.vertices[used], renumbered[mesh.faces]
    old_normals, old_uvs = mesh.normals[used], mesh.uvs[used].astype(np.float64)
    # agg: how fast the bound on the error of one collapse is raised; with the default of 7 levels came out twice as
    # wrong as with 4.
    new, new_faces, collapses = fast_simplification.simplify(
        old, triangles, target_count=max(faces, 1), agg=4.0, preserve_border=True, return_collapses=True
    )
    # The replay finds (V,) which new vertex each old one went into. Its own points are float32.
    became = np.asarray(fast_simplification.replay_simplification(old, triangles, collapses)[2], np.int64)
    new, new_faces = np.asarray(new, np.float64), np.asarray(new_faces, np.int32)
    old_at, new_at = incident_faces(triangles, len(old)), incident_faces(new_faces, len(new))

    # New vertices take their attributes from the nearest point of the old surface, sought from a vertex that went into
    # them: they stay on its side of every seam.
    went_in = np.zeros(len(new), np.int64)
    went_in[became] = np.arange(len(old))
    away, face, weights = walk_to_nearest(new, old_at[1][old_at[0][went_in]], old, triangles, *old_at)
    mixed = lambda values: (weights[:, :, None] * values[triangles[face]]).sum(axis=1)
    normals = mixed(old_normals.astype(np.float64))
    normals = (normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)).astype(np.float32)
    uvs = mixed(old_uvs).astype(np.float32)
    # An unmoved vertex keeps its own attributes bit by bit.
    origin = np.full(len(new), -1, np.int64)
    same = np.flatnonzero((new[became] == old).all(axis=1))
    origin[became[same]] = used[same]
    kept = origin >= 0
    normals[kept], uvs[kept] = mesh.normals[origin[kept]], mesh.uvs[origin[kept]]

    # The other way round: how far each old vertex is from the new surface, and from its texture there.
    back, face, weights = walk_to_nearest(old, new_at[1][new_at[0][became]], new, new_faces, *new_at)
    shift = np.linalg.norm(
        (weights[:, :, None] * uvs[new_faces[face]].astype(np.float64)).sum(axis=1) - old_uvs, axis=1
    )
    texture = area(uvs[new_faces].astype(np.float64))
    units_per_uv = np.sqrt(np.where(texture > 1e-14, area(new[new_faces]) / np.maximum(texture, 1e-14), 0.0))
    sheared = float(np.sqrt(np.mean((shift * units_per_uv[face]) ** 2)))
    return Level(new, new_faces, normals, uvs, origin, max(float(away.max()), float(back.max()), sheared))
