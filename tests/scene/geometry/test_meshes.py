"""Mesh making: creases, projection, closedness, repair, transforms, and what is refused."""

import numpy as np
import pytest
import trimesh

from blinkgl.camera import PinHole
from blinkgl.errors import AssetError
from blinkgl.scene.geometry import meshes as M, primitives as P
from blinkgl.scene.motion.paths import StaticPath
from blinkgl.scene.rig import Rig
from blinkgl.scene.types import Material, Part, Scene, SceneObject
from tests.refusals import refusal
from tests.scene.faces import uv_turns, vectors, volume

CUBE = trimesh.creation.box()


def test_a_cuboid_without_normals_stays_flat():
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces)
    assert len(mesh.vertices) == 24
    flat = vectors(mesh.vertices, mesh.faces)
    np.testing.assert_allclose(
        mesh.normals[mesh.faces],
        np.repeat(flat[:, None], 3, axis=1) / np.linalg.norm(flat, axis=1)[:, None, None],
        atol=1e-6,
    )


def test_a_sphere_without_normals_is_smooth():
    ball = trimesh.creation.icosphere(subdivisions=3)
    mesh = M.make_mesh(ball.vertices, ball.faces)
    assert (mesh.normals * mesh.vertices).sum(axis=1).min() > np.cos(np.radians(1.0))


@pytest.mark.parametrize("sides, smooth", [(12, True), (6, False)])  # 30 and 60 degrees between neighbouring sides
def test_crease_angle_decides(sides, smooth):
    prism = P.prism(sides=sides)
    mesh = M.make_mesh(prism.vertices, prism.faces)
    side = np.abs(mesh.normals[:, 2]) < 0.5
    radial = mesh.vertices[side] * [1, 1, 0]
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    along = 1.0 if smooth else np.cos(np.pi / sides)
    np.testing.assert_allclose((mesh.normals[side] * radial).sum(axis=1), along, atol=1e-4)


def test_box_projection_is_isometric_and_upright():
    mesh = M.make_mesh(CUBE.vertices * [1, 2, 3], CUBE.faces, uv_size=0.5)
    v, uv = mesh.vertices[mesh.faces], mesh.uvs[mesh.faces].astype(float)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        np.testing.assert_allclose(
            np.linalg.norm(uv[:, a] - uv[:, b], axis=1), np.linalg.norm(v[:, a] - v[:, b], axis=1) / 0.5, rtol=1e-5
        )
    assert (uv_turns(mesh) < 0).all()  # not mirrored
    side = np.abs(mesh.normals[:, 2]) < 0.5
    top = mesh.vertices[side][:, 2] > 0
    assert mesh.uvs[side][top, 1].max() < mesh.uvs[side][~top, 1].min()  # the picture's top is up


def test_projection_covers_the_texture_once_by_default():
    mesh = M.make_mesh(CUBE.vertices * [7, 2, 3], CUBE.faces)
    assert mesh.uvs.min() == pytest.approx(0) and mesh.uvs.max() == pytest.approx(1)


@pytest.mark.parametrize(
    "uvs, line", [(np.zeros((8, 2)), "degenerate"), (np.full((8, 2), np.nan), "broken"), (np.zeros((5, 2)), "broken")]
)
def test_useless_texture_coordinates_are_projected(uvs, line):
    log = []
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces, uvs=uvs, name="box", project_degenerate=True, log=log)
    assert log == [f"box: the texture coordinates are {line}, projected new ones"]
    np.testing.assert_array_equal(mesh.uvs, M.make_mesh(CUBE.vertices, CUBE.faces).uvs)


def test_degenerate_coordinates_are_kept_for_palette_textures():
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces, uvs=np.full((8, 2), 0.25))
    assert (mesh.uvs == 0.25).all()


def test_no_face_is_turned_round():
    """A room, a dome, an open box: what its file says is drawn, whatever it looks like."""
    for faces in (CUBE.faces, CUBE.faces[:, ::-1], CUBE.faces[:-2], CUBE.faces[:-2, ::-1]):
        log: list[str] = []
        mesh = M.make_mesh(CUBE.vertices, faces, log=log)
        np.testing.assert_array_equal(mesh.vertices[mesh.faces], CUBE.vertices[faces])
        flat = vectors(mesh.vertices, mesh.faces)
        assert (np.einsum("fk,fck->fc", flat, mesh.normals[mesh.faces]) > 0.99).all() and not log and not mesh.closed


def closed(vertices, faces):
    return M.closedness(*M.weld(np.asarray(vertices), np.asarray(faces)))


def test_closedness():
    assert closed(CUBE.vertices, CUBE.faces) and not closed(CUBE.vertices, CUBE.faces[:-1])
    flipped = CUBE.faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not closed(CUBE.vertices, flipped) and not closed(CUBE.vertices, CUBE.faces[:, ::-1])
    soup = CUBE.vertices[CUBE.faces].reshape(-1, 3)  # every corner its own vertex, as in STL
    assert closed(soup, np.arange(36).reshape(-1, 3))
    two = np.concatenate([CUBE.vertices, CUBE.vertices + [1, 1, 0]]), np.concatenate([CUBE.faces, CUBE.faces + 8])
    assert closed(*two)  # touching along an edge


def test_slivers_are_dropped_at_any_size():
    for scale in (1e-6, 1.0, 1e6):
        vertices = np.vstack([CUBE.vertices, CUBE.vertices[0] * 0.5 + CUBE.vertices[1] * 0.5]) * scale
        faces = np.vstack([CUBE.faces, [0, 8, 1], [3, 3, 4]])
        assert len(M.make_mesh(vertices, faces).faces) == 12


def test_mirroring_keeps_faces_and_normals_outward():
    ball = P.sphere()
    for matrix in (np.diag([-1.0, 2, 1]), np.diag([1.0, 1, 1, 1]) + np.eye(4, k=1) * 0.3):
        moved = M.transform_mesh(ball, matrix)
        out = vectors(moved.vertices, moved.faces)
        assert ((moved.normals[moved.faces].mean(axis=1) * out).sum(axis=1) > 0).all() and volume(moved) > 0


def test_normalise_centres_the_box_and_scales_the_sphere():
    (mesh,) = M.normalise((M.make_mesh(CUBE.vertices * [1, 2, 3] + [5, 6, 7], CUBE.faces),))
    low, high = M.bounds((mesh,))
    np.testing.assert_allclose(low, -high, atol=1e-12)
    assert mesh.radius == pytest.approx(1, rel=1e-12)


@pytest.mark.parametrize(
    "vertices, faces, message",
    [
        (
            np.where(np.arange(24).reshape(8, 3) == 4, np.nan, CUBE.vertices),
            CUBE.faces,
            "1 vertices are NaN, infinite or beyond 1e+15, the first is 1",
        ),
        (CUBE.vertices * 1e300, CUBE.faces, "8 vertices are NaN, infinite"),
        (CUBE.vertices, CUBE.faces + 1, "a face refers to a vertex outside 0..7"),
        (CUBE.vertices, CUBE.faces - 1, "a face refers to a vertex outside 0..7"),
        (CUBE.vertices, np.zeros((0, 3), int), "the mesh has no faces"),
        (CUBE.vertices * 0, CUBE.faces, "the mesh has no faces with an area"),
        (CUBE.vertices[:, :2], CUBE.faces, "are no triangle mesh"),
    ],
)
def test_refused(vertices, faces, message):
    line = refusal(AssetError, M.make_mesh, vertices, faces, where="broken.obj")
    assert line.startswith("broken.obj: ") and message in line


# --- at the edges -----------------------------------------------------------------------------------------------------


def scene_of(*meshes):
    part = lambda mesh: Part(mesh, Material())
    return Scene(
        tuple(SceneObject(f"o{k}", k + 1, tuple(map(part, ms)), StaticPath(np.eye(4))) for k, ms in enumerate(meshes)),
        Rig.alone(PinHole.centred(8, 8, 8.0), StaticPath(np.eye(4))),
        0,
        1,
        log=("before",),
    )  # fmt: skip


def strip(height: float) -> M.Mesh:
    """Two triangles over a base from x = 1 to 2, one of them of that height."""
    vertices = np.array([[1.0, 1, 0], [2, 1, 0], [1.5, 1 + height, 0], [1.5, 2, 0]])
    flat = np.tile(np.float32([0, 0, 1]), (4, 1))
    return M.Mesh(vertices, np.int32([[0, 1, 2], [0, 1, 3]]), flat, np.zeros((4, 2), np.float32), False, "strip", "h")


def test_what_a_card_rounds_to_a_line_is_not_drawn():
    """Rounding moves a corner at 2 by 2^-24 or so; what is not higher than twice 2^-22 is a line."""
    line, thin, fine = strip(2.0**-21), strip(2.0**-21 + 2.0**-23), strip(0.5)
    assert M.faces_in_float32(line).tolist() == [False, True] and M.faces_in_float32(thin).all()
    assert M.faces_in_float32(
        M.Mesh(fine.vertices * np.nan, *(getattr(fine, n) for n in ("faces", "normals", "uvs")), False, "", "")
    ).all()
    untouched = scene_of([fine, thin], [fine])
    assert M.without_collapsed_faces(untouched) is untouched
    nothing = M.scale_mesh(M.replace(line, faces=line.faces[:1]), 3.0)
    scene = M.without_collapsed_faces(scene_of([fine], [line, fine], [nothing], [line]))
    assert scene.log == ("before", "3 triangles without width in float32 are not drawn")
    assert [[len(p.mesh.faces) for p in o.parts] for o in scene.objects] == [[2], [1, 2], [], [1]]
    assert scene.objects[0].parts[0].mesh is fine and scene.objects[1].parts[0].mesh is scene.objects[3].parts[0].mesh
    assert scene.objects[1].parts[0].mesh.faces.tolist() == [[0, 1, 3]]


@pytest.mark.parametrize("gap, points", [(0.4e-6, 3), (1.6e-6, 4)])
def test_points_nearer_than_a_millionth_are_one(gap, points):
    vertices = 7.0 * np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [gap, gap, gap]]) + 100
    welded, faces = M.weld(vertices, np.array([[0, 1, 2], [3, 1, 2]]))
    assert len(welded) == points and (faces[0, 0] == faces[1, 0]) == (points == 3)


@pytest.mark.parametrize("height, kept", [(2e-10, 2), (0.5e-10, 1)])
def test_a_sliver_is_judged_by_its_own_longest_edge(height, kept):
    for size in (1e-5, 1.0, 1e5):
        vertices = np.array([[0, 0, 0], [1, 0, 0], [0.5, height, 0], [0.5, 1, 0]]) * size
        assert len(M.make_mesh(vertices, [[0, 1, 2], [0, 1, 3]]).faces) == kept


def test_normals_that_are_given_are_kept_unless_they_are_none():
    slanted = np.tile([3.0, 0, 4], (8, 1))
    log: list[str] = []
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces, normals=slanted, log=log)
    assert np.allclose(mesh.normals, [0.6, 0, 0.8]) and log == []
    kept = M.make_mesh(CUBE.vertices, CUBE.faces[:, ::-1], normals=CUBE.vertices)
    assert ((kept.normals * kept.vertices).sum(axis=1) > 0).all()
    for row, bad in ((0, 0.0), (3, np.nan), (7, 0.9e-150)):
        broken = np.array(CUBE.vertices)
        broken[row] = [bad, 0, 0]
        log.clear()
        mesh = M.make_mesh(CUBE.vertices, CUBE.faces, normals=broken, name="box", log=log)
        assert (
            log == ["box: the normals are unusable, made new ones"] and (np.abs(mesh.normals).max(axis=1) > 0.99).all()
        )
    assert (np.abs(M.make_mesh(CUBE.vertices, CUBE.faces, normals=slanted[:5]).normals).max(axis=1) > 0.99).all()
    tiny = np.array(CUBE.vertices)
    tiny[0] = [1.1e-150, 0, 0]
    assert M.make_mesh(CUBE.vertices, CUBE.faces, normals=tiny).normals.max() == 1


@pytest.mark.parametrize("uv, kept", [(0.9e9, True), (-0.9e9, True), (1e9, False), (np.inf, False)])
def test_repeats_of_a_texture_have_an_end(uv, kept):
    uvs = np.full((8, 2), 0.25)
    uvs[3, 1] = uv
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces, uvs=uvs)
    assert (0.25 in mesh.uvs and np.float32(uv) in mesh.uvs) is kept


@pytest.mark.parametrize("axis, sign", [(a, s) for a in range(3) for s in (1, -1)])
def test_a_projected_texture_is_upright_on_each_side(axis, sign):
    """For a viewer outside with z up (y for the top and the bottom): u to the right, v down."""
    outward = sign * np.eye(3)[axis]
    up = np.eye(3)[1 if axis == 2 else 2]
    right = np.cross(up, outward)
    mesh = M.make_mesh(CUBE.vertices * [2.0, 3.0, 4.0] + [5, 6, 7], CUBE.faces, uv_size=2.0)
    here = mesh.normals @ outward > 0.9
    centred = mesh.vertices[here] - [5, 6, 7]
    np.testing.assert_allclose(mesh.uvs[here], 0.5 + np.stack([centred @ right, -centred @ up], axis=1) / 2, atol=1e-6)


def test_corner_normals_are_weighted_by_angle():
    """A cube cut into small triangles on one side only: its corners point along the diagonal all the same."""
    fan = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0.2, 0], [0.3, 1, 0], [0, 1, 0], [0, 0, 1]])
    faces = np.array([[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 5, 4], [0, 1, 5]])
    made = M.crease_normals(fan, faces, faces, 180.0)
    np.testing.assert_allclose(made[:, 0], np.tile(-np.ones(3) / np.sqrt(3), (5, 1)), atol=1e-12)
    sharp = M.crease_normals(fan, faces, faces, 89.0)
    np.testing.assert_allclose(sharp[:3, 0], np.tile([0, 0, -1.0], (3, 1)), atol=1e-12)


def test_joining_moving_and_scaling():
    ball, box = P.sphere(segments=5, rings=3), P.cuboid()
    joined = M.concatenate((ball, box), name="n", source_hash="s")
    assert (joined.name, joined.source_hash, joined.closed) == ("n", "s", True)
    n = len(ball.vertices)
    assert np.array_equal(joined.faces[len(ball.faces) :], box.faces + n) and np.array_equal(joined.uvs[n:], box.uvs)
    alone = M.concatenate((ball,), name="x")
    assert alone.name == "x" and alone.source_hash == ball.source_hash and alone.faces is ball.faces
    assert M.concatenate((ball,), source_hash="y").name == ball.name
    moved = M.transform_mesh(box, np.array([[2.0, 0, 0, 5], [0, 3, 0, 6], [0, 0, 4, 7], [0, 0, 0, 1]]))
    np.testing.assert_allclose(moved.vertices, box.vertices * [2, 3, 4] + [5, 6, 7])
    assert moved.faces is box.faces and np.array_equal(M.scale_mesh(box, 3.0).vertices, box.vertices * 3)
    for matrix in (np.diag([1.0, 0, 1]), np.full((3, 3), np.nan)):
        refusal(AssetError, M.transform_mesh, box, matrix, match="cuboid: a transform flattens the mesh")
    two = M.normalise((M.transform_mesh(box, np.eye(4) + np.eye(4, k=3)), box))
    low, high = M.bounds(two)
    np.testing.assert_allclose([low, high], [[-v for v in high], high])
    assert max(np.linalg.norm(m.vertices, axis=1).max() for m in two) == pytest.approx(1)
    refusal(AssetError, M.normalise, (M.scale_mesh(box, 0.0),), where="here", match="here: the mesh has size zero")


def test_rows_of_one_hash_stay_apart():
    """Equal rows are found by a hash. Two rows are made that have the same one: the search must not join them, and
    agrees with np.unique on rows."""
    rng = np.random.default_rng(3)
    with np.errstate(over="ignore"):
        mixed = (np.array([5, 9], np.uint64) * np.uint64(0x9E3779B97F4A7C15)).astype(np.uint64)
    mixed ^= mixed >> np.uint64(29)
    second = np.array([77, 77 ^ int(mixed[0] ^ mixed[1])], np.uint64).view(np.int64)
    collide = [np.array([5, 9, 5]), second[[0, 1, 0]]]
    plain = [rng.integers(-3, 3, 500) for _ in range(3)]
    for columns in (collide, plain, [*plain, np.arange(500)]):
        first, index = M._equal_rows(columns)
        rows = np.stack(columns, axis=1)
        np.testing.assert_array_equal(rows[first][index], rows)
        assert (
            len(first) == len(np.unique(rows, axis=0))
            and (first == [index.tolist().index(k) for k in range(len(first))]).all()
        )
