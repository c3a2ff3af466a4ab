"""obj, ply and stl files as raw meshes."""

from __future__ import annotations

import io
import logging
import re
import warnings
from dataclasses import replace
from pathlib import Path
from typing import NoReturn

import numpy as np
import trimesh
from PIL import Image

from blinkgl.errors import AssetError
from blinkgl.scene.importing.gltf_file import inside
from blinkgl.scene.importing.parts import RawMesh
from blinkgl.scene.reading import Omissions, contents
from blinkgl.scene.surfaces.images import IMAGE_SUFFIXES, content_hash, decode_image
from blinkgl.scene.types import Material, Texture
from blinkgl.srgb import linear_from_srgb

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its warnings are of no use to a user


def read_meshes(
    path: Path, data: bytes, kind: str, max_faces: int, max_texture: int | None, omissions: Omissions
) -> list[RawMesh]:
    """Return raw meshes of a file of this ``kind`` ("obj", "ply", "stl").

    max_texture : None leaves materials out.   omissions : gets the undrawn features of the file. Raises AssetError:
    truncated, corrupt, no faces, more than ``max_faces``, references outside its folder."""
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
    raws = [
        _raw_mesh(g, max_texture, omissions, resolver)
        for g in loaded.geometry.values()
        if isinstance(g, trimesh.Trimesh)
    ]
    if not raws:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if any(not isinstance(g, trimesh.Trimesh) for g in loaded.geometry.values()):
        omissions.add("points and lines")
    return raws


def _raw_mesh(
    mesh: trimesh.Trimesh, max_texture: int | None, omissions: Omissions, resolver: FolderResolver
) -> RawMesh:
    """Return raw triangles and material. max_texture : None leaves the material out."""
    # mesh.vertex_normals would compute normals that the file does not have.
    normals = mesh._cache.cache.get("vertex_normals")  # noqa: SLF001
    uvs = getattr(mesh.visual, "uv", None)
    if uvs is not None and len(uvs) == len(mesh.vertices):
        uvs = np.asarray(uvs, np.float64)[:, :2] * [1, -1] + [0, 1]  # trimesh has v upwards
    else:
        uvs = None
    material, colours = None, None
    if max_texture is not None:
        material = _material(mesh.visual, max_texture, omissions, resolver)
        if getattr(mesh.visual, "kind", None) == "vertex":
            colours = linear_from_srgb(np.asarray(mesh.visual.vertex_colors, float)[:, :3] / 255)
            if (colours == colours[0]).all():
                colours = None
            elif material is not None:
                material = replace(material, base_color=(1.0, 1.0, 1.0))
    return RawMesh(
        np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces), normals, uvs, material, colours=colours
    )


def _to_linear(srgb: np.ndarray) -> tuple[float, float, float]:
    """Return the linear light of an sRGB colour (3,), clipped to 0 to 1."""
    r, g, b = (float(c) for c in linear_from_srgb(np.clip(srgb, 0, 1)))
    return r, g, b


def _material(visual, max_texture: int, omissions: Omissions, resolver: FolderResolver) -> Material | None:
    material = getattr(visual, "material", None)
    if material is None:
        kind = getattr(visual, "kind", None)
        if kind not in ("face", "vertex"):
            return None
        colours = visual.face_colors if kind == "face" else visual.vertex_colors
        if kind == "face" and not (colours == colours[0]).all():
            omissions.add(f"{kind} colours (drawn in the most frequent one)")
        return Material(base_color=_to_linear(np.asarray(visual.main_color, float)[:3] / 255))
    image, diffuse = material.image, material.diffuse
    # An untouched default is not a material; the usual grey diffuse default does not darken a texture.
    if image is None and material.name is None and np.array_equal(diffuse[:3], trimesh.visual.color.DEFAULT_COLOR[:3]):
        return None
    if image is None:
        return Material(base_color=_to_linear(np.asarray(diffuse, float)[:3] / 255))
    return Material(texture=resolver.texture(image, max_texture))


class FolderResolver(trimesh.resolvers.Resolver):
    """Reads material and image files beside a mesh; refuses paths outside its folder.

    trimesh opens images with Pillow itself and ignores those that it cannot open. So it gets a pixel instead of each,
    whose colour is the image's number; :meth:`texture` decodes the file by the rules of all other textures.
    """

    def __init__(self, folder: Path, where: str, kind: str, omissions: Omissions):
        self.folder, self.where, self.kind, self.omissions = Path(folder), where, kind, omissions
        self.refused: AssetError | None = None
        self._named: set[str] = set()  # images named by a material file
        self._images: list[tuple[str, bytes]] = []
        self._textures: dict[int, Texture] = {}

    def get(self, name: str) -> bytes:
        try:
            file = inside(self.folder, str(name), self.where)
            data = contents(file, "file")
        except AssetError as error:  # trimesh hides it; read_meshes raises it
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
        """Return the texture of a placeholder ``pixel``. Raises AssetError naming its file."""
        red, green, blue = pixel.convert("RGB").getpixel((0, 0))
        number = red + (green << 8) + (blue << 16)
        if number not in self._textures:
            name, data = self._images[number]
            self._textures[number] = Texture(decode_image(data, max_texture, name), Path(name).name, content_hash(data))
        return self._textures[number]

    def _read_mtl(self, data: bytes) -> None:
        """Record the images that a material file names, and undrawn features of its materials."""
        for line in data.decode("utf-8", errors="replace").splitlines():
            key, _, rest = line.strip().partition(" ")
            key, rest = key.lower(), rest.strip()
            if key == "map_kd":
                self._named.add(rest)
            elif key in _MTL_MAPS:
                self.omissions.add(_MTL_MAPS[key])

    def write(self, name: str, data: bytes) -> NoReturn:
        raise AssetError("a mesh loader tried to write", where=self.where, value=name)

    def namespaced(self, namespace: str) -> FolderResolver:
        return FolderResolver(inside(self.folder, namespace, self.where), self.where, self.kind, self.omissions)

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


def _check_stl(data: bytes, max_faces: int, where: str) -> None:
    if len(data) >= 84:
        claimed = int(np.frombuffer(data[80:84], "<u4")[0])
        # Binary when the size fits; ASCII begins with 'solid' (some binary files do, too, so the size comes first).
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
        if count > len(data) - end:  # an element takes at least one byte
            raise AssetError(f"the mesh is truncated: {count} {what} in {len(data)} bytes", where=where)


def _check_obj(data: bytes, max_faces: int, where: str) -> None:
    _limit(data.count(b"\nf ") + data.startswith(b"f "), max_faces, where)
    # trimesh allocates as many vertices as the largest index of a face; a file has at most one per line.
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
