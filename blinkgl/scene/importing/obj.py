"""Reader of Wavefront OBJ and MTL files.

A corner has a position, a texture coordinate and a normal of its own (v/vt/vn); indices count from 1, negative ones
back from their line. Reference: Alias Wavefront's "Object Files" and "MTL material format", and, for colours of
vertices, what MeshLab and Blender write.
"""

from __future__ import annotations

import io
import math
import re
from array import array
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from blinkgl.errors import AssetError
from blinkgl.scene.importing.neighbours import Neighbours
from blinkgl.scene.importing.parts import INVISIBLE, RawMesh
from blinkgl.scene.importing.polygons import Polygons, linear_colours, raw_meshes, texture_beside
from blinkgl.scene.reading import Omissions, contents
from blinkgl.scene.types import REPEAT, Material, Wrap

_WITHOUT_EFFECT = (
    "o g mg vp mtllib bevel c_interp d_interp lod maplib cstype deg bmat step parm trim hole scrv sp end con".split()
)
_NOT_DRAWN = {"p": "points and lines", "l": "points and lines"}
_NOT_DRAWN |= dict.fromkeys(("curv", "curv2", "surf"), "curves and curved surfaces")
_SHINE, _CLEAR, _EMISSIVE = "shine (drawn matt)", "transparency (drawn opaque)", "emissive light"
# What the statements of MTL are, by their names in lower case; "" has no effect on what is drawn.
_MTL: dict[str, str] = dict.fromkeys("kd d tr map_kd ka map_ka ns ni illum sharpness tf map_aat pr pcr".split(), "")
_MTL |= dict.fromkeys(("map_bump", "bump", "norm"), "normal maps") | {"map_ke": _EMISSIVE, "disp": "displacement maps"}
_MTL |= dict.fromkeys("map_ks map_ns map_pr map_pm map_ps map_pc refl aniso anisor".split(), _SHINE)
_MTL |= dict.fromkeys(("map_d", "map_tr", "map_opacity"), _CLEAR) | {"decal": "decals"}
# Those that count where a number of them is above 0.
_STRENGTHS = dict.fromkeys(("ks", "pm", "ps", "pc"), _SHINE) | {"ke": _EMISSIVE}
# A '#' begins a comment only at the start of a line or after a blank, since names of files may contain one.
_COMMENT = re.compile(r"(?:^|\s)#")
_FLOAT = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
# An option beside the name of a texture, with its values.
_OPTION = re.compile(
    r"(?:-(?:blendu|blendv|cc|boost|texres|clamp|bm|imfchan|type|colorspace)\s+\S+|-mm\s+\S+\s+\S+"
    rf"|-[ost](?:\s+{_FLOAT}(?=\s)){{1,3}})\s+",
    re.IGNORECASE,
)
_BEHIND = re.compile(
    r"\s+(?=-(?:blend[uv]|cc|boost|texres|clamp|bm|imfchan|type|colorspace|mm|[ost])\s)", re.IGNORECASE
)


@dataclass
class _Statements:
    """What the lines of a file say. tables : numbers of v, vt and vn, one row after the other, and how many each row
    has.   distinct : corners as three indices from 0, -1 for none.   used : numbers of all faces' corners.   faces :
    line, corners, material and smoothing group (0: off) of each face.   materials : numbers of names.   grouped :
    whether it says ``s``."""

    tables: dict[str, tuple[array, array]] = field(
        default_factory=lambda: {key: (array("d"), array("q")) for key in ("v", "vt", "vn")}
    )
    distinct: array = field(default_factory=lambda: array("q"))
    used: array = field(default_factory=lambda: array("q"))
    faces: array = field(default_factory=lambda: array("q"))
    materials: dict[str, int] = field(default_factory=dict)
    grouped: bool = False


def read_obj(data: bytes, near: Neighbours, max_faces: int, max_texture: int | None) -> list[RawMesh]:
    """Return raw meshes, one for each material. ``near`` gets what is not drawn, and what was decided.

    max_texture : None leaves materials out. Raises AssetError with file and line: indices that do not exist,
    coordinates that are not numbers, too many faces."""
    polygons, materials = _polygons(data, near, max_texture)
    return raw_meshes(polygons, materials, max_faces, str(near.path), near.log)


def _polygons(data: bytes, near: Neighbours, max_texture: int | None) -> tuple[Polygons, list[Material | None]]:
    """Return the polygons of an OBJ file, and their materials by their numbers."""
    path, log, where = near.path, near.log, str(near.path)
    statements = _statements(data, where, near.omissions)
    # Four numbers a face, as _statements appends them; ``sizes`` are the corners of each face.
    lines, sizes, surfaces, smoothing = np.array(statements.faces).reshape(-1, 4).T
    # Each distinct v/vt/vn is parsed once; ``used`` repeats them for the corners of all faces.
    index = np.array(statements.distinct).reshape(-1, 3)[np.array(statements.used, np.int64)]
    tables = [_rows(*table, width) for table, width in zip(statements.tables.values(), (7, 2, 3), strict=True)]
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
    vertices, coordinates, directions = tables
    uvs, normals = (None if len(table) == 1 else table[index[:, k]] for k, table in ((1, coordinates), (2, directions)))
    at, colours = index[:, 0].copy(), None
    materials: list[Material | None] = [None]
    del index
    if max_texture is not None:
        worn = _materials(data, near, statements.materials, max_texture)
        materials = [material for material, _, _ in worn]
        if uvs is not None:
            scale, offset = (np.array([one[k] for one in worn])[np.repeat(surfaces, sizes)] for k in (1, 2))
            uvs = uvs * scale + offset
        # Colours, and their opacity, stand behind x, y and z.
        have = np.array(statements.tables["v"][1])
        if (have >= 6).any():
            codes = np.where((have >= 6)[:, None], vertices[:-1, 3:6], np.nan)
            colours = linear_colours(codes, near, None, vertices[:-1][have >= 7, 6])[at]
    polygons = Polygons(
        points=vertices[:-1, :3],
        places=at,
        sizes=sizes,
        uvs=uvs,
        normals=normals,
        colours=colours,
        surfaces=surfaces if max_texture is not None else surfaces * 0,
        smoothing=smoothing if statements.grouped else None,
        lines=lines,
    )
    return polygons, materials


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
    encoding = "utf-8-sig"
    try:
        data.decode(encoding)
    except UnicodeDecodeError:
        encoding = "latin-1"  # older exporters write no UTF-8; Latin-1 decodes any byte
    begun = ""
    # Line by line, since the lines of a large file take several times its size.
    for number, line in enumerate(io.TextIOWrapper(io.BytesIO(data), encoding), 1):
        if line.endswith(("\\\n", "\\")):
            begun += line.rstrip("\n")[:-1] + " "
            continue
        words = (begun + line if begun else line).split(None, 1)
        begun = ""
        if words and words[0][0] != "#":
            yield number, words[0], words[1].rstrip() if len(words) > 1 else ""


def _statements(data: bytes, where: str, omissions: Omissions) -> _Statements:
    statements, material, smoothing = _Statements(), "", 0
    known: dict[str, int] = {}
    unknown: dict[str, None] = {}
    for line, key, rest in _lines(data):
        if key in statements.tables:
            row = _numbers(rest, 1 if key == "vt" else 3, where, line)
            values, counts = statements.tables[key]
            values.extend(row)
            counts.append(len(row))
        elif key in ("f", "fo"):
            # ``fo`` is an older form of ``f``.
            words = (_COMMENT.split(rest)[0] if "#" in rest else rest).split()
            for word in words:
                if word not in known or "-" in word:  # what a relative index means depends on its line
                    known[word] = len(statements.distinct) // 3
                    statements.distinct.extend(_corner(word, statements.tables, f"{where}, line {line}"))
                statements.used.append(known[word])
            surface = statements.materials.setdefault(material, len(statements.materials))
            statements.faces.extend((line, len(words), surface, smoothing))
        elif key == "usemtl":
            material = rest
        elif key == "s":
            # "s off" switches smoothing off, as "s 0" does; anything else that is no number counts as off, too.
            smoothing, statements.grouped = int(rest) if re.fullmatch(r"\d{1,9}", rest) else 0, True
        elif key in _NOT_DRAWN:
            omissions.add(_NOT_DRAWN[key])
        elif key not in _WITHOUT_EFFECT:
            unknown[key[:20]] = None
    omissions.unknown("statements of OBJ", unknown)
    if not statements.faces:
        raise AssetError("the file has no faces", where=where, accepted="a mesh with triangles")
    return statements


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
        if not part.removeprefix("-").isdecimal():
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
# The rest of a line of an MTL file, the file and the line.
_Entry = tuple[str, str, int]
# A material, and the scale and offset of its texture coordinates.
_Surface = tuple[Material | None, np.ndarray, np.ndarray]
_PLAIN: _Surface = None, np.ones(2), np.zeros(2)


def files_of_obj(data: bytes, near: Neighbours) -> Iterator[tuple[str, Path | None]]:
    """Yield the names in an OBJ file, and in its MTL files, of files that may be read, and what is there."""
    entries: dict[str, dict[str, _Entry]] = {}
    yield from _libraries(data, near, entries)
    for own in entries.values():
        if (entry := own.get("map_kd", own.get("map_ka"))) is not None:
            yield entry[0], _picture(entry, near)[0]


def _libraries(
    data: bytes, near: Neighbours, entries: dict[str, dict[str, _Entry]]
) -> Iterator[tuple[str, Path | None]]:
    """Yield the names and files of an OBJ's MTL files, whose materials go into ``entries``."""
    if b"\\\n" in data or b"\\\r" in data:
        data = re.sub(rb"\\(?:\r\n|\r|\n)", b" ", data)
    statements = re.finditer(rb"mtllib[ \t]+[^\r\n]+", data)
    # Those that begin their line: no other statement or comment stands before them.
    ahead = lambda m: re.split(rb"[\r\n]", data[max(m.start() - 99, 0) : m.start()])[-1]
    for line in dict.fromkeys(m[0] for m in statements if not ahead(m).strip(b"\xef\xbb\xbf \t")):
        ((_, _, rest),) = _lines(line)
        # A name may have blanks, and a line may have several names.
        plain = _COMMENT.split(rest)[0].rstrip()
        whole = Neighbours(near.path, near.border, log=near.log).optional((rest, plain))
        # A blank behind a backslash belongs to the name.
        parts = [part.replace("\\ ", " ") for part in re.split(r"(?<!\\)\s+", plain)]
        for name, file in [(plain, whole)] if whole else [(part, near.optional((part,))) for part in parts]:
            own: dict[str, _Entry] = {}
            yield name, file
            for number, key, rest in () if file is None else _lines(contents(file, "material")):
                if key.lower() == "newmtl":
                    own = entries.setdefault(rest, {})
                else:
                    own[key.lower()] = rest, str(file), number


def _materials(data: bytes, near: Neighbours, names: Iterable[str], max_texture: int) -> list[_Surface]:
    """Return the materials of these ``names``."""
    entries: dict[str, dict[str, _Entry]] = {}
    missing = [name for name, file in _libraries(data, near, entries) if file is None]
    # A name that differs in case or spaces alone is taken, if there is only one such.
    alike: dict[str, list[str]] = {}
    for entry in entries:
        alike.setdefault(_bare(entry), []).append(entry)
    worn: list[_Surface] = []
    unknown: dict[str, None] = {}
    for name in names:
        same = [name] if name in entries else alike.get(_bare(name), [])
        key = same[0] if len(same) == 1 else None
        if key != name and key is not None:
            near.log.append(f"{near.path.stem}: the material '{name}' is taken as '{key}'")
        # Exporters of one material leave usemtl out.
        if not name and len(entries) == 1 and names == {"": 0}:
            (key,) = entries
            near.log.append(
                f"{near.path.stem}: it has no usemtl, so the only material of its MTL file is used: '{key}'"
            )
        elif not name and entries:
            near.omissions.add(f"one of {len(entries)} materials, since faces have no usemtl (drawn without)")
        elif name and key is None and not missing:
            near.omissions.add(f"the material '{name}', which no MTL file has")
        worn.append(_PLAIN if key is None else _surface(key, entries[key], near, max_texture, unknown))
    near.omissions.unknown("statements of MTL", unknown)
    return worn


def _bare(name: str) -> str:
    """Return the name of a material without the comment behind it, in lower case."""
    return _COMMENT.split(name)[0].rstrip().casefold()


def _surface(
    name: str, entries: dict[str, _Entry], near: Neighbours, max_texture: int, unknown: dict[str, None]
) -> _Surface:
    for key, (rest, file, line) in entries.items():
        strong = key in _STRENGTHS and max(_numbers(rest or "0", 1, file, line)) > 0
        if strong and not (key == "ks" and entries.get("illum", ("",))[0] in ("0", "1")):  # models without highlights
            near.omissions.add(_STRENGTHS[key])
        elif key not in _MTL and key not in _STRENGTHS:
            unknown[key[:20]] = None
        elif _MTL.get(key):
            near.omissions.add(_MTL[key])
    # With -halo the opacity depends on the viewing angle; its factor is taken as a plain opacity.
    stated = {key: entries[key] for key in ("d", "tr") if key in entries}
    numbers = {
        key: _numbers(rest.removeprefix("-halo"), 1, file, line)[0] for key, (rest, file, line) in stated.items()
    }
    # Tr is 1 - d by some exporters and d by others: it hides nothing.
    opacity, scale, offset = numbers.get("d", 0.5 if 0 < numbers.get("tr", 1) < 1 else 1), np.ones(2), np.zeros(2)
    if opacity < 1:
        near.omissions.add(f"the material '{name}' of opacity 0" if opacity <= 0 else _CLEAR)
    if opacity <= 0:
        return INVISIBLE, scale, offset
    material = Material(base_color=_colour(*entries.get("kd", ("1", "", 0)), near))
    if (entry := entries.get("map_kd", entries.get("map_ka"))) is not None:
        image, settings = _picture(entry, near)
        # -s is the scale and -o the offset; what they leave out keeps its default.
        for key, values in (("-s", scale), ("-o", offset)):
            values[:] = [*map(float, settings.pop(key, ())), *values][:2]
        wrap: tuple[Wrap, Wrap] = ("clamp", "clamp") if settings.pop("-clamp", []) == ["on"] else REPEAT
        if settings:
            near.omissions.add("options of textures: " + ", ".join(settings))
        if (texture := texture_beside(image, max_texture, near.omissions)) is not None:
            material = replace(material, texture=texture, wrap=wrap)
            if "map_kd" not in entries:
                near.log.append(f"{near.path.stem}: '{name}' has a map_Ka and no map_Kd: it is taken as the colour")
            # A grey other than white: three equal numbers that are not 1.
            if len(set(material.base_color)) == 1 != material.base_color[0]:
                # Exporters write a grey that no one chose beside a texture; a colour is a choice.
                near.log.append(f"{near.path.stem}: the grey Kd of '{name}' does not darken its texture")
                material = replace(material, base_color=(1.0, 1.0, 1.0))
    return material, scale, offset


def _picture(entry: _Entry, near: Neighbours) -> tuple[Path | None, dict[str, list[str]]]:
    """Return the file that the rest of a line names, None where it is missing, and the options beside the name."""
    settings: dict[str, list[str]] = {}
    plain = _COMMENT.split(entry[0])[0].rstrip()
    name, *behind = _BEHIND.split(_options(plain, settings))
    # A file may have blanks, a '#' or what looks like an option in its name.
    image = near.optional((_options(entry[0], {}), _options(plain, {}), name), Path(entry[1]).parent)
    _options(" ".join([*behind, ""]), settings)
    return image, settings


def _options(text: str, settings: dict[str, list[str]]) -> str:
    """Return a text without the options at its beginning, which go into ``settings``."""
    while option := _OPTION.match(text):
        key, *settings[key.lower()] = option[0].split()
        text = text[option.end() :]
    return text


def _colour(rest: str, file: str, line: int, near: Neighbours) -> tuple[float, float, float]:
    """Return the linear colour of a Kd: an sRGB code, or one number for a grey."""
    if rest.startswith(("spectral", "xyz")):
        near.omissions.add("colours given as a spectrum or as XYZ (drawn white)")
        return 1.0, 1.0, 1.0
    code = _numbers(rest, 1, file, line)
    r, g, b = linear_colours(np.array([code[:3] if len(code) > 2 else code[:1] * 3], np.float64), near)[0].tolist()
    return r, g, b
