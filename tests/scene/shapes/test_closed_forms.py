"""Deformers by formula: their rates, normals and differences are those of their positions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from blinkgl.config.deform import BendConfig, BreatheConfig, FlagConfig, TwistConfig, WaveConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.shapes.table import deformer_of

MS = 1_000_000
KINDS = {
    "wave": WaveConfig(along="y", amplitude=0.2),
    "flag": FlagConfig(phase=40),
    "twist": TwistConfig(angle=200),
    "bend": BendConfig(angle=80, held=0.3),
    "breathe": BreatheConfig(amount=(0.4, 0.2, -0.3)),
}
TIMES = (0, 137 * MS, 1_812_345_678, 10**15 + 137 * MS)


def body(kind, build="icosphere", **parameters):
    mesh = BUILDERS[build](**parameters)
    return replace(mesh, deformer=deformer_of(KINDS[kind], mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)))


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("t", TIMES)
def test_velocity_is_the_rate_of_the_positions(kind, t):
    mesh, h = body(kind), 1000
    before, after = (mesh.deformer.positions(mesh, t + dt) for dt in (-h, h))
    velocity = mesh.deformer.velocity(mesh, t)
    np.testing.assert_allclose(velocity, (after - before) / (2e-9 * h), atol=1e-8)
    assert np.abs(velocity).max() > 0.01


@pytest.mark.parametrize("kind", KINDS)
def test_normals_are_those_of_the_surface(kind):
    """Across two directions along the surface, moved as the shape moves them."""
    mesh, t, h = body(kind), 137 * MS, 1e-6
    n = mesh.normals.astype(np.float64)
    u = np.cross(n, np.where(np.abs(n[:, :1]) < 0.6, [[1.0, 0, 0]], [[0, 1.0, 0]]))
    moved = lambda way: mesh.deformer.positions(replace(mesh, vertices=mesh.vertices + way), t)
    across = np.cross(moved(h * u) - moved(-h * u), moved(h * np.cross(n, u)) - moved(-h * np.cross(n, u)))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    normals = mesh.deformer.normals(mesh, t)
    np.testing.assert_allclose(normals / np.linalg.norm(normals, axis=1, keepdims=True), across, atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_a_shape_elsewhere_in_its_file_changes_in_the_same_way(kind):
    here, offset = BUILDERS["icosphere"](), np.array([3.0, -2.0, 5.0])
    at = []
    for mesh in (here, replace(here, vertices=here.vertices + offset)):
        ends = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        at.append(deformer_of(KINDS[kind], *ends).positions(mesh, 137 * MS))
    np.testing.assert_allclose(at[1] - offset, at[0], atol=1e-6)


@pytest.mark.parametrize("kind", KINDS)
def test_bounds_hold_every_shape(kind):
    mesh = body(kind)
    low, high = mesh.deformer.bounds(mesh, 0, 900 * MS)
    for t in np.linspace(0, 900 * MS, 401).astype(np.int64):
        at = mesh.deformer.positions(mesh, int(t))
        assert (at >= low).all() and (at <= high).all()
    rest = np.ptp(mesh.vertices, axis=0).max()
    assert (high - low).max() < 2.2 * rest  # and hold little else
    vertices, faces = mesh.deformer.sweep(mesh, 0, 900 * MS).hull
    corners = vertices[faces] - vertices.mean(axis=0)
    assert (np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) * corners.mean(axis=1)).sum(
        axis=1
    ).min() > 0


def test_a_configuration_is_refused_in_words():
    from blinkgl.config.problems import validate
    from blinkgl.config.scene import ObjectConfig

    for data, said in (
        ({"kind": "wobble"}, "wobble"),
        ({"kind": "wave", "towards": "x"}, "must be another axis than along"),
        ({"kind": "breathe", "amount": [1, 0, 0]}, "amount"),
        ({"kind": "bend", "wavelength": 1}, "wavelength"),
    ):
        with pytest.raises(ConfigError, match=said):
            validate(ObjectConfig, {"mesh": "a", "deform": data})
