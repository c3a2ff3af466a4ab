"""The YAML as a user writes it, and what a user reads when it is wrong."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path

import pytest
import yaml

from blinkgl.camera import PinHole
from blinkgl.cli import run
from blinkgl.config.camera import CameraConfig
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.config.sequence import TimeConfig
from blinkgl.errors import ConfigError
from tests.refusals import refusal


def write(tmp_path, text):
    path = tmp_path / "run.yaml"
    path.write_text(text)
    return path


def test_shipped_configurations_are_valid():
    folder = resources.files("blinkgl.configs")
    shipped = [p for f in (folder, folder / "scenes") for p in f.iterdir() if p.name.endswith(".yaml")]
    assert {p.name for p in shipped} >= {"demo.yaml", "flying_objects.yaml", "falling_dice.yaml"}
    for path in (p for p in shipped if p.name != "blinkflow.yaml"):  # test_recipe.py draws from that one
        for group in load_run(path).groups:
            group.template.sequence(0)


def test_overrides_reach_nested_keys_lists_and_absent_tables(tmp_path):
    path = write(tmp_path, "camera: {width: 64, height: 48}")
    run = load_run(
        path,
        [
            "camera.width=32",
            "time.duration=0.5",
            "labels.flow=[forward, backward]",
            "labels.flow.1=forward",
            "timeline={kind: uniform, fps: 1e2}",
        ],
        seed=9,
    )
    config = run.sequence(0)
    assert (config.camera.width, config.time.duration, config.labels.flow, config.seed) == (
        32,
        0.5,
        ("forward", "forward"),
        9,
    )
    assert config.timeline.kind == "uniform" and config.timeline.fps == 100.0


@pytest.mark.parametrize(
    "given, message",
    [
        ("{integer: [1, 9]}", "seed: belongs to the whole run and cannot be drawn"),
        ("2.5", "seed: not a whole number"),
        ("null", "seed: not a whole number"),
        ("0x" + "f" * 6000, "not valid YAML: a number of 6002 digits"),
        ("'" + "9" * 5000 + "'", "seed: too many digits"),
        ("99999999999999999999", "seed: too large"),
    ],
)
def test_seeds_that_are_none(tmp_path, given, message):
    for text in (f"seed: {given}", f"groups: {{a: {{seed: {given}}}}}"):
        assert message.split(": ", 1)[1] in refusal(ConfigError, load_run, write(tmp_path, text)).replace(
            "in group 'a': ", ""
        )


@pytest.mark.parametrize(
    "time, message",
    [
        (
            "{duration: 5000}",
            (
                "time.duration: with one label interval before and one after, 5000.1 s are more than the 4295.0 s "
                "(71.6 minutes)"
            ),
        ),
        ("{duration: 4000, label_rate: 0.001}", "time.duration: with one label interval"),
        (
            "{duration: 100, label_rate: 1e5}",
            "time.label_rate: 10000000 labels (got 100000.0); expected duration * label_rate of at most 1000000",
        ),
        ("{start: 1.1e7}", "time.start: too large"),
        ("{start: 9e6}\nreadout: {events_per_second: 1e6}", "time.start: too late for the read-out"),
    ],
)
def test_what_no_file_can_hold_is_known_when_it_is_read(tmp_path, time, message):
    assert refusal(ConfigError, load_run, write(tmp_path, f"time: {time}")).startswith(message)


def test_times_of_the_paper():
    time = TimeConfig(duration=1.0, label_rate=10, start=5)
    assert time.label_count == 10 and time.t0_ns == 5_000_000_000
    assert time.label_times_ns[0] - time.t0_ns == 100_000_000, "a label interval of events before the first label"
    assert time.t1_ns - time.t0_ns == 1_100_000_000


def test_field_of_view_is_horizontal_and_the_principal_point_the_centre():
    camera = CameraConfig(width=640, height=480, fov=90).model
    assert math.isclose(camera.fx, 320) and camera.fx == camera.fy and (camera.cx, camera.cy) == (319.5, 239.5)
    assert CameraConfig(focal=77, cx=3, near=2).model == PinHole(346, 260, 77, 77, 3, 129.5, 2)


@pytest.mark.parametrize(
    "text, message",
    [
        ("camra: {width: 3}", "camra: unknown key; expected 'camera' (nearest)"),
        ("camera: {widht: 3}", "camera.widht: unknown key; expected 'width' (nearest)"),
        ("scene: {kind: random, objects: {cuont: 3}}", "scene.objects.cuont: unknown key; expected 'count' (nearest)"),
        (
            "events: {emulator: esim, contrast_treshold: 0.2}",
            "events.contrast_treshold: unknown key; expected 'contrast_threshold' (nearest)",
        ),
        (
            "camera: {width: many}",
            "camera.width: not a whole number (got 'many'); expected a whole number from 1 to 16384",
        ),
        ("camera: {width: 0}", "camera.width: too small (got 0); expected a whole number from 1 to 16384"),
        ("camera: 7", "camera: not a table of keys (got 7)"),
        ("camera: {fov: 60, focal: 200}", "camera: give fov or focal, not both"),
        (
            "camera: {fov: .nan}",
            (
                "camera.fov: not a finite number (got nan); expected a number greater than 0.01 and less than 179.9, "
                "or null"
            ),
        ),
        (
            "time: {duration: -1}",
            "time.duration: too small (got -1); expected a number greater than 0 and at most 172800",
        ),
        ("time: {duration: 0.01}", "time: duration * label_rate must be at least 1 label"),
        (
            "timeline: {kind: regular}",
            "timeline.kind: unknown choice (got 'regular'); expected one of 'uniform', 'displacement'",
        ),
        (
            "timeline: {kind: budget}",
            "timeline.kind: unknown choice (got 'budget'); expected one of 'uniform', 'displacement', 'brightness'",
        ),
        ("timeline: {reconstruction: pchip, kind: uniform}", "timeline.reconstruction: "),
        (
            "timeline: {kind: displacement, min_step_us: 5, max_step_us: 4}",
            "timeline: min_step_us must not exceed max_step_us = 4.0",
        ),
        ("events: {emulator: easim}", "events.emulator: unknown choice (got 'easim')"),
        (
            "labels: {flow: [sideways]}",
            "labels.flow.0: not a direction or an interval (got 'sideways'); expected forward, backward",
        ),
        (
            "output: {name: ../escape}",
            "output.name: not a name for folders (got '../escape'); expected a letter or digit, then",
        ),
        ("seed: -1", "seed: too small (got -1)"),
        (
            "events: {emulator: esim, contrast_threshold: {uniform: [0.1, 11]}}",
            "events.contrast_threshold: too large (got 11.0); expected a number from 0.001 to 10",
        ),
    ],
)
def test_bad_values_name_path_value_and_what_is_accepted(tmp_path, text, message):
    assert refusal(ConfigError, load_run, write(tmp_path, text)).startswith(message)


@pytest.mark.parametrize(
    "content, said",
    [(None, "no such file"), (b"\xff\xfe\x00\x80", "cannot be read"), (b" " * (5 << 20), "too large")],
    ids=["none", "binary", "huge"],
)
def test_missing_binary_and_huge_files(tmp_path, content, said):
    if content:
        (tmp_path / "run.yaml").write_bytes(content)
    with pytest.raises(ConfigError, match=said):
        load_run(tmp_path / "run.yaml")
    with pytest.raises(ConfigError, match="is a folder; expected a YAML file"):
        load_run(tmp_path)


@pytest.mark.parametrize(
    "option, message",
    [
        ("camera.width", "--set: not an override"),
        ("=3", "--set: not an override"),
        ("camera.width.x=3", "--set camera.width: is a plain value and has no keys"),
        ("labels.flow.5=forward", "--set labels.flow.5: no such list entry"),
        ("camera.width=[", "--set camera.width:2:1: not valid YAML"),
    ],
)
def test_bad_overrides(tmp_path, option, message):
    path = write(tmp_path, "camera: {width: 3}\nlabels: {flow: [forward]}")
    assert refusal(ConfigError, load_run, path, [option]).startswith(message)


# --- Keys that earlier versions had: read where they say what happens anyway, refused in one line where they do not.

OLD = Path(__file__).parents[1] / "golden" / "config_0.1.0.yaml"
"""A sequence's own config.yaml as 0.1.0 wrote it (commit 348eebef), with every key that there was."""


def test_a_recorded_configuration_of_an_earlier_version_is_read(tmp_path):
    config = load_run(OLD).sequence(0)
    assert config.events.emulator == "v2e" and config.camera.width == 96
    again = tmp_path / "again.yaml"
    again.write_text(to_yaml(config.model_dump(mode="json")))
    assert load_run(again).sequence(0) == config


@pytest.mark.parametrize(
    "path, value, said",
    [
        ("render.lod.enabled", "true", "render.lod: this key was removed"),
        ("timeline.first_look", "true", "timeline.first_look: this key was removed (got True); expected the key left"),
        ("events.compat", "authors", "events.compat: this key was removed (got 'authors'); expected the key left out"),
    ],
)
def test_a_value_that_would_matter_is_refused(path, value, said):
    assert refusal(ConfigError, load_run, OLD, [f"{path}={value}"]).startswith(said)


# --- What a scene's light and its surfaces cannot be: one line each, with key, value and what is accepted, before
# any work starts.

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
    ("scene.light", {"unlit": True, "shadows": "hard"}, "scene.light.shadows: these lights have no effect"),
    ("scene.materials.m.normal_map", "no.png", "scene.materials.m.normal_map: no such file (got 'no.png')"),
    ("scene.materials.m.emission_map", "a.png", "scene.materials.m.emission: emission_map has no effect"),
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
