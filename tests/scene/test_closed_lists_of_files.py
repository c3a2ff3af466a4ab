"""Closed lists at the door of scenes: what each format's description knows is drawn as a formula says, or named in
``not_drawn``; what it does not know is named. Each list below is the format's, not the reader's."""

from __future__ import annotations

import base64
import json
import struct

import numpy as np
import pytest
from PIL import Image

from blinkgl.errors import AssetError
from blinkgl.scene.importing.mesh_files import load_asset
from tests.refusals import refusal
from tests.scene.gltf_files import textured_file, triangle_file

CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)]
SQUARE = "".join(f"v {x} {y} {z}\n" for x, y, z in CORNERS)
RED, ORANGE = (200, 40, 20), (0.8, 0.2, 0.1)


def linear(code):
    """The piecewise curve of IEC 61966-2-1, written out again."""
    code = np.asarray(code, float)
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def load(folder, name, content, **options):
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return load_asset(folder / name, **options)


def colours_of(asset) -> np.ndarray:
    """The linear colour at each corner of every face, textures by their mean."""
    rows = []
    for part in asset.parts:
        base = np.array(part.material.base_color)
        if part.material.texture is not None:
            base = base * linear(part.material.texture.image.reshape(-1, 3).mean(axis=0) / 255)
        own = np.ones((len(part.mesh.vertices), 3)) if part.mesh.colours is None else part.mesh.colours
        rows.append((own * base)[part.mesh.faces.ravel()])
    return np.concatenate(rows)


def said(asset) -> str:
    return " ".join((*asset.omissions, *asset.log))


@pytest.fixture
def folder(tmp_path):
    Image.new("RGB", (4, 4), RED).save(tmp_path / "tex.png")
    return tmp_path


# ---- OBJ and MTL
OBJ = (  # Appendix B1 of Alias|Wavefront's Advanced Visualizer, and its superseded statements
    "v vt vn vp deg bmat step cstype p l f fo curv curv2 surf parm trim hole scrv sp end con g s mg o bevel c_interp "
    "d_interp lod usemtl mtllib usemap maplib shadow_obj trace_obj ctech stech bsp bzp cdc cdp res call csh"
).split()
OBJ_DRAWN = {"v", "vt", "vn", "f", "fo", "s", "usemtl", "mtllib"}
OBJ_EFFECTLESS = {"g", "o", "mg", "vp", "lod", "bevel", "c_interp", "d_interp", "maplib", "cstype", "deg", "bmat"}
OBJ_EFFECTLESS |= {"step", "parm", "trim", "hole", "scrv", "sp", "end", "con"}  # of curves, which are named themselves


@pytest.mark.parametrize("key", [*OBJ, "frobnicate"])
def test_every_statement_of_obj(folder, key):
    plain = load(folder, "plain.obj", SQUARE + "f 1 2 3 4\n")
    rest = {"f": "1 2 3", "fo": "1 2 3", "usemtl": "m", "mtllib": "none.mtl", "s": "1"}.get(key, "1 2 3")
    asset = load(folder, "a.obj", f"{SQUARE}{key} {rest}\nf 1 2 3 4\n")
    if key in OBJ_DRAWN | OBJ_EFFECTLESS:
        expected = {"usemtl": "'m', which no MTL file has", "mtllib": "'none.mtl', which is missing"}.get(key, "")
        assert expected in said(asset) and bool(expected) == bool(asset.omissions)
    else:
        named = {"p": "points and lines", "l": "points and lines"}
        named |= dict.fromkeys(("curv", "curv2", "surf"), "curves and curved surfaces")
        assert named.get(key, f"unknown statements of OBJ ({key})") in asset.omissions[0]
    if key not in ("f", "fo"):
        np.testing.assert_array_equal(asset.parts[0].mesh.faces, plain.parts[0].mesh.faces)


MTL = (  # Ramey, Rose, Tyerman: "MTL material format", and the extension for physically-based rendering
    "Ka Kd Ks Tf illum d Ns sharpness Ni map_Ka map_Kd map_Ks map_Ns map_d disp decal bump map_bump refl map_aat Pr "
    "map_Pr Pm map_Pm Ps map_Ps Pc Pcr Ke map_Ke aniso anisor norm Tr map_Tr map_opacity"
).split()
MTL_NAMED = {"Ks": "shine", "map_Ks": "shine", "map_Ns": "shine", "map_d": "transparency", "d": "transparency"}
MTL_NAMED |= {"disp": "displacement", "decal": "decals", "bump": "normal maps", "map_bump": "normal maps"}
MTL_NAMED |= dict.fromkeys(("map_Pr", "map_Pm", "map_Ps", "Pm", "Ps", "Pc", "aniso", "anisor", "refl"), "shine")
MTL_NAMED |= {"Ke": "emissive", "map_Ke": "emissive", "norm": "normal maps", "Tr": "transparency"}
MTL_NAMED |= {"map_Tr": "transparency", "map_opacity": "transparency"}


@pytest.mark.parametrize("key", [*MTL, "map_frobnicate"])
def test_every_statement_of_mtl(folder, key):
    rest = "tex.png" if key.startswith(("map_", "disp", "decal", "bump", "refl", "norm")) else "0.5 0.5 0.5"
    (folder / "m.mtl").write_text(f"newmtl m\nKd 1 1 1\n{key} {rest}\n")
    text = "mtllib m.mtl\n" + SQUARE + "vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n"
    asset = load(folder, "a.obj", text)
    if key in ("Kd", "map_Kd", "map_Ka"):
        expected = linear([0.5] * 3) if key == "Kd" else linear(np.array(RED) / 255)
        np.testing.assert_allclose(colours_of(asset), np.tile(expected, (6, 1)), atol=3e-3)
        assert not asset.omissions
    elif key in MTL_NAMED:
        assert MTL_NAMED[key] in asset.omissions[0]
    elif key == "map_frobnicate":
        assert "unknown statements of MTL (map_frobnicate)" in asset.omissions[0]
    else:
        assert not asset.omissions  # Ka, Ns, Ni, illum, sharpness, Tf, map_aat, Pr, Pcr: no effect on a matt surface
    assert len(asset.parts) == 1


@pytest.mark.parametrize(
    "name, mtl, use, expected, words",
    [
        ("no usemtl", "newmtl m\nmap_Kd tex.png\n", "", RED, "no usemtl"),
        ("two materials, no usemtl", "newmtl m\nmap_Kd tex.png\nnewmtl n\n", "", (255,) * 3, "one of 2 materials"),
        ("comment behind a material", "newmtl m\nmap_Kd tex.png\n", "usemtl m # body\n", RED, "taken as 'm'"),
        ("comment behind a name", "newmtl m # body\nmap_Kd tex.png\n", "usemtl m\n", RED, ""),
        ("comment behind a texture", "newmtl m\nmap_Kd tex.png # diffuse\n", "usemtl m\n", RED, ""),
        ("options behind", "newmtl m\nmap_Kd tex.png -s 2 2 2 -clamp on\n", "usemtl m\n", RED, ""),
        ("options before", "newmtl m\nmap_Kd -s 2 2 -mm 0 1 tex.png\n", "usemtl m\n", RED, "options of textures: -mm"),
        ("other case of a material", "newmtl Mat\nmap_Kd tex.png\n", "usemtl mat\n", RED, "taken as 'Mat'"),
        ("other case of a texture", "newmtl m\nmap_Kd TEX.Png\n", "usemtl m\n", RED, "is taken from tex.png"),
        ("other case of a statement", "NEWMTL m\nMAP_KD tex.png\n", "usemtl m\n", RED, ""),
        ("tabs", "\tnewmtl m\n\t\tmap_Kd\ttex.png\t\n", "usemtl\tm \n", RED, ""),
        ("quotes", 'newmtl m\nmap_Kd "tex.png"\n', "usemtl m\n", RED, ""),
        ("of Windows", "newmtl m\r\nmap_Kd .\\tex.png\r\n", "usemtl m\r\n", RED, ""),
        (
            "unknown format",
            "newmtl m\nmap_Kd tex.ktx2\n",
            "usemtl m\n",
            (255,) * 3,
            "'tex.ktx2', whose format is not known",
        ),
        ("DirectDraw surface", "newmtl m\nmap_Kd tex.dds\n", "usemtl m\n", RED, ""),
    ],
    ids=lambda value: value if isinstance(value, str) and " " in value and "\n" not in value else "",
)
def test_names_as_people_write_them(folder, name, mtl, use, expected, words):
    (folder / "tex.ktx2").write_bytes(b"\xabKTX 20\xbb\r\n\x1a\n" + b"\0" * 64)
    Image.new("RGB", (4, 4), RED).save(folder / "tex.dds")
    (folder / "m.mtl").write_text(mtl, newline="")
    asset = load(folder, "a.obj", f"mtllib m.mtl # its colours\n{SQUARE}vt 0 0\n{use}f 1/1 2/1 3/1 4/1\n")
    np.testing.assert_allclose(colours_of(asset), np.tile(linear(np.array(expected) / 255), (6, 1)), atol=3e-3)
    assert words in said(asset) and (words or not asset.omissions)


def test_libraries_are_statements_not_words(folder):
    """A byte order mark before ``mtllib``, a comment that has the word, a line that goes on in the next."""
    (folder / "m.mtl").write_text("newmtl m\nmap_Kd tex.png\n")
    face = SQUARE + "vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n"
    for head, found in (("\ufeffmtllib m.mtl\n", True), ("# mtllib m.mtl\n", False), ("mtllib \\\n m.mtl\n", True)):
        asset = load(folder, "a.obj", (head + face).encode())
        assert (asset.parts[0].material.texture is not None) == found
        assert ("'m', which no MTL file has" in said(asset)) != found


@pytest.mark.parametrize(
    "rows, expected, words",
    [
        (["0.8 0.2 0.1"] * 4, [linear(ORANGE)] * 4, ""),
        (["0.8 0.2 0.1 1"] * 4, [linear(ORANGE)] * 4, ""),
        (["0.8 0.2 0.1 0.5"] * 4, [linear(ORANGE)] * 4, "opacity of vertex colours"),
        (["204 51 26"] * 4, [linear(np.array([204, 51, 26]) / 255)] * 4, "taken as parts of 255"),
        (["0.8 0.2 0.1", "", "", ""], [linear(ORANGE), (1, 1, 1), (1, 1, 1), (1, 1, 1)], "3 of 4 colours are missing"),
        (["nan 0 0", "0 1 0", "0 1 0", "0 1 0"], [(1, 1, 1)] + [(0, 1, 0)] * 3, "1 of 4 colours are missing or NaN"),
        (["1.2 0.5 0"] * 4, [linear([1, 0.5, 0])] * 4, "colours up to 1.2 are drawn as 1"),
        (["2.0"] * 4, [(1, 1, 1)] * 4, ""),  # a weight, not a colour
    ],
)
def test_colours_of_obj(folder, rows, expected, words):
    text = "".join(f"v {x} {y} {z} {row}\n" for (x, y, z), row in zip(CORNERS, rows, strict=True))
    asset = load(folder, "a.obj", text + "f 1 2 3 4\n")
    at = np.concatenate([part.mesh.vertices[part.mesh.faces.ravel()] for part in asset.parts])
    right = np.array([expected[CORNERS.index(tuple(int(v) for v in point))] for point in at])
    np.testing.assert_allclose(colours_of(asset), right, atol=1e-6)
    assert words in said(asset)


@pytest.mark.parametrize(
    "code, expected, words",
    [
        ("204 51 26", linear(np.array([204, 51, 26]) / 255), "taken as parts of 255"),
        ("-1 0.2 0.1", linear([0, 0.2, 0.1]), "colours down to -1 are drawn as 0"),
        ("nan 0.2 0.1", (1, 1, 1), "1 of 1 colours are missing or NaN"),
        ("1.2 0.5 0", linear([1, 0.5, 0]), "colours up to 1.2 are drawn as 1"),
        ("0.8 0.2 0.1", linear(ORANGE), ""),
    ],
)
def test_colours_of_mtl(folder, code, expected, words):
    (folder / "m.mtl").write_text(f"newmtl m\nKd {code}\n")
    asset = load(folder, "a.obj", f"mtllib m.mtl\n{SQUARE}usemtl m\nf 1 2 3 4\n")
    np.testing.assert_allclose(colours_of(asset), np.tile(expected, (6, 1)), atol=1e-6)
    assert words in said(asset) and bool(words) == bool(said(asset))


# ---- PLY
TYPES = {"char": 127, "uchar": 255, "short": 255, "ushort": 65535, "int": 255, "uint": 255, "float": 1, "double": 1}


def ply(vertex="", rows=("",) * 4, face="", tail="", more="", after="", comments=""):
    head = f"ply\nformat ascii 1.0\n{comments}element vertex 4\nproperty float x\nproperty float y\nproperty float z\n"
    head += vertex + "element face 1\nproperty list uchar int vertex_indices\n" + face + more + "end_header\n"
    body = "".join(f"{x} {y} {z} {row}\n" for (x, y, z), row in zip(CORNERS, rows, strict=True))
    return head + body + f"4 0 1 2 3 {tail}\n" + after


@pytest.mark.parametrize("kind", TYPES)
@pytest.mark.parametrize("element", ["vertex", "face"])
def test_colours_of_ply_of_every_type(folder, kind, element):
    most = TYPES[kind]
    codes = np.array(ORANGE) * most
    codes = codes if kind in ("float", "double") else codes.round()
    names = "".join(f"property {kind} {channel}\n" for channel in ("red", "green", "blue"))
    row = " ".join(f"{code:g}" for code in codes)
    text = ply(names, [row] * 4) if element == "vertex" else ply(face=names, tail=row)
    most = 255 if kind == "char" else most  # of 127: no larger number says what white is
    asset = load(folder, "a.ply", text)
    np.testing.assert_allclose(colours_of(asset), np.tile(linear(codes / most), (6, 1)), atol=1e-6)
    assert ("taken as parts of 255" in said(asset)) == (kind not in ("uchar", "ushort", "float", "double"))


def test_colours_of_vertices_and_faces_of_ply(folder):
    names = "".join(f"property uchar {channel}\n" for channel in ("red", "green", "blue"))
    asset = load(folder, "a.ply", ply(names, ["204 51 26"] * 4, face=names, tail="0 255 0"))
    np.testing.assert_allclose(colours_of(asset), np.tile(linear(np.array([204, 51, 26]) / 255), (6, 1)), atol=1e-6)
    assert "colours of faces, beside those of vertices" in said(asset)


def test_float_colours_of_ply_up_to_255(folder):
    names = "property float red\nproperty float green\nproperty float blue\nproperty float alpha\n"
    asset = load(folder, "a.ply", ply(names, ["204.4 51 25.6 255"] * 4))
    np.testing.assert_allclose(colours_of(asset), np.tile(linear(np.array([204.4, 51, 25.6]) / 255), (6, 1)), atol=1e-6)
    assert not asset.omissions and "taken as parts of 255" in said(asset)


@pytest.mark.parametrize(
    "text",
    [
        ply(
            "property float s\nproperty float t\n",
            ["0 0", "1 0", "1 1", "0 1"],
            comments="comment TextureFile tex.png\n",
        ),
        ply(
            "property float u\nproperty float v\n",
            ["0 0", "1 0", "1 1", "0 1"],
            comments="comment texturefile tex.png\n",
        ),
        ply(
            "property float texture_u\nproperty float texture_v\n",
            ["0 0", "1 0", "1 1", "0 1"],
            comments="comment  TEXTUREFILE   Tex.PNG\n",
        ),
        *(
            ply(
                face=f"property list uchar float {name}\n",
                tail="8 0 0 1 0 1 1 0 1",
                comments="comment TextureFile tex.png\n",
            )
            for name in ("texcoord", "t", "st", "uv")
        ),
        ply(
            comments="comment TextureFile tex.png\n",
            more="element multi_texture_vertex 4\nproperty uchar tx\nproperty float u\nproperty float v\n"
            "element multi_texture_face 1\nproperty uchar tx\nproperty uint tn\n"
            "property list uchar int texture_vertex_indices\n",
            after="0 0 1\n0 1 1\n0 1 0\n0 0 0\n0 0 4 3 2 1 0\n",
        ),
    ],
)
def test_texture_coordinates_of_ply(folder, text):
    """The corner (x, y) of the square has the coordinates (x, y), v upwards, in every form."""
    asset = load(folder, "a.ply", text)
    (part,) = asset.parts
    assert part.material.texture is not None and not asset.omissions
    np.testing.assert_allclose(part.mesh.uvs, part.mesh.vertices[:, :2] * [1, -1] + [0, 1], atol=1e-6)


@pytest.mark.parametrize(
    "text, words",
    [
        (ply("property float heat\n", ["1"] * 4), "unknown properties of vertex elements (heat)"),
        (ply(face="property int heat\n", tail="1"), "unknown properties of face elements (heat)"),
        (ply(more="element heat 1\nproperty int x\n", after="1\n"), "elements 'heat'"),
        (ply(more="element edge 1\nproperty int vertex1\n", after="1\n"), "edges and triangle strips"),
        (
            ply(face="property list uchar float texcoord\n", tail="2 0 0"),
            "texture coordinates that do not fit the faces",
        ),
        (ply(comments="comment TextureFile tex.png\n"), "a texture, since there are no texture coordinates"),
        (
            ply(
                "property uchar red\nproperty uchar green\nproperty uchar blue\nproperty uchar alpha\n", ["9 9 9 7"] * 4
            ),
            "opacity",
        ),
        (ply("property float quality\nproperty float confidence\nproperty int flags\n", ["1 1 1"] * 4), ""),
    ],
)
def test_what_ply_does_not_say(folder, text, words):
    asset = load(folder, "a.ply", text)
    assert words in said(asset) and bool(words) == bool(asset.omissions)


# ---- OFF
V = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


@pytest.mark.parametrize(
    "text, expected, words",
    [
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3\n", (1, 1, 1), ""),
        ("4 1 0\n" + V + "4 0 1 2 3\n", (1, 1, 1), ""),  # the keyword is optional
        ("OFF4 1 0\n" + V + "4 0 1 2 3\n", (1, 1, 1), ""),  # as ModelNet writes it
        ("OFF 4 1 0 " + V.replace("\n", " ") + "4 0 1 2 3", (1, 1, 1), ""),  # free form
        ("OFF # all\n4\n1 0\n0 0\n0 1 0 0\n1 1 0 0 1 0\n4 0 1\n2 3\n", (1, 1, 1), ""),
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 204 51 26\n", linear(np.array([204, 51, 26]) / 255), ""),
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 0.8 0.2 0.1 1.0\n", linear(ORANGE), ""),
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 0.8 0.2 0.1 0.5\n", linear(ORANGE), "opacity"),
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 1 0 0\n", linear(np.array([1, 0, 0]) / 255), ""),  # whole numbers: of 255
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 1 0 0 1\n", (1, 0, 0), ""),  # an opacity of 1 says fractions
        ("OFF\n4 1 0\n" + V + "4 0 1 2 3 7\n", (1, 1, 1), "colour map"),
        ("COFF\n4 1 0\n" + V.replace("\n", " 255 51 0 255\n") + "4 0 1 2 3\n", linear([1, 0.2, 0]), ""),
        ("COFF\n4 1 0\n" + V.replace("\n", " 0.8 0.2 0.1\n") + "4 0 1 2 3\n", linear(ORANGE), ""),
        ("NOFF\n4 1 0\n" + V.replace("\n", " 0 0 1\n") + "4 0 1 2 3\n", (1, 1, 1), ""),
        ("CNOFF\n4 1 0\n" + V.replace("\n", " 0 0 1 0.8 0.2 0.1 1\n") + "4 0 1 2 3\n", linear(ORANGE), ""),
        ("STOFF\n4 1 0\n" + V.replace("\n", " 0.5 0.5\n") + "4 0 1 2 3\n", (1, 1, 1), ""),
    ],
)  # fmt: skip
def test_forms_of_off(folder, text, expected, words):
    asset = load(folder, "a.off", text)
    np.testing.assert_allclose(colours_of(asset), np.tile(expected, (6, 1)), atol=1e-6)
    assert {tuple(v) for v in np.concatenate([p.mesh.vertices for p in asset.parts]).tolist()} == set(CORNERS)
    assert words in said(asset) and bool(words) == bool(asset.omissions)


def test_faces_of_off_without_a_colour_are_white(folder):
    asset = load(folder, "a.off", "OFF\n4 2 0\n" + V + "3 0 1 2 0.8 0.2 0.1\n3 0 2 3\n")
    found = {tuple(row) for row in colours_of(asset).round(6).tolist()}
    assert found == {tuple(linear(ORANGE).round(6).tolist()), (1.0, 1.0, 1.0)}
    assert "1 of 2 colours are missing" in said(asset)


@pytest.mark.parametrize("text", ["4OFF\n1 1 0\n", "nOFF\n3\n1 1 0\n", "OFF BINARY\n", "4nOFF\n3\n", "PLY\n"])
def test_other_kinds_of_off_are_refused(folder, text):
    refusal(AssetError, load, folder, "a.off", text, match="no OFF file of text")


# ---- STL
def stl(head: bytes, *bits: int) -> bytes:
    faces = [(0, 1, 2), (0, 2, 3)]
    rows = [struct.pack("<12fH", 0, 0, 1, *(c for k in face for c in CORNERS[k]), b) for face, b in zip(faces, bits)]
    return head.ljust(80) + struct.pack("<I", 2) + b"".join(rows)


@pytest.mark.parametrize(
    "head, bits, expected, words",
    [
        (b"plain", (0, 0), [(1, 1, 1)] * 2, ""),
        (b"VisCAM", (0x8000 | 25 << 10 | 6 << 5 | 3, 0x8000 | 31), [linear(np.array([25, 6, 3]) / 31), (0, 0, 1)], ""),
        (b"VisCAM", (0x8000 | 31 << 10, 31), [(1, 0, 0), (1, 1, 1)], ""),  # the second has no colour
        (b"COLOR=\xff\x00\x00\xff", (31 << 10, 0x8000), [(0, 0, 1), (1, 0, 0)], ""),  # Magics: the other way round
        (b"COLOR=\xff\x00\x00\xff,MATERIAL=abcdefghijkl", (0x8000, 0x8000), [(1, 0, 0)] * 2, "material of Magics"),
    ],
)
def test_colours_of_stl(folder, head, bits, expected, words):
    asset = load(folder, "a.stl", stl(head, *bits))
    np.testing.assert_allclose(colours_of(asset), np.repeat(expected, 3, axis=0), atol=1e-6)
    assert words in said(asset)


# ---- PNG
@pytest.mark.parametrize(
    "gamma, extra, expected",
    [
        (None, b"", linear(128 / 255)),
        (45455, b"", linear(128 / 255)),  # sRGB's
        (100000, b"", 128 / 255),
        (55556, b"", (128 / 255) ** 1.8),
        (100000, b"sRGB\0", linear(128 / 255)),  # which says more
    ],
)
def test_the_gamma_of_a_png(folder, gamma, extra, expected):
    from PIL.PngImagePlugin import PngInfo

    information = PngInfo()
    if gamma is not None:
        information.add(b"gAMA", struct.pack(">I", gamma))
    if extra:
        information.add(extra[:4], extra[4:])
    Image.new("RGB", (4, 4), (128,) * 3).save(folder / "g.png", pnginfo=information)
    (folder / "m.mtl").write_text("newmtl m\nmap_Kd g.png\n")
    asset = load(folder, "a.obj", "mtllib m.mtl\n" + SQUARE + "vt 0 0\nusemtl m\nf 1/1 2/1 3/1 4/1\n")
    np.testing.assert_allclose(colours_of(asset), expected, atol=4e-3)
    # glTF says that the material decides, not the file.
    path = textured_file("g.png").write(folder / "a.glb")
    np.testing.assert_allclose(colours_of(load_asset(path)), linear(128 / 255), atol=4e-3)


# ---- glTF
def glb(folder, change, *, colours=None, material=None) -> bytes:
    tree, number = ({}, None) if material is None else ({"materials": [material]}, 0)
    builder = triangle_file(tree=tree, uvs=[(0, 0), (1, 0), (0, 1)], material=number)
    primitive = builder.tree["meshes"][0]["primitives"][0]
    if colours is not None:
        values = np.asarray(colours, "f4")
        primitive["attributes"]["COLOR_0"] = builder.array(values, f"VEC{values.shape[1]}")
    change(builder, primitive)
    return builder.glb()


ATTRIBUTES = "NORMAL TANGENT TEXCOORD_1 COLOR_1 JOINTS_4 WEIGHTS_4 _MASS FROBNICATE".split()


@pytest.mark.parametrize("name", ATTRIBUTES)
def test_every_attribute_of_gltf(folder, name):
    width = {"NORMAL": 3, "TEXCOORD_1": 2}.get(name, 4)

    def change(builder, primitive):
        values = np.tile(np.array([0, 0, 1, 1], "f4")[-width:] if width < 4 else np.ones(4, "f4"), (3, 1))
        primitive["attributes"][name] = builder.array(values, f"VEC{width}")

    asset = load(folder, "a.glb", glb(folder, change))
    named = name in ("COLOR_1", "JOINTS_4", "WEIGHTS_4", "FROBNICATE")
    assert (f"unknown attributes ({name})" in said(asset)) == named == bool(asset.omissions)


PLACES = {
    "asset": lambda tree: tree["asset"],
    "nodes": lambda tree: tree["nodes"][0],
    "meshes": lambda tree: tree["meshes"][0],
    "primitives": lambda tree: tree["meshes"][0]["primitives"][0],
    "materials": lambda tree: tree["materials"][0],
    "pbrMetallicRoughness": lambda tree: tree["materials"][0]["pbrMetallicRoughness"],
    "accessors": lambda tree: tree["accessors"][0],
    "bufferViews": lambda tree: tree["bufferViews"][0],
    "scenes": lambda tree: tree["scenes"][0],
}


@pytest.mark.parametrize("place", PLACES)
def test_every_part_of_gltf_is_a_closed_list(folder, place):
    """A property that the standard does not have is named with its place, an extension by its name; names and extras
    are silent."""
    surface = {"pbrMetallicRoughness": {"baseColorFactor": [1, 0, 0, 1]}}

    def change(builder, _):
        PLACES[place](builder.tree).update({"frobnicate": 7, "extras": {"a": 1}, "name": "n"})
        PLACES[place](builder.tree)["extensions"] = {"VENDOR_thing": {}}

    asset = load(folder, "a.glb", glb(folder, change, material=surface))
    assert f"unknown properties ({place}.frobnicate)" in said(asset) and "VENDOR_thing" in said(asset)
    np.testing.assert_allclose(colours_of(asset), np.tile([1, 0, 0], (3, 1)))


@pytest.mark.parametrize(
    "mode, opacity, words, drawn",
    [
        ("OPAQUE", [0, 0, 0], "", True),  # it is ignored, as the standard says
        ("MASK", [1, 1, 1], "", True),
        ("MASK", [0, 1, 1], "opacity of vertex colours", True),
        ("MASK", [0, 0, 0], "opacity of vertex colours", False),
        ("BLEND", [0, 1, 1], "opacity of vertex colours", True),
        ("BLEND", [0, 0, 0], "opacity of vertex colours", False),
    ],
)
def test_opacity_of_colours_of_gltf(folder, mode, opacity, words, drawn):
    colours = np.column_stack([np.tile([0, 1, 0], (3, 1)), opacity])
    data = glb(folder, lambda *_: None, colours=colours, material={"alphaMode": mode})
    asset = load(folder, "a.glb", data)
    assert words in said(asset) and bool(asset.parts) == drawn


@pytest.mark.parametrize("name", ["COLOR_0", "TEXCOORD_0", "FROBNICATE", "NORMAL", "TANGENT", "POSITION"])
def test_every_attribute_of_a_morph_target(folder, name):
    def change(builder, primitive):
        primitive["targets"] = [{name: builder.array(np.zeros((3, 3), "f4"), "VEC3")}]

    asset = load(folder, "a.glb", glb(folder, change, colours=[[1, 0, 0]] * 3))
    expected = name in ("COLOR_0", "TEXCOORD_0", "FROBNICATE")
    assert (f"unknown attributes of morph targets ({name})" in said(asset)) == expected


@pytest.mark.parametrize("colours", [[[np.nan, 0, 0]] * 3, [[2.0, 0, 0]] * 3, [[-1.0, 0, 0]] * 3])
def test_colours_of_gltf_beyond_their_range(folder, colours):
    asset = load(folder, "a.glb", glb(folder, lambda *_: None, colours=colours))
    right = {True: (1, 1, 1)}.get(bool(np.isnan(colours[0][0])), (float(np.clip(colours[0][0], 0, 1)), 0, 0))
    np.testing.assert_allclose(colours_of(asset), np.tile(right, (3, 1)))
    assert "colours beyond 0 to 1" in said(asset)


@pytest.mark.parametrize(
    "uri, expected, words",
    [
        ("tex.png", RED, ""),
        ("TEX.PNG", RED, "taken from tex.png"),
        (".\\tex.png", RED, ""),
        ("te%78.png", RED, ""),
        ("none.png", (255,) * 3, "'none.png', which is missing"),
        ("/home/x/tex.png", (255,) * 3, "which lies outside the folder of the pool or recipe"),
        ("https://host/tex.png", (255,) * 3, "which is on a network"),
        ("", (255,) * 3, "'', which is missing"),
        ("x" * 5000, (255,) * 3, "which is missing"),
    ],
)
def test_images_of_gltf(folder, uri, expected, words):
    def change(builder, _):
        builder.tree.update(images=[{"uri": uri}], textures=[{"source": 0}])

    data = glb(folder, change, material={"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}})
    asset = load(folder, "a.glb", data)
    np.testing.assert_allclose(colours_of(asset), np.tile(linear(np.array(expected) / 255), (3, 1)), atol=3e-3)
    assert words in said(asset) and (words or not asset.omissions)


def test_numbers_and_data_of_gltf_as_json_and_browsers_have_them(folder):
    """36.0 is a whole number; base64 may have line breaks and percent signs."""
    builder = triangle_file()
    broken = base64.encodebytes(builder.data).decode()
    for body in (broken, broken.replace("=", "%3D")):
        tree = {**builder.tree, "buffers": [{"byteLength": len(builder.data), "uri": f"data:a/b;base64,{body}"}]}
        text = json.dumps(tree).replace('"count": 3', '"count": 3.0').replace('"byteOffset": 0', '"byteOffset": 0.0')
        asset = load(folder, "a.gltf", text)
        assert len(asset.parts[0].mesh.faces) == 1
    with pytest.raises(AssetError, match="input should be a valid integer.*got 3.5"):
        load(folder, "a.gltf", json.dumps(tree).replace('"count": 3', '"count": 3.5'))


# ---- 3MF
@pytest.mark.parametrize("tag, words", [("beamlattice", "unknown elements of 3MF (beamlattice)"), ("metadata", "")])
def test_elements_of_3mf(folder, tag, words):
    import io
    import zipfile

    import trimesh

    data = trimesh.Trimesh(CORNERS, [[0, 1, 2], [0, 2, 3]], process=False).export(file_type="3mf")
    out = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(data)) as source, zipfile.ZipFile(out, "w") as archive:
        for name in source.namelist():
            text = source.read(name)
            archive.writestr(name, text.replace(b"<resources>", f"<{tag} name='x'/><resources>".encode()))
    asset = load(folder, "a.3mf", out.getvalue())
    assert words in said(asset) and bool(words) == bool(asset.omissions)
