"""Mesh files (obj, ply, each by a reader of its own; stl, off, 3mf by :mod:`blinkgl.scene.importing.trimesh_files`;
glb, gltf by :mod:`blinkgl.scene.importing.gltf`) as :class:`Asset` objects.

Sizes that a file declares are checked against limits before memory is allocated, and only files below a border are
read (:mod:`blinkgl.scene.importing.neighbours`).
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from blinkgl.config.deform import AnimationConfig
from blinkgl.errors import AssetError
from blinkgl.scene.geometry.meshes import concatenate, normalise
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import Animation, clip_names, play as play_clip, shown
from blinkgl.scene.importing.gltf_file import files_of_gltf, parse
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.obj import files_of_obj, read_obj
from blinkgl.scene.importing.parts import WHOLE, Z_UP, DeformerOf, RawMesh, part_of, transformed
from blinkgl.scene.importing.ply import checked_ply, files_of_ply, read_ply
from blinkgl.scene.reading import MAX_BYTES, RECENT, Omissions, contents, limit_faces, reading
from blinkgl.scene.shapes.skin import Skin, joined
from blinkgl.scene.surfaces.images import content_hash
from blinkgl.scene.types import Material, Mesh, Part

ClipOf = Callable[[gltf.Document], Animation]


@dataclass(frozen=True, eq=False)
class Asset:
    """A loaded object: its parts in object coordinates, z up.

    has_materials : the parts have the file's own materials.   log : repairs made.
    omissions : undrawn features of the file, in one line (:mod:`blinkgl.scene.reading`), or empty.
    clips : names of the file's animations.   replay : loads it again playing one; None: it has none.
    """

    name: str
    source_hash: str
    parts: tuple[Part, ...]
    has_materials: bool = False
    log: tuple[str, ...] = ()
    omissions: tuple[str, ...] = ()
    clips: tuple[str, ...] = ()
    replay: Callable[[AnimationConfig], Asset] | None = None

    @property
    def has_looks(self) -> bool:
        """Return whether its file chose its looks: textures, light of its own, colours of vertices, or anything but one
        plain grey, which exporters write where no one chose."""
        worn = [part.material for part in self.parts]
        pictured = any(m.texture is not None or m.bumps is not None or any(m.emission) for m in worn)
        own = pictured or any(part.mesh.colours is not None for part in self.parts)
        return self.has_materials and (own or len({c for m in worn for c in m.base_color}) > 1)

    def normalised(self) -> Asset:
        """Return it with the bounding box centred on the origin and bounding radius 1; a deforming one by its whole
        region. Raises AssetError where nothing of it is visible."""
        if not self.parts:
            raise AssetError("nothing of the file is visible", where=self.name, accepted="a mesh with visible faces")
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
    play: ClipOf | None = None,
    border: Path | None = None,
) -> Asset:
    """Return one object from a file.

    border : folder that the files which it names must lie below; None: its own.

    play : for a glTF file, returns the clip that it plays (:func:`clip_of`); None: it is at rest.
    up : the file's upward axis, which becomes z, "y" or "z"; "auto" is y for glb and gltf, by their standard, and z for
        the others, which do not define it.
    keep_materials : parts with the file's materials; else one part, white, with texture coordinates that can carry any
        texture (projected where the file has none or degenerate ones).
    uv_size : edge of one repeat of projected texture coordinates.
    Raises AssetError naming the file: missing, corrupt, NaN, no faces, more than ``max_faces`` triangles or
    ``max_bytes`` bytes, buffers beyond the border, a required extension that is not supported; ConfigError:
    ``play`` does not find its clip.
    """
    path = Path(path)
    options = {"max_faces": max_faces, "keep_materials": keep_materials, "max_texture": max_texture}
    options |= {"uv_size": uv_size, "up": up, "border": border}
    with reading("mesh", str(path)):
        data = contents(path, "mesh", max_bytes=max_bytes)
        digest = source_hash or identity_of(path, data, border, keep_materials).whole
        make = partial(_asset, path, data, digest, play, **options)
        # A pool keeps its own, and clips differ.
        remembered = source_hash is None and play is None
        asset = RECENT.get((path, digest, *options.values()), make, bytes_of) if remembered else make()
    again = partial(load_asset, path, **options, max_bytes=max_bytes, source_hash=source_hash)
    return replace(asset, replay=lambda config: again(play=clip_of(config))) if asset.clips else asset


def _asset(
    path: Path,
    data: bytes,
    digest: str,
    play: ClipOf | None,
    *,
    max_faces: int,
    keep_materials: bool,
    max_texture: int,
    uv_size: float | None,
    up: str,
    border: Path | None,
) -> Asset:
    """Return the asset of a file with the content ``data``; the arguments are those of :func:`load_asset`."""
    near = Neighbours(path, border, Omissions(path.name))
    content = _found(data, near, max_faces, keep_materials, max_texture, up, play)
    limit_faces(sum(len(raw.faces) for raw in content.raws), max_faces, str(path))
    has_materials = keep_materials and any(raw.material is not None for raw in content.raws)
    common = {"name": path.stem, "where": str(path), "source_hash": digest, "log": content.log}
    parts = tuple(
        part_of(raw, **common, materials=has_materials, uv_size=uv_size, deformer=deformer)
        for raw, deformer in zip(content.raws, content.deformers, strict=True)
        if len(raw.faces) or len(content.raws) == 1
    )
    if not parts:
        content.omissions.add(WHOLE)
    parts = parts if has_materials else _white(parts, path.stem, digest)
    lines = tuple(dict.fromkeys(content.log)), content.omissions.lines()
    return Asset(path.stem, digest, parts, has_materials, *lines, tuple(content.clips))


def clip_of(config: AnimationConfig, base: Path | str = ".", where: str = "animation") -> ClipOf:
    """Return a function from a document to the clip of ``config``. base : folder that a path in it starts from.
    where : its key of the configuration."""
    return partial(play_clip, config=config, base=Path(base), where=where)


class _Found(NamedTuple):
    """The meshes of a file. raws : in its own world, z up.   deformers : one for each, None: it is rigid."""

    raws: list[RawMesh]
    deformers: list[DeformerOf | None]
    log: list[str]
    omissions: Omissions
    clips: list[str]


def _found(data: bytes, near: Neighbours, max_faces: int, materials: bool, max_texture: int, up, play) -> _Found:
    """Return the meshes of the file."""
    suffix = near.path.suffix.lower()
    if suffix not in _KINDS:
        accepted = " ".join(MESH_SUFFIXES)
        raise AssetError("unknown kind of mesh file", where=str(near.path), value=suffix, accepted=accepted)
    is_gltf = suffix in (".glb", ".gltf")
    # Only glTF's standard says which axis is up.
    turn = Z_UP if up == "y" or (up == "auto" and is_gltf) else None
    if is_gltf:
        limits = {"max_faces": max_faces, "max_texture": max_texture}
        return _of_document(gltf.read(near.path, data, **limits, materials=materials, border=near.border), play, turn)
    if play is not None:
        accepted = "a gltf or glb file, or no animation"
        raise AssetError("only glTF files have animations", where=str(near.path), accepted=accepted)
    raws = (_KINDS[suffix].read or _by_trimesh("read_meshes"))(
        data, near, max_faces, max_texture if materials else None
    )
    raws = raws if turn is None else [transformed(raw, turn) for raw in raws]
    return _Found(raws, [None] * len(raws), near.log, near.omissions, [])


def _by_trimesh(name: str) -> Callable[..., Any]:
    """Return a function of the module that imports trimesh, which takes half as long as everything else that a worker
    needs, and which most scenes do not use."""
    return getattr(import_module("blinkgl.scene.importing.trimesh_files"), name)


def border_of(path: Path, base: Path) -> Path:
    """Return the folder that the files of a recipe's mesh lie below: the recipe's, or the mesh's own outside of it."""
    return base if path.resolve().is_relative_to(base.resolve()) else path.parent


class Identity(NamedTuple):
    """What decides how an asset looks. files : hash of each file beside the mesh that is read for it, by its name from
    the mesh's folder; "missing" where none is there.   shape : one hash of the mesh and its buffers.   whole : of
    all."""

    files: dict[str, str]
    shape: str
    whole: str


def identity_of(path: Path, data: bytes, border: Path | None = None, materials: bool = True) -> Identity:
    """Return the identity of a file with the content ``data``: of a mesh's buffers, and with ``materials`` of its MTL
    files and images, too. Raises AssetError: a file that cannot be read, a buffer that is missing or beyond the
    border."""
    near, kind = Neighbours(path, border), _KINDS.get(path.suffix.lower())
    shape, files, looks = [data], {}, {}
    for name, file in files_of_gltf(data, near, "buffers") if path.suffix.lower() == ".gltf" else ():
        assert file is not None
        shape.append(contents(file, "buffer"))
        files[name] = content_hash(shape[-1])
    for name, file in kind.beside(data, near) if kind and materials else ():
        key = name if file is None else Path(os.path.relpath(file, path.parent)).as_posix()
        # An image that several materials wear is read once.
        looks[key] = "missing" if file is None else looks.get(key) or content_hash(contents(file, "file"))
    rows = [f"{name} {digest}".encode() for name, digest in looks.items()]
    return Identity(files | looks, content_hash(*shape), content_hash(*shape, *rows))


def check_header(path: Path, data: bytes, max_faces: int) -> None:
    """Raise AssetError for a mesh file that its first lines, or what they say about its size, show to be unusable."""
    with reading("mesh", str(path)):
        _KINDS[path.suffix.lower()].check(data, max_faces, str(path))


def _check_obj(data: bytes, max_faces: int, where: str) -> None:
    if re.search(rb"(?:^|[\r\n])[ \t]*fo?[ \t]", data) is None:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")


class _Kind(NamedTuple):
    """A kind of file. check : raises AssetError for a broken header.   beside : names and files of its look.   read :
    returns its meshes; None: by another way."""

    check: Callable[[bytes, int, str], Any]
    beside: Callable[[bytes, Neighbours], Iterable[tuple[str, Path | None]]] = lambda data, near: ()
    read: Callable[..., list[RawMesh]] | None = None


_GLTF = _Kind(lambda data, max_faces, where: parse(data, where), partial(files_of_gltf, key="images"))
_KINDS = {".obj": _Kind(_check_obj, files_of_obj, read_obj), ".ply": _Kind(checked_ply, files_of_ply, read_ply)}
_KINDS |= dict.fromkeys(
    (".stl", ".off", ".3mf"),
    _Kind(lambda *given: _by_trimesh("check_kind")(*given)),  # noqa: PLW0108 - imports it when it is called
) | dict.fromkeys((".glb", ".gltf"), _GLTF)
MESH_SUFFIXES = tuple(_KINDS)


def _of_document(document: gltf.Document, play: ClipOf | None, turn: np.ndarray | None) -> _Found:
    """Return the meshes of a document. turn : (4, 4) from the file's world to the object's axes; None: they are the
    same."""
    clips, played = clip_names(document), None if play is None else play(document)
    if clips and played is None:
        document.omissions.add("animations (the rest pose is drawn)")
    content = _Found([], [], document.log, document.omissions, clips)
    if not any(node.mesh is not None for node in document.nodes.values()):
        raise AssetError("the file has no faces", where=document.where, accepted="a mesh with triangles")
    for node in document.nodes:
        raws, world = shown(document, node, played) or ([], np.eye(4))
        for raw in raws:
            placed = transformed(raw, world)
            content.raws.append(placed if turn is None else transformed(placed, turn))
            axes = np.eye(4) if turn is None else turn
            deformer = None if played is None else partial(played.deformer, node, at_rest=axes @ world, turn=axes)
            content.deformers.append(deformer)
    return content


def _white(parts: tuple[Part, ...], name: str, digest: str) -> tuple[Part, ...]:
    """Return white parts: one for each kind of sides, unless their deformations cannot be joined."""
    made: list[Part] = []
    for both in dict.fromkeys(part.material.both_sides for part in parts):
        meshes = tuple(part.mesh for part in parts if part.material.both_sides == both)
        whole = joined_mesh(meshes, name, digest)
        made += [Part(mesh, Material(both_sides=both)) for mesh in ((whole,) if whole is not None else meshes)]
    return tuple(made)


def joined_mesh(meshes: tuple[Mesh, ...], name: str, source_hash: str) -> Mesh | None:
    """Return one mesh of several; None where their deformations cannot be joined."""
    whole = concatenate(meshes, name=name, source_hash=source_hash)
    changing = [mesh.deformer for mesh in meshes if mesh.deformer is not None]
    if not changing or len(meshes) == 1:
        return whole
    skins = [deformer for deformer in changing if isinstance(deformer, Skin)]
    one = joined(skins) if len(skins) == len(meshes) else None
    return None if one is None else replace(whole, deformer=one)


def sides_of(material: Material, wanted: bool | None) -> bool | None:
    """Return whether both sides of a part are drawn: what the file says (None: it says nothing), unless ``wanted`` says
    otherwise."""
    return material.both_sides if material.both_sides is None or wanted is None else wanted


def bytes_of(asset: Asset) -> int:
    """Return the bytes of an asset's meshes and textures."""
    meshes = [part.mesh for part in asset.parts]
    own = sum(a.nbytes for m in meshes for a in (m.vertices, m.faces, m.normals, m.uvs))
    # Parts share textures, which count once.
    worn = {id(part.material.texture): part.material.texture for part in asset.parts}
    return own + sum(texture.image.nbytes for texture in worn.values() if texture is not None)
