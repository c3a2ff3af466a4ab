"""Deformers by formula: their rates, normals and differences are those of their positions."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import ClassVar, Literal

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from skinned import arm

from blinkgl.cli import run
from blinkgl.config.deform import BendConfig, BreatheConfig, DeformConfig, FlagConfig, TwistConfig, WaveConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import ObjectConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.geometry import BUILDERS
from blinkgl.scene.geometry.living import fish, flag
from blinkgl.scene.geometry.primitives import icosphere
from blinkgl.scene.geometry.random_primitives import random_primitive
from blinkgl.scene.shapes.skin import Morphs, Skin
from blinkgl.scene.shapes.sweep import Sweep, filled, sweep
from blinkgl.scene.shapes.table import DEFORMERS, deformer_of, register
from blinkgl.scene.types import Deformer
from tests.refusals import refusal
from tests.scene.faces import outwards

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
    swept = sweep(mesh, 0, 900 * MS)
    low, high = swept.low, swept.high
    for t in np.linspace(0, 900 * MS, 401).astype(np.int64):
        at = mesh.deformer.positions(mesh, int(t))
        assert (at >= low).all() and (at <= high).all()
    rest = np.ptp(mesh.vertices, axis=0).max()
    assert (high - low).max() < 2.2 * rest  # and hold little else
    vertices, faces = sweep(mesh, 0, 900 * MS).hull
    assert outwards(vertices - vertices.mean(axis=0), faces).min() > 0


def test_a_configuration_is_refused_in_words():
    for data, said in (
        ({"kind": "wobble"}, "wobble"),
        ({"kind": "wave", "towards": "x"}, "must be another axis than along"),
        ({"kind": "breathe", "amount": [1, 0, 0]}, "amount"),
        ({"kind": "bend", "wavelength": 1}, "wavelength"),
    ):
        refusal(ConfigError, validate, ObjectConfig, {"mesh": "a", "deform": data}, match=said)


# --- What a shape sweeps: looked at at some times, held at all.


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
    corners, _ = sweep(mesh, 0, MS).hull
    assert len(corners) > 3 and np.abs(corners).max() < 1e-5


@pytest.mark.parametrize("name", SHAPES)
def test_no_shape_leaves_what_it_is_said_to_sweep(name):
    """Box and hull with its margin, at 97 times that are not those that were looked at; the margin is no excuse,
    either."""
    mesh = SHAPES[name]()
    swept = sweep(mesh, 0, mesh.deformer.span_ns)
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


# --- The table of deformers: one that is registered from outside is configured, drawn, judged and taken out again.


class ShearConfig(DeformConfig):
    """x moves with z, to and fro."""

    kind: Literal["shear"] = "shear"
    amount: float = 0.4


class Shear(Deformer):
    """x + a sin(2 pi t) z."""

    Config = ShearConfig
    rows: ClassVar[int] = 1
    period_ns = span_ns = 1_000_000_000
    glsl = "shear"
    source = """
vec3 deformed(vec3 p) { return p + vec3(shape[0].x * p.z, 0.0, 0.0); }
vec3 deformed_rate(vec3 p) { return vec3(shape[SHAPE_RATE].x * p.z, 0.0, 0.0); }
vec3 deformed_change(vec3 p, int other) { return vec3(shape[other].x * p.z, 0.0, 0.0); }
vec3 deformed_normal(vec3 p, vec3 n) { return n - vec3(0.0, 0.0, shape[0].x * n.x); }
vec3 deformed_normal_rate(vec3 p, vec3 n) { return vec3(0.0, 0.0, -shape[SHAPE_RATE].x * n.x); }
"""

    def __init__(self, amount):
        self.amount = amount

    @classmethod
    def of(cls, config, low, high):
        return cls(config.amount)

    def _at(self, t_ns):
        phase = 2 * np.pi * 1e-9 * t_ns
        return self.amount * np.sin(phase), self.amount * 2 * np.pi * np.cos(phase)

    def positions(self, mesh, t_ns):
        return mesh.vertices + self._at(t_ns)[0] * mesh.vertices[:, 2:] * [1, 0, 0]

    def velocity(self, mesh, t_ns):
        return self._at(t_ns)[1] * mesh.vertices[:, 2:] * [1, 0, 0]

    def normals(self, mesh, t_ns):
        return mesh.normals - self._at(t_ns)[0] * mesh.normals[:, :1] * [0, 0, 1.0]

    def numbers(self, t_ns):
        return np.array([[self._at(t_ns)[0], 0, 0, 0]])

    def rates(self, t_ns):
        return np.array([[self._at(t_ns)[1], 0, 0, 0]])

    def changes(self, t_ns, there_ns):
        return np.array([[self._at(there_ns)[0] - self._at(t_ns)[0], 0, 0, 0]])


YAML = """
camera: {width: 48, height: 36}
time: {duration: 0.02, label_rate: 100}
timeline: {kind: uniform, fps: 200}
labels: {flow: [forward, backward], velocity: true, normals: true}
preview: {enabled: false}
scene:
  kind: explicit
  meshes: {box: {primitive: cuboid}}
  objects: [{mesh: box, position: [3, 0, 0], euler: [10, 20, 30], deform: {kind: shear, amount: 0.6}}]
  camera: {position: [0, 0, 0.3]}
"""


def test_one_from_outside_is_generated_and_judged(tmp_path, capsys):
    (tmp_path / "c.yaml").write_text(YAML)
    register(Shear)
    try:
        assert validate(ObjectConfig, {"mesh": "a", "deform": {"kind": "shear"}}).deform == ShearConfig()
        assert run(["generate", str(tmp_path / "c.yaml"), "--out", str(tmp_path / "out")]) == 0
        capsys.readouterr()
        assert run(["shader", "diff", str(tmp_path / "c.yaml"), "--json"]) == 0
        reports = {b["buffer"]: b for b in json.loads(capsys.readouterr().out)["buffers"]}
        assert reports["flow_forward"]["off_silhouettes"]["pixels"] > 100
    finally:
        del DEFORMERS["Shear"], DeformConfig.members["shear"]
    refusal(ConfigError, validate, ObjectConfig, {"mesh": "a", "deform": {"kind": "shear"}}, match="shear")


@pytest.mark.parametrize(
    "part, value, said",
    [
        ("glsl", "Not a word", "glsl"),
        ("source", "vec3 deformed(vec3 p) { return p; }", "does not define vec3 deformed_rate"),
        ("source", None, "so is the file shaders/include/deform/shear.glsl"),
        ("Config", ObjectConfig, "no DeformConfig"),
        ("of", Deformer.of, "`of` is missing"),
        ("__name__", "Wave", "is taken"),
    ],
)
def test_a_part_that_is_wrong_is_named(part, value, said):
    broken = type("Shear", (Shear,), {part: value} if part != "__name__" else {})
    if part == "__name__":
        broken.__name__ = value
    before = dict(DEFORMERS)
    with pytest.raises(TypeError, match=said):
        register(broken)
    assert before == DEFORMERS
    with pytest.raises(TypeError, match="`rates` is missing"):
        register(type("Half", (Deformer,), {k: v for k, v in vars(Shear).items() if k != "rates"}))
