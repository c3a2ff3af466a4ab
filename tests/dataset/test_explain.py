"""blinkgl explain: what it says is what a run does."""

import json
import os
import subprocess
import sys
from importlib import resources

import cv2
import numpy as np
import pytest
import yaml
from rich.console import Console

from blinkgl.config.run import RunTemplate, load_run
from blinkgl.dataset.executor import Local
from blinkgl.dataset.explain import error_in_words, explain
from blinkgl.dataset.generate import generate_run
from blinkgl.show.generate import MAX_NOTES, Display, run
from tests.scene.gltf_files import GltfBuilder, triangle

SMALL = {
    "camera": {"width": 64, "height": 48},
    "time": {"duration": 0.2, "label_rate": 20},
    "timeline": {"kind": "displacement", "max_px": 0.5},
    "scene": {
        "kind": "random",
        "objects": {"count": 4},
        "textures": {"photographs": False, "max_size": 64, "variants": 2},
        "pool": {"primitives": ["cuboid"], "variants": 2},
    },
    "labels": {"flow": ["forward"]},
    "preview": {"enabled": False},
}


def template(tmp_path, **changes):
    path = tmp_path / "run.yaml"
    path.write_text(yaml.safe_dump({**SMALL, **changes}))
    return load_run(path)


def test_expected_frames_and_passes_are_those_of_the_run(tmp_path):
    run = template(tmp_path)
    told = explain(run)
    made = list(generate_run(run, tmp_path / "out"))[0]
    assert told.frames == made.frames
    assert [p.name for p in told.passes] == ["event frames", "speeds", "colour", "labels", "event kernel"]
    assert f"{made.triangles:,}" == told.scene["triangles"] and "4 objects" in told.scene["bodies"]
    assert all(p.count > 0 for p in told.passes) and told.stages["render"] > 0
    span_s = run.sequence(0).time.t1_ns * 1e-9
    assert f"about {made.events / span_s / 1e6:.1f} M events per simulated second" in told.passes[-1].why


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"camera": {"width": 32, "height": 24}},
        {"camera": {"width": 160, "height": 120}},
        {"events": {"emulator": "esim"}},
        {"events": {"emulator": "voltmeter"}},
        {"preview": {"enabled": True}},
        {"labels": {"flow": [], "images": False}},
        {"labels": {"flow": ["forward", "backward"], "depth": True}},
        {"timeline": {"kind": "uniform", "fps": 300}},
        {"imu": {"rate": 1000}},
    ],
    ids=str,
)
def test_the_size_of_a_run_is_foretold(tmp_path, changes):
    """Ten recipes, within a quarter. (Times are those of a busy machine: no test compares them.)"""
    run = template(tmp_path, output={"sequences": 2}, **changes)
    told = explain(run)
    list(generate_run(run, tmp_path / "out"))
    size = sum(p.stat().st_size for p in (tmp_path / "out").rglob("*") if p.is_file())
    assert told.sequences == 2 and 2 * told.bytes == pytest.approx(size, rel=0.25)
    assert told.seconds > 0 and told.run_seconds >= told.seconds


def test_of_a_recipe_the_first_group_that_is_used_is_explained(tmp_path):
    groups = {
        "a_off": {"enabled": False, "camera": {"width": 32}},
        "b_wide": {"camera": {"width": 96}},
        "c_rest": {"output": {"name": "rest"}},
    }
    told = explain(template(tmp_path, groups=groups))
    assert told.scene["group"] == "b_wide, the first of 2" and told.scene["camera"].startswith("96x48")


def test_what_is_left_out_follows_the_configuration(tmp_path):
    out = dict(explain(template(tmp_path)).left_out)
    assert "depth" in out and "backward flow" in out and "preview" in out and "esim: refractory_us" in out
    more = explain(
        template(
            tmp_path,
            timeline={"kind": "uniform", "fps": 100},
            labels={"images": False, "depth": True, "flow": []},
            events={"emulator": "esim", "refractory_us": 50},
            render={"antialiasing": "ssaa2"},
        )
    )
    out = dict(more.left_out)
    assert "depth" not in out and "images" in out and "velocity pass" in out and "esim: refractory_us" not in out
    assert "anti-aliasing of event frames" not in out
    assert [p.name for p in more.passes] == ["event frames", "labels", "event kernel"]
    assert more.frames == 26, "0.25 s at 100 frames/s, both ends included"


def test_recorded_frames_are_what_is_explained(tmp_path):
    """Nothing is rendered, so no scene is described, no OpenGL is opened and no pass is a drawing."""
    (tmp_path / "P0/image_left").mkdir(parents=True)
    rng = np.random.default_rng(0)
    image = rng.integers(0, 255, (24, 40), dtype=np.uint8)
    for k in range(20):
        cv2.imwrite(str(tmp_path / f"P0/image_left/{k:03d}.png"), np.roll(image, k, axis=1))
    path = tmp_path / "run.yaml"
    tree = {
        "frames": {
            "folders": ["P0"],
            "fps": 10,
            "flow": None,
            "interpolate": "linear",
            "first": 1,
            "max_displacement": None,
        },
        "preview": {"enabled": False},
        "camera": {"width": 99, "height": 99},
        "gl": {"backend": "egl", "device": 4000},
    }
    path.write_text(yaml.safe_dump(tree))
    run = load_run(path)
    told = explain(run)
    assert (
        set(told.scene) == {"frames", "images", "flow", "not used"}
        and "40x24" in told.scene["frames"]
        and "19 of" in told.scene["frames"]
    )
    made = list(generate_run(run, tmp_path / "out"))[0]
    assert told.frames == made.frames == 19 and [p.name for p in told.passes] == ["frames and event kernel"]
    assert told.seconds > 0 and "forward flow" in dict(told.left_out)


ENVIRONMENTS = [
    {"PYTHONIOENCODING": "ascii"},
    {"PYTHONIOENCODING": "latin-1"},
]


def command(arguments: list[str], environment: dict[str, str]) -> subprocess.CompletedProcess:
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("LC_", "LANG", "PYTHONIO", "PYTHONUTF8"))}
    return subprocess.run([sys.executable, *arguments], env={**clean, **environment}, capture_output=True, timeout=300)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_output_that_cannot_show_every_character(environment):
    """In the one place that all commands go through; and an error's line that holds what the user typed."""
    code = (
        "import sys; from blinkgl import cli; status = cli.run(['explain', '\\u00b5\\u2603.yaml']); print('1 "
        "\\u00b5s \\u2026 2 px\\u00b2 \\u2603'); sys.exit(status)"
    )
    done = command(["-c", code], environment)
    assert done.returncode == 2 and done.stderr.startswith(b"error: ") and done.stderr.count(b"\n") == 1
    assert done.stdout in (b"1 us ... 2 px^2 ?\n", b"1 \xb5s ... 2 px\xb2 ?\n")


# --- What files ask for and is not drawn is said once by the run, by explain, and by every manifest.

LINE = "card.glb asks for what is not drawn: alpha BLEND (drawn opaque); occlusion maps"
SMALL_NOT_DRAWN = {
    "camera": {"width": 32, "height": 24},
    "time": {"duration": 0.05, "label_rate": 20},
    "timeline": {"kind": "uniform", "fps": 100},
    "output": {"sequences": 3},
    "preview": {"enabled": False},
    "labels": {"flow": []},
}
EXPLICIT = {
    "kind": "explicit",
    "meshes": {"card": {"file": "assets/card.glb"}},
    "objects": [{"mesh": "card"}, {"mesh": "card"}],
    "camera": {"position": [-3, 0, 1]},
}
RANDOM = {
    "kind": "random",
    "objects": {"count": 3},
    "pool": {"primitives": [], "folders": ["assets"], "keep_materials": True, "test_fraction": 0},
    "textures": {"procedural": ["checks"], "variants": 2, "photographs": False, "max_size": 16, "test_fraction": 0},
}


def recipe(tmp_path, scene):
    builder = GltfBuilder()
    builder.tree["materials"] = [{"alphaMode": "BLEND", "occlusionTexture": {"index": 0}}]
    builder.node(mesh=triangle(builder, material=0))
    (tmp_path / "assets").mkdir()
    (tmp_path / "assets/card.glb").write_bytes(builder.glb())
    (tmp_path / "run.yaml").write_text(yaml.safe_dump({**SMALL_NOT_DRAWN, "scene": scene}))
    return tmp_path / "run.yaml"


@pytest.mark.parametrize(
    "scene, workers",
    [
        (EXPLICIT, None),
        (RANDOM, None),
        pytest.param(EXPLICIT, 2, marks=pytest.mark.slow),
    ],
)
def test_a_run_says_it_once(tmp_path, capsys, scene, workers):
    path = recipe(tmp_path, scene)
    assert run(str(path), str(tmp_path / "out"), executor=workers and Local(workers)) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if line.startswith("note: ")]
    assert said == ["note: " + LINE]
    manifests = sorted((tmp_path / "out").glob("*/*/manifest.json"))
    assert len(manifests) == 3
    for manifest in manifests:
        assert json.loads(manifest.read_text())["not_drawn"] == [LINE]
    assert explain(load_run(path)).scene["not drawn"] == LINE


def test_what_is_recognised_of_a_trajectory_is_said(tmp_path, capsys):
    """TUM's rows without a heading: on the screen as in the manifest."""
    (tmp_path / "path.txt").write_text("".join(f"{k / 50:.6f} {k / 100} 0 0 0 0 0 1\n" for k in range(60)))
    scene = {**EXPLICIT, "camera": {"trajectory": {"file": "path.txt"}}}
    assert run(str(recipe(tmp_path, scene)), str(tmp_path / "out")) == 0
    said = [line for line in capsys.readouterr().out.splitlines() if "path.txt" in line]
    assert any("read as TUM's" in line for line in said) and all(line.startswith("note: path.txt") for line in said)
    (manifest, *_) = sorted((tmp_path / "out").glob("*/*/manifest.json"))
    assert {line.removeprefix("note: ") for line in said} <= set(json.loads(manifest.read_text())["scene_log"])


def test_many_files_are_not_a_screenful(tmp_path, capsys):
    """Messages of any number of workers arrive in any order; a line is printed once, and not more than so many."""
    display = Display(Console(width=200), tmp_path)
    for _ in range(2):
        for k in range(MAX_NOTES + 10):
            display._note([f"{k}.glb asks for what is not drawn: lights"])
    said = capsys.readouterr().out.splitlines()
    assert len(said) == MAX_NOTES + 1 and len(set(said)) == len(said)
    assert said[-1] == "note: there are more; the manifests have them under not_drawn and scene_log"


@pytest.mark.parametrize("quality", ["fast", "reference"])
def test_the_error_of_the_setting_is_that_of_the_measured_suite(tmp_path, quality):
    rows = json.loads((resources.files("blinkgl.configs") / "quality" / "measured.json").read_text())
    name = rows["presets"][quality]
    errors = [100 * r["voxel"] for scene in rows["scenes"].values() for r in scene["settings"] if r["name"] == name]
    usual = {key: value for key, value in SMALL.items() if key != "timeline"}
    words = lambda **changes: error_in_words(RunTemplate({**usual, **changes}, tmp_path).sequence(0))
    assert f"voxel grids {np.median(errors):.0f} % apart ({min(errors):.0f} to {max(errors):.0f} %)" in words(
        quality=quality
    )
    assert "not measured" in words(timeline={"kind": "uniform", "fps": 77})


def test_a_rig_says_once_what_all_cameras_have_and_the_rest_by_name(tmp_path):
    sensors = [
        {"name": "ev", "events": {"emulator": "esim"}, "labels": {"flow": [], "images": False, "depth": True}},
        {"name": "fr", "images": {"rate": 30}, "labels": {"flow": ["forward"]}},
        {"name": "unit", "imu": {"rate": 200}},
    ]
    told = explain(template(tmp_path, sensors=sensors, labels={}))
    names = [one.name for one in told.passes]
    assert {"ev: event frames", "ev: labels", "fr: labels", "fr: frame camera", "unit: inertial unit"} <= set(names)
    assert "fr: event kernel" not in names and len(names) == len(set(names))
    left = [what for what, _ in told.left_out]
    assert len(left) == len(set(left)) and not any("inertial unit" in what for what in left)
    assert "fr: depth" in left and not {"depth", "ev: depth"} & set(left) and "normals" in left
    assert "triangles" in told.scene and not any(key.endswith(": triangles") for key in told.scene)
    one, two = (explain(template(tmp_path, rig=name)) for name in (None, "stereo"))
    assert [what for what, _ in two.left_out if not what.startswith(("left: ", "right: "))]
    assert len(two.left_out) < 1.5 * len(one.left_out)
