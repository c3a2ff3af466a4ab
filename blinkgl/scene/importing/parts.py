"""Conversion of a file's raw meshes to the parts of an object."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from blinkgl.scene.geometry.meshes import CREASE_DEGREES, make_mesh
from blinkgl.scene.geometry.tangents import split_mirrored
from blinkgl.scene.reading import RECENT
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.types import Deformer, Material, Mesh, Part

# ---------------------------------------------------------------------------------------------------------------------
# Triangles as stored in a file, before they are checked and become a :class:`~blinkgl.scene.types.Mesh`.

# The material of a surface of which nothing is drawn: fully transparent, or cut off everywhere.
INVISIBLE = Material()
WHOLE = "the whole file: all of it is hidden, transparent or without area"
# Columns: the file's x, y, z axes in a z-up world.
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, -1.0, 0], [0, 1.0, 0, 0], [0, 0, 0, 1.0]])


@dataclass(frozen=True, eq=False)
class RawMesh:
    """Raw triangles. normals, uvs (v down) and material may be None.

    binding : (V, k) joints of the node's skin and (V, k) weights; None: no skin.
    targets : morph targets, (n, V, 3) positions, likewise normals or None; None: none.
    colours : (V, 3) linear factors on the albedo; None: none.
    both_sides : whether its file draws its faces from both sides; a file that does not say so does.
    flat : whether faces without normals are flat; otherwise they are smooth where they meet at a small angle."""

    vertices: np.ndarray
    faces: np.ndarray
    normals: np.ndarray | None = None
    uvs: np.ndarray | None = None
    material: Material | None = None
    binding: tuple[np.ndarray, np.ndarray] | None = None
    targets: tuple[np.ndarray, np.ndarray | None] | None = None
    colours: np.ndarray | None = None
    both_sides: bool = True
    flat: bool = False


def tinted(material: Material | None, colours: np.ndarray) -> tuple[Material, np.ndarray | None]:
    """Return (the material, (V, 3) linear factors on it); one colour on all vertices becomes part of the material, with
    None for the factors."""
    material = material or Material()
    if len(colours) and not (colours == colours[0]).all():
        return material, colours
    r, g, b = (float(c) for c in (colours[0] * material.base_color if len(colours) else material.base_color))
    return replace(material, base_color=(r, g, b)), None


def transformed(raw: RawMesh, matrix: np.ndarray) -> RawMesh:
    """Return the triangles under an affine (4, 4) map; a reflection reverses the faces so that they face out."""
    linear = matrix[:3, :3]
    determinant = float(np.linalg.det(linear))
    vertices = raw.vertices @ linear.T + matrix[:3, 3]
    # Cofactors instead of the inverse: also valid for a singular map.
    cofactors = np.stack(
        [np.cross(linear[1], linear[2]), np.cross(linear[2], linear[0]), np.cross(linear[0], linear[1])]
    )
    normals = None if raw.normals is None else raw.normals @ cofactors.T * (1.0 if determinant >= 0 else -1.0)
    return replace(raw, vertices=vertices, normals=normals, faces=raw.faces if determinant >= 0 else raw.faces[:, ::-1])


# Returns the deformer of the mesh made from a raw one; (W,) index of the raw vertex of each of the mesh's.
DeformerOf = Callable[[RawMesh, np.ndarray], "Deformer | None"]


def part_of(
    raw: RawMesh,
    *,
    name: str,
    where: str,
    source_hash: str,
    log: list[str],
    materials: bool = True,
    uv_size: float | None = None,
    deformer: DeformerOf | None = None,
) -> Part:
    """Return a checked mesh of a raw one, with its material; the other arguments are those of
    :func:`~blinkgl.scene.geometry.meshes.make_mesh`.

    materials : whether it has its own; False: a white one, for any texture. Raises AssetError."""
    material = raw.material if materials and raw.material is not None else Material()
    material = replace(material, both_sides=raw.both_sides)
    colours = raw.colours if materials else None
    bumped = material.bumps is not None
    # Only per-vertex data of the file needs the indices of the mesh's vertices.
    indexed = deformer is not None or colours is not None or bumped
    options: dict[str, Any] = {
        "name": name,
        "where": where,
        "uv_size": uv_size,
        # Degenerate coordinates that select from a palette work with the file's own texture, but with no other.
        "project_degenerate": material.texture is None,
        "crease_degrees": 0.0 if raw.flat else CREASE_DEGREES,
    }

    def make() -> tuple[Mesh, np.ndarray | None, list[str]]:
        lines: list[str] = []
        origin: list[np.ndarray] | None = [] if indexed else None
        mesh = make_mesh(raw.vertices, raw.faces, normals=raw.normals, uvs=raw.uvs, log=lines, source=origin, **options)
        return mesh, origin[0] if origin else None, lines

    arrays = (np.zeros(0) if a is None else a for a in (raw.vertices, raw.faces, raw.normals, raw.uvs))
    key = content_hash(*(np.ascontiguousarray(a).data for a in arrays)), indexed, *options.values()
    mesh, index, lines = RECENT.get(key, make, lambda made: 2 * made[0].vertices.nbytes)
    log += lines
    mesh = replace(mesh, source_hash=source_hash)
    if index is None:
        return Part(mesh, material)
    if colours is not None:
        mesh = replace(mesh, colours=colours[index].astype(np.float32))
    if bumped:
        mesh, kept = split_mirrored(mesh)
        index = index[kept]
    return Part(mesh if deformer is None else replace(mesh, deformer=deformer(raw, index)), material)
