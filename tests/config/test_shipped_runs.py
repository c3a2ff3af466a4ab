"""What ships, by name: from anywhere, as long as no file of that name is there."""

from pathlib import Path

import pytest

from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.config.shipped import run_file, shipped_runs
from blinkgl.errors import ConfigError


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
