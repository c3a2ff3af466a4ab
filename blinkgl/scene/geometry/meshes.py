"""Conversion of any triangles to a valid :class:`~blinkgl.scene.types.Mesh`: checked, cleaned, with normals and texture
coordinates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from blinkgl.errors import AssetError
from blinkgl.scene.geometry.polygons import face_cross
from blinkgl.scene.shapes.sweep import filled
from blinkgl.scene.types import Deformer, Mesh, Scene, SceneObject
from blinkgl.types.poses import pose_of

CREASE_DEGREES = 40.0
WELD_RELATIVE = 1e-6  # vertices nearer than this times the extent are one point
_MAX_REPEATS = 1e9  # of a texture: float32 has no fraction left, and overflows later
MAX_COORDINATE = 1e15  # squares of larger coordinates are inaccurate in float32 and overflow soon after


def make_mesh(
    vertices: np.ndarray,
    faces: np.ndarray,
    *,
    normals: np.ndarray | None = None,
    uvs: np.ndarray | None = None,
    name: str = "",
    where: str | None = None,
    uv_size: float | None = None,
    project_degenerate: bool = False,
    log: list[str] | None = None,
    source: list[np.ndarray] | None = None,
    crease_degrees: float = CREASE_DEGREES,
) -> Mesh:
    """Return a valid mesh from raw triangles.

    Parameters
    ----------
    vertices : (V, 3) any float, object-local.   faces : (F, 3) any int, counter-clockwise seen from outside.
    normals : (V, 3) or None: made from the faces, angle-weighted, split where faces meet at ``crease_degrees`` or
        more; 0: flat.
    uvs : (V, 2), v down, or None: box projection (:func:`box_project`).
    uv_size : edge of one repeat of projected texture coordinates, in the mesh's units; None: the largest side of the
        bounding box, so that the texture covers the mesh once.
    project_degenerate : also project when the given coordinates cannot carry a texture (:func:`uvs_degenerate`). They
        are kept otherwise, because palette textures use exactly such coordinates.
    log : gets a line for each repair.
    source : gets (W,) int64, the index of the given vertex of each of the mesh's: none of different origin are joined.

    Faces without area are dropped and unused vertices removed; no face is turned round. Raises :class:`AssetError`
    (``where`` or ``name`` in it) for NaN or infinite vertices, indices out of range, no faces.
    """
    where, label = where or name or "mesh", name or where or "mesh"
    log = [] if log is None else log
    vertices, faces, used = _checked(np.asarray(vertices, np.float64), np.asarray(faces), where)
    origin = np.flatnonzero(used)
    normals = None if normals is None or len(normals) != len(used) else _rows(np.asarray(normals, np.float64), used)
    uvs_given = uvs is not None
    uvs = None if uvs is None or np.shape(uvs) != (len(used), 2) else _rows(np.asarray(uvs, np.float64), used)

    faces = faces[_worth_drawing(vertices, faces, where, label, log)]
    if normals is not None and not _usable_normals(normals, vertices, faces):
        log.append(f"{label}: the normals are unusable, made new ones")
        normals = None
    if uvs_given and (wrong := _wrong_coordinates(vertices, faces, uvs, project_degenerate)):
        log.append(f"{label}: the texture coordinates are {wrong}, projected new ones")
        uvs = None

    corners = None if source is None else origin[faces]
    # Attributes of corners, (F, 3, …), which become vertices; without names here, so that each is freed as soon as it
    # can be.
    mesh, first = _from_corners(
        normals=crease_normals(vertices, faces, weld(vertices, faces)[1], crease_degrees)
        if normals is None
        else normals[faces],
        uvs=box_project(vertices, faces, uv_size) if uvs is None else uvs[faces],
        positions=vertices[faces],
        origin=corners,
        name=name,
    )
    if source is not None and corners is not None:
        source.append(corners.ravel()[first])
    return mesh


def _checked(vertices: np.ndarray, faces: np.ndarray, where: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return ((V', 3) vertices that faces use, (F, 3) int64 faces over them, (V,) bool which those are). Raises
    AssetError."""
    if vertices.ndim != 2 or vertices.shape[1] != 3 or (faces.size and (faces.ndim != 2 or faces.shape[1] != 3)):
        raise AssetError(f"vertices {vertices.shape} and faces {faces.shape} are no triangle mesh", where=where)
    if faces.size == 0:
        raise AssetError("the mesh has no faces", where=where, accepted="a mesh with triangles")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise AssetError(f"a face refers to a vertex outside 0..{len(vertices) - 1}", where=where)
    faces = faces.astype(np.int64)
    used = np.zeros(len(vertices), bool)
    used[faces] = True
    bad = used & ~(np.abs(vertices) < MAX_COORDINATE).all(axis=1)  # NaN compares false
    if bad.any():
        first = int(np.flatnonzero(bad)[0])
        raise AssetError(
            f"{int(bad.sum())} vertices are NaN, infinite or beyond {MAX_COORDINATE:g}, the first is {first}",
            where=where,
            value=vertices[first].tolist(),
            accepted="finite coordinates",
        )
    # The running count less 1 is the new number of each vertex that is used.
    return _rows(vertices, used), faces if used.all() else (np.cumsum(used) - 1)[faces], used


def _rows(array: np.ndarray, used: np.ndarray) -> np.ndarray:
    """Return the ``used`` rows of an array, without a copy where they are all of it."""
    return array if used.all() else array[used]


def _wrong_coordinates(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray | None, degenerate: bool) -> str:
    """Return what is wrong with texture coordinates, in a word; "" where they can be used. degenerate : counts as
    wrong, too."""
    if uvs is None or not (np.abs(uvs[faces]) < _MAX_REPEATS).all():  # NaN compares false
        return "broken"
    return "degenerate" if degenerate and uvs_degenerate(vertices, faces, uvs) else ""


def _worth_drawing(vertices: np.ndarray, faces: np.ndarray, where: str, label: str, log: list[str]) -> np.ndarray:
    """Return (F,) bool: faces with an area. Raises AssetError where there are none."""
    kept = faces_with_area(vertices, faces)
    if not kept.any():
        raise AssetError("the mesh has no faces with an area", where=where, accepted="a mesh with triangles")
    if (~kept).mean() > 0.1:  # a few slivers are in almost every file
        log.append(f"{label}: {int((~kept).sum())} of {len(faces)} faces without area dropped")
    return kept


def faces_with_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return (F,) bool. A sliver is compared with its own longest edge, so that small meshes are not dropped."""
    corners = vertices[faces]
    height, longest = _height_and_edge(corners)
    # A shorter edge is within the rounding of the coordinates.
    floor = 1e-14 * max(float(np.abs(corners).max()), 1e-300)
    return (height > 1e-10 * longest) & (longest > floor)


def _height_and_edge(corners: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ((F,) smallest height, (F,) longest edge) of (F, 3, 3) triangles."""
    edges = corners - np.roll(corners, 1, axis=1)
    longest = np.linalg.norm(edges, axis=2).max(axis=1)
    # Products of the smallest coordinates would underflow.
    edges = edges / np.where(longest > 0, longest, 1.0)[:, None, None]
    # Twice the area over the longest edge: the smallest height.
    return np.linalg.norm(np.cross(edges[:, 0], edges[:, 1]), axis=1) * longest, longest


def faces_in_float32(mesh: Mesh) -> np.ndarray:
    """Return (F,) bool: faces that still have a direction after a GPU has rounded the vertices to float32.

    Rounding moves a corner by up to half of 2^-23 times its largest coordinate in each axis, so corners on one line
    become a triangle up to sqrt(3) times 2^-23 high. A face at most twice that high counts as a line: its normal and
    the slopes of interpolated values are noise. NaN and overflow do not count: the renderer refuses such meshes."""
    with np.errstate(over="ignore", invalid="ignore"):
        corners = mesh.vertices.astype(np.float32)[mesh.faces].astype(np.float64)
        return ~(_height_and_edge(corners)[0] <= 2.0**-22 * np.abs(corners).max(axis=(1, 2)))


def without_collapsed_faces(scene: Scene) -> Scene:
    """Return the scene without the faces that are lines in float32 (:func:`faces_in_float32`), with a line in its log
    that counts them; the scene itself when there are none."""
    # By identity, so that parts that share a mesh share what is left of it.
    meshes = {id(part.mesh): part.mesh for obj in scene.objects for part in obj.parts}
    kept = {key: faces_in_float32(mesh) for key, mesh in meshes.items()}
    made = {
        key: mesh if kept[key].all() else replace(mesh, faces=mesh.faces[kept[key]]) for key, mesh in meshes.items()
    }
    dropped = sum(int((~kept[id(part.mesh)]).sum()) for obj in scene.objects for part in obj.parts)
    if not dropped:
        return scene

    def drawn(obj: SceneObject) -> SceneObject:
        if all(kept[id(part.mesh)].all() for part in obj.parts):
            return obj
        parts = (replace(part, mesh=made[id(part.mesh)]) for part in obj.parts if kept[id(part.mesh)].any())
        return replace(obj, parts=tuple(parts))

    log = (*scene.log, f"{dropped} triangles without width in float32 are not drawn")
    return replace(scene, objects=tuple(map(drawn, scene.objects)), log=log)


def _usable_normals(normals: np.ndarray, vertices: np.ndarray, faces: np.ndarray) -> bool:
    normals = np.asarray(normals, np.float64)
    if normals.shape != vertices.shape:
        return False
    length = np.linalg.norm(normals[faces], axis=2)
    # Directions of any length: those of a file in mm have the square of its scale. Shorter ones are rounding.
    return bool(np.isfinite(length).all() and (length > 1e-150).all())


def weld(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return ((P, 3) float64 points, (F, 3) int64 faces over them): coincident vertices become one point, because files
    split vertices at seams and between materials."""
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    step = max(float((high - low).max()) * WELD_RELATIVE, 1e-300)
    cells = np.round((vertices - low) / step).astype(np.int64)  # below 2**20 each: one int64 holds all three
    _, first, index = np.unique(
        (cells[:, 0] << 42) | (cells[:, 1] << 21) | cells[:, 2], return_index=True, return_inverse=True
    )
    return vertices[first], index.reshape(-1)[faces]


def _components(left: np.ndarray, right: np.ndarray, count: int) -> tuple[int, np.ndarray]:
    """Return (number of, (count,) label of) the connected components of ``count`` nodes joined by edges left-right."""
    return connected_components(
        coo_matrix((np.ones(len(left), np.int8), (left, right)), shape=(count, count)), directed=False
    )


def closedness(points: np.ndarray, welded: np.ndarray) -> bool:
    """Return whether a welded mesh is closed and wound outwards: every directed edge occurs as often as its reverse (an
    oriented surface without a boundary, which also allows solids that touch along an edge), around no negative
    volume."""
    # Faces that welding has collapsed to a line or a point do not count.
    alive = (welded[:, 0] != welded[:, 1]) & (welded[:, 1] != welded[:, 2]) & (welded[:, 2] != welded[:, 0])
    welded, count = welded[alive], len(points)
    start, end = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    # start * count + end is the number of a directed edge. The sorted lists agree where each has its reverse.
    if not len(welded) or not np.array_equal(np.sort(start * count + end), np.sort(end * count + start)):
        return False
    # The volume is the sum of signed tetrahedra from the middle of the points to each face.
    a, b, c = ((points - points.mean(axis=0))[welded[:, i]] for i in range(3))
    # A sheet of two coincident layers has no volume and counts as closed.
    noise = 1e-9 * float(np.linalg.norm(points.max(axis=0) - points.min(axis=0))) ** 3
    return bool(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6 >= -noise)


def corner_angles(corners: np.ndarray) -> np.ndarray:
    """Return the (F, 3) angles at the corners, (F, 3, 3), of triangles, rad."""
    angles = np.empty(corners.shape[:2])
    for k in range(3):  # one after the other: all at once take three times the memory
        to_next, to_previous = (corners[:, (k + step) % 3] - corners[:, k] for step in (1, 2))
        length = np.linalg.norm(np.cross(to_next, to_previous), axis=1)
        angles[:, k] = np.arctan2(length, (to_next * to_previous).sum(axis=1))
    return angles


def crease_normals(
    vertices: np.ndarray,
    faces: np.ndarray,
    welded: np.ndarray,
    crease_degrees: float = CREASE_DEGREES,
    groups: np.ndarray | None = None,
) -> np.ndarray:
    """Return (F, 3, 3) float64 unit corner normals: angle-weighted mean over the fan of faces around the corner's point
    that are joined by edges bent less than ``crease_degrees``; with (F,) ``groups`` instead by edges between two faces
    of one smoothing group, 0: of none."""
    unit = face_cross(vertices, faces)
    unit /= np.maximum(np.linalg.norm(unit, axis=1, keepdims=True), 1e-300)
    fan = _fans(welded, unit, crease_degrees, groups)
    angle = corner_angles(vertices[faces])
    # Sums over the corners of each fan, given back to every corner of it.
    weighted = ((unit[:, i, None] * angle).ravel() for i in range(3))
    total = np.stack([np.bincount(fan, weights=w, minlength=fan.max() + 1) for w in weighted], axis=1)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    total /= np.maximum(length, 1e-300)
    made = total[fan]
    flat = np.flatnonzero(~(length[fan, 0] > 1e-9))
    made[flat] = unit[flat // 3]
    return made.reshape(len(faces), 3, 3)


def _fans(welded: np.ndarray, unit: np.ndarray, crease_degrees: float, groups: np.ndarray | None) -> np.ndarray:
    """Return (3 F,) int32, the number of the fan that each corner belongs to; ``unit`` are the (F, 3) normals of faces,
    the other arguments those of :func:`crease_normals`."""
    # Pair up faces across each undirected edge; edge k of a face joins its corners k and k+1.
    a, b = welded.ravel(), np.roll(welded, -1, axis=1).ravel()
    edge = np.minimum(a, b) * (welded.max() + 1) + np.maximum(a, b)
    # The sort makes equal edges neighbours; of more than two at one edge each is paired with the next.
    order = np.argsort(edge, kind="stable")
    same = edge[order][1:] == edge[order][:-1]
    first, second = order[:-1][same], order[1:][same]  # edge numbers 3*face + k
    if groups is None:
        smooth = (unit[first // 3] * unit[second // 3]).sum(axis=1) > np.cos(np.radians(crease_degrees))
    else:
        smooth = (groups[first // 3] == groups[second // 3]) & (groups[first // 3] > 0)
    first, second = first[smooth], second[smooth]
    # The corner at the other end of each edge, in the edge's own face.
    f_next, s_next = first - first % 3 + (first % 3 + 1) % 3, second - second % 3 + (second % 3 + 1) % 3
    # The edge's two ends: joined corners are those at the same welded point (faces may be wound either way).
    direct = a[first] == a[second]
    left = np.concatenate([first, f_next])
    right = np.concatenate([np.where(direct, second, s_next), np.where(direct, s_next, second)])
    return _components(left, right, len(a))[1]


# Seen from outside, with z (for ±z: y) up: (axis, sign) -> the axis and sign that point right, the axis that points up.
_BOX_SIDES = {
    (0, 1): (1, 1, 2),
    (0, -1): (1, -1, 2),
    (1, 1): (0, -1, 2),
    (1, -1): (0, 1, 2),
    (2, 1): (0, 1, 1),
    (2, -1): (0, -1, 1),
}


def box_project(vertices: np.ndarray, faces: np.ndarray, uv_size: float | None = None) -> np.ndarray:
    """Return (F, 3, 2) float64 corner texture coordinates: each face is projected along the axis nearest to its normal,
    never mirrored, upright (z up). One repeat measures ``uv_size``; by default the largest side of the bounding box,
    then the coordinates lie in [0, 1]."""
    low, high = vertices[faces].min(axis=(0, 1)), vertices[faces].max(axis=(0, 1))
    size = float((high - low).max()) if uv_size is None else float(uv_size)
    centred = (vertices[faces] - (low + high) / 2) / max(size, 1e-300)
    normal = face_cross(vertices, faces)
    axis = np.abs(normal).argmax(axis=1)
    sign = np.where(np.take_along_axis(normal, axis[:, None], 1)[:, 0] < 0, -1, 1)
    uvs = np.empty((len(faces), 3, 2))
    for (side_axis, side_sign), (right, right_sign, up) in _BOX_SIDES.items():
        here = (axis == side_axis) & (sign == side_sign)
        uvs[here, :, 0] = 0.5 + right_sign * centred[here][:, :, right]
        # v runs down the texture.
        uvs[here, :, 1] = 0.5 - centred[here][:, :, up]
    return uvs


def uvs_degenerate(vertices: np.ndarray, faces: np.ndarray, uvs: np.ndarray) -> bool:
    """Return whether more than half of the surface has (next to) no area in the texture."""
    a, b, c = (uvs[faces[:, i]] for i in range(3))
    # Twice the area of each triangle in the texture.
    uv_area = np.abs((b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0]))
    area = np.linalg.norm(face_cross(vertices, faces), axis=1)
    return bool(area[uv_area < 1e-10].sum() > 0.5 * area.sum())


def _from_corners(
    positions: np.ndarray, normals: np.ndarray, uvs: np.ndarray, origin: np.ndarray | None = None, **fields
) -> tuple[Mesh, np.ndarray]:
    """Return a mesh in which corners with equal position, normal and coordinates (and of one origin, if given) are one
    vertex. Also (W,), the corner, of all one after the other, that each vertex was first."""
    positions = positions.reshape(-1, 3)
    normals = normals.reshape(-1, 3)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    uvs = uvs.reshape(-1, 2).astype(np.float32)
    # Adding 0.0 turns -0.0 into 0.0, which would otherwise split vertices. Normals are compared to 1e-5: float noise.
    columns = [
        *(positions + 0.0).view(np.int64).T,
        *np.round(normals * 1e5).astype(np.int32).T,
        *(uvs + 0.0).view(np.int32).T,
        *([] if origin is None else [origin.ravel()]),
    ]
    first, index = _equal_rows(columns)
    # Vertices in order of first use: good for the vertex cache, and independent of np.unique's sort order.
    order = np.argsort(first, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    first = first[order]
    mesh = Mesh(
        vertices=positions[first],
        faces=rank[index].reshape(-1, 3).astype(np.int32),
        normals=normals[first],
        uvs=uvs[first],
        **fields,
    )
    return mesh, first


def _equal_rows(columns: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Return ((k,) row in which each distinct row of whole-number ``columns``, (n,) each, comes first; (n,) which of
    those each row equals)."""
    mixed = np.zeros(len(columns[0]), np.uint64)
    for column in columns:
        # A multiply and a shift per column (Fibonacci hashing, 2^64 over the golden ratio) mix all bits of a row.
        mixed ^= column.astype(np.int64).view(np.uint64)
        mixed *= np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    _, first, index = np.unique(mixed, return_index=True, return_inverse=True)
    if not all((column == column[first][index]).all() for column in columns):  # two rows of one hash, in 1e-7 of meshes
        _, first, index = np.unique(np.stack(columns, axis=1), axis=0, return_index=True, return_inverse=True)
    return first, index.ravel()


def transform_mesh(mesh: Mesh, matrix: np.ndarray) -> Mesh:
    """Return the mesh under an affine (4, 4) or linear (3, 3) map; a reflection reverses the faces so that they face
    out."""
    matrix = np.asarray(matrix, np.float64)
    linear = matrix[:3, :3]
    vertices = mesh.vertices @ linear.T + (matrix[:3, 3] if matrix.shape[0] == 4 else 0.0)
    determinant = float(np.linalg.det(linear))
    if not np.isfinite(determinant) or determinant == 0.0:
        raise AssetError("a transform flattens the mesh (determinant 0)", where=mesh.name or "mesh")
    # n^T M^-1 is (M^-T n)^T: normals are transformed by the inverse transpose.
    normals = mesh.normals @ np.linalg.inv(linear)
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    faces = mesh.faces if determinant > 0 else np.ascontiguousarray(mesh.faces[:, ::-1])
    shift = matrix[:3, 3] if matrix.shape[0] == 4 else np.zeros(3)
    return replace(mesh, vertices=vertices, faces=faces, normals=normals, deformer=_transformed(mesh, linear, shift))


def _transformed(mesh: Mesh, linear: np.ndarray, shift: np.ndarray) -> Deformer | None:
    """Return the mesh's deformer under an affine map."""
    if mesh.deformer is None:
        return None
    return mesh.deformer.transformed(pose_of(shift, linear))


def scale_mesh(mesh: Mesh, scale: float) -> Mesh:
    """Return the mesh, ``scale`` times as large."""
    return replace(mesh, vertices=mesh.vertices * scale, deformer=_transformed(mesh, np.eye(3) * scale, np.zeros(3)))


def bounds(meshes: Sequence[Mesh]) -> tuple[np.ndarray, np.ndarray]:
    """Return the corners of the common bounding box, ((3,), (3,))."""
    return (
        np.min([m.vertices.min(axis=0) for m in meshes], axis=0),
        np.max([m.vertices.max(axis=0) for m in meshes], axis=0),
    )


def normalise(meshes: tuple[Mesh, ...], where: str = "mesh") -> tuple[Mesh, ...]:
    """Return the meshes of one object, moved so that the bounding box is centred on the origin and scaled to bounding
    radius 1. For a deforming mesh its whole region counts."""
    room = [(m.vertices, 0.0) if m.deformer is None else filled(m) for m in meshes]
    low = np.min([points.min(axis=0) - margin for points, margin in room], axis=0)
    high = np.max([points.max(axis=0) + margin for points, margin in room], axis=0)
    centre = (low + high) / 2
    radius = max(float(np.sqrt(((points - centre) ** 2).sum(axis=1).max())) + margin for points, margin in room)
    if not radius > 0:
        raise AssetError("the mesh has size zero", where=where)
    return tuple(
        replace(
            m, vertices=(m.vertices - centre) / radius, deformer=_transformed(m, np.eye(3) / radius, -centre / radius)
        )
        for m in meshes
    )


def quartered(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the edges, (E, 2), and the faces, (4 F, 3), of triangles that are split into four.

    The vertex in the middle of edge e is number ``count`` + e."""
    # Each undirected edge gets one new vertex, however many faces share it.
    pairs = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    edges, middle = np.unique(pairs, axis=0, return_inverse=True)
    a, b, c = faces.T
    ab, bc, ca = (middle.reshape(-1, 3) + count).T
    return edges, np.stack([a, ab, ca, ab, b, bc, ca, bc, c, ab, bc, ca], axis=1).reshape(-1, 3)


def subdivided(mesh: Mesh, edge: float, max_faces: int = 5_000) -> Mesh:
    """Return the same surface with smaller triangles: each is split into four until no edge is longer than ``edge``, or
    there would be more than ``max_faces``."""
    while True:
        corners = mesh.vertices[mesh.faces]
        longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max()
        if longest <= edge or 4 * len(mesh.faces) > max_faces:
            return mesh
        edges, faces = quartered(mesh.faces, len(mesh.vertices))
        halfway = lambda values, edges=edges: np.concatenate([values, values[edges].mean(axis=1, dtype=np.float64)])
        normals = halfway(mesh.normals.astype(np.float64))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
        # The normals of old vertices stay bitwise the same.
        normals[: len(mesh.vertices)] = mesh.normals
        mesh = replace(
            mesh,
            vertices=halfway(mesh.vertices),
            faces=faces.astype(np.int32),
            normals=normals.astype(np.float32),
            uvs=halfway(mesh.uvs).astype(np.float32),
            colours=None if mesh.colours is None else halfway(mesh.colours).astype(np.float32),
        )


def concatenate(meshes: tuple[Mesh, ...], *, name: str = "", source_hash: str = "") -> Mesh:
    """Return one mesh of several."""
    if len(meshes) == 1:
        return replace(meshes[0], name=name or meshes[0].name, source_hash=source_hash or meshes[0].source_hash)
    offsets = np.cumsum([0] + [len(m.vertices) for m in meshes[:-1]])
    return Mesh(
        vertices=np.concatenate([m.vertices for m in meshes]),
        faces=np.concatenate([m.faces + o for m, o in zip(meshes, offsets)]).astype(np.int32),
        normals=np.concatenate([m.normals for m in meshes]),
        uvs=np.concatenate([m.uvs for m in meshes]),
        closed=all(m.closed for m in meshes),
        name=name,
        source_hash=source_hash,
    )
