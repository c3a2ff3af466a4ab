"""What a scene's light and its surfaces cannot be: one line each, with key, value and what is
accepted, before any work starts."""

from __future__ import annotations

import pytest
import yaml

from blinkgl.cli import run

BASE = {
    "camera": {"width": 16, "height": 12},
    "time": {"duration": 0.2, "label_rate": 10},
    "scene": {
        "kind": "explicit",
        "meshes": {"box": {"primitive": "cuboid"}},
        "materials": {"m": {}},
        "objects": [{"mesh": "box", "material": "m", "position": [0, 4, 0]}],
        "camera": {"look_at": [0, 4, 0]},
    },
}
LAMP = {"kind": "point", "position": [0, 0, 1]}
INF, NAN = float("inf"), float("nan")
ROWS = [
    ("scene.light.sun", -1, "scene.light.sun: too small (got -1); expected a number from 0 to 1e+09"),
    ("scene.light.sky", INF, "scene.light.sky: not a finite number (got inf)"),
    ("scene.light.sun_color", [1, -1, 1], "scene.light.sun_color.1: too small (got -1)"),
    ("scene.light.lights", [LAMP | {"strength": -2}], "scene.light.lights.0.strength: too small (got -2)"),
    ("scene.light.lights", [LAMP | {"strength": INF}], "scene.light.lights.0.strength: not a finite number (got inf)"),
    ("scene.light.lights", [LAMP | {"strength": NAN}], "scene.light.lights.0.strength: not a finite number (got nan)"),
    ("scene.light.lights", [LAMP] * 33, "scene.light.lights: too many lights (got 33); expected at most 31"),
    ("scene.light.shadow_size", 30000, "scene.light.shadow_size: too large (got 30000)"),
    ("scene.light.environment", {"map": "no.hdr"}, "scene.light.environment.map: no such file (got 'no.hdr')"),
    ("scene.light.environment", {"map": "a", "strength": INF}, "environment.strength: not a finite number (got inf)"),
    ("scene.light", {"unlit": True, "shadows": "hard"}, "scene.light.shadows: nothing is lit by them"),
    ("scene.materials.m.normal_map", "no.png", "scene.materials.m.normal_map: no such file (got 'no.png')"),
    ("scene.materials.m.emission_map", "a.png", "scene.materials.m.emission: a map of light that is none"),
    ("scene.materials.m.normal_scale", NAN, "scene.materials.m.normal_scale: not a finite number (got nan)"),
    ("scene.materials.m.metallic", 2, "scene.materials.m.metallic: too large (got 2); expected a number from 0 to 1"),
    ("scene.fog", {"density": -1}, "scene.fog.density: too small (got -1)"),
]


@pytest.mark.parametrize("key, value, words", ROWS, ids=[f"{k.rpartition('.')[2]}-{v}"[:40] for k, v, _ in ROWS])
def test_one_line_with_the_key(tmp_path, monkeypatch, capsys, key, value, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bad.yaml").write_text(yaml.safe_dump(BASE))
    option = f"{key}={yaml.safe_dump([value], default_flow_style=True, width=9999).strip()[1:-1]}"
    assert run(["generate", "bad.yaml", "--out", "out", "--set", option]) == 2
    said = capsys.readouterr().err
    assert said.startswith("error: ") and said.count("\n") == 1 and words in said, said
    assert not (tmp_path / "out").exists()
