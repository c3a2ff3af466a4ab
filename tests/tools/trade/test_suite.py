"""The suite: a small one is measured here, presets are judged by it, and what can go wrong in one does."""

from __future__ import annotations

import itertools
import json
from functools import cache
from importlib import resources
from pathlib import Path

import numpy as np
import pytest
import yaml
from rich.console import Console

from blinkgl.cli import run
from blinkgl.config.quality import QUALITIES
from blinkgl.config.run import load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.errors import ConfigError
from blinkgl.render.frames import Rectangle
from blinkgl.scene.build import sequence_scene
from blinkgl.tools.quality_presets import meaning, preset_text, rows_of
from blinkgl.tools.trade.measure import Density, FineTiles, Options
from blinkgl.tools.trade.settings import Setting, excess, suite_design
from blinkgl.tools.trade.suite import Trial, clips, preset_names, run_suite, standing
from blinkgl.tools.trade.suite_command import show

SAMPLES = {"none": 1, "taps4": 2, "edges2": 8, "edges": 2.5, "ssaa2": 4, "ssaa4": 16, "ssaa8": 64}
"""What a frame costs, in frames without a filter, about (docs/trade.md)."""
WORLD = {
    "seed": 5,
    "camera": {"width": 80, "height": 60, "fov": 60},
    "time": {"duration": 0.1, "label_rate": 50},
    "scene": {
        "kind": "random",
        "objects": {"count": 4, "distance": [2, 5]},
        "camera_motion": {"speed": [0.5, 1.0], "rotation_rate": [40, 60]},
        "pool": {"primitives": ["cuboid", "torus"], "variants": 2},
        "textures": {"procedural": ["checks", "bricks"], "variants": 2, "photographs": False, "max_size": 128},
    },
}
RIVALS = tuple(
    Setting(f"displacement {px:g} px", a, o)
    for px, a, o in (
        (2, "none", "mip bias -1"),
        (0.5, "none", ""),
        (1, "ssaa2", "mip bias -1"),
        (2, "taps4", "mip bias -1"),
    )
)
OPTIONS = Options(tiles=(1, 1, 80, 60), levels=Density((4, 8), (0.25, 0.125)), rounds=1, labels=False)


def presets() -> tuple[Setting, ...]:
    names = preset_names(s.name for s in suite_design())
    assert list(names) == list(QUALITIES), "every preset is a setting of the suite"
    return tuple(s for s in suite_design() if s.name in names.values())


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("scenes")
    (path / "world.yaml").write_text("# A world: of a few objects.\n" + yaml.safe_dump(WORLD))
    (path / "broken.yaml").write_text("frames: {folders: nowhere}\n")
    return path


@pytest.fixture(scope="module")
def measured(folder, tmp_path_factory) -> tuple[dict, Path]:
    out = tmp_path_factory.mktemp("suite")
    settings = tuple(dict.fromkeys([*presets(), *RIVALS]))
    return run_suite(clips(folder), out, options=OPTIONS, settings=settings), out


def test_no_rival_beats_a_preset_measured_again(measured):
    """Cost is what a busy machine cannot change: samples drawn. A rival has to be better by 15 % in both to count: the
    scene is small, and its reference coarse."""
    rows = measured[0]["scenes"]["world"]["settings"]
    rows = [
        {**r, "cost": r["frames_per_s"] * next(n for a, n in SAMPLES.items() if f", {a}" in r["name"])} for r in rows
    ]
    names = {s.name for s in presets()}
    for row in rows:
        if row["name"] in names:
            assert excess(row, rows, "cost", "voxel") < 0.15, row["name"]
    errors = {r["name"]: r["voxel"] for r in rows}
    by_quality = [errors[name] for name in preset_names(errors).values()]
    assert by_quality == sorted(by_quality, reverse=True), "each preset is better than the one before"
    assert by_quality[0] < errors["displacement 2 px, none, mip bias -1"]


def test_a_scene_that_cannot_be_measured_has_a_line_and_the_others_stay(measured, folder):
    result, out = measured
    assert result["missing"] == ["broken"] and not result["complete"]
    assert "no settings to compare" in result["scenes"]["broken"]["error"]
    assert json.loads((out / "suite.json").read_text())["missing"] == ["broken"]
    assert (out / "suite.csv").read_text().count("\nworld,") == len(result["scenes"]["world"]["settings"])
    with pytest.raises(ConfigError, match="no settings to compare"):
        run_suite([Trial("broken", folder / "broken.yaml")], out / "alone", options=OPTIONS)


def test_table(measured, capsys):
    show(measured[0], Console())
    text = capsys.readouterr().out
    assert "PARTIAL: without broken" in text and "broken: not measured" in text and "world" in text


def test_standing_by_hand():
    row = lambda name, cost, error, trusted=True: {"name": name, "cpu_s": cost, "voxel": error, "trusted": trusted}
    scenes = {
        "a": {"settings": [row("x", 1, 0.4), row("y", 2, 0.2), row("z", 3, 0.22)]},
        "b": {"settings": [row("x", 1, 0.9), row("y", 2, 0.1, trusted=False), row("z", 3, 0.3)]},
    }
    x, y, z = standing(scenes, "cpu_s")
    assert (x["scenes"], x["undominated"], x["worst_voxel"], x["worst_scene"]) == (2, 2, 0.9, "b")
    assert (y["scenes"], y["undominated"]) == (1, 1), "a row that does not count beats nobody and is not counted"
    assert (z["undominated"], round(z["excess"], 6)) == (1, 0.1), "y is better by 1.5 in cost and by 1.1 in error"
    assert x["voxel"] == pytest.approx(0.6) and x["cost"] == 1
    assert excess(row("p", 1, 0.5), [], "cpu_s", "voxel") == 0


def test_samples_of_a_reference_end_where_plain_ones_do(gl, folder):
    """The reference draws its samples as `edges`, which is judged, too: so it is held to samples that are points."""
    config = load_run(folder / "world.yaml").sequence(0)
    scene = sequence_scene(config, 0, folder)
    t_ns, tiles = (scene.t0_ns + scene.t1_ns) // 2, (Rectangle(10, 8, 34, 26),)

    def drawn(scale: int, *samples: RenderConfig) -> np.ndarray:
        with FineTiles(gl, scene, tiles, scale, *samples) as source:
            return np.log(next(iter(source([t_ns])))[8:26, 10:34] + 1e-3)

    plain = drawn(96, RenderConfig(mip_bias=-1.0))
    away = lambda frame: float(np.sqrt(np.mean((frame - plain) ** 2)))
    coarse, fine = away(drawn(8)), away(drawn(32))
    assert fine < 0.004 and fine < coarse / 4
    assert away(drawn(32, RenderConfig())) > 2 * fine, "or the plain samples that there were before would do"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--suite", "--scene", "moon"], "--scene: no scene has this name"),
        (["--suite", "nowhere"], "nowhere: the suite is a folder of scenes"),
        (["--suite", "--quick"], "--quick: these are options of a single scene"),
        (["--suite", "--only", "raytracing"], "no setting has this name"),
        ([], "no scene given"),
        (["c.yaml", "--scene", "moon"], "--scene: these are options of the suite"),
    ],
)
def test_bad_input(arguments, message, tmp_path, capsys):
    assert run(["trade", *arguments, "-o", str(tmp_path / "x")]) == 2
    error = capsys.readouterr().err
    assert message in error and error.count("\n") == 1 and not (tmp_path / "x").exists()


# --- The presets of ``quality:``: what they were chosen by is what is recorded, and a small suite measured here
# agrees.

SAMPLES_PRESETS = {"none": 1, "taps4": 4, "edges2": 10, "edges": 4, "ssaa2": 4, "ssaa4": 16, "ssaa8": 64}
OF_ALL = 0.75
BEATEN_BY = 0.1
NOISE = 0.05
"""Settings that draw the same frames differ by that and more in processor time, on the machine that measured."""
MISSED = {("accurate", "thin"), ("accurate", "intersecting")}
"""What does not hold, and stands in docs/trade.md."""
SHORT: set[str] = set()
"""Presets that are beaten in more than a quarter of the scenes."""


@cache
def measured_of_presets() -> dict:
    """The run of the suite that the presets were chosen by."""
    return json.loads((resources.files("blinkgl.configs") / "quality" / "measured.json").read_text())


def recorded_rows(name: str) -> dict[str, tuple[dict, float]]:
    """Scene -> (row, by how much it is beaten) where the row counts."""
    return {scene: (row, beaten) for scene, row, beaten in rows_of(name, measured_of_presets())}


def test_presets_are_the_recorded_settings():
    assert preset_names(s.name for s in suite_design()) == measured_of_presets()["presets"]
    for name in measured_of_presets()["presets"].values():
        setting = next(s for s in suite_design() if s.name == name)
        assert meaning(setting.overrides) == measured_of_presets()["settings"][name]


def test_presets_are_on_the_fronts_of_the_suite():
    assert len(measured_of_presets()["scenes"]) >= 8
    for quality, name in measured_of_presets()["presets"].items():
        rows = recorded_rows(name)
        beaten = {scene: e for scene, (_, e) in rows.items() if e > NOISE}
        assert len(rows) >= 6 and len(beaten) <= (1 - OF_ALL) * len(rows) + 1, (quality, beaten)
        assert (len(beaten) > (1 - OF_ALL) * len(rows)) == (quality in SHORT), (quality, beaten)
        assert {(quality, scene) for scene, e in beaten.items() if e > BEATEN_BY} <= MISSED, (quality, beaten)


def test_each_preset_is_dearer_and_better_than_the_one_before():
    for cheap, dear in itertools.pairwise(measured_of_presets()["presets"].values()):
        before, after = recorded_rows(cheap), recorded_rows(dear)
        for scene in before.keys() & after.keys():
            # Where motion is so slow that both draw the same frames, only the noise differs.
            assert before[scene][0]["cpu_s"] < (1 + NOISE) * after[scene][0]["cpu_s"], scene
            assert after[scene][0]["voxel"] <= 1.001 * before[scene][0]["voxel"], (scene, cheap, dear)


def test_fast_is_nowhere_worse_by_a_tenth_than_two_pixels_without_a_filter():
    fast, plain = (
        recorded_rows(measured_of_presets()["presets"]["fast"]),
        recorded_rows("displacement 2 px, none, mip bias -1"),
    )
    assert len(fast.keys() & plain.keys()) >= 7
    for scene in fast.keys() & plain.keys():
        assert fast[scene][0]["voxel"] <= 1.1 * plain[scene][0]["voxel"], scene


def test_figures_in_the_files_are_the_recorded_ones():
    for quality, name in measured_of_presets()["presets"].items():
        text = (resources.files("blinkgl.configs") / "quality" / f"{quality}.yaml").read_text(encoding="utf-8")
        assert text == preset_text(quality, name, measured_of_presets())
