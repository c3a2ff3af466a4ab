"""stl, off and 3mf files as raw meshes, read by trimesh."""

from __future__ import annotations

import io
import logging
import re
import zipfile
from pathlib import Path

import numpy as np
import trimesh

from blinkgl.errors import AssetError
from blinkgl.scene.importing.parts import RawMesh, tinted, transformed
from blinkgl.scene.importing.polygons import Polygons, raw_meshes
from blinkgl.scene.reading import MAX_BYTES, Omissions, limit_faces
from blinkgl.srgb import linear_from_srgb

logging.getLogger("trimesh").setLevel(logging.CRITICAL)  # its warnings are of no use to a user


def read_meshes(
    path: Path, data: bytes, max_faces: int, max_texture: int | None, omissions: Omissions, log: list[str]
) -> list[RawMesh]:
    """Return raw meshes of an stl, off or 3mf file.

    max_texture : None leaves colours out.   omissions, log : get what is not drawn, and what was decided. Raises
    AssetError: truncated, corrupt, no faces, more than ``max_faces``."""
    where, kind = str(path), path.suffix.lower()[1:]
    if kind == "off":
        return _off(data, max_faces, max_texture is not None, where, log)
    {"stl": _check_stl, "3mf": _check_3mf}[kind](data, max_faces, where)
    loaded = trimesh.load_scene(io.BytesIO(data), file_type=kind, process=False)
    raws = []
    for node in loaded.graph.nodes_geometry:
        place, name = loaded.graph[node]
        mesh = loaded.geometry[name]
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            raws.append(transformed(_raw_mesh(mesh, max_texture is not None), np.asarray(place, np.float64)))
    if not raws:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    if kind == "3mf" and any(tag in _model_of(data) for tag in (b"basematerials", b"texture2d", b"colorgroup")):
        omissions.add("colours and textures of 3MF (drawn white)")
    return raws


def _raw_mesh(mesh: trimesh.Trimesh, wanted: bool) -> RawMesh:
    """Return raw triangles, with the colours of faces where they are ``wanted``."""
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(mesh.faces, np.int64)
    if not wanted or getattr(mesh.visual, "kind", None) != "face":
        return RawMesh(vertices, faces)
    codes = np.asarray(mesh.visual.face_colors)[:, :3] / 255
    material, tint = tinted(None, linear_from_srgb(np.repeat(codes, 3, axis=0)))
    # Colours belong to faces, so no two share a vertex.
    apart = np.arange(faces.size).reshape(-1, 3)
    return RawMesh(vertices[faces.ravel()], apart, None, None, material, colours=tint)


def _off(data: bytes, max_faces: int, wanted: bool, where: str, log: list[str]) -> list[RawMesh]:
    """Return the polygons of an OFF file (Geomview), which trimesh would fan, with the colours of vertices or faces."""
    text = re.sub(r"#.*", "", data.decode("latin-1"))
    head = re.match(r"\s*((?:ST)?C?N?OFF)(?!\s*BINARY)", text, re.IGNORECASE)
    if head is None:
        raise AssetError("the mesh is no OFF file of text", where=where, value=text[:20], accepted="OFF, COFF, NOFF")
    kind, rows = head[1].upper(), [words for line in text[head.end() :].splitlines() if (words := line.split())]
    number, count = (int(word) for word in rows[0][:2])
    vertices, faces = rows[1 : 1 + max(number, 0)], rows[1 + number : 1 + number + count]
    sizes = np.array([int(row[0]) for row in faces], np.int64)
    if len(vertices) != number or len(faces) != count or any(len(r) <= n for r, n in zip(faces, sizes, strict=True)):
        raise AssetError(f"the mesh is truncated: {number} vertices and {count} faces", where=where)
    places = np.array([int(place) for row in faces for place in row[1 : 1 + int(row[0])]], np.int64)
    given, first = Polygons(np.array([row[:3] for row in vertices], np.float64), places, sizes), 6 if "N" in kind else 3
    if wanted and "C" in kind:
        given.colours = np.array([row[first : first + 3] for row in vertices], np.float64)[places.clip(0, number - 1)]
    elif wanted and all(len(row) >= size + 4 for row, size in zip(faces, sizes, strict=True)):
        given.colours = np.repeat(np.array([row[1 + int(row[0]) :][:3] for row in faces], np.float64), sizes, axis=0)
    if given.colours is not None:  # whole numbers up to 255, or fractions
        given.colours = linear_from_srgb((given.colours / (255 if given.colours.max() > 1 else 1)).clip(0, 1))
    return raw_meshes(given, [None], max_faces, where, log)


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
