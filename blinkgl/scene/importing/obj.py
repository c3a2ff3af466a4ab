"""Reader of Wavefront OBJ and MTL files.

A corner has a position, a texture coordinate and a normal of its own (v/vt/vn); indices count from 1, negative ones
back from their line. Reference: Alias Wavefront's "Object Files" and "MTL material format", and, for colours of
vertices, what MeshLab and Blender write.
"""

from __future__ import annotations

import math
import os
import re
from array import array
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.importing.parts import INVISIBLE, RawMesh
from blinkgl.scene.importing.polygons import Polygons, beside, raw_meshes, texture_of
from blinkgl.scene.reading import Omissions, contents
from blinkgl.scene.types import REPEAT, Material, Wrap
from blinkgl.srgb import linear_from_srgb

_WITHOUT_EFFECT = (
    "o g mg vp bevel c_interp d_interp lod maplib cstype deg bmat step parm trim hole scrv sp end con".split()
)
_NOT_DRAWN = {"p": "points and lines", "l": "points and lines"}
_NOT_DRAWN |= dict.fromkeys(("curv", "curv2", "surf"), "curves and curved surfaces")
_MAPS = dict.fromkeys(("map_bump", "bump", "norm"), "normal maps") | {"map_ke": "emissive light"}
_MAPS |= dict.fromkeys(("map_ks", "map_pr", "map_pm"), "shine (drawn matt)") | {"map_d": "transparency (drawn opaque)"}
# A '#' begins a comment only at the start of a line or after a blank, since names of files may contain one.
_COMMENT = re.compile(r"(?:^|\s)#")
_FLOAT = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OPTION = re.compile(
    r"(?:-(?:blendu|blendv|cc|boost|texres|clamp|bm|imfchan|type|colorspace)\s+\S+|-mm\s+\S+\s+\S+"
    rf"|-[ost](?:\s+{_FLOAT}(?=\s)){{1,3}})\s+",
    re.IGNORECASE,
)
"""An option before the name of a texture, with its values."""


@dataclass
class _Statements:
    """What the lines of a file say. tables : numbers of v, vt and vn, one row after the other, and how many each row
    has.   distinct : corners as three indices from 0, -1 for none.   used : numbers of all faces' corners.   faces :
    line, corners, material and smoothing group (0: off) of each face.   materials : numbers of names.   libraries :
    names and lines of MTL files.   grouped : whether it says ``s``."""

    tables: dict[str, tuple[array, array]] = field(
        default_factory=lambda: {key: (array("d"), array("q")) for key in ("v", "vt", "vn")}
    )
    distinct: array = field(default_factory=lambda: array("q"))
    used: array = field(default_factory=lambda: array("q"))
    faces: array = field(default_factory=lambda: array("q"))
    materials: dict[str, int] = field(default_factory=dict)
    libraries: list[tuple[str, int]] = field(default_factory=list)
    grouped: bool = False


def read_obj(
    path: Path, data: bytes, max_faces: int, max_texture: int | None, omissions: Omissions, log: list[str]
) -> list[RawMesh]:
    """Return raw meshes, one for each material.

    max_texture : None leaves materials out.   omissions, log : get what is not drawn, and what was decided.
    Raises AssetError with file and line: indices that do not exist, coordinates that are not numbers, too many faces,
    materials and textures outside the file's folder."""
    where = str(path)
    said = _statements(data, where, omissions)
    # Four numbers a face, as _statements appends them; ``sizes`` are the corners of each face.
    lines, sizes, surfaces, smoothing = np.array(said.faces).reshape(-1, 4).T
    # Each distinct v/vt/vn is parsed once; ``used`` repeats them for the corners of all faces.
    index = np.array(said.distinct).reshape(-1, 3)[np.array(said.used, np.int64)]
    tables = [_rows(*table, width) for table, width in zip(said.tables.values(), (6, 2, 3), strict=True)]
    for k, table in enumerate(tables):
        # k is 0 for positions, 1 for texture coordinates, 2 for normals. A table of length 1 has only the NaN row that
        # _rows appends, which index -1 selects.
        if k and len(table) == 1 and (index[:, k] >= 0).any():
            log.append(
                f"{path.stem}: faces have {('texture coordinates', 'normals')[k - 1]} of which the file has none"
            )
            index[:, k] = -1
        if len(wrong := np.flatnonzero(index[:, k] >= len(table) - 1)):
            line = np.repeat(lines, sizes)[wrong[0]]
            raise _beyond(index[wrong[0], k] + 1, len(table) - 1, f"{where}, line {line}")
    vertices, uvs, normals = tables
    uvs, materials, colours = uvs[index[:, 1]], [None], None
    if max_texture is not None:
        found = _materials(path, said.libraries, said.materials, max_texture, omissions, log)
        materials = [found[name][0] for name in said.materials]
        scale, offset = (np.array([one[k] for one in found.values()])[np.repeat(surfaces, sizes)] for k in (1, 2))
        uvs = uvs * scale + offset
        # Colours are three numbers after x, y and z; they are used only where every vertex has them.
        if set(said.tables["v"][1]) == {6}:
            colours = linear_from_srgb(np.clip(np.nan_to_num(vertices[index[:, 0], 3:]), 0, 1))
    surfaces, groups = (surfaces if max_texture is not None else surfaces * 0), smoothing if said.grouped else None
    given = Polygons(vertices[:-1, :3], index[:, 0], sizes, uvs, normals[index[:, 2]], colours, surfaces, groups, lines)
    return raw_meshes(given, materials, max_faces, where, log)


def _rows(values: array, counts: array, width: int) -> np.ndarray:
    """Return (n + 1, width) numbers, 0 where a row has fewer; the last row, of corners without any, is NaN."""
    numbers, have = np.array(values), np.array(counts, np.int64)
    # starts: index in ``numbers`` of the first number of each row.
    rows, starts = np.zeros((len(have) + 1, width)), np.cumsum(have) - have
    for k in range(width):
        rows[:-1][have > k, k] = numbers[starts[have > k] + k]
    rows[-1] = np.nan
    return rows


def _lines(data: bytes) -> Iterator[tuple[int, str, str]]:
    """Return (number, key, rest) of each line; a line that ends with a backslash goes on in the next one."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        # Older exporters write no UTF-8; Latin-1 decodes any byte.
        text = data.decode("latin-1")
    begun = ""
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        words = (begun + line if begun else line).split(None, 1)
        begun = ""
        if words and words[0][0] != "#":
            yield number, words[0], words[1].rstrip() if len(words) > 1 else ""


def _statements(data: bytes, where: str, omissions: Omissions) -> _Statements:
    said, material, smoothing = _Statements(), "", 0
    known: dict[str, int] = {}
    for line, key, rest in _lines(data):
        if key in said.tables:
            row = _numbers(rest, 1 if key == "vt" else 3, where, line)
            values, counts = said.tables[key]
            values.extend(row)
            counts.append(len(row))
        elif key in ("f", "fo"):
            # ``fo`` is an older form of ``f``.
            words = (_COMMENT.split(rest)[0] if "#" in rest else rest).split()
            for word in words:
                if (number := known.get(word)) is None:
                    number = len(said.distinct) // 3
                    said.distinct.extend(_corner(word, said.tables, f"{where}, line {line}"))
                    if "-" not in word:  # what a relative index means depends on its line
                        known[word] = number
                said.used.append(number)
            surface = said.materials.setdefault(material, len(said.materials))
            said.faces.extend((line, len(words), surface, smoothing))
        elif key == "usemtl":
            material = rest
        elif key == "s":
            # "s off" switches smoothing off, as "s 0" does; anything else that is no number counts as off, too.
            smoothing, said.grouped = int(rest) if re.fullmatch(r"\d{1,9}", rest) else 0, True
        elif key == "mtllib":
            said.libraries.append((rest, line))
        elif key in _NOT_DRAWN:
            omissions.add(_NOT_DRAWN[key])
        elif key not in _WITHOUT_EFFECT:
            omissions.add("statements that OBJ does not know")
    if not said.faces:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    return said


def _numbers(text: str, least: int, where: str, line: int) -> list[float]:
    try:
        row = list(map(float, text.split()))
    except ValueError:  # a comment, or such as 1.#IND of old C libraries
        text = _COMMENT.split(text)[0]
        row = [float(word) if re.fullmatch(_FLOAT, word) else math.nan for word in text.split()]
    if len(row) < least:
        raise AssetError(
            "numbers are missing, or are none",
            where=f"{where}, line {line}",
            value=text[:40],
            accepted=f"at least {least} number{'s' if least > 1 else ''}",
        )
    return row


def _corner(word: str, tables: dict[str, tuple[array, array]], where: str) -> list[int]:
    """Return the indices of a corner from 0, -1 for what it has not. Those of later lines are checked at the end."""
    out = [-1, -1, -1]
    for k, (part, (_, table)) in enumerate(zip(word.split("/"), tables.values(), strict=False)):
        if not part and k > 0:
            continue
        if not re.fullmatch(r"-?\d+", part):
            raise AssetError("a face is corrupt", where=where, value=word[:40], accepted="v, v/vt, v//vn, v/vt/vn")
        # A word of so many digits may exceed int64; 0 is no index and is refused below.
        index = int(part) if len(part) < 18 else 0
        # A negative index counts back from the last row before this line.
        out[k] = index - 1 if index > 0 else len(table) + index
        if index == 0 or out[k] < 0:
            raise _beyond(part, len(table), where)
    return out


def _beyond(given: object, count: int, where: str) -> AssetError:
    accepted = f"1 to {count}, or -1 to -{count}" if count else "a file with such vertices"
    problem = "a face refers to a vertex that does not exist"
    return AssetError(problem, where=where, value=str(given)[:20], accepted=accepted)


# ---- MTL
_Entry = tuple[str, str, int]
"""The rest of a line of an MTL file, the file and the line."""
_Surface = tuple[Material | None, np.ndarray, np.ndarray]
"""A material, and the scale and offset of its texture coordinates."""


def _materials(path: Path, libraries, names, max_texture: int, omissions: Omissions, log) -> dict[str, _Surface]:
    """Return the materials of these ``names``. Raises AssetError for files outside the folder."""
    entries: dict[str, dict[str, _Entry]] = {}
    for given, line in dict(libraries).items():
        # A name may have blanks, and a line may have several names.
        whole = (path.parent / given.replace("\\", "/")).is_file()
        for name in [given] if whole else re.split(r"(?<!\\)\s+", given):
            name = name.replace("\\ ", " ")
            file, own = beside(path.parent, "", name, f"{path}, line {line}", omissions), {}
            for number, key, rest in () if file is None else _lines(contents(file, "material")):
                if key == "newmtl":
                    own = entries.setdefault(rest, {})
                else:
                    own[key.lower()] = rest, str(file), number
    found: dict[str, _Surface] = {}
    for name in names:
        if name and name not in entries and entries:
            omissions.add(f"the material '{name}', which no MTL file has")
        plain = None, np.ones(2), np.zeros(2)
        found[name] = _surface(path, name, entries[name], max_texture, omissions, log) if name in entries else plain
    return found


def _surface(path: Path, name: str, entries: dict[str, _Entry], max_texture, omissions, log) -> _Surface:
    for key in (key for key in entries if key in _MAPS):
        omissions.add(_MAPS[key])
    numbers = {}
    for key in (key for key in ("d", "tr") if key in entries):
        rest, file, line = entries[key]
        # With -halo the opacity depends on the viewing angle; its factor is taken as a plain opacity.
        numbers[key] = _numbers(rest.removeprefix("-halo"), 1, file, line)[0]
    # Tr is 1 - d by some exporters and d by others: it hides nothing.
    opacity, scale, offset = numbers.get("d", 0.5 if 0 < numbers.get("tr", 1) < 1 else 1), np.ones(2), np.zeros(2)
    if opacity < 1:
        omissions.add(f"the material '{name}' of opacity 0" if opacity <= 0 else "transparency (drawn opaque)")
    if opacity <= 0:
        return INVISIBLE, scale, offset
    material = Material(base_color=_colour(*entries.get("kd", ("1", "", 0)), omissions))
    if "map_kd" in entries:
        (rest, file, line), settings = entries["map_kd"], {}
        # Options stand before the name of the file; each one found is cut off the front.
        while option := _OPTION.match(rest):
            key, *settings[key.lower()] = option[0].split()
            rest = rest[option.end() :]
        # -s is the scale and -o the offset; what they leave out keeps its default.
        for key, values in (("-s", scale), ("-o", offset)):
            values[:] = [*map(float, settings.pop(key, ())), *values][:2]
        wrap: tuple[Wrap, Wrap] = ("clamp", "clamp") if settings.pop("-clamp", []) == ["on"] else REPEAT
        if settings:
            omissions.add("options of textures: " + ", ".join(settings))
        inner = os.path.relpath(os.path.dirname(file), path.parent)
        if (image := beside(path.parent, inner, rest, f"{file}, line {line}", omissions)) is not None:
            material = replace(material, texture=texture_of(image, max_texture), wrap=wrap)
            # A grey other than white: three equal numbers that are not 1.
            if len(set(material.base_color)) == 1 != material.base_color[0]:
                # Exporters write a grey that no one chose beside a texture; a colour is a choice.
                log.append(f"{path.stem}: the grey Kd of '{name}' does not darken its texture")
                material = replace(material, base_color=(1.0, 1.0, 1.0))
    return material, scale, offset


def _colour(rest: str, file: str, line: int, omissions: Omissions) -> tuple[float, float, float]:
    """Return the linear colour of a Kd: an sRGB code, or one number for a grey."""
    if rest.startswith(("spectral", "xyz")):
        omissions.add("colours given as a spectrum or as XYZ (drawn white)")
        return 1.0, 1.0, 1.0
    code = _numbers(rest, 1, file, line)
    r, g, b = linear_from_srgb(np.clip(np.nan_to_num(code[:3] if len(code) > 2 else code[:1] * 3), 0, 1)).tolist()
    return r, g, b
