"""stl, off and 3mf files as raw meshes, read by trimesh."""

from __future__ import annotations

import io
import logging
import re
import zipfile
from array import array
from collections.abc import Sequence

import numpy as np
import trimesh

from blinkgl.errors import AssetError
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import RawMesh, tinted, transformed
from blinkgl.scene.importing.polygons import Polygons, linear_colours, raw_meshes
from blinkgl.scene.reading import MAX_BYTES, limit_faces

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its warnings are of no use to a user


def read_meshes(data: bytes, near: Neighbours, max_faces: int, max_texture: int | None) -> list[RawMesh]:
    """Return raw meshes of an stl, off or 3mf file. ``near`` gets what is not drawn, and what was decided.

    max_texture : None leaves colours out. Raises AssetError: truncated, corrupt, no faces, more than ``max_faces``."""
    where, kind = str(near.path), near.path.suffix.lower()[1:]
    check_kind(data, max_faces, where)
    if kind == "off":
        return raw_meshes(_off(data, max_texture is not None, near), [None], max_faces, where, near.log)
    # Bytes instead of a path: a library must not open other files. process would merge and reorder vertices.
    loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    raws = []
    for node in loaded.graph.nodes_geometry:
        place, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            raw = RawMesh(np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64))
            raws.append(transformed(raw, np.asarray(place, np.float64)))
    if not raws:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if kind == "stl" and max_texture is not None:
        return [_coloured_stl(data, raw, near) for raw in raws]
    if kind == "3mf" and max_texture is not None:
        _note_3mf(_model_of(data), near)
    return raws


def _coloured_stl(data: bytes, raw: RawMesh, near: Neighbours) -> RawMesh:
    """Return the triangles with the colours of a binary STL file, five bits a channel in the two bytes behind each
    face: those of Magics, whose header has "COLOR=" and the colour of all others, or of VisCAM and SolidView."""
    count = (len(data) - 84) // 50
    if len(raw.faces) != count or (len(data) - 84) % 50:
        return raw
    bits = np.frombuffer(data, np.dtype([("corners", "V48"), ("bits", "<u2")]), count, 84)["bits"].astype(np.int64)
    codes, own = np.stack([bits & 31, bits >> 5 & 31, bits >> 10 & 31], axis=1), bits >> 15 == 1
    head, rest = data[:80].partition(b"COLOR=")[2], np.full(3, 31.0)
    if b"MATERIAL=" in data[:80]:
        near.omissions.add("the material of Magics (drawn by its colour alone)")
    if len(head) > 3:  # bit 15 says that a face has the colour of all, and red is in the low bits
        own, rest = ~own, np.frombuffer(head[:3], np.uint8) * (31 / 255)
    elif not own.any():
        return raw
    colours = np.where(own[:, None], codes if len(head) > 3 else codes[:, ::-1], rest)
    material, tint = tinted(None, linear_colours(np.repeat(colours, 3, axis=0), near, 31.0))
    faces = np.arange(3 * count).reshape(-1, 3)
    return RawMesh(raw.vertices[raw.faces.ravel()], faces, material=material, colours=tint)


# Tags of a 3MF model that are understood, and those without effect on shape; the colours of others are not drawn.
_3MF = set("model resources object mesh vertices vertex triangles triangle build item components component".split())
_3MF |= {"metadata", "metadatagroup"}
_3MF_COLOURS = set("basematerials base colorgroup color texture2d texture2dgroup tex2coord compositematerials".split())
_3MF_COLOURS |= {"composite", "multiproperties", "multi"}


_3MF_UNITS = {"micron": 1e-6, "millimeter": 1e-3, "centimeter": 1e-2, "inch": 0.0254, "foot": 0.3048, "meter": 1.0}


def _note_3mf(model: bytes, near: Neighbours) -> None:
    # 3MF's core specification, 3.4: without a unit, millimetres.
    stated = re.search(rb"<(?:[A-Za-z0-9_.-]+:)?model\b[^>]*?\bunit\s*=\s*[\"'](\w+)", model)
    unit = stated[1].decode() if stated else "millimeter"
    if unit != "meter":
        scale = f", scale: {_3MF_UNITS[unit]:g} is its true size" if unit in _3MF_UNITS else ""
        near.log.append(f"{near.path.stem}: lengths in {unit} are taken as metres{scale}")
    tags = {tag.decode() for tag in re.findall(rb"<(?:[A-Za-z0-9_.-]+:)?([A-Za-z0-9_]+)", model)}
    if tags & _3MF_COLOURS:
        near.omissions.add("colours and textures of 3MF (drawn white)")
    near.omissions.unknown("elements of 3MF", tags - _3MF - _3MF_COLOURS)


# "4" and "n" (in lower case) are points of other than three numbers.
_OFF_HEAD = re.compile(r"\s*((?:ST|st)?[Cc]?N?)(4?n?)(?i:OFF)(?!\s*(?i:BINARY))")


def off_counts(data: bytes, where: str) -> tuple[str, int, int, str]:
    """Return (letters before OFF, vertices, faces, the text behind the counts). Geomview allows an OFF file to lack its
    keyword. Raises AssetError: another file, or points of other than three numbers."""
    text = re.sub(r"#.*", "", data.decode("latin-1"))
    head = _OFF_HEAD.match(text)
    begin = head.end() if head else 0
    counts = re.match(r"\s*(\d+)\s+(\d+)(?:\s+\d+)?[^\S\n]*", text[begin:])
    if counts is None or (head and head[2]):
        accepted = "OFF, COFF, NOFF, CNOFF, STOFF, without 4 or n, or the counts"
        raise AssetError("the mesh is no OFF file of text", where=where, value=text[:20], accepted=accepted)
    return head[1].upper() if head else "", int(counts[1]), int(counts[2]), text[begin + counts.end() :]


def _off(data: bytes, wanted: bool, near: Neighbours) -> Polygons:
    """Return the polygons of an OFF file (Geomview), which trimesh would fan, with the colours of vertices or faces if
    they are ``wanted``. Numbers stand in free form; only the end of a line ends the colour of a face."""
    kind, number, count, text = off_counts(data, str(near.path))
    # The numbers of a vertex: x y z, normal, colour, texture coordinates. A colour may lack its opacity.
    first, width = (6 if "N" in kind else 3), 3 + 3 * ("N" in kind) + 2 * ("ST" in kind)
    tints = 0 if "C" not in kind else 3 if len(text.lstrip().split("\n")[0].split()) == width + 3 else 4
    lines, words = (match[0] for match in re.finditer(r"[^\n]+", text)), []

    def take(size: int) -> list[str]:
        """Take the next ``size`` words, on as many lines as they need; fewer where the file ends."""
        while len(words) < size and (line := next(lines, None)) is not None:
            words.extend(line.split())
        taken, words[:size] = words[:size], ()
        return taken

    rows = take(number * (width + tints))
    sizes, places, specs = array("q"), array("q"), []
    for _ in range(count):
        size = int(word) if (word := "".join(take(1))) else -1
        corners = take(max(size, 0))
        sizes.append(size)
        places.extend(map(int, corners))
        specs.append(tuple(words))  # what is left of the line
        words.clear()
    if len(rows) < number * (width + tints) or sum(map(abs, sizes)) != len(places):
        raise AssetError(f"the mesh is truncated: {number} vertices and {count} faces", where=str(near.path))
    points = np.array(rows, np.float64).reshape(number, width + tints)
    polygons = Polygons(points[:, :3], np.array(places, np.int64), np.array(sizes, np.int64))
    corner = polygons.places.clip(0, max(number - 1, 0))
    polygons.normals = points[corner, 3:6] if "N" in kind else None
    polygons.uvs = points[corner, -2:] if "ST" in kind else None
    if wanted and tints:
        own = [rows[k + first : k + first + tints] for k in range(0, len(rows), width + tints)]
        polygons.colours = _off_colours(own, near)[corner]
    elif wanted and any(specs):
        polygons.colours = np.repeat(_off_colours(specs, near), polygons.sizes, axis=0)
    return polygons


def _off_colours(specs: Sequence[Sequence[str]], near: Neighbours) -> np.ndarray:
    """Return (n, 3) linear colours of words: three or four numbers, whole ones of 255, or fractions; none is white."""
    if any(len(spec) in (1, 2) for spec in specs):
        near.omissions.add("colours by their number in a colour map (drawn white)")
    codes = np.array([[*spec[:4], "nan"][:4] if len(spec) > 2 else ["nan"] * 4 for spec in specs], np.float64)
    opacity = codes[np.isfinite(codes[:, 3]), 3]
    whole = not any("." in word or "e" in word for spec in specs for word in spec[:3])
    # An opacity of 1 beside whole numbers up to 1 says that they are fractions.
    small = np.nanmax(codes[:, :3], initial=0) <= 1 and (not whole or 0 < opacity.max(initial=0) <= 1)
    return linear_colours(codes[:, :3], near, 1.0 if small else 255.0, opacity)


def check_kind(data: bytes, max_faces: int, where: str) -> None:
    """Check what an stl, off or 3mf file says about its size. Raises AssetError: truncated, or too many faces."""
    of_off = lambda data, max_faces, where: limit_faces(off_counts(data, where)[2], max_faces, where)
    {"stl": _check_stl, "3mf": _check_3mf, "off": of_off}[where.lower()[-3:]](data, max_faces, where)


def _check_stl(data: bytes, max_faces: int, where: str) -> None:
    if len(data) >= 84:
        claimed = int(np.frombuffer(data[80:84], "<u4")[0])
        # Binary when the size fits; ASCII begins with 'solid' (some binary files do, too, so the size comes first).
        if data.lstrip()[:5].lower() != b"solid" or len(data) == 84 + 50 * claimed:
            limit_faces(claimed, max_faces, where)
            if len(data) < 84 + 50 * claimed:
                raise AssetError(
                    f"the mesh is truncated: {claimed} faces need {84 + 50 * claimed} bytes",
                    where=where,
                    value=len(data),
                )
            return
    limit_faces(data.count(b"facet normal"), max_faces, where)


def _check_3mf(data: bytes, max_faces: int, where: str) -> None:
    """Check what the archive says about its sizes before anything is unpacked."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        size = sum(info.file_size for info in archive.infolist())
    # XML packs to a tenth; more than a hundred times is a bomb.
    if size > MAX_BYTES or size > 100 * len(data):
        raise AssetError("the mesh is too large when it is unpacked", where=where, value=f"{size / 1e6:.0f} MB")
    limit_faces(_model_of(data).count(b"<triangle "), max_faces, where)


def _model_of(data: bytes) -> bytes:
    """Return the XML of a 3MF file's models."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        return b"".join(archive.read(name) for name in archive.namelist() if name.lower().endswith(".model"))
