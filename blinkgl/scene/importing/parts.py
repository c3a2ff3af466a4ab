"""From raw meshes of a file to the parts of an object."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np

from blinkgl.scene.geometry.meshes import closed_together, make_mesh
from blinkgl.scene.geometry.tangents import split_mirrored
from blinkgl.scene.importing.raw_mesh import RawMesh
from blinkgl.scene.shapes.deformer import Deformer
from blinkgl.scene.types import Material, Part

DeformerOf = Callable[[RawMesh, np.ndarray], "Deformer | None"]
"""The deformer of the mesh that is made of a raw one; (W,) which of its vertices each of the mesh's is."""


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
    """A checked mesh of a raw one, with its material; the other arguments are those of
    :func:`~blinkgl.scene.geometry.meshes.make_mesh`.

    materials : whether it has its own; False: a white one, that any texture may replace. Raises AssetError."""
    material = raw.material if materials and raw.material is not None else Material()
    colours = raw.colours if materials else None
    bumped = material.bumps is not None
    # Only what counts the file's vertices has to know which of them the mesh's are.
    source: list[np.ndarray] | None = [] if deformer is not None or colours is not None or bumped else None
    mesh = make_mesh(
        raw.vertices,
        raw.faces,
        normals=raw.normals,
        uvs=raw.uvs,
        name=name,
        source_hash=source_hash,
        where=where,
        uv_size=uv_size,
        # A palette picked by degenerate coordinates is fine with the file's own texture, useless with any other.
        project_degenerate=material.texture is None,
        log=log,
        source=source,
    )
    if source is None:
        return Part(mesh, material)
    index = source[0]
    if colours is not None:
        mesh = replace(mesh, colours=colours[index].astype(np.float32))
    if bumped:
        mesh, kept = split_mirrored(mesh)
        index = index[kept]
    return Part(mesh if deformer is None else replace(mesh, deformer=deformer(raw, index)), material)


def closed_parts(parts: Iterable[Part]) -> tuple[Part, ...]:
    """The parts, each closed where they are so together: one solid, split by material."""
    parts = tuple(parts)
    if not closed_together(tuple(part.mesh for part in parts)):
        return parts
    return tuple(Part(replace(part.mesh, closed=True), part.material) for part in parts)
