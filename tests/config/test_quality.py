"""quality: fills what the YAML does not say, and nothing else."""

from __future__ import annotations

from pathlib import Path

import pytest
import yaml

from blinkgl.cli import run
from blinkgl.config.quality import QUALITIES, fill_quality, load_quality
from blinkgl.config.reader import run_file, shipped_runs
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sequence import RenderConfig
from blinkgl.config.timeline import DisplacementTimeline
from blinkgl.dataset.report import config_yaml
from blinkgl.errors import ConfigError


def load_run_of(tmp_path, tree: dict, *overrides: str) -> RunTemplate:
    (tmp_path / "c.yaml").write_text(yaml.safe_dump(tree))
    return load_run(tmp_path / "c.yaml", overrides)


def sequence(tmp_path, tree: dict, *overrides: str):
    return load_run_of(tmp_path, tree, *overrides).sequence(0)


@pytest.mark.parametrize("name", QUALITIES)
def test_a_preset_is_what_its_file_says(tmp_path, name):
    config, preset = sequence(tmp_path, {"quality": name}), load_quality(name)
    for table in ("timeline", "render"):
        assert {k: v for k, v in getattr(config, table).model_dump().items() if k in preset[table]} == preset[table]


def test_what_is_said_wins(tmp_path):
    preset = load_quality("balanced")
    assert preset["timeline"]["kind"] == "displacement", "or choose another timeline below"
    config = sequence(
        tmp_path, {"quality": "balanced", "timeline": {"max_px": 0.3}, "render": {"antialiasing": "ssaa4"}}
    )
    assert (config.timeline.max_px, config.render.antialiasing) == (0.3, "ssaa4")
    assert config.timeline.min_step_us == preset["timeline"].get("min_step_us", 200.0)
    config = sequence(tmp_path, {"quality": "balanced"}, "timeline={kind: uniform, fps: 77}")
    assert (config.timeline.kind, config.timeline.fps) == ("uniform", 77)
    assert config.render.antialiasing == preset["render"]["antialiasing"]


def test_null_leaves_every_key_its_own_default(tmp_path):
    assert fill_quality(None, "uniform") == {} == fill_quality("best", None)
    config = sequence(tmp_path, {"quality": None})
    assert (config.timeline, config.render) == (DisplacementTimeline(), RenderConfig())
    (tmp_path / "again.yaml").write_text(config_yaml(config, 0))
    assert load_run(tmp_path / "again.yaml").sequence(0) == config, "and stays so in what is written"


# --- What ships, by name: from anywhere, as long as no file of that name is there.


@pytest.mark.parametrize("name", ["demo", "demo.yaml", "configs/demo.yaml", "flags", "scenes/flags.yaml"])
def test_a_run_is_found_by_its_name(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    stem = name.split("/")[-1].removesuffix(".yaml")
    assert run_file(name) == shipped_runs()[stem]
    assert load_run(name).tree == load_run(shipped_runs()[stem]).tree


@pytest.mark.parametrize("name", ["demo", "demo.yaml"])
def test_a_file_of_ones_own_comes_first(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    (tmp_path / name).write_text("seed: 91\n")
    assert load_run(name).seed == 91


@pytest.mark.parametrize("name", ["nothing", "elsewhere/demo.yaml", "../demo", "flags/demo"])
def test_what_is_neither_says_where_names_are_listed(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(
        ConfigError, match=f"^{name}: no such file; expected a YAML file, or a name that 'blinkgl configs' lists$"
    ):
        load_run(name)


def test_every_run_that_ships_is_listed_with_what_it_is(capsys, monkeypatch):
    monkeypatch.delenv("COLUMNS", raising=False)
    assert run(["configs"]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert {words[0] for words in lines} >= set(shipped_runs()) and all(len(words) > 3 for words in lines)


def test_a_folder_of_that_name_hides_no_run(tmp_path, monkeypatch):
    """`blinkgl generate demo --out demo` twice."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "demo").mkdir()
    assert run_file("demo") == shipped_runs()["demo"]
    (tmp_path / "other").mkdir()
    with pytest.raises(ConfigError, match="is a folder"):
        load_run("other")
    (tmp_path / "stereo").write_text("seed: 7\n")
    assert run_file("stereo") == Path("stereo")


def test_what_says_no_quality_is_balanced(tmp_path):
    """A sequence and the corners of a recipe; ``null`` is none of them."""
    nothing, balanced, null = (load_run_of(tmp_path, tree) for tree in ({}, {"quality": "balanced"}, {"quality": None}))
    assert nothing.sequence(0).timeline == balanced.sequence(0).timeline != null.sequence(0).timeline
    assert nothing.corners[0].timeline == balanced.corners[0].timeline != null.corners[0].timeline
