"""OBJ, PLY, OFF and 3MF: corners, polygons, normals, materials and colours as the file says them, and what is refused.

The expected corners are written down beside each file, or computed by an oracle: areas of polygons by the shoelace
formula, normals of smoothing groups as sums over faces."""

import zipfile

import numpy as np
import pytest
from PIL import Image

from blinkgl.errors import AssetError
from blinkgl.scene.geometry.polygons import triangulate
from blinkgl.scene.importing.mesh_files import load_asset
from blinkgl.scene.importing.polygons import MAX_CORNERS
from blinkgl.srgb import linear_from_srgb
from tests.refusals import refusal
from tests.scene.faces import area, vectors

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


def asset(tmp_path, text, name="a.obj", **options):
    (tmp_path / name).write_text(text)
    return load_asset(tmp_path / name, **options)


def corners(part):
    """{(x, y, z, u, v)} of all corners of a part's faces, rounded."""
    m = part.mesh
    rows = np.column_stack([m.vertices, m.uvs])[m.faces.ravel()]
    return {tuple(float(x) for x in row) for row in np.round(rows, 6) + 0.0}


def outline(x, y):
    """The area inside a simple polygon, by the shoelace formula."""
    return abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2


def test_corners_of_an_obj_keep_their_own_coordinates(tmp_path):
    """Two triangles that share positions and not coordinates: a seam."""
    text = SQUARE + "vt 0 0\nvt .25 0\nvt .25 .5\nvt .5 1\nvt 1 1\nvt 1 .5\nf 1/1 2/2 3/3\nf 1/4 3/5 4/6\n"
    (part,) = asset(tmp_path, text).parts
    expected = {(0, 0, 0, 0, 1), (1, 0, 0, 0.25, 1), (1, 1, 0, 0.25, 0.5)}
    expected |= {(0, 0, 0, 0.5, 0), (1, 1, 0, 1, 0), (0, 1, 0, 1, 0.5)}
    assert corners(part) == expected


def test_negative_indices_count_from_their_line(tmp_path):
    text = (
        SQUARE
        + "vt 0 0\nvt 1 0\nvt 1 1\nf -4/-3 -3/-2 -2/-1\nv 5 5 5\nv 6 5 5\nv 6 6 5\nvt .5 .5\nf -3/-1 -2/-1 -1/-1\n"
    )
    (part,) = asset(tmp_path, text).parts
    far = {(5, 5, 5, 0.5, 0.5), (6, 5, 5, 0.5, 0.5), (6, 6, 5, 0.5, 0.5)}
    assert corners(part) == {(0, 0, 0, 0, 1), (1, 0, 0, 1, 1), (1, 1, 0, 1, 0)} | far


def test_polygons_keep_their_area_and_winding():
    """Stars, spirals and combs in any plane, from any first corner, both ways round, and repeated corners."""
    rng = np.random.default_rng(3)
    for n in (4, 5, 7, 12, 60):
        turn = np.linspace(0, 2 * np.pi, n, endpoint=False)
        x, y = np.cos(turn) * (r := rng.uniform(0.3, 2, n)), np.sin(turn) * r
        for way in (1, -1):
            axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
            points = np.column_stack([x, y, np.full(n, 0.3)])[::way] @ axes.T
            places = np.insert(np.arange(n), 2, 2)  # corner 2 twice
            triangles, owner, repeated = triangulate(points, places, np.array([n + 1]))
            cross = vectors(points, places[triangles]) / 2
            up = np.cross(axes[:, 0], axes[:, 1]) * way
            assert len(triangles) == n - 2 and repeated == 1 and (owner == 0).all()
            assert (cross @ up > -1e-12).all() and (cross @ up).sum() == pytest.approx(outline(x, y), rel=1e-9)


def test_repeated_corners_are_said(tmp_path):
    found = asset(tmp_path, SQUARE + "f 1 2 2 3 4 1\nf 1 1 2\nf 1 2\n")
    assert found.log == ("a: 3 repeated corners and 2 faces of fewer than three left out",)
    assert area(found.parts[0].mesh) == pytest.approx(1)


@pytest.mark.parametrize("first", range(4))
def test_a_concave_quadrilateral_is_split_inside(tmp_path, first):
    order = " ".join(str((first + k) % 4 + 1) for k in range(4))
    (part,) = asset(tmp_path, f"v -1 -1 0\nv 0 -.3 0\nv 1 -1 0\nv 0 1.2 0\nf {order}\n").parts
    assert area(part.mesh) == pytest.approx(outline(np.array([-1, 0, 1, 0]), np.array([-1, -0.3, -1, 1.2])))


def test_a_hole_reached_by_a_bridge_stays_open(tmp_path):
    ring = [(0, 0), (4, 0), (4, 4), (0, 4), (0, 0), (1, 1), (1, 3), (3, 3), (3, 1), (1, 1)]
    (part,) = asset(
        tmp_path,
        "".join(f"v {x} {y} 0\n" for x, y in [*ring[:4], *ring[5:9]]) + "f 1 2 3 4 1 5 6 7 8 5\n",
    ).parts
    assert area(part.mesh) == pytest.approx(12)


def test_normals_of_an_obj(tmp_path):
    """The file's; in smoothing groups across any angle; flat where smoothing is off; by the angle without groups."""
    roof = "v 0 0 0\nv 1 0 0\nv 1 1 1\nv 0 1 1\nv 0 2 0\nv 1 2 0\n"
    faces = "f 1 2 3 4\n{}f 4 3 6 5\n"

    def at_ridge(text):
        mesh = asset(tmp_path, text).parts[0].mesh
        return {tuple(n) for n in mesh.normals[mesh.vertices[:, 2] == 1].astype(float).round(4).tolist()}

    left, right = (0, -0.7071, 0.7071), (0, 0.7071, 0.7071)
    assert at_ridge(roof + "s 1\n" + faces.format("")) == {(0, 0, 1)}
    assert at_ridge(roof + "s 1\n" + faces.format("s 2\n")) == {left, right}
    assert at_ridge(roof + "s off\n" + faces.format("")) == {left, right}
    assert at_ridge(roof + faces.format("")) == {left, right}  # 90 degrees are an edge
    assert at_ridge("v 1e9 nan 0\n" + roof + "f 2 3 4 5\nf 5 4 7 6\n") == {left, right}  # a point without a face
    given = roof + "vn 1 0 0\nvn 0 0 5\nf 1//2 2//2 3//1 4//1\nf 4//1 3//1 6//2 5//2\n"
    assert at_ridge(given) == {(1, 0, 0)}
    # smooth over the border of two materials
    assert at_ridge(roof + "s 1\nusemtl a\n" + faces.format("usemtl b\n")) == {(0, 0, 1)}


def test_materials_of_an_obj(tmp_path):
    """Options, backslashes, names with blanks, their own folder, opacity, a tint; what is missing is drawn without."""
    (tmp_path / "maps").mkdir()
    Image.new("RGB", (4, 4), (10, 200, 30)).save(tmp_path / "maps" / "my wood.png")
    (tmp_path / "maps" / "m.mtl").write_text(
        "newmtl a\nKd 1 .5 1\nmap_Kd -s 2 4 1 -o .5 -clamp on my wood.png\n"
        "newmtl b\nmap_Kd ..\\maps\\my wood.png\nKd .8 .8 .8\n"
        "newmtl c\nmap_Kd gone.png\nKd 0 0 1\nnewmtl d\nd 0\nnewmtl e\nKd \\\n 1 0 0\n"
    )
    text = SQUARE + "vt 0 0\nvt 1 0\nvt 1 1\nmtllib maps\\m.mtl\n"
    found = asset(tmp_path, text + "".join(f"usemtl {m}\nf 1/1 2/2 3/3\n" for m in "abcdef"))
    a, b, c, e, f = (part.material for part in found.parts)
    assert (a.texture.image == (10, 200, 30)).all() and a.wrap == ("clamp", "clamp")
    assert a.base_color == pytest.approx((1, float(linear_from_srgb(np.array(0.5))), 1))
    assert {row[3:] for row in corners(found.parts[0])} == {(0.5, 1), (2.5, 1), (2.5, -3)}
    assert b.texture.name == "my wood.png" and b.base_color == (1, 1, 1)
    assert c.texture is None and c.base_color == (0, 0, 1) and e.base_color == (1, 0, 0) and f.base_color == (1, 1, 1)
    (line,) = found.omissions
    for words in ("'gone.png', which is missing", "'d' of opacity 0", "'f', which no MTL file has"):
        assert words in line
    assert found.log == ("a: the grey Kd of 'b' does not darken its texture",)


@pytest.mark.parametrize(
    "mtl, problem",
    [
        ("newmtl a\nmap_Kd ../../t.png\n", "'../../t.png', which lies outside the folder of the pool or recipe"),
        ("newmtl a\nmap_Kd C:\\t.png\n", "'C:\\t.png', which is missing"),
        ("newmtl a\nmap_Kd /t.png\n", "'/t.png', which lies outside the folder of the pool or recipe"),
        ("newmtl a\nmap_Kd https://host/t.png\n", "'https://host/t.png', which is on a network"),
        ("newmtl a\nmap_Kd \0.png\n", "'\0.png', which is missing"),
        (f"newmtl a\nmap_Kd {'x' * 5000}.png\n", "x.png', which is missing"),
        ("newmtl a\nmap_Kd loop.png\n", "'loop.png', which is missing"),
        ("newmtl a\nKd\n", "m.mtl, line 2: numbers are missing, or are none (got '')"),
    ],
)
def test_bad_material_files(tmp_path, mtl, problem):
    (tmp_path / "m.mtl").write_text(mtl)
    (tmp_path / "loop.png").symlink_to(tmp_path / "loop.png")
    text = SQUARE + "vt 0 0\nmtllib m.mtl\nusemtl a\nf 1/1 2/1 3/1\n"
    if "which" in problem:  # the mesh without its texture
        found = asset(tmp_path, text)
        assert problem in found.omissions[0] and found.parts[0].material.texture is None
        return
    assert problem in refusal(AssetError, asset, tmp_path, text)


@pytest.mark.parametrize(
    "text, problem",
    [
        (
            SQUARE + "f 0 1 2\n",
            "a.obj, line 5: a face refers to a vertex that does not exist (got '0'); expected 1 to 4",
        ),
        (
            SQUARE + "\nf 1 2 -5\n",
            "a.obj, line 6: a face refers to a vertex that does not exist (got '-5'); expected 1",
        ),
        (
            SQUARE + "vt 0 0\nf 1/1 2/1 3/2\n",
            "line 6: a face refers to a vertex that does not exist (got '2'); expected 1",
        ),
        ("f 1 2 3\n", "line 1: a face refers to a vertex that does not exist (got '1'); expected a file with such"),
        (SQUARE + "f 1 2 3.5\n", "a.obj, line 5: a face is corrupt (got '3.5'); expected v, v/vt, v//vn, v/vt/vn"),
        ("v 0 0\n" + SQUARE + "f 1 2 3\n", "a.obj, line 1: numbers are missing, or are none"),
        (SQUARE + "f 1 2 2\n", "the file has no faces"),
        (
            "v 0 0 0\n" * 3 + "f" + " 1 2 3" * (MAX_CORNERS // 3 + 1),
            f"a polygon has too many corners (got {MAX_CORNERS + 1}",
        ),
        ("p 1\n", "the file has no faces"),
    ],
)
def test_bad_objs(tmp_path, text, problem):
    assert problem in refusal(AssetError, asset, tmp_path, text)


HEAD = (
    "ply\nformat ascii 1.0\n{}element vertex 5\nproperty float x\nproperty float y\nproperty float z\n{}"
    "element face {}\n{}property list uchar int vertex_indices\n{}end_header\n"
)
ARROW = [(-1, -1, 0), (0, -0.3, 0), (1, -1, 0), (0, 1.2, 0), (0, 0, 1)]


def ply(first="", vertex="", count=2, before="", after=""):
    return HEAD.format(first, vertex, count, before, after)


def rows(*more):
    return "".join(" ".join(map(str, (*p, *more[k]) if more else p)) + "\n" for k, p in enumerate(ARROW))


def binary(text, order):
    """A file of floats and bytes as the ASCII one says, whose body has the properties that its header declares."""
    head, _, body = text.partition("end_header\n")
    kinds = {"float": "f4", "uchar": "u1", "int": "i4", "ushort": "u2"}
    out, words = [], iter(body.split())
    elements = []
    for line in head.splitlines():
        word = line.split()
        if word[0] == "element":
            elements.append((int(word[2]), []))
        elif word[0] == "property":
            elements[-1][1].append(word)
    for count, properties in elements:
        for _ in range(count):
            for word in properties:
                if word[1] == "list":
                    n = next(words)
                    out.append(np.array(float(n), order + kinds[word[2]]))
                    out += [np.array(float(next(words)), order + kinds[word[3]]) for _ in range(int(n))]
                else:
                    out.append(np.array(float(next(words)), order + kinds[word[1]]))
    form = "binary_little_endian" if order == "<" else "binary_big_endian"
    return (head.replace("ascii", form) + "end_header\n").encode() + b"".join(x.tobytes() for x in out)


@pytest.mark.parametrize("order", ["", "<", ">"])
def test_plys(tmp_path, order):
    """Concave and mixed faces; coordinates of vertices or of corners, with and without a texture; colours."""

    def read(text):
        data = binary(text, order) if order else text.encode()
        (tmp_path / "a.ply").write_bytes(data)
        return load_asset(tmp_path / "a.ply")

    faces = "4 0 1 2 3\n3 0 4 1\n"
    side = float(np.linalg.norm(np.cross(np.subtract(ARROW[4], ARROW[0]), np.subtract(ARROW[1], ARROW[0])))) / 2
    whole = outline(np.array([-1, 0, 1, 0]), np.array([-1, -0.3, -1, 1.2])) + side
    assert area(read(ply() + rows() + faces).parts[0].mesh) == pytest.approx(whole)
    uvs = [(k / 8, k * k / 32) for k in range(5)]
    found = read(ply(vertex="property float s\nproperty float t\n") + rows(*uvs) + faces)
    assert {row[3:] for row in corners(found.parts[0])} == {
        (k / 8, 1 - k * k / 32) for k in range(5)
    } and not found.has_materials
    Image.new("RGB", (4, 4), (10, 200, 30)).save(tmp_path / "t.png")
    own = ply("comment TextureFile t.png\n", after="property list uchar float texcoord\n")
    own += rows() + "4 0 1 2 3 8 0 0 .25 0 .5 0 1 1\n3 0 4 1 6 .75 0 .75 .5 .25 .25\n"
    (part,) = read(own).parts
    assert part.material.texture.name == "t.png"
    assert (-1, -1, 0, 0, 1) in corners(part) and (-1, -1, 0, 0.75, 1) in corners(part) and len(corners(part)) == 7
    # colours: of vertices by another name, 16 bits, of faces
    tint = "property {0} diffuse_red\nproperty {0} diffuse_green\nproperty {0} diffuse_blue\n"
    for kind, most in (("uchar", 255), ("ushort", 65535)):
        text = ply(vertex=tint.format(kind)) + rows(*[(most, 0, most * (k > 3)) for k in range(5)]) + faces
        mesh = read(text).parts[0].mesh
        np.testing.assert_array_equal(
            mesh.colours, np.column_stack([0 * mesh.vertices[:, 2] + 1, 0 * mesh.uvs[:, 0], mesh.vertices[:, 2] > 0.5])
        )
    text = ply(before="property uchar red\nproperty uchar green\nproperty uchar blue\n") + rows()
    (part,) = read(text + "255 0 0 4 0 1 2 3\n0 0 255 3 0 4 1\n").parts
    red = (part.mesh.colours[part.mesh.faces] == (1, 0, 0)).all(axis=(1, 2))
    assert red.sum() == 2 and (part.mesh.vertices[part.mesh.faces[red]][..., 2] == 0).all()


@pytest.mark.parametrize(
    "text, problem",
    [
        (
            ply() + rows() + "4 0 1 2 3\n3 0 4 5\n",
            "face 1: a face refers to a vertex that does not exist (got 5); expected 0 to 4",
        ),
        (ply() + rows() + "4 0 1 2 -3\n3 0 4 1\n", "face 0: a face refers to a vertex that does not exist (got -3)"),
        (ply() + rows() + "4 0 1 2 3\n3 0 4\n", "the mesh is truncated: not all of 2 face elements are there"),
        (ply() + rows() + "999999999 0 1 2 3\n3 0 4\n", "the mesh is truncated"),
        (
            ply().replace("ascii", "text") + rows(),
            "unknown PLY format (got 'text'); expected ascii, binary_little_endian",
        ),
        (
            ply() + rows().replace("1.2", "nan") + "4 0 1 2 3\n3 0 4 1\n",
            "face 0: a face has a vertex that is NaN or infinite",
        ),
        (ply(count=0) + rows(), "the file has no faces"),
    ],
)
def test_bad_plys(tmp_path, text, problem):
    assert problem in refusal(AssetError, asset, tmp_path, text, "a.ply")


def test_lines_of_a_ply_may_say_more_than_its_header(tmp_path):
    """As MeshLab's with colours of corners do; a file without a line for each element is read word by word."""
    lines = ply() + rows() + "4 0 1 2 3 9 1 1 1\n3 0 4 1 9 1 1 1\n"
    words = ply() + rows().replace("\n", " ", 3) + "4 0 1 2 3\n3 0 4 1\n"
    mine, other = (asset(tmp_path, text, "a.ply").parts[0].mesh for text in (lines, words))
    np.testing.assert_array_equal(mine.vertices[mine.faces], other.vertices[other.faces])
    with pytest.raises(AssetError, match="truncated: not all of 5 vertex elements"):
        asset(tmp_path, lines.replace("0 1.2 0", "0 1.2"), "a.ply")


def test_offs(tmp_path):
    text = "OFF # arrow\n\n5 2 0\n" + rows() + "4 0 1 2 3 1.0 0.0 0.0\n3 0 4 1 0 0 1.0\n"
    (part,) = asset(tmp_path, text, "a.off").parts
    assert area(part.mesh) > 1.5 and {tuple(c) for c in part.mesh.colours.tolist()} == {(1, 0, 0), (0, 0, 1)}
    text = "COFF 5 2 0\n" + rows(*[(255, 0, 255, 255)] * 5) + "4 0 1 2 3\n3 0 4 1\n"
    assert asset(tmp_path, text, "b.off").parts[0].material.base_color == (1, 0, 1)
    for bad, problem in (
        ("OFF\n9 9 0\n0 0 0\n", "truncated: 9 vertices and 9 faces"),
        ("FOO\n", "no OFF file of text"),
    ):
        refusal(AssetError, asset, tmp_path, bad, "c.off", match=problem)


def packed(path, model):
    """The asset of a 3MF file with this model."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("3D/3dmodel.model", model)
    return load_asset(path)


def test_3mf(tmp_path):
    """Two placed instances of one object."""
    space = "http://schemas.microsoft.com/3dmanufacturing/core/2015/02"
    points = "".join(f'<vertex x="{x}" y="{y}" z="{z}"/>' for x, y, z in ((0, 0, 0), (1, 0, 0), (0, 1, 0)))
    model = (
        f'<?xml version="1.0"?><model unit="millimeter" xmlns="{space}"><resources><object id="1" type="model"><mesh>'
        f'<vertices>{points}</vertices><triangles><triangle v1="0" v2="1" v3="2"/></triangles></mesh></object>'
        '</resources><build><item objectid="1"/>'
        '<item objectid="1" transform="1 0 0 0 1 0 0 0 1 5 6 7"/></build></model>'
    )
    found = {tuple(v) for part in packed(tmp_path / "a.3mf", model).parts for v in part.mesh.vertices.tolist()}
    assert found == {(0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 6, 7), (6, 6, 7), (5, 7, 7)}
    refusal(AssetError, packed, tmp_path / "b.3mf", " " * 30_000_000, match="too large when it is unpacked")


@pytest.mark.parametrize(
    "unit, said",
    [
        ("", "millimeter are taken as metres, scale: 0.001 is"),
        (' unit="inch"', "inch are taken as metres, scale: 0.0254"),
        (' xml:lang="en" unit="meter"', None),
        (' unit="parsec"', "parsec are taken as metres"),
    ],
)
def test_the_unit_of_3mf_is_said(tmp_path, unit, said):
    corner = '<vertex x="{}" y="{}" z="0"/>'
    mesh = f"<vertices>{corner.format(0, 0)}{corner.format(9, 0)}{corner.format(0, 9)}</vertices>"
    mesh += '<triangles><triangle v1="0" v2="1" v3="2"/></triangles>'
    model = f'<model{unit} xmlns="http://schemas.microsoft.com/3dmanufacturing/core/2015/02"><resources>'
    model += f'<object id="1" type="model"><mesh>{mesh}</mesh></object></resources>'
    made = packed(tmp_path / "a.3mf", model + '<build><item objectid="1"/></build></model>')
    assert made.parts[0].mesh.vertices.max() == 9
    assert [said in line for line in made.log] == ([] if said is None else [True])
