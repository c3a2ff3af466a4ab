"""The presets of ``quality:`` are on the front: of the sweep they were taken from, and of
one that is made again here."""

from __future__ import annotations

import itertools
import json
from importlib import resources

import pytest
import yaml

from blinkgl.config.quality import QUALITIES, load_quality
from blinkgl.config.sequence import RunTemplate, apply_overrides, load_run
from blinkgl.trade.measure import Bench, Options
from blinkgl.trade.settings import Setting

SAMPLES = {"none": 1, "msaa4": 4, "taps4": 4, "edges": 4, "ssaa2": 4, "ssaa4": 16}


@pytest.fixture(scope="module")
def recorded() -> dict:
    return json.loads((resources.files("blinkgl.configs") / "quality" / "measured.json").read_text(encoding="utf-8"))


def tables(overrides) -> dict:
    """timeline and render that overrides mean, every value filled in."""
    config = RunTemplate(apply_overrides({}, overrides), None).sequence(0)
    return {"timeline": config.timeline.model_dump(), "render": config.render.model_dump()}


def dominating(row: dict, rows: list[dict], cost: str, error: str, margin: float = 0.0) -> list[dict]:
    """Rows that beat ``row`` in cost and in error, in both by more than the relative ``margin``."""
    return [r for r in rows if r[cost] < row[cost] * (1 - margin) and r[error] < row[error] * (1 - margin)]


def row_of(name: str, rows: list[dict]) -> dict:
    wanted = tables([f"quality={name}"])
    (row,) = [r for r in rows if not r["size"] and "textures" not in r["other"] and tables(r["overrides"]) == wanted]
    return row


def test_presets_are_on_the_measured_front(recorded):
    rows = [r for r in recorded["settings"] if not r["size"]]
    presets = [row_of(name, rows) for name in QUALITIES]
    for preset in presets:
        assert preset["on_front"] and not dominating(preset, rows, recorded["cost"], "voxel"), preset["name"]
    for cheap, dear in itertools.pairwise(presets):
        assert cheap[recorded["cost"]] < dear[recorded["cost"]] and cheap["voxel"] > dear["voxel"]


def test_balanced_counts_its_events_right(recorded):
    """Issue 4: within 5 % of the converged count on the default random scene at 640x480."""
    assert (recorded["sizes"]["full"]["width"], recorded["sizes"]["full"]["height"]) == (640, 480)
    assert abs(row_of("balanced", recorded["settings"])["count"]) < 0.05


def test_figures_in_the_files_are_the_recorded_ones(recorded):
    for name in QUALITIES:
        text = (resources.files("blinkgl.configs") / "quality" / f"{name}.yaml").read_text(encoding="utf-8")
        row = row_of(name, recorded["settings"])
        assert row["name"] in text and f"{100 * row['voxel']:.1f} %" in text and recorded["date"] in text


CONFIG = {
    "seed": 5,
    "camera": {"width": 96, "height": 72, "fov": 60},
    "time": {"duration": 0.1, "label_rate": 20},
    "scene": {
        "kind": "random",
        "objects": {"count": 5, "distance": [2, 5]},
        "camera_motion": {"speed": [0.5, 1.0], "rotation_rate": [20, 40]},
        "pool": {"primitives": ["cuboid", "sphere", "torus"], "variants": 4, "urdfs": False},
        "textures": {"procedural": ["checks", "fbm", "bricks"], "variants": 4, "photographs": False, "max_size": 256},
    },
}
RIVALS = [
    Setting(f"displacement {px:g} px", r, a, o)
    for px, r, a, o in (
        (2, "linear", "none", ""),
        (2, "linear", "ssaa2", ""),
        (0.5, "linear", "none", ""),
        (0.5, "linear", "ssaa2", ""),
        (1, "pchip", "none", ""),
        (1, "pchip", "ssaa2", "mip bias -0.5"),
        (2, "pchip", "ssaa4", ""),
    )
]


def test_no_rival_beats_a_preset_measured_again(gl, tmp_path):
    """Cost is what a busy machine cannot change: samples drawn. A rival has to be better by 15 %
    in both to count: the scene is small."""
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(CONFIG))
    bench = Bench(
        gl, load_run(tmp_path / "c.yaml"), Options(clip_s=0.03, tiles=(1, 1, 96, 72), levels=((8, 0.1),), rounds=1)
    )
    presets = [_Preset(name) for name in QUALITIES]
    results = bench.measure([*presets, *RIVALS])
    bench.judge(results, bench.speeds())
    rows = [
        {
            "name": r.setting.name,
            "cost": r.frames_per_s * drawn(bench.config(r.setting.overrides)),
            "voxel": r.errors.voxel,
        }
        for r in results
    ]
    for preset in rows[: len(presets)]:
        assert not dominating(preset, rows, "cost", "voxel", margin=0.15), (preset, rows)
    errors = [row["voxel"] for row in rows[: len(presets)]]
    assert errors == sorted(errors, reverse=True), "each preset is better than the one before"


def drawn(config) -> float:
    """Samples per frame and pixel; a frame with rates costs twice (measured: docs/trade.md).
    Half a sample stands for the triangles."""
    return (0.5 + SAMPLES[config.render.antialiasing]) * (2 if config.timeline.reconstruction == "hermite" else 1)


class _Preset:
    """A preset in a Setting's place."""

    sampling = reconstruction = antialiasing = other = size = ""

    def __init__(self, name: str):
        preset = load_quality(name)
        self.name, self.overrides = (
            name,
            tuple(f"{table}={json.dumps(preset[table])}" for table in ("timeline", "render")),
        )
