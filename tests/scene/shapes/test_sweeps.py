"""What a shape sweeps: looked at at some times, held at all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from skinned import arm

from blinkgl.scene.geometry.living import fish, flag
from blinkgl.scene.geometry.primitives import icosphere
from blinkgl.scene.geometry.random_primitives import random_primitive
from blinkgl.scene.shapes.deformer import Sweep, filled
from blinkgl.scene.shapes.skin import Morphs, Skin

MS = 1_000_000


def ball(factor, period_ns=1000 * MS):
    """A small ball that a morph target takes along x by ``factor``(share of the period): the weight and its rate."""
    mesh = icosphere(subdivisions=1)
    shift = np.zeros((1, len(mesh.vertices), 3))
    shift[..., 0] = 1.0

    def weights(t_ns):
        value, rate = factor((t_ns % period_ns) / period_ns)
        return np.array([value]), np.array([rate / (period_ns * 1e-9)])

    return replace(mesh, deformer=Skin.morphing(Morphs(shift, None, weights, False, period_ns, period_ns)))


def zigzag(x):
    """Turns round at shares that no sample falls on."""
    return (x / 0.37, 1 / 0.37) if x < 0.37 else ((1 - x) / 0.63, -1 / 0.63)


SHAPES = {
    "walks": lambda: random_primitive("figure", 0),
    "dances": lambda: random_primitive("figure", 1),
    "runs": lambda: random_primitive("figure", 2),
    "waves": lambda: random_primitive("figure", 5),
    "fish": fish,
    "flag": flag,
    "arm": arm,
    "to and fro": lambda: ball(zigzag),
    "a fast sine": lambda: ball(lambda x: (np.sin(14 * np.pi * x + 0.1), 14 * np.pi * np.cos(14 * np.pi * x + 0.1))),
}


def test_a_shape_that_is_shrunk_to_a_point_has_a_hull():
    mesh = icosphere(subdivisions=1)
    gone = Morphs(-mesh.vertices[None], None, lambda t_ns: (np.ones(1), np.zeros(1)), False, MS, MS)
    mesh = replace(mesh, deformer=Skin.morphing(gone))
    corners, _ = mesh.deformer.sweep(mesh, 0, MS).hull
    assert len(corners) > 3 and np.abs(corners).max() < 1e-5


@pytest.mark.parametrize("name", SHAPES)
def test_no_shape_leaves_what_it_is_said_to_sweep(name):
    """Box and hull with its margin, at 97 times that are not those that were looked at; the margin is no excuse,
    either."""
    mesh = SHAPES[name]()
    swept = mesh.deformer.sweep(mesh, 0, mesh.deformer.span_ns)
    planes = ConvexHull(swept.hull[0]).equations
    outside, beyond = -np.inf, -np.inf
    for t in np.linspace(0, mesh.deformer.span_ns, 99).astype(np.int64)[1:-1]:
        points = mesh.deformer.positions(mesh, int(t))
        outside = max(outside, float((swept.low - points).max()), float((points - swept.high).max()))
        beyond = max(beyond, float((points @ planes[:, :3].T + planes[:, 3]).max()))
    assert outside <= 0 and beyond <= swept.margin
    assert beyond > -0.2 * mesh.radius and swept.margin < 0.15 * (swept.high - swept.low).max()
    assert filled(mesh)[1] == swept.margin


def test_a_hull_reaches_as_far_as_its_points_in_every_direction():
    """Against all points at once, in directions that it does not know."""
    mesh = random_primitive("figure", 1)
    swept = Sweep.of(mesh.deformer, mesh, 0, 300 * MS)
    points = np.concatenate([mesh.deformer.positions(mesh, t) for t in swept.times])
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    gap = (swept.hull[0] @ directions.T).max(axis=0) - (points @ directions.T).max(axis=0)
    assert gap.min() >= 0 and gap.max() < 0.1 * np.linalg.norm(swept.high - swept.low)
    np.testing.assert_array_equal(swept.low + swept.margin, points.min(axis=0))
    np.testing.assert_array_equal(swept.high - swept.margin, points.max(axis=0))


def test_a_skin_follows_its_joints_term_by_term():
    """Positions and velocities against the sum of the definition, morph targets included."""
    mesh = arm()
    skin, rng = mesh.deformer, np.random.default_rng(1)
    deltas = rng.normal(size=(2, len(mesh.vertices), 3))
    morphs = Morphs(deltas, None, lambda t: (np.array([0.3, -0.2]), np.array([2.0, 1.0])))
    both = Skin(skin.skeleton, skin.bones, skin.inverse_bind, skin.joints, skin.weights, morphs)
    J, dJ = skin.matrices(123 * MS)
    for shape, morph, rate in ((skin, 0, 0), (both, 0.3 * deltas[0] - 0.2 * deltas[1], 2 * deltas[0] + deltas[1])):
        place, speed = np.zeros((2, len(mesh.vertices), 3))
        for w, j in zip(skin.weights.T, skin.joints.T):
            p = np.einsum("vij,vj->vi", J[j][:, :3, :3], mesh.vertices + morph) + J[j][:, :3, 3]
            v = np.einsum("vij,vj->vi", dJ[j][:, :3, :3], mesh.vertices + morph) + dJ[j][:, :3, 3]
            v += np.einsum("vij,vj->vi", J[j][:, :3, :3], 0 * mesh.vertices + rate)
            place, speed = place + w[:, None] * p, speed + w[:, None] * v
        np.testing.assert_allclose(shape.positions(mesh, 123 * MS), place, atol=1e-12)
        np.testing.assert_allclose(shape.velocity(mesh, 123 * MS), speed, atol=1e-11)
