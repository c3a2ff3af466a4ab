"""The body of a figure: one watertight skin of the proportions that are asked for; flags and fish."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.errors import AssetError
from blinkgl.scene.geometry.figure import ATLAS, CHARTS, isosurface
from blinkgl.scene.geometry.living import figure, fish, flag
from blinkgl.scene.geometry.meshes import closedness, uvs_degenerate, weld
from blinkgl.scene.shapes.gait import CLIPS
from tests.scene.faces import outwards, uv_turns, vectors

MS = 1_000_000
PEOPLE = [
    {},
    {"height": 1.1, "head": 1.4, "build": 1.3, "clip": "run"},
    {"height": 1.95, "legs": 1.2, "arms": 0.8, "build": 0.7, "clip": "dance", "variant": 3},
]
LIVING = [*((figure, keys) for keys in PEOPLE), (flag, {}), (fish, {}), (fish, {"deep": 0.7, "length": 2.0})]


@pytest.mark.parametrize(("build", "keys"), LIVING)
def test_a_skin_is_watertight_and_its_normals_face_out(build, keys):
    mesh = build(**keys)
    assert mesh.closed and closedness(*weld(mesh.vertices, mesh.faces))
    for t in (0, 130 * MS, 700 * MS):
        at, n = mesh.deformer.positions(mesh, t), mesh.deformer.normals(mesh, t)
        outward = vectors(at, mesh.faces)
        size, agree = np.linalg.norm(outward, axis=1), (n[mesh.faces].mean(axis=1) * outward).sum(axis=1)
        assert size[agree <= 0].sum() < 0.01 * size.sum()
        assert outwards(at, mesh.faces).sum() > 0
        np.testing.assert_allclose(np.linalg.norm(mesh.normals, axis=1), 1, atol=1e-5)


@pytest.mark.parametrize("keys", PEOPLE)
def test_proportions_are_those_asked_for(keys):
    mesh = figure(**keys)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    assert abs(low[2]) < 0.004 and high[2] == pytest.approx(keys.get("height", 1.75), rel=0.01)
    assert 2000 <= len(mesh.vertices) <= 6000
    assert low[1] == pytest.approx(-high[1], rel=0.01)
    weights = mesh.deformer.weights
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-6)
    assert (weights >= 0).all() and len(mesh.deformer.skeleton.parents) == 21
    # Skin does not tear: neighbours follow much the same joints.
    full = np.zeros((len(weights), 21))
    np.add.at(full, (np.arange(len(weights))[:, None], mesh.deformer.joints), weights)
    assert np.abs(full[mesh.faces] - full[np.roll(mesh.faces, 1, axis=1)]).sum(axis=2).max() < 1.2


def test_texture_coordinates_are_an_atlas_in_one_scale():
    mesh = figure()
    assert not uvs_degenerate(mesh.vertices, mesh.faces, mesh.uvs)
    ratio = ATLAS**2 * np.abs(uv_turns(mesh)) / np.linalg.norm(vectors(mesh.vertices, mesh.faces), axis=1)
    assert 0.4 < np.median(ratio) < 1.4
    assert np.quantile(ratio, 0.1) > 0.15 and np.quantile(ratio, 0.9) < 3
    # No face is drawn over more than a part of the body: no seam runs through one. (At the crown all of them meet.)
    width = np.ptp(mesh.uvs[mesh.faces], axis=1).max(axis=1)
    assert np.quantile(width, 0.99) < 0.06 and width.max() < 0.3
    boxes = [(c.left, c.top, c.left + c.around, c.top + c.length) for c in CHARTS.values()]
    for k, one in enumerate(boxes):
        assert min(one) >= 0 and max(one) <= ATLAS
        for other in boxes[k + 1 :]:
            assert one[2] <= other[0] or other[2] <= one[0] or one[3] <= other[1] or other[3] <= one[1]


@pytest.mark.parametrize(
    ("where", "accepted", "build", "keys"),
    [
        ("figure.clip", ", ".join(CLIPS), figure, {"clip": "jog"}),
        ("figure.tempo", "a number from 0.1 to 4", figure, {"tempo": 0}),
        ("figure.tempo", "a number", figure, {"tempo": "fast"}),
        ("figure.height", "a number greater than 0", figure, {"height": -1.7}),
        ("figure.height", "a number up to 1000", figure, {"height": 1e4}),
        ("figure.legs", "a number from 0.7 to 1.4", figure, {"legs": 9}),
        ("figure.build", "a number from 0.7 to 1.4", figure, {"build": (1, 1, 1)}),
        ("figure.coat", "a whole number", figure, {"coat": -1}),
        ("figure.variant", "a whole number", figure, {"variant": 1.5}),
        ("figure.phase", "a number from 0 to 1", figure, {"phase": float("nan")}),
        ("flag.wind", "a number from 0.1 to 4", flag, {"wind": 0}),
        ("fish.length", "a number greater than 0", fish, {"length": 0}),
        ("fish", "one of length", fish, {"clip": "walk"}),
    ],
)
def test_what_cannot_be_made_is_refused_in_one_line(where, accepted, build, keys):
    with pytest.raises(AssetError) as error:
        build(**keys)
    said = str(error.value)
    assert said.startswith(where) and accepted in said and "\n" not in said


def test_a_surface_lies_where_the_function_is_zero():
    def distance(points):
        ring = np.hypot(np.linalg.norm(points[:, :2], axis=1) - 1, points[:, 2]) - 0.4
        return np.minimum(ring, np.linalg.norm(points - [0, 0, 1.2], axis=1) - 0.3)

    points, faces, normals = isosurface(distance, np.full(3, -1.7), np.full(3, 1.8), 0.08)
    assert np.abs(distance(points)).max() < 1e-6
    assert closedness(points, faces.astype(np.int64))
    true = 2 * np.pi**2 * 0.4**2 + 4 / 3 * np.pi * 0.3**3
    assert outwards(points, faces).sum() / 6 == pytest.approx(true, rel=0.02)
    ring = points[:, 2] < 0.6
    ahead = points * [1, 1, 0] / np.linalg.norm(points[:, :2], axis=1)[:, None].clip(1e-9)
    outward = points - ahead
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    np.testing.assert_allclose(normals[ring], outward[ring], atol=1e-4)
