"""The table of deformers: one that is registered from outside is configured, drawn, judged and taken out again."""

from __future__ import annotations

import json
from typing import ClassVar, Literal

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.config.deform import DeformConfig
from blinkgl.config.problems import validate
from blinkgl.config.scene import ObjectConfig
from blinkgl.errors import ConfigError
from blinkgl.scene.shapes.deformer import Deformer
from blinkgl.scene.shapes.table import DEFORMERS, register, unregister


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
        unregister(Shear)
    with pytest.raises(ConfigError, match="shear"):
        validate(ObjectConfig, {"mesh": "a", "deform": {"kind": "shear"}})


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
