"""Mesh making: creases, projection, closedness, repair, transforms, and what is refused."""

import numpy as np
import pytest
import trimesh

from blinkgl.errors import AssetError
from blinkgl.scene.geometry import meshes as M, primitives as P

CUBE = trimesh.creation.box()


def test_a_cuboid_without_normals_stays_flat():
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces)
    assert len(mesh.vertices) == 24 and mesh.closed
    v = mesh.vertices[mesh.faces]
    flat = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
    np.testing.assert_allclose(
        mesh.normals[mesh.faces],
        np.repeat(flat[:, None], 3, axis=1) / np.linalg.norm(flat, axis=1)[:, None, None],
        atol=1e-6,
    )


def test_a_sphere_without_normals_is_smooth():
    ball = trimesh.creation.icosphere(subdivisions=3)
    mesh = M.make_mesh(ball.vertices, ball.faces)
    assert (mesh.normals * mesh.vertices).sum(axis=1).min() > np.cos(np.radians(1.0))


def test_crease_angle_decides():
    prism = P.prism(sides=12)  # 30 degrees between neighbouring sides
    smooth, flat = (M.make_mesh(prism.vertices, prism.faces, crease_degrees=a) for a in (40, 20))
    side = np.abs(flat.normals[:, 2]) < 0.5
    radial = flat.vertices[side] * [1, 1, 0]
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    np.testing.assert_allclose((flat.normals[side] * radial).sum(axis=1), np.cos(np.radians(15)), atol=1e-6)
    side = np.abs(smooth.normals[:, 2]) < 0.5
    radial = smooth.vertices[side] * [1, 1, 0]
    radial /= np.linalg.norm(radial, axis=1, keepdims=True)
    assert (smooth.normals[side] * radial).sum(axis=1).min() > 1 - 1e-4


def test_box_projection_is_isometric_and_upright():
    mesh = M.make_mesh(CUBE.vertices * [1, 2, 3], CUBE.faces, uv_size=0.5)
    v, uv = mesh.vertices[mesh.faces], mesh.uvs[mesh.faces].astype(float)
    for a, b in ((0, 1), (1, 2), (2, 0)):
        np.testing.assert_allclose(
            np.linalg.norm(uv[:, a] - uv[:, b], axis=1), np.linalg.norm(v[:, a] - v[:, b], axis=1) / 0.5, rtol=1e-5
        )
    e1, e2 = uv[:, 1] - uv[:, 0], uv[:, 2] - uv[:, 0]
    assert (e1[:, 0] * e2[:, 1] - e1[:, 1] * e2[:, 0] < 0).all()  # not mirrored (v down)
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


def test_inside_out_is_turned_round():
    log = []
    mesh = M.make_mesh(CUBE.vertices, CUBE.faces[:, ::-1], name="box", log=log)
    assert log == ["box: the mesh was inside out, turned round"] and mesh.closed
    v = mesh.vertices[mesh.faces]
    assert np.einsum("ij,ij->i", v[:, 0], np.cross(v[:, 1], v[:, 2])).sum() / 6 == pytest.approx(1)
    assert ((mesh.normals * mesh.vertices).sum(axis=1) > 0).all()


def test_closedness():
    assert not M.make_mesh(CUBE.vertices, CUBE.faces[:-1]).closed
    flipped = CUBE.faces.copy()
    flipped[0] = flipped[0, ::-1]
    assert not M.make_mesh(CUBE.vertices, flipped).closed
    soup = CUBE.vertices[CUBE.faces].reshape(-1, 3)  # every corner its own vertex, as in STL
    assert M.make_mesh(soup, np.arange(36).reshape(-1, 3)).closed
    two = np.concatenate([CUBE.vertices, CUBE.vertices + [1, 1, 0]]), np.concatenate([CUBE.faces, CUBE.faces + 8])
    assert M.make_mesh(*two).closed  # touching along an edge
    hollow = np.concatenate([CUBE.vertices, CUBE.vertices / 2]), np.concatenate([CUBE.faces, CUBE.faces[:, ::-1] + 8])
    assert M.make_mesh(*hollow).closed
    apart = (
        np.concatenate([CUBE.vertices, CUBE.vertices / 2 + 5]),
        np.concatenate([CUBE.faces, CUBE.faces[:, ::-1] + 8]),
    )
    assert not M.make_mesh(*apart).closed  # a shell turned inside out
    rng = np.random.default_rng(0)
    quantised = soup + rng.uniform(-2e-4, 2e-4, soup.shape)
    assert M.make_mesh(quantised, np.arange(36).reshape(-1, 3)).closed  # an exporter's gaps
    assert not M.make_mesh(soup + rng.uniform(-0.02, 0.02, soup.shape), np.arange(36).reshape(-1, 3)).closed


def test_parts_that_are_closed_together():
    top = M.make_mesh(CUBE.vertices, CUBE.faces[:5])
    rest = M.make_mesh(CUBE.vertices, CUBE.faces[5:])
    assert not top.closed and not rest.closed and M.closed_together((top, rest))
    joined = M.concatenate((top, rest))
    assert joined.closed and len(joined.faces) == 12


def test_slivers_are_dropped_at_any_size():
    for scale in (1e-6, 1.0, 1e6):
        vertices = np.vstack([CUBE.vertices, CUBE.vertices[0] * 0.5 + CUBE.vertices[1] * 0.5]) * scale
        faces = np.vstack([CUBE.faces, [0, 8, 1], [3, 3, 4]])
        assert len(M.make_mesh(vertices, faces).faces) == 12


def test_mirroring_keeps_faces_and_normals_outward():
    ball = P.sphere()
    for matrix in (np.diag([-1.0, 2, 1]), np.diag([1.0, 1, 1, 1]) + np.eye(4, k=1) * 0.3):
        moved = M.transform_mesh(ball, matrix)
        v = moved.vertices[moved.faces]
        out = np.cross(v[:, 1] - v[:, 0], v[:, 2] - v[:, 0])
        assert ((moved.normals[moved.faces].mean(axis=1) * out).sum(axis=1) > 0).all()
        assert np.einsum("ij,ij->i", v[:, 0], np.cross(v[:, 1], v[:, 2])).sum() > 0


def test_normalise_centres_the_box_and_scales_the_sphere():
    (mesh,) = M.normalise((M.make_mesh(CUBE.vertices * [1, 2, 3] + [5, 6, 7], CUBE.faces),))
    low, high = M.bounds((mesh,))
    np.testing.assert_allclose(low, -high, atol=1e-12)
    assert mesh.radius == pytest.approx(1, rel=1e-12)


def test_same_input_same_arrays():
    a, b = (M.make_mesh(CUBE.vertices, CUBE.faces) for _ in range(2))
    for name in ("vertices", "faces", "normals", "uvs"):
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


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
    with pytest.raises(AssetError) as error:
        M.make_mesh(vertices, faces, where="broken.obj")
    assert str(error.value).startswith("broken.obj: ") and message in str(error.value) and "\n" not in str(error.value)


def test_too_many_faces():
    with pytest.raises(AssetError, match=r"too many faces \(got 12\); expected at most 11"):
        M.make_mesh(CUBE.vertices, CUBE.faces, max_faces=11)


def test_nan_in_an_unused_vertex_is_no_problem():
    assert M.make_mesh(np.vstack([CUBE.vertices, [[np.nan] * 3]]), CUBE.faces).closed
