"""Reader of PLY files, ASCII and binary: polygons, texture coordinates and colours of vertices, corners and faces.

Reference: Greg Turk's "The PLY polygon file format"; names of properties as Blender, MeshLab, CloudCompare and VTK
write them. Texture coordinates have v upwards.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import RawMesh
from blinkgl.scene.importing.polygons import Polygons, linear_colours, raw_meshes, texture_beside
from blinkgl.scene.types import Material

_TYPES = {"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4"}
_TYPES |= {"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4", "float32": "f4"}
_TYPES |= {"double": "f8", "float64": "f8", "int64": "i8", "uint64": "u8"}
_COORDINATES = (("texture_u", "texture_v"), ("u", "v"), ("s", "t"))
_COLOURS = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
_OPACITIES = ("alpha", "diffuse_alpha", "a")
_OF_CORNERS = ("texcoord", "t", "st", "uv")  # lists of faces: u and v of each corner
_PART = ("multi_texture_vertex", "multi_texture_face")
# The closed list of what is understood, by element. Flags and measures of scanners change nothing that is drawn.
_EFFECTLESS = set("flags quality confidence curvature radius".split())
_KNOWN = {
    "vertex": {"x", "y", "z", "nx", "ny", "nz", *_OPACITIES, *sum(_COORDINATES + _COLOURS, ())} | _EFFECTLESS,
    "face": {"vertex_indices", "vertex_index", "texnumber", "nx", "ny", "nz", *_OPACITIES, *sum(_COLOURS, ())}
    | {*_OF_CORNERS, *_EFFECTLESS},
    _PART[0]: {"tx", "u", "v"},
    _PART[1]: {"tx", "tn", "texture_vertex_indices"},
}
# Values of a property, (n,); of a list (n,) lengths and all values, one list after the other.
Column = np.ndarray | tuple[np.ndarray, np.ndarray]


def read_ply(data: bytes, near: Neighbours, max_faces: int, max_texture: int | None) -> list[RawMesh]:
    """Return raw meshes, one for each texture. ``near`` gets what is not drawn, and what was decided.

    max_texture : None leaves materials and colours out. Raises AssetError: truncated, corrupt, no faces, too many
    faces."""
    where = str(near.path)
    # Counts are checked before anything is allocated.
    declared, body = checked_ply(data, max_faces, where)
    elements = {name: body.columns(count, properties, name, where) for name, count, properties in declared}
    vertex, face = elements.get("vertex", {}), elements.get("face", {})
    indices = face.get("vertex_indices", face.get("vertex_index"))
    if not isinstance(indices, tuple) or not {"x", "y", "z"} <= set(vertex) or not len(indices[0]):
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    for name in (name for name in elements if name not in _KNOWN):
        near.omissions.add("edges and triangle strips" if name in ("edge", "tristrips") else f"elements '{name}'")
    sizes, places = (values.astype(np.int64) for values in indices)
    inside = np.clip(places, 0, max(len(vertex["x"]) - 1, 0))  # raw_meshes refuses the others
    polygons = Polygons(_columns_of(vertex, "xyz"), places, sizes)
    if {"nx", "ny", "nz"} <= set(vertex):
        polygons.normals = _columns_of(vertex, ("nx", "ny", "nz"))[inside]
    polygons.uvs, number = _coordinates(elements, sizes, inside, near)
    materials: list[Material | None] = [None]
    if max_texture is not None:
        for name, known in _KNOWN.items():
            near.omissions.unknown(f"properties of {name} elements", set(elements.get(name, ())) - known)
        of_faces, of_vertices = _colours(face, near), _colours(vertex, near)
        polygons.colours = np.repeat(of_faces, sizes, axis=0) if of_faces is not None else None
        polygons.colours = of_vertices[inside] if of_vertices is not None else polygons.colours
        if of_faces is not None and of_vertices is not None:
            near.omissions.add("colours of faces, beside those of vertices")
        textures = [file for _, file in files_of_ply(data, near)]
        for file in textures if polygons.uvs is not None else ():
            texture = texture_beside(file, max_texture, near.omissions)
            materials.append(None if texture is None else Material(texture=texture))
        if textures and polygons.uvs is None:
            near.omissions.add("a texture, since there are no texture coordinates")
        if len(materials) > 1 and isinstance(number, np.ndarray):
            # A face's number counts textures from 0, and -1 is none; material 0 is for faces without a texture.
            polygons.surfaces = np.clip(np.nan_to_num(number), -1, len(materials) - 2).astype(np.int64) + 1
    return raw_meshes(polygons, materials, max_faces, where, near.log)


def _coordinates(
    elements: dict[str, dict[str, Column]], sizes: np.ndarray, inside: np.ndarray, near: Neighbours
) -> tuple[np.ndarray | None, Column]:
    """Return ((C, 2) texture coordinates of corners, None without; (P,) the texture of each face)."""
    vertex, face = elements["vertex"], elements["face"]
    own, rows = (elements.get(name, {}) for name in _PART)
    number = face.get("texnumber", np.zeros(len(sizes)))
    lists = [(face[name], 2 * sizes) for name in _OF_CORNERS if isinstance(face.get(name), tuple)]
    # Artec's scanners: a list of coordinates, and for each face which of them its corners have.
    listed = isinstance(rows.get("texture_vertex_indices"), tuple) and {"u", "v"} <= set(own) and len(own["u"]) > 0
    for (lengths, values), expected in [(rows["texture_vertex_indices"], sizes)] if listed else lists[:1]:
        if not np.array_equal(lengths, expected):
            near.omissions.add("texture coordinates that do not fit the faces")
        elif listed:
            chosen = values.astype(np.int64).clip(0, len(own["u"]) - 1)
            return _columns_of(own, ("u", "v"))[chosen], rows.get("tx", number)
        else:
            return values.reshape(-1, 2).astype(np.float64), number
    names = next((names for names in _COORDINATES if set(names) <= set(vertex)), None)
    return None if names is None else _columns_of(vertex, names)[inside], number


def files_of_ply(data: bytes, near: Neighbours) -> list[tuple[str, Path | None]]:
    """Return the names of the textures in a PLY file's header, and what is there."""
    head = _HEADER.match(data)
    names = re.findall(rb"comment[ \t]+TextureFile[ \t]+([^\r\n]+)", head[1] if head else b"", re.IGNORECASE)
    return [(name, near.optional((name,))) for name in (n.decode("utf-8", "replace").strip() for n in names)]


def _columns_of(element: dict, names) -> np.ndarray:
    return np.column_stack([element[name] for name in names]).astype(np.float64)


def _colours(element: dict[str, Column], near: Neighbours) -> np.ndarray | None:
    """Return (n, 3) linear colours of an element's items; None: it has none. One byte is a fraction of 255, two of
    65535; what larger numbers are fractions of, their size says."""
    for names in _COLOURS:
        if set(names) <= set(element):
            most = {"u1": 255.0, "u2": 65535.0}.get(np.asarray(element[names[0]]).dtype.str[1:])
            opacity = next((element[name] for name in _OPACITIES if name in element), np.ones(0))
            return linear_colours(_columns_of(element, names), near, most, np.asarray(opacity))
    return None


# Lines may also end as on old Macs.
_HEADER = re.compile(rb"ply\s*[\r\n](.{0,65536}?)end_header(?:\r\n|[^\n\r]*\n|\r)", re.DOTALL)


def checked_ply(data: bytes, max_faces: int, where: str) -> tuple[list, _Body]:
    """Return (name, number and properties of each element, what follows the header). Raises AssetError: no header,
    an unknown form, or more elements than are allowed or fit into the file."""
    head = _HEADER.match(data)
    if head is None:
        raise AssetError("the mesh is corrupt (no PLY header)", where=where)
    form = ""
    declared: list[tuple[str, int, list[tuple[str, str | None, str]]]] = []
    for line in re.split(r"[\r\n]+", head[1].decode("utf-8", "replace")):
        words = line.split()
        if words[:1] == ["format"]:
            form = words[1]
        elif words[:1] == ["element"]:
            # A count is compared with the bytes that are left before memory is taken.
            declared.append((words[1], _count(words[1], words[2], max_faces, len(data) - head.end(), where), []))
        elif words[:2] == ["property", "list"]:
            declared[-1][2].append((words[4], _TYPES[words[2]], _TYPES[words[3]]))
        elif words[:1] == ["property"]:
            declared[-1][2].append((words[2], None, _TYPES[words[1]]))
    orders = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
    if form not in orders:
        raise AssetError("the mesh is of an unknown PLY format", where=where, value=form, accepted=", ".join(orders))
    return declared, _Body(data[head.end() :], orders[form], sum(count for _, count, _ in declared))


def _count(name: str, digits: str, max_faces: int, available: int, where: str) -> int:
    what, accepted = "faces" if name == "face" else f"{name} elements", f"at most {max_faces} faces"
    count = int(digits) if digits.isdecimal() and len(digits) <= 18 else f"a number of {len(digits)} digits"
    if isinstance(count, str) or count > (max_faces if name == "face" else 3 * max_faces + 1_000_000):
        raise AssetError(f"the mesh has too many {what}", where=where, value=count, accepted=accepted)
    if count > available:  # an element takes at least one byte
        raise AssetError(f"the mesh is truncated: {count} {what} in {available} bytes", where=where)
    return count


class _Body:
    """What follows the header as ``items``: bytes, or for ASCII the numbers. at : the first that is not read yet.
    lines : where each line of an ASCII file with a line for each of its ``rows`` begins, and the end; None: of others.
    Such a line may have more numbers than its header says, as MeshLab writes them."""

    def __init__(self, data: bytes, order: str, rows: int):
        self.order, self.at, self.lines = order, 0, None
        if order:
            self.items = np.frombuffer(data, np.uint8)
            return
        lines = [words for line in data.splitlines() if (words := line.split())]
        self.items = np.array([float(word) for words in lines for word in words])
        if len(lines) == rows:
            self.lines = np.cumsum([0, *map(len, lines)])

    def width(self, kind: str) -> int:
        """Return the number of items of one value."""
        return int(kind[1]) if self.order else 1

    def values(self, at: np.ndarray, kind: str) -> np.ndarray:
        """Return the values at (n,) places; numbers of a text that a type does not hold become its largest."""
        if self.order:
            # The bytes of each value in a row, read as its type.
            return self.items[at[:, None] + np.arange(self.width(kind))].view(self.order + kind).ravel().astype(kind)
        limits = np.iinfo(kind if kind[0] != "f" else "i4")
        # The numbers of a text are float64, which holds whole numbers up to 2^53 exactly.
        least, most = max(limits.min, -(2**53)), min(limits.max, 2**53)
        item = self.items[at]
        return item if kind[0] == "f" else np.clip(np.nan_to_num(item, nan=most), least, most).astype(kind)

    def columns(self, count: int, properties: list[tuple[str, str | None, str]], name: str, where: str) -> dict:
        """Return the columns of the next element: (name, type of a list's length or None, type) of each property."""
        truncated = AssetError(f"the mesh is truncated: not all of {count} {name} elements are there", where=where)
        # widths: items of a value, or of a list's length. inner: items of a list's entry, 0 where the property
        # is no list.
        widths = [self.width(length or kind) for _, length, kind in properties]
        inner = [self.width(kind) if length else 0 for _, length, kind in properties]
        at, end, begins = self.at, len(self.items), None
        if self.lines is not None:
            begins, self.lines = self.lines[: count + 1], self.lines[count:]
        short = at + count * sum(widths) > end if begins is None else bool((np.diff(begins) < sum(widths)).any())
        if short:
            raise truncated
        first = at + np.arange(count) * sum(widths) if begins is None else begins[:-1]
        starts = first + np.cumsum([0, *widths[:-1]])[:, None]
        lengths = np.zeros_like(starts)
        # Rows with lists are found only by walking from one to the next.
        for row in range(count if any(inner) else 0):
            if begins is not None:
                at, end = begins[row : row + 2].tolist()
            for k, width in enumerate(widths):
                starts[k, row] = at
                at += width
                if at > end:
                    raise truncated
                if inner[k]:
                    # The value itself where a length takes one item: a byte, or a number of a text.
                    count_of = self.items[at - 1]
                    if self.order and width > 1:  # one byte, the usual length of a length, is read without an array
                        count_of = self.values(starts[k, row : row + 1], properties[k][1] or "")[0]
                    lengths[k, row] = max(int(count_of), 0)
                    at += int(lengths[k, row]) * inner[k]
            if at > end:
                raise truncated
        self.at, columns = at if any(inner) else at + count * sum(widths), {}
        if starts.max(initial=0) >= max(len(self.items), 1):
            raise truncated
        for k, (key, length, kind) in enumerate(properties):
            if length is None:
                columns[key] = self.values(starts[k], kind)
                continue
            # within: the place of each value in its own list, 0, 1, …
            within = np.arange(lengths[k].sum()) - np.repeat(np.cumsum(lengths[k]) - lengths[k], lengths[k])
            places = np.repeat(starts[k] + widths[k], lengths[k]) + within * inner[k]
            columns[key] = lengths[k], self.values(places, kind)
        return columns
