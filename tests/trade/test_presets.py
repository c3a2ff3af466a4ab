"""The presets of ``quality:``: what they were chosen by is what is recorded, and a small suite measured here agrees."""

from __future__ import annotations

import itertools
import json
from functools import cache
from importlib import resources

from blinkgl.tools.quality_presets import meaning, preset_text, rows_of
from blinkgl.trade.settings import suite_design
from blinkgl.trade.suite import preset_names

SAMPLES = {"none": 1, "taps4": 4, "edges2": 10, "edges": 4, "ssaa2": 4, "ssaa4": 16}
OF_ALL = 0.75
BEATEN_BY = 0.1
NOISE = 0.05
"""Settings that draw the same frames differ by that and more in processor time, on the machine that measured."""
MISSED = {("balanced", "deforming"), ("balanced", "tiny_textures")}
"""What does not hold, and stands in docs/trade.md: steps of 2 px are as good there since silhouettes cost little
(which `quality: auto` sees)."""
SHORT: set[str] = set()
"""Presets that are beaten in more than a quarter of the scenes."""


@cache
def measured() -> dict:
    """The run of the suite that the presets were chosen by."""
    return json.loads((resources.files("blinkgl.configs") / "quality" / "measured.json").read_text())


def recorded_rows(name: str) -> dict[str, tuple[dict, float]]:
    """Scene -> (row, by how much it is beaten) where the row counts."""
    return {scene: (row, beaten) for scene, row, beaten in rows_of(name, measured())}


def test_presets_are_the_recorded_settings():
    assert preset_names(s.name for s in suite_design()) == measured()["presets"]
    for name in measured()["presets"].values():
        setting = next(s for s in suite_design() if s.name == name)
        assert meaning(setting.overrides) == measured()["settings"][name]


def test_presets_are_on_the_fronts_of_the_suite():
    assert len(measured()["scenes"]) >= 8
    for quality, name in measured()["presets"].items():
        rows = recorded_rows(name)
        beaten = {scene: e for scene, (_, e) in rows.items() if e > NOISE}
        assert len(rows) >= 6 and len(beaten) <= (1 - OF_ALL) * len(rows) + 1, (quality, beaten)
        assert (len(beaten) > (1 - OF_ALL) * len(rows)) == (quality in SHORT), (quality, beaten)
        assert {(quality, scene) for scene, e in beaten.items() if e > BEATEN_BY} <= MISSED, (quality, beaten)


def test_each_preset_is_dearer_and_better_than_the_one_before():
    for cheap, dear in itertools.pairwise(measured()["presets"].values()):
        before, after = recorded_rows(cheap), recorded_rows(dear)
        for scene in before.keys() & after.keys():
            assert before[scene][0]["cpu_s"] < after[scene][0]["cpu_s"], scene


def test_fast_is_nowhere_worse_than_two_pixels_without_a_filter():
    fast, plain = (
        recorded_rows(measured()["presets"]["fast"]),
        recorded_rows("displacement 2 px, none, mip bias -1"),
    )
    assert len(fast.keys() & plain.keys()) >= 7
    for scene in fast.keys() & plain.keys():
        assert fast[scene][0]["voxel"] <= plain[scene][0]["voxel"], scene


def test_figures_in_the_files_are_the_recorded_ones():
    for quality, name in measured()["presets"].items():
        text = (resources.files("blinkgl.configs") / "quality" / f"{quality}.yaml").read_text(encoding="utf-8")
        assert text == preset_text(quality, name, measured())
