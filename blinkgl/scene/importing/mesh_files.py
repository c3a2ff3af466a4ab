"""Mesh files (obj, ply, stl through trimesh; glb, gltf through
:mod:`blinkgl.scene.importing.gltf`) as :class:`Asset` objects.

What a file claims is checked against limits before anything is allocated for it, and nothing outside the file's own
folder is read on its behalf.
"""

from __future__ import annotations

import io
import logging
import re
import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import NoReturn

import numpy as np
import trimesh
from PIL import Image

from blinkgl.config.deform import AnimationConfig
from blinkgl.errors import AssetError, ConfigError
from blinkgl.scene.geometry.meshes import closed_together, concatenate, make_mesh, normalise
from blinkgl.scene.geometry.tangents import split_mirrored
from blinkgl.scene.importing import gltf
from blinkgl.scene.importing.animations import clip_names, play, rest_pieces
from blinkgl.scene.omissions import Omissions
from blinkgl.scene.reading import MAX_BYTES, contents, reading
from blinkgl.scene.shapes.skin import Skin, joined
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, content_hash, decode_image, shrink
from blinkgl.scene.types import Material, Mesh, Part, Texture
from blinkgl.srgb import linear_from_srgb

MESH_SUFFIXES = (".obj", ".ply", ".stl", ".glb", ".gltf")
logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its warnings say nothing a user could act on


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
    project_uvs: bool = False,
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
    project_uvs : replace the file's texture coordinates; ``uv_size`` is the edge of one repeat.
    Raises AssetError naming the file: missing, corrupt, NaN, no faces, more than ``max_faces`` triangles or
    ``max_bytes`` bytes, references outside its folder, an extension required that is not drawn.
    """
    with reading("mesh", str(path)):
        given = Path(path), max_faces, max_bytes, keep_materials, max_texture, source_hash, project_uvs, uv_size, up
        asset = _load(*given, animation, Path(base), where)
    again = partial(
        load_asset,
        path,
        max_faces=max_faces,
        max_bytes=max_bytes,
        keep_materials=keep_materials,
        max_texture=max_texture,
        source_hash=source_hash,
        project_uvs=project_uvs,
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
    project_uvs: bool,
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
        clips, played = [], None
        omissions = Omissions(path.name)
        pieces = _trimesh_pieces(path, data, suffix[1:], max_faces, max_texture if keep_materials else None, omissions)
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
            uvs=None if project_uvs else piece.uvs,
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


def _trimesh_pieces(
    path: Path, data: bytes, kind: str, max_faces: int, max_texture: int | None, omissions: Omissions
) -> list[gltf.Piece]:
    where = str(path)
    {"stl": _check_stl, "ply": _check_ply, "obj": _check_obj}[kind](data, max_faces, where)
    resolver = FolderResolver(path.parent, where, kind, omissions)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        loaded = trimesh.load_scene(
            io.BytesIO(data),
            file_type=kind,
            resolver=resolver,
            process=False,
            maintain_order=True,
            skip_materials=max_texture is None,
        )
    if max_texture is not None and resolver.refused is not None:
        raise resolver.refused
    pieces = [
        piece_of_trimesh(
            g, max_texture=max_texture, where=where, file_normals=True, omissions=omissions, resolver=resolver
        )
        for g in loaded.geometry.values()
        if isinstance(g, trimesh.Trimesh)
    ]
    if not pieces:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if any(not isinstance(g, trimesh.Trimesh) for g in loaded.geometry.values()):
        omissions.add("points and lines")
    return pieces


def piece_of_trimesh(
    mesh: trimesh.Trimesh,
    *,
    max_texture: int | None,
    where: str,
    file_normals: bool,
    omissions: Omissions,
    resolver: FolderResolver | None = None,
) -> gltf.Piece:
    """Raw triangles and material of a ``trimesh.Trimesh``.

    file_normals : use normals that came with the mesh; trimesh's own smooth ones would round off a cuboid.
    max_texture : None leaves the material out.   resolver : what the mesh was loaded with; it knows the images.
    """
    # mesh.vertex_normals would make up what the file does not have.
    normals = mesh._cache.cache.get("vertex_normals") if file_normals else None  # noqa: SLF001
    uvs = getattr(mesh.visual, "uv", None)
    if uvs is not None and len(uvs) == len(mesh.vertices):
        uvs = np.asarray(uvs, np.float64)[:, :2] * [1, -1] + [0, 1]  # trimesh has v upwards
    else:
        uvs = None
    material, colours = None, None
    if max_texture is not None:
        material = _material(mesh.visual, max_texture, where, omissions, resolver)
        if getattr(mesh.visual, "kind", None) == "vertex":
            colours = linear_from_srgb(np.asarray(mesh.visual.vertex_colors, float)[:, :3] / 255)
            if (colours == colours[0]).all():
                colours = None
            elif material is not None:
                material = replace(material, base_color=(1.0, 1.0, 1.0))
    return gltf.Piece(
        np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), normals, uvs, material, colours=colours
    )


def _material(
    visual, max_texture: int, where: str, omissions: Omissions, resolver: FolderResolver | None
) -> Material | None:
    material = getattr(visual, "material", None)
    if material is None:
        kind = getattr(visual, "kind", None)
        if kind not in ("face", "vertex"):
            return None
        colours = visual.face_colors if kind == "face" else visual.vertex_colors
        if kind == "face" and not (colours == colours[0]).all():
            omissions.add(f"{kind} colours (drawn in the most frequent one)")
        return Material(base_color=gltf.to_linear(np.asarray(visual.main_color, float)[:3] / 255))
    image = getattr(material, "baseColorTexture", None)
    factor = getattr(material, "baseColorFactor", None)
    if isinstance(material, trimesh.visual.material.SimpleMaterial):
        image = material.image
        diffuse = material.diffuse
        # An untouched default is no material; a texture is not darkened by the usual grey diffuse default.
        if (
            image is None
            and material.name is None
            and np.array_equal(diffuse[:3], trimesh.visual.color.DEFAULT_COLOR[:3])
        ):
            return None
        colour = (1.0, 1.0, 1.0) if image is not None else gltf.to_linear(np.asarray(diffuse, float)[:3] / 255)
    else:
        factor = np.ones(3) if factor is None else np.asarray(factor)[:3]
        # glTF factors are linear.
        colour = tuple(float(c) for c in (factor / 255 if factor.dtype.kind in "iu" else factor))
        if getattr(material, "alphaMode", None) not in (None, "OPAQUE"):
            omissions.add(f"alpha {material.alphaMode} (drawn opaque)")
        if np.any(getattr(material, "emissiveFactor", None)):
            omissions.add("emissive light")
    texture = None
    if image is not None:
        opened = resolver is None  # by whoever made the mesh
        texture = texture_of(image, max_texture, where) if opened else resolver.texture(image, max_texture)
    return Material(texture=texture, base_color=colour, double_sided=bool(getattr(material, "doubleSided", False)))


def texture_of(image: Image.Image, max_texture: int, where: str) -> Texture:
    """A Pillow image that somebody else opened, as a texture. AssetError when its file turns out to be broken."""
    with reading("image", where):
        pixels = np.ascontiguousarray(np.asarray(image.convert("RGB")))
        return Texture(shrink(pixels, max_texture), "texture", content_hash(pixels.tobytes()))


class FolderResolver(trimesh.resolvers.Resolver):
    """Reads material and image files beside a mesh; refuses what leads out of its folder.

    trimesh opens images with Pillow as it finds them, and does without those that it cannot open. So it is given a
    pixel in place of each, whose colour is the image's number; :meth:`texture` decodes the file by the rules of all
    other textures.
    """

    def __init__(self, folder: Path, where: str, kind: str, omissions: Omissions):
        self.folder, self.where, self.kind, self.omissions = Path(folder), where, kind, omissions
        self.refused: AssetError | None = None
        self._named: set[str] = set()  # images that a material file names
        self._images: list[tuple[str, bytes]] = []
        self._textures: dict[int, Texture] = {}

    def get(self, name: str) -> bytes:
        try:
            file = gltf.inside(self.folder, str(name), self.where)
            data = contents(file, "file")
        except AssetError as error:  # trimesh swallows it; _trimesh_pieces raises it
            if "missing" in error.problem:
                self.omissions.add(f"'{name}', which is missing")
            else:
                self.refused = self.refused or error
            raise
        if self.kind == "obj" and name not in self._named:
            self._read_mtl(data)
            return data
        self._images.append((str(file), data))
        number, stream = len(self._images) - 1, io.BytesIO()
        Image.new("RGB", (1, 1), (number & 255, number >> 8 & 255, number >> 16 & 255)).save(stream, "PNG")
        return stream.getvalue()

    def texture(self, pixel: Image.Image, max_texture: int) -> Texture:
        """The texture that ``pixel`` stands for. AssetError naming its file."""
        red, green, blue = pixel.convert("RGB").getpixel((0, 0))
        number = red + (green << 8) + (blue << 16)
        if number not in self._textures:
            name, data = self._images[number]
            self._textures[number] = Texture(decode_image(data, max_texture, name), Path(name).name, content_hash(data))
        return self._textures[number]

    def _read_mtl(self, data: bytes) -> None:
        """Notes the images that a material file names, and what it asks for beside a matt colour."""
        for line in data.decode("utf-8", errors="replace").splitlines():
            key, _, rest = line.strip().partition(" ")
            key, rest = key.lower(), rest.strip()
            if key == "map_kd":
                self._named.add(rest)
            elif key in _MTL_MAPS:
                self.omissions.add(_MTL_MAPS[key])
            elif key in _MTL_VALUES:
                what, plain = _MTL_VALUES[key]
                try:
                    asked = any(float(value) != plain for value in rest.split()[:3])
                except ValueError:
                    asked = False
                if asked:
                    self.omissions.add(what)

    def write(self, name: str, data: bytes) -> NoReturn:
        raise AssetError("a mesh loader wanted to write", where=self.where, value=name)

    def namespaced(self, namespace: str) -> FolderResolver:
        return FolderResolver(gltf.inside(self.folder, namespace, self.where), self.where, self.kind, self.omissions)

    def keys(self) -> list[str]:
        return [p.name for p in self.folder.iterdir() if p.suffix.lower() in (".mtl", *IMAGE_SUFFIXES)]


_MTL_MAPS = {
    "map_bump": "normal maps",
    "bump": "normal maps",
    "norm": "normal maps",
    "map_d": "transparency (drawn opaque)",
    "map_ke": "emissive light",
    "map_ks": "shine (drawn matt)",
    "map_pr": "shine (drawn matt)",
    "map_pm": "shine (drawn matt)",
}
# Statement -> what it asks for, unless all its values are this.
_MTL_VALUES = {
    "ke": ("emissive light", 0.0),
    "ks": ("shine (drawn matt)", 0.0),
    "pm": ("shine (drawn matt)", 0.0),
    "d": ("transparency (drawn opaque)", 1.0),
    "tr": ("transparency (drawn opaque)", 0.0),
}


def _check_stl(data: bytes, max_faces: int, where: str) -> None:
    if len(data) >= 84:
        claimed = int(np.frombuffer(data[80:84], "<u4")[0])
        # Binary when the size fits; ASCII begins with 'solid' (some binary files do too, hence the size first).
        if data.lstrip()[:5].lower() != b"solid" or len(data) == 84 + 50 * claimed:
            if claimed > max_faces:
                raise AssetError(
                    "the mesh has too many faces", where=where, value=claimed, accepted=f"at most {max_faces}"
                )
            if len(data) < 84 + 50 * claimed:
                raise AssetError(
                    f"the mesh is truncated: {claimed} faces need {84 + 50 * claimed} bytes",
                    where=where,
                    value=len(data),
                )
            return
    _limit(data.count(b"facet normal"), max_faces, where)


def _check_ply(data: bytes, max_faces: int, where: str) -> None:
    end = data[: 1 << 16].find(b"end_header")
    if not data.startswith(b"ply") or end < 0:
        raise AssetError("the mesh is corrupt (no PLY header)", where=where)
    for name, digits in re.findall(rb"element\s+(\w+)\s+(\d+)", data[:end]):
        what = "faces" if name == b"face" else f"{name.decode(errors='replace')} elements"
        if len(digits) > 18:
            raise AssetError(
                f"the mesh has too many {what}",
                where=where,
                value=f"a number of {len(digits)} digits",
                accepted=f"at most {max_faces} faces",
            )
        count = int(digits)
        if count > (max_faces if name == b"face" else 3 * max_faces + 1_000_000):
            raise AssetError(
                f"the mesh has too many {what}", where=where, value=count, accepted=f"at most {max_faces} faces"
            )
        if count > len(data) - end:  # an element takes a byte at least
            raise AssetError(f"the mesh is truncated: {count} {what} in {len(data)} bytes", where=where)


def _check_obj(data: bytes, max_faces: int, where: str) -> None:
    _limit(data.count(b"\nf ") + data.startswith(b"f "), max_faces, where)
    # trimesh allocates as many vertices as the largest index of a face says; a file has no more of them than lines.
    lines = data.count(b"\n") + data.count(b"\r") + 1
    found = re.search(
        rb"(?:\A|[\r\n])f[^\r\n]*?(\d{%d,})" % (len(str(lines)) + 1),
        data.replace(b"\\\n", b" ") if b"\\\n" in data else data,
    )
    if found:
        raise AssetError(
            "a face refers to a vertex that does not exist",
            where=where,
            value=found[1][:20].decode(),
            accepted=f"at most {lines}",
        )


def _limit(faces: int, max_faces: int, where: str) -> None:
    if faces > max_faces:
        raise AssetError("the mesh has too many faces", where=where, value=faces, accepted=f"at most {max_faces}")
