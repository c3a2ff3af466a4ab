"""Mesh files (obj, ply, stl through trimesh; glb, gltf through :mod:`blinkgl.scene.gltf`) as :class:`Asset` objects.

What a file claims is checked against limits before anything is allocated for it, and nothing outside the file's own
folder is read on its behalf.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import trimesh

from blinkgl.errors import AssetError
from blinkgl.scene import gltf
from blinkgl.scene.images import IMAGE_SUFFIXES, content_hash, decode_image
from blinkgl.scene.meshes import closed_together, concatenate, make_mesh, normalise
from blinkgl.scene.types import Material, Part, Texture

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb", ".gltf")
MAX_BYTES = 2_000_000_000
logging.getLogger("trimesh").setLevel(logging.CRITICAL)     # its warnings say nothing a user could act on


@dataclass(frozen=True, eq=False)
class Asset:
    """A loaded object: its parts in object coordinates, z up.

    has_materials : the parts carry the file's own materials.   log : repairs made.
    """

    name: str
    source_hash: str
    parts: tuple[Part, ...]
    has_materials: bool = False
    log: tuple[str, ...] = ()

    def normalised(self) -> Asset:
        """Bounding box centred on the origin, bounding radius 1."""
        meshes = normalise(tuple(p.mesh for p in self.parts), self.name)
        return replace(self, parts=tuple(Part(m, p.material) for m, p in zip(meshes, self.parts)))


def load_asset(path: Path, *, max_faces: int = 5_000_000, max_bytes: int = MAX_BYTES, keep_materials: bool = True, max_texture: int = 2048,
               source_hash: str | None = None, project_uvs: bool = False, uv_size: float | None = None) -> Asset:
    """One object from a file.

    keep_materials : parts with the file's materials; else one part, white, with texture coordinates that can carry any
        texture (projected where the file has none or degenerate ones).
    project_uvs : replace the file's texture coordinates; ``uv_size`` is the edge of one repeat.
    Raises AssetError naming the file: missing, corrupt, NaN, no faces, more than ``max_faces`` triangles or ``max_bytes``
    bytes, references outside its folder.
    """
    path, where = Path(path), str(path)
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise AssetError("unknown kind of mesh file", where=where, value=suffix, accepted=" ".join(MESH_SUFFIXES))
    try:
        size = path.stat().st_size
        if size > max_bytes:
            raise AssetError("the mesh file is too large", where=where, value=f"{size / 1e6:.0f} MB",
                             accepted=f"at most {max_bytes / 1e6:.0f} MB")
        data = path.read_bytes()
    except OSError as error:
        raise AssetError(f"cannot read the mesh: {error.strerror or error}", where=where) from None
    digest = source_hash or content_hash(data, *dependencies(path, data))
    log: list[str] = []
    if suffix in (".glb", ".gltf"):
        document = gltf.read(path, data, max_faces=max_faces, max_texture=max_texture, textures=keep_materials)
        pieces, log = document.pieces(), document.log
    else:
        pieces = _trimesh_pieces(path, data, suffix[1:], max_faces, max_texture if keep_materials else None, log)
    total = sum(len(p.faces) for p in pieces)
    if total > max_faces:
        raise AssetError("the mesh has too many faces", where=where, value=total, accepted=f"at most {max_faces}")
    has_materials = keep_materials and any(p.material is not None for p in pieces)
    parts = []
    for number, piece in enumerate(pieces):
        if len(piece.faces) == 0 and len(pieces) > 1:
            continue
        # A palette picked by degenerate coordinates is fine with the file's own texture, useless with any other.
        own_texture = has_materials and piece.material is not None and piece.material.texture is not None
        mesh = make_mesh(piece.vertices, piece.faces, normals=piece.normals, uvs=None if project_uvs else piece.uvs, name=path.stem,
                         source_hash=digest, where=where, uv_size=uv_size, project_degenerate=not own_texture, log=log)
        material = piece.material if has_materials and piece.material is not None else Material()
        parts.append(Part(mesh, material))
    if not parts:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if not has_materials:
        parts = [Part(concatenate(tuple(p.mesh for p in parts), name=path.stem, source_hash=digest), Material())]
    elif closed_together(tuple(p.mesh for p in parts)):
        parts = [Part(replace(p.mesh, closed=True), p.material) for p in parts]     # one solid, split by material
    return Asset(path.stem, digest, tuple(parts), has_materials, tuple(dict.fromkeys(log)))


def dependencies(path: Path, data: bytes | None = None) -> list[bytes]:
    """Contents of the buffer files that a .gltf refers to (they are part of what it is); [] for other files."""
    if path.suffix.lower() != ".gltf":
        return []
    return gltf.buffer_contents(path, path.read_bytes() if data is None else data)


def _trimesh_pieces(path: Path, data: bytes, kind: str, max_faces: int, max_texture: int | None, log: list[str]) -> list[gltf.Piece]:
    where = str(path)
    {"stl": _check_stl, "ply": _check_ply, "obj": _check_obj}[kind](data, max_faces, where)
    resolver = FolderResolver(path.parent, where)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, resolver=resolver, process=False, maintain_order=True,
                                        skip_materials=max_texture is None)
    except AssetError:
        raise
    except MemoryError:
        raise AssetError("the mesh does not fit into memory", where=where) from None
    except Exception as error:      # parsers of broken files raise anything
        raise AssetError(f"the mesh is corrupt ({type(error).__name__}: {' '.join(str(error).split())[:80]})", where=where) from None
    if max_texture is not None:
        if resolver.refused is not None:
            raise resolver.refused
        log += [f"{path.name}: '{name}' is missing, done without it" for name in dict.fromkeys(resolver.missing)]
    pieces = [piece_of_trimesh(g, max_texture=max_texture, where=where, file_normals=True)
              for g in loaded.geometry.values() if isinstance(g, trimesh.Trimesh)]
    if not pieces:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    return pieces


def piece_of_trimesh(mesh: trimesh.Trimesh, *, max_texture: int | None, where: str, file_normals: bool) -> gltf.Piece:
    """Raw triangles and material of a ``trimesh.Trimesh``. ``file_normals`` uses normals that came with the mesh;
    trimesh's own smooth ones would round off a cuboid."""
    normals = mesh._cache.cache.get("vertex_normals") if file_normals else None
    uvs = getattr(mesh.visual, "uv", None)
    if uvs is not None and len(uvs) == len(mesh.vertices):
        uvs = np.asarray(uvs, np.float64)[:, :2] * [1, -1] + [0, 1]      # trimesh has v upwards
    else:
        uvs = None
    return gltf.Piece(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), normals, uvs,
                      None if max_texture is None else _material(mesh.visual, max_texture, where))


def _material(visual, max_texture: int, where: str) -> Material | None:
    material = getattr(visual, "material", None)
    if material is None:
        if getattr(visual, "kind", None) == "face" or getattr(visual, "kind", None) == "vertex":
            colour = np.asarray(visual.main_color, float)[:3] / 255
            return Material(base_color=gltf.to_linear(colour))
        return None
    image = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if isinstance(material, trimesh.visual.material.SimpleMaterial):
        image = material.image
        diffuse = material.diffuse
        # An untouched default is no material; a texture is not darkened by the usual grey diffuse default.
        if image is None and material.name is None and np.array_equal(diffuse[:3], trimesh.visual.color.DEFAULT_COLOR[:3]):
            return None
        colour = (1.0, 1.0, 1.0) if image is not None else gltf.to_linear(np.asarray(diffuse, float)[:3] / 255)
    else:
        factor = np.ones(3) if factor is None else np.asarray(factor)[:3]
        colour = tuple(float(c) for c in (factor / 255 if factor.dtype.kind in "iu" else factor))     # glTF factors are linear
    texture = None
    if image is not None:
        stream = io.BytesIO()
        image.convert("RGB").save(stream, "PNG")
        texture = Texture(decode_image(stream.getvalue(), max_texture, where), "texture", content_hash(stream.getvalue()))
    return Material(texture=texture, base_color=colour, double_sided=bool(getattr(material, "doubleSided", False)))


class FolderResolver(trimesh.resolvers.Resolver):
    """Reads material and image files beside a mesh; refuses what leads out of its folder."""

    def __init__(self, folder: Path, where: str):
        self.folder, self.where, self.refused, self.missing = Path(folder), where, None, []

    def get(self, name: str) -> bytes:
        try:
            return gltf.inside(self.folder, name, self.where).read_bytes()
        except AssetError as error:         # trimesh swallows it; load_asset raises or logs it
            if "missing" in error.problem:
                self.missing.append(str(name))
            else:
                self.refused = self.refused or error
            raise

    def write(self, name, data):
        raise AssetError("a mesh loader wanted to write", where=self.where, value=name)

    def namespaced(self, namespace):
        return FolderResolver(gltf.inside(self.folder, namespace, self.where), self.where)

    def keys(self):
        return [p.name for p in self.folder.iterdir() if p.suffix.lower() in (".mtl", *IMAGE_SUFFIXES)]


def _check_stl(data: bytes, max_faces: int, where: str) -> None:
    if len(data) >= 84:
        claimed = int(np.frombuffer(data[80:84], "<u4")[0])
        # Binary when the size fits; ASCII begins with 'solid' (some binary files do too, hence the size first).
        if not data.lstrip()[:5].lower() == b"solid" or len(data) == 84 + 50 * claimed:
            if claimed > max_faces:
                raise AssetError("the mesh has too many faces", where=where, value=claimed, accepted=f"at most {max_faces}")
            if len(data) < 84 + 50 * claimed:
                raise AssetError(f"the mesh is truncated: {claimed} faces need {84 + 50 * claimed} bytes", where=where, value=len(data))
            return
    _limit(data.count(b"facet normal"), max_faces, where)


def _check_ply(data: bytes, max_faces: int, where: str) -> None:
    end = data[: 1 << 16].find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise AssetError("the mesh is corrupt (no PLY header)", where=where)
    for name, count in re.findall(rb"element\s+(\w+)\s+(\d+)", data[:end]):
        what = "faces" if name == b"face" else f"{name.decode(errors='replace')} elements"
        if int(count) > (max_faces if name == b"face" else 3 * max_faces + 1_000_000):
            raise AssetError(f"the mesh has too many {what}", where=where, value=int(count), accepted=f"at most {max_faces} faces")
        if int(count) > len(data) - end:       # an element takes a byte at least
            raise AssetError(f"the mesh is truncated: {int(count)} {what} in {len(data)} bytes", where=where)


def _check_obj(data: bytes, max_faces: int, where: str) -> None:
    _limit(data.count(b"\nf ") + data.startswith(b"f "), max_faces, where)


def _limit(faces: int, max_faces: int, where: str) -> None:
    if faces > max_faces:
        raise AssetError("the mesh has too many faces", where=where, value=faces, accepted=f"at most {max_faces}")
