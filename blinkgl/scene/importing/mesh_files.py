"""Mesh files (obj, ply, stl through :mod:`blinkgl.scene.importing.trimesh_pieces`; glb, gltf through
:mod:`blinkgl.scene.importing.gltf`) as :class:`Asset` objects.

What a file claims is checked against limits before anything is allocated for it, and nothing outside the file's own
folder is read on its behalf.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from blinkgl.config.deform import AnimationConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.geometry.meshes import closed_together, concatenate, make_mesh, normalise
from blinkgl.scene.geometry.tangents import split_mirrored
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import clip_names, play, rest_pieces
from blinkgl.scene.omissions import Omissions
from blinkgl.scene.reading import MAX_BYTES, contents, reading
from blinkgl.scene.shapes.skin import Skin, joined
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.types import Material, Mesh, Part

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb", ".gltf")


@dataclass(frozen=True, eq=False)
class Asset:
    """A loaded object: its parts in object coordinates, z up.

    has_materials : the parts carry the file's own materials.   log : repairs made.
    omissions : what the file asks for and is not drawn, in one line (:mod:`blinkgl.scene.omissions`), or empty.
    clips : names of the animations that its file has.   replay : loads it again as it plays one; None: it has none.
    """

    name: str
    source_hash: str
    parts: tuple[Part, ...]
    has_materials: bool = False
    log: tuple[str, ...] = ()
    omissions: tuple[str, ...] = ()
    clips: tuple[str, ...] = ()
    replay: Callable[[AnimationConfig], Asset] | None = None

    def normalised(self) -> Asset:
        """Bounding box centred on the origin, bounding radius 1; of all that it sweeps, where it deforms."""
        meshes = normalise(tuple(p.mesh for p in self.parts), self.name)
        return replace(self, parts=tuple(Part(m, p.material) for m, p in zip(meshes, self.parts)))


def load_asset(
    path: Path,
    *,
    max_faces: int = 5_000_000,
    max_bytes: int = MAX_BYTES,
    keep_materials: bool = True,
    max_texture: int = 2048,
    source_hash: str | None = None,
    uv_size: float | None = None,
    up: str = "auto",
    animation: AnimationConfig | None = None,
    base: Path | str = ".",
    where: str = "animation",
) -> Asset:
    """One object from a file.

    animation : of a glTF file, which it plays; None: it is at rest.   base : folder that paths in it start from.
    where : its key of the
        configuration.

    up : the file's axis that points up and becomes z, "y" or "z"; "auto" is y for glb and gltf, whose standard says so,
        and z for the others, which say nothing.
    keep_materials : parts with the file's materials; else one part, white, with texture coordinates that can carry any
        texture (projected where the file has none or degenerate ones).
    uv_size : edge of one repeat of texture coordinates that are projected.
    Raises AssetError naming the file: missing, corrupt, NaN, no faces, more than ``max_faces`` triangles or
    ``max_bytes`` bytes, references outside its folder, an extension required that is not drawn.
    """
    with reading("mesh", str(path)):
        given = Path(path), max_faces, max_bytes, keep_materials, max_texture, source_hash, uv_size, up
        asset = _load(*given, animation, Path(base), where)
    again = partial(
        load_asset,
        path,
        max_faces=max_faces,
        max_bytes=max_bytes,
        keep_materials=keep_materials,
        max_texture=max_texture,
        source_hash=source_hash,
        uv_size=uv_size,
        up=up,
        base=base,
        where=where,
    )
    return replace(asset, replay=lambda clip: again(animation=clip)) if asset.clips else asset


def _load(
    path: Path,
    max_faces: int,
    max_bytes: int,
    keep_materials: bool,
    max_texture: int,
    source_hash: str | None,
    uv_size: float | None,
    up: str,
    animation: AnimationConfig | None,
    base: Path,
    key: str,
) -> Asset:
    where = str(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise AssetError("unknown kind of mesh file", where=where, value=suffix, accepted=" ".join(MESH_SUFFIXES))
    data = contents(path, "mesh", max_bytes=max_bytes)
    digest = source_hash or content_hash(data, *dependencies(path, data))
    log: list[str] = []
    if suffix in (".glb", ".gltf"):
        document = gltf.read(path, data, max_faces=max_faces, max_texture=max_texture, materials=keep_materials)
        log, omissions, clips = document.log, document.omissions, clip_names(document)
        played = None if animation is None else play(document, animation, base, key)
        nodes, at_rest, pieces = [], [], []
        for node in (i for i, n in document.nodes.items() if n.mesh is not None):
            if played is not None:
                own, world = document.mesh_pieces(document.nodes[node].mesh, changing=True), document.world(node)
            else:
                own, world = rest_pieces(document, node)
            for piece in own:
                nodes.append(node)
                at_rest.append(world)
                pieces.append(gltf.transformed(piece, world))
        if clips and played is None:
            omissions.add("animations (the rest pose is drawn)")
    else:
        if animation is not None:
            raise ConfigError(
                "only glTF files have animations", where=key, value=path.name, accepted="a gltf or glb file, or null"
            )
        # Here: trimesh takes as long to import as half of what else a worker needs, and most scenes have no such file.
        from blinkgl.scene.importing.trimesh_pieces import read_pieces

        clips, played = [], None
        omissions = Omissions(path.name)
        pieces = read_pieces(path, data, suffix[1:], max_faces, max_texture if keep_materials else None, omissions)
    if up == "y" or (up == "auto" and suffix in (".glb", ".gltf")):
        pieces, turn = [gltf.transformed(p, gltf.Z_UP) for p in pieces], gltf.Z_UP
    else:
        turn = np.eye(4)
    total = sum(len(p.faces) for p in pieces)
    if total > max_faces:
        raise AssetError("the mesh has too many faces", where=where, value=total, accepted=f"at most {max_faces}")
    has_materials = keep_materials and any(p.material is not None for p in pieces)
    parts = []
    for number, piece in enumerate(pieces):
        if len(piece.faces) == 0 and len(pieces) > 1:
            continue
        own = has_own_vertices(piece, has_materials)
        source: list[np.ndarray] | None = [] if played is not None or own else None
        # A palette picked by degenerate coordinates is fine with the file's own texture, useless with any other.
        own_texture = has_materials and piece.material is not None and piece.material.texture is not None
        mesh = make_mesh(
            piece.vertices,
            piece.faces,
            normals=piece.normals,
            uvs=piece.uvs,
            name=path.stem,
            source_hash=digest,
            where=where,
            uv_size=uv_size,
            project_degenerate=not own_texture,
            log=log,
            source=source,
        )
        if source is not None and own:
            mesh = with_own_vertices(mesh, piece, source)
        if played is not None and source is not None:
            deformer = played.deformer(nodes[number], piece, source[0], turn @ at_rest[number], turn)
            mesh = replace(mesh, deformer=deformer)
        material = piece.material if has_materials and piece.material is not None else Material()
        parts.append(Part(mesh, material))
    if not parts:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if not has_materials:
        meshes = tuple(p.mesh for p in parts)
        whole = joined_mesh(meshes, path.stem, digest)
        parts = [Part(mesh, Material()) for mesh in ((whole,) if whole is not None else meshes)]
    elif closed_together(tuple(p.mesh for p in parts)):
        parts = [Part(replace(p.mesh, closed=True), p.material) for p in parts]  # one solid, split by material
    said = tuple(dict.fromkeys(log)), omissions.lines()
    return Asset(path.stem, digest, tuple(parts), has_materials, *said, tuple(clips))


def has_own_vertices(piece: gltf.Piece, materials: bool = True) -> bool:
    """Whether a piece's vertices carry what :func:`make_mesh` knows nothing of. materials : whether it has its own."""
    bumped = piece.material is not None and piece.material.bumps is not None
    return materials and (piece.colours is not None or bumped)


def with_own_vertices(mesh: Mesh, piece: gltf.Piece, source: list[np.ndarray]) -> Mesh:
    """``mesh``, made of a piece, with the colours of its vertices, and split where a normal map meets its mirror image.
    source : which of the piece's vertices each of the mesh's is; replaced by that of the result."""
    if piece.colours is not None:
        mesh = replace(mesh, colours=piece.colours[source[0]].astype(np.float32))
    if piece.material is not None and piece.material.bumps is not None:
        mesh, index = split_mirrored(mesh)
        source[0] = source[0][index]
    return mesh


def joined_mesh(meshes: tuple[Mesh, ...], name: str, source_hash: str) -> Mesh | None:
    """One mesh of several; None where they change their shapes in ways that are not one."""
    whole = concatenate(meshes, name=name, source_hash=source_hash)
    changing = [mesh.deformer for mesh in meshes if mesh.deformer is not None]
    if not changing or len(meshes) == 1:
        return whole
    skins = [deformer for deformer in changing if isinstance(deformer, Skin)]
    one = joined(skins) if len(skins) == len(meshes) else None
    return None if one is None else replace(whole, deformer=one)


def dependencies(path: Path, data: bytes | None = None) -> list[bytes]:
    """Contents of the buffer files that a .gltf refers to (they are part of what it is); [] for other files."""
    if path.suffix.lower() != ".gltf":
        return []
    return gltf.buffer_contents(path, contents(path, "mesh") if data is None else data)
