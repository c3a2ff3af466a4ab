"""Primitives against formulas: closedness, outward winding, volume and area with their
convergence order, normals, uvs."""

import math

import numpy as np
import pytest

from blinkgl.config.primitives import PRIMITIVES, PrimitiveKind, kinds, seed_of
from blinkgl.errors import AssetError
from blinkgl.scene.geometry import primitives as P
from blinkgl.scene.geometry.meshes import make_mesh
from blinkgl.scene.geometry.random_primitives import RANDOM, random_primitive
from tests.refusals import refusal
from tests.scene.faces import area, outwards, uv_turns, vectors, volume


@pytest.mark.parametrize("kind", kinds("pool"))
def test_closed_outward_unit_normals(kind):
    mesh = P.BUILDERS[kind]()
    assert mesh.closed and volume(mesh) > 0
    np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-6)
    # each corner's normal is on its face's outer side, within the facet's own curvature
    faces = vectors(mesh.vertices, mesh.faces)
    unit = faces / np.linalg.norm(faces, axis=1, keepdims=True)
    assert np.einsum("fkj,fj->fk", mesh.normals[mesh.faces].astype(float), unit).min() > 0.8
    assert np.isfinite(mesh.uvs).all() and mesh.uvs.min() >= -1e-6 and mesh.uvs.max() <= 1.05


def test_flat_solids_exactly():
    box = P.cuboid(extents=(1.0, 2.0, 3.0), subdivisions=3)
    assert volume(box) == pytest.approx(6, rel=1e-12) and area(box) == pytest.approx(22, rel=1e-12)
    hexagon = 3 * math.sqrt(3) / 2 * 0.5**2
    assert volume(P.prism(sides=6, radius=0.5, height=2.0)) == pytest.approx(2 * hexagon, rel=1e-12)
    assert volume(P.pyramid(sides=6, radius=0.5, height=2.0)) == pytest.approx(2 * hexagon / 3, rel=1e-12)
    flat = P.grid(width=2.0, depth=3.0, subdivisions=4)
    assert area(flat) == pytest.approx(6, rel=1e-12) and not flat.closed and (flat.normals == [0, 0, 1]).all()


CURVED = {
    "sphere": (lambda n: P.sphere(radius=1.0, segments=2 * n, rings=n), 4 / 3 * math.pi, 4 * math.pi),
    "cylinder": (lambda n: P.cylinder(radius=1.0, height=2.0, segments=n), 2 * math.pi, 6 * math.pi),
    "cone": (lambda n: P.cone(radius=1.0, height=2.0, segments=n), 2 * math.pi / 3, math.pi * (1 + math.sqrt(5))),
    "torus": (
        lambda n: P.torus(radius=1.0, tube=0.4, segments=n, tube_segments=n),
        2 * math.pi**2 * 0.16,
        4 * math.pi**2 * 0.4,
    ),
    "capsule": (
        lambda n: P.capsule(radius=1.0, height=2.0, segments=2 * n, rings=n),
        4 / 3 * math.pi + 2 * math.pi,
        8 * math.pi,
    ),
}


@pytest.mark.parametrize("kind", CURVED)
def test_curved_solids_converge_with_order_two(kind):
    build, true_volume, true_area = CURVED[kind]
    sizes = np.array([16, 32, 64])
    errors = np.array([[true_volume - volume(build(int(n))), true_area - area(build(int(n)))] for n in sizes])
    assert (errors > 0).all()  # inscribed
    for column in errors.T:
        order = -np.polyfit(np.log(sizes), np.log(column), 1)[0]
        assert order == pytest.approx(2, abs=0.1)


def test_icosphere_is_on_the_sphere_and_converges():
    errors = []
    for k in (1, 2, 3):
        mesh = P.icosphere(radius=2.0, subdivisions=k)
        assert len(mesh.faces) == 20 * 4**k
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 2, rtol=1e-12)
        np.testing.assert_allclose(mesh.normals, mesh.vertices / 2, atol=1e-6)
        errors.append(1 - volume(mesh) / (4 / 3 * math.pi * 8))
    assert np.polyfit(range(3), np.log2(errors), 1)[0] == pytest.approx(-2, abs=0.15)


@pytest.mark.parametrize("kind", ["sphere", "torus", "capsule", "cylinder", "cone"])
def test_analytic_normals_against_angle_weighted_ones(kind):
    fine = {
        "sphere": dict(segments=128, rings=64),
        "torus": dict(segments=128, tube_segments=64),
        "capsule": dict(segments=128, rings=64),
    }
    mesh = P.BUILDERS[kind](**fine.get(kind, dict(segments=128)))
    made = make_mesh(mesh.vertices, mesh.faces, uvs=mesh.uvs)
    cosine = (made.normals[made.faces] * mesh.normals[mesh.faces]).sum(axis=2)
    if kind == "cone":  # at the tip the analytic normal differs from segment to segment
        cosine = cosine[mesh.vertices[mesh.faces][:, :, 2].max(axis=1) < 0.49]
    assert cosine.min() > math.cos(math.radians(3))


def test_textures_are_not_mirrored():
    """Seen from outside, u x (-v) points at the viewer: a map with positive determinant everywhere."""
    for kind in kinds("pool"):
        assert (uv_turns(P.BUILDERS[kind]()) < 1e-9).all(), kind


@pytest.mark.parametrize(
    "kind, parameters, message",
    [
        (
            "cuboid",
            {"extents": (1.0, -1.0, 1.0)},
            "cuboid.extents: bad parameter (got (1.0, -1.0, 1.0)); expected 3 numbers greater than 0",
        ),
        ("sphere", {"segments": 2}, "sphere.segments: bad parameter (got 2); expected a whole number in 3..4096"),
        (
            "sphere",
            {"radius": float("nan")},
            "sphere.radius: bad parameter (got nan); expected a number greater than 0",
        ),
        ("torus", {"tube": 0.5}, "torus.tube: bad parameter (got 0.5); expected less than radius 0.35"),
        (
            "icosphere",
            {"subdivisions": 12},
            "icosphere.subdivisions: bad parameter (got 12); expected a whole number in 0..7",
        ),
        (
            "cone",
            {"hight": 2},
            "cone: unknown parameter (got 'hight'); expected one of radius, height, segments, rings",
        ),
    ],
)
def test_bad_parameters(kind, parameters, message):
    assert refusal(AssetError, P.BUILDERS[kind], **parameters) == message


def test_hash_is_of_the_parameters():
    assert P.sphere().source_hash == P.sphere(radius=0.5).source_hash != P.sphere(radius=0.6).source_hash
    # pinned: a published data set's splits depend on it
    assert P.cuboid().source_hash == "55684c5d222dadfe09b8cc81c42433ea"


def test_every_parameter_is_documented():
    assert {name for kind in P.BUILDERS for name in P.parameters(kind)} == set(P.PARAMETERS)


@pytest.mark.parametrize("rounding", [0.05, 0.12, 0.5])
def test_a_die_is_a_rounded_cube_with_a_face_in_each_sixth_of_its_texture(rounding):
    mesh = P.die(size=0.2, rounding=rounding)
    assert mesh.closed
    r, h = 0.2 * rounding, 0.1
    core = np.clip(mesh.vertices, -(h - r), h - r)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices - core, axis=1), r, rtol=1e-9)
    np.testing.assert_allclose(mesh.vertices - core, r * mesh.normals, atol=1e-8)
    assert (outwards(mesh.vertices, mesh.faces) > 0).all()
    # Opposite faces are 7 together; not mirrored.
    numbers = {}
    for axis, sign in ((0, 1), (0, -1), (1, 1), (1, -1), (2, 1), (2, -1)):
        inside = sign * mesh.normals[:, axis] > 0.999 if rounding < 0.5 else sign * mesh.normals[:, axis] > 0.9
        u, v = mesh.uvs[inside].mean(axis=0)
        numbers[axis, sign] = 1 + int(v * 2) * 3 + int(u * 3)
    assert sorted(numbers.values()) == [1, 2, 3, 4, 5, 6]
    assert all(numbers[axis, 1] + numbers[axis, -1] == 7 for axis in range(3))
    assert (uv_turns(mesh) < 1e-9).all()


def test_a_die_cannot_be_rounder_than_a_ball():
    refusal(AssetError, P.die, rounding=0.6, match=r"die.rounding: bad parameter \(got 0.6\); expected at most 0.5")


# --- where the texture lies, and how large bodies are -----------------------------------------------------------------

TALL = {
    "sphere": dict(radius=2.0, segments=7, rings=5),
    "cylinder": dict(radius=2.0, height=3.0, segments=7, rings=4),
    "cone": dict(radius=2.0, height=3.0, segments=7, rings=5),
    "torus": dict(radius=2.0, tube=0.5, segments=7, tube_segments=6),
    "capsule": dict(radius=2.0, height=3.0, segments=7, rings=6),
}


def test_every_kind_is_built_and_every_pooled_one_drawn():
    assert set(P.BUILDERS) == set(PRIMITIVES)
    assert set(RANDOM) == set(kinds("pool", "living"))
    numbers = [kind.category for kind in PRIMITIVES.values()]
    assert len(set(numbers)) == len(numbers) and min(numbers) > 3, "1 to 3 are sky, ground and wall"


def test_another_kind_changes_no_other_shape(monkeypatch):
    """Random shapes hang on their kind's own seed, wherever it stands in the table."""
    before = {kind: random_primitive(kind, 3) for kind in RANDOM}
    monkeypatch.setitem(PRIMITIVES, "brick", PrimitiveKind("pool"))
    table = {"brick": PRIMITIVES["brick"], **PRIMITIVES}
    monkeypatch.setattr("blinkgl.config.primitives.PRIMITIVES", table)
    assert "brick" in kinds("pool") and seed_of("brick") not in {kind.seed for kind in PRIMITIVES.values()}
    for kind, mesh in before.items():
        np.testing.assert_array_equal(random_primitive(kind, 3).vertices, mesh.vertices, err_msg=kind)


def test_a_builder_of_an_unknown_kind_is_refused():
    with pytest.raises(TypeError, match="no primitive 'brick' in config/primitives.py"):

        @P.primitive
        def brick(): ...
