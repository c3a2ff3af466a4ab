"""Reader of Wavefront OBJ and MTL files.

A corner has a position, a texture coordinate and a normal of its own (v/vt/vn); indices count from 1, negative ones
back from their line. Reference: Alias Wavefront's "Object Files" and "MTL material format", and, for colours of
vertices, what MeshLab and Blender write.
"""

from __future__ import annotations

import math
import os
import re
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
_COMMENT = re.compile(r"(?:^|\s)#")
_FLOAT = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_OPTION = re.compile(
    rf"(?:-(?:blendu|blendv|cc|boost|texres|clamp|bm|imfchan|type|colorspace)\s+\S+|-mm\s+\S+\s+\S+|-[ost](?:\s+{_FLOAT}(?=\s)){{1,3}})\s+",
    re.IGNORECASE,
)
"""An option before the name of a texture, with its values."""


@dataclass
class _Statements:
    """What the lines of a file say. tables : rows of v, vt and vn.   distinct : the corners, as indices from 0, -1 for
    none, and their numbers.   used : numbers of all faces' corners.   faces : line, corners, material and smoothing
    group (0: off) of each face.   libraries : names and lines of MTL files.   grouped : whether it says ``s``."""

    tables: dict[str, list[list[float]]] = field(default_factory=lambda: {"v": [], "vt": [], "vn": []})
    distinct: dict[tuple[int, ...], int] = field(default_factory=dict)
    used: list[int] = field(default_factory=list)
    faces: list[tuple[int, int, str, int]] = field(default_factory=list)
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
    lines, sizes, names, smoothing = zip(*said.faces, strict=True)
    sizes = np.array(sizes)
    index = np.array(list(said.distinct)).reshape(-1, 3)[said.used]
    line_of = np.repeat(lines, sizes)
    corners = []
    for k, (width, table) in enumerate(zip((0, 2, 3), said.tables.values(), strict=True)):
        if k and not table and (index[:, k] >= 0).any():
            log.append(
                f"{path.stem}: faces have {('texture coordinates', 'normals')[k - 1]} of which the file has none"
            )
            index[:, k] = -1
        if len(wrong := np.flatnonzero(index[:, k] >= len(table))):
            raise _beyond(index[wrong[0], k] + 1, len(table), f"{where}, line {line_of[wrong[0]]}")
        # The last row is that of corners that have none.
        if width:
            corners.append(np.array([*((*row, 0.0)[:width] for row in table), (np.nan,) * width])[index[:, k]])
    numbers = {name: k for k, name in enumerate(dict.fromkeys(names) if max_texture is not None else [""])}
    surfaces = np.array([numbers.get(name, 0) for name in names])
    materials: list[Material | None] = [None]
    if max_texture is not None:
        found = _materials(path, said.libraries, numbers, max_texture, omissions, log)
        materials = [found[name][0] for name in numbers]
        scale, offset = (np.array([found[name][k] for name in numbers])[np.repeat(surfaces, sizes)] for k in (1, 2))
        corners[0] = corners[0] * scale + offset
    colours, vertices = None, said.tables["v"]
    if max_texture is not None and all(len(row) >= 6 for row in vertices):
        colours = linear_from_srgb(np.clip(np.nan_to_num([row[3:6] for row in vertices]), 0, 1))[index[:, 0]]
    points = np.array([row[:3] for row in vertices])
    groups = np.array(smoothing) if said.grouped else None
    uvs, normals = corners
    given = Polygons(points, index[:, 0], sizes, uvs, normals, colours, surfaces, groups, np.array(lines))
    return raw_meshes(given, materials, max_faces, where, log)


def _lines(data: bytes) -> Iterator[tuple[int, str, str]]:
    """Return (number, key, rest) of each line; a line that ends with a backslash goes on in the next one."""
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = data.decode("latin-1")
    begun = ""
    for number, line in enumerate(re.split(r"\r\n|\n|\r", text), 1):
        if line.endswith("\\"):
            begun += line[:-1] + " "
            continue
        key, _, rest = (begun + line).strip().replace("\t", " ").partition(" ")
        begun = ""
        if key and not key.startswith("#"):
            yield number, key, rest.strip()


def _statements(data: bytes, where: str, omissions: Omissions) -> _Statements:
    said, material, smoothing, unknown = _Statements(), "", 0, {}
    tables, known = said.tables, {}
    for line, key, rest in _lines(data):
        if key in tables:
            tables[key].append(_numbers(_COMMENT.split(rest)[0], 1 if key == "vt" else 3, f"{where}, line {line}"))
        elif key in ("f", "fo"):
            words = _COMMENT.split(rest)[0].split()
            for word in words:
                if (number := known.get(word)) is None:
                    corner = _corner(word, tables, f"{where}, line {line}")
                    number = said.distinct.setdefault(corner, len(said.distinct))
                    if "-" not in word:  # what a relative index means depends on its line
                        known[word] = number
                said.used.append(number)
            said.faces.append((line, len(words), material, smoothing))
        elif key == "usemtl":
            material = rest
        elif key == "s":
            smoothing, said.grouped = int(rest) if re.fullmatch(r"\d{1,9}", rest) else 0, True
        elif key == "mtllib":
            said.libraries.append((rest, line))
        elif key in _NOT_DRAWN:
            omissions.add(_NOT_DRAWN[key])
        elif key not in _WITHOUT_EFFECT:
            unknown[key[:20]] = None
    if unknown:
        omissions.add("unknown statements: " + ", ".join(list(unknown)[:5]) + (", …" if len(unknown) > 5 else ""))
    if not said.faces:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    return said


def _numbers(text: str, least: int, where: str) -> list[float]:
    try:
        row = list(map(float, text.split()))
    except ValueError:  # such as 1.#IND of old C libraries
        row = [float(word) if re.fullmatch(_FLOAT, word) else math.nan for word in text.split()]
    if len(row) < least:
        accepted = f"at least {least} number{'s' if least > 1 else ''}"
        raise AssetError("numbers are missing, or are none", where=where, value=text[:40], accepted=accepted)
    return row


def _corner(word: str, tables: dict[str, list[list[float]]], where: str) -> tuple[int, ...]:
    """Return the indices of a corner from 0, -1 for what it has not. Those of later lines are checked at the end."""
    out = [-1, -1, -1]
    for k, (part, table) in enumerate(zip(word.split("/"), tables.values(), strict=False)):
        if not part and k > 0:
            continue
        if not re.fullmatch(r"-?\d+", part):
            raise AssetError("a face is corrupt", where=where, value=word[:40], accepted="v, v/vt, v//vn, v/vt/vn")
        index = int(part) if len(part) < 18 else 0
        out[k] = index - 1 if index > 0 else len(table) + index
        if index == 0 or out[k] < 0:
            raise _beyond(part, len(table), where)
    return tuple(out)


def _beyond(given: object, count: int, where: str) -> AssetError:
    accepted = f"1 to {count}, or -1 to -{count}" if count else "a file with such vertices"
    problem = "a face refers to a vertex that does not exist"
    return AssetError(problem, where=where, value=str(given)[:20], accepted=accepted)


# ---- MTL
_Surface = tuple[Material | None, np.ndarray, np.ndarray]
"""A material, and the scale and offset of its texture coordinates."""


def _materials(path: Path, libraries, names, max_texture: int, omissions: Omissions, log) -> dict[str, _Surface]:
    """Return the materials of these ``names``. Raises AssetError for files outside the folder."""
    entries: dict[str, dict[str, tuple[str, str]]] = {}
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
                    own[key.lower()] = rest, f"{file}, line {number}"
    found: dict[str, _Surface] = {}
    for name in names:
        if name and name not in entries and entries:
            omissions.add(f"the material '{name}', which no MTL file has")
        plain = None, np.ones(2), np.zeros(2)
        found[name] = _surface(path, name, entries[name], max_texture, omissions, log) if name in entries else plain
    return found


def _surface(path: Path, name: str, entries: dict[str, tuple[str, str]], max_texture, omissions, log) -> _Surface:
    for key in (key for key in entries if key in _MAPS):
        omissions.add(_MAPS[key])
    material = Material(base_color=_colour(*entries.get("kd", ("1", "")), omissions))
    scale, offset, settings = np.ones(2), np.zeros(2), {}
    # Tr is 1 - d by some exporters and d by others: it hides nothing.
    rest, where = entries.get("d", ("1", ""))
    opacity = _numbers(rest.removeprefix("-halo"), 1, where)[0]
    if "tr" in entries and "d" not in entries and 0 < _numbers(entries["tr"][0], 1, entries["tr"][1])[0] < 1:
        omissions.add("transparency (drawn opaque)")
    if opacity < 1:
        omissions.add(f"the material '{name}' of opacity 0" if opacity <= 0 else "transparency (drawn opaque)")
    if opacity <= 0:
        return INVISIBLE, scale, offset
    if "map_kd" in entries:
        rest, where = entries["map_kd"]
        while option := _OPTION.match(rest):
            key, *settings[key.lower()] = option[0].split()
            rest = rest[option.end() :]
        for key, numbers in (("-s", scale), ("-o", offset)):
            numbers[:] = [*map(float, settings.pop(key, ())), *numbers][:2]
        wrap: tuple[Wrap, Wrap] = ("clamp", "clamp") if settings.pop("-clamp", []) == ["on"] else REPEAT
        if settings:
            omissions.add("options of textures: " + ", ".join(settings))
        inner = os.path.relpath(os.path.dirname(where.rpartition(", line ")[0]), path.parent)
        if (image := beside(path.parent, inner, rest, where, omissions)) is not None:
            material = replace(material, texture=texture_of(image, max_texture), wrap=wrap)
            if len(set(material.base_color)) == 1 != material.base_color[0]:
                # Exporters write a grey that no one chose beside a texture; a colour is a choice.
                log.append(f"{path.stem}: the grey Kd of '{name}' does not darken its texture")
                material = replace(material, base_color=(1.0, 1.0, 1.0))
    return material, scale, offset


def _colour(rest: str, where: str, omissions: Omissions) -> tuple[float, float, float]:
    """Return the linear colour of a Kd: an sRGB code, or one number for a grey."""
    if rest.startswith(("spectral", "xyz")):
        omissions.add("colours given as a spectrum or as XYZ (drawn white)")
        return 1.0, 1.0, 1.0
    code = _numbers(rest, 1, where)
    r, g, b = linear_from_srgb(np.clip(np.nan_to_num(code[:3] if len(code) > 2 else code[:1] * 3), 0, 1)).tolist()
    return r, g, b
