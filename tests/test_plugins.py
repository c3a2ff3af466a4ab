"""A file of the user's own, from the command line: what it registers reaches commands, workers and verify."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from apart import run_apart

from blinkgl import open_events
from blinkgl.cli import run
from blinkgl.errors import ConfigError
from blinkgl.machine import plugins

MINE = Path(__file__).parents[1] / "examples/plugins"


@pytest.fixture(autouse=True)
def none_so_far(monkeypatch):
    monkeypatch.delenv("BLINKGL_PLUGINS", raising=False)


def with_mine(folder: Path, *lines: str) -> list[tuple[int, str]]:
    return run_apart([["blinkgl", "--plugin", "mine.py", *line.split()] for line in lines], folder)


GENERATE = f"generate {MINE / 'mine.yaml'} --out set --set camera.width=48 --set camera.height=36"


def test_four_parts_of_ones_own_reach_everything(tmp_path, monkeypatch, capsys):
    """The file of docs/extending.md: emulator, label, primitive and event format, in commands, workers and verify; its
    folder has a character that separates paths elsewhere."""
    tmp_path = tmp_path / "of a:b"
    tmp_path.mkdir()
    monkeypatch.chdir(tmp_path)
    shutil.copy(MINE / "mine.py", tmp_path)
    assert run(GENERATE.split()) == 2
    assert "unknown" in capsys.readouterr().err and not (tmp_path / "set").exists()
    np.save(tmp_path / "frames.npy", (np.random.default_rng(0).random((6, 24, 32)) * 255).astype(np.uint8))
    answers = with_mine(
        tmp_path,
        f"{GENERATE} --set output.sequences=2 --workers 2",
        "verify set --deep",
        "convert set/train/sequence_000000/events.h5 e.nine",
        "convert e.nine back.h5",
        "simulate frames.npy --fps 30 --emulator toy -o s.nine",
        f"shader diff {MINE / 'mine.yaml'} --time 0.1 --pass height --out diff",
    )
    assert [status for status, _ in answers] == [0] * 6, answers
    assert "serializ" not in answers[1][1] and "agrees with the reference" in answers[5][1]
    (folder, _) = sorted(path.parent for path in (tmp_path / "set").glob("*/*/manifest.json"))
    manifest = json.loads((folder / "manifest.json").read_text())
    assert manifest["emulator"] == "toy" and len(manifest["versions"]["plug-in mine"]) == 16
    height = np.load(min((folder / "height").glob("*.npy")))
    assert 0.5 < height.max() < 0.6001 and height.min() == 0, "of the ramp, world units"
    there, here = (open_events(path).read() for path in (folder / "events.h5", tmp_path / "back.h5"))
    assert len(there) > 300 and all(np.array_equal(getattr(there, k), getattr(here, k)) for k in "xytp")
    assert run(["verify", "set"]) == 2
    said = capsys.readouterr().out
    assert "made with the plug-in mine (sha256" in said and "--plugin FILE" in said
    (tmp_path / "e.nine").write_bytes((tmp_path / "e.nine").read_bytes() + b"x")
    (tmp_path / "mine.py").write_text((tmp_path / "mine.py").read_text() + "\n# another\n")
    answers = with_mine(tmp_path, "verify set", "convert e.nine back.h5")
    for (status, said), line in zip(answers, ("which differs here", "truncated"), strict=True):
        assert status == 2 and line in said


def test_nodes_of_ray_load_the_file(tmp_path):
    pytest.importorskip("ray")
    shutil.copy(MINE / "mine.py", tmp_path)
    (answer,) = with_mine(tmp_path, f"{GENERATE} --num 2 --workers 2 --executor ray")
    assert answer[0] == 0, answer


EMULATOR = (
    "from blinkgl.events import register\nfrom blinkgl.events.esim import Esim\nclass Other(Esim): ...\nregister(Other)"
)
FORMAT = "from blinkgl.io.formats import FORMATS, register\nregister(FORMATS['evt3'])"
PRIMITIVE = "from blinkgl.scene.geometry.primitives import register\n@register\ndef cuboid(a: float = 1.0): ..."
LAYOUT = "from blinkgl.layouts.export import LAYOUTS, register\nregister(LAYOUTS['dsec'])"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (None, "--plugin: no such file (got "),
        ("1 / 0", "mine.py: the plug-in fails (got 'ZeroDivisionError: division by zero')"),
        ("def", "mine.py: the plug-in fails (got 'SyntaxError: "),
        ("import mine_again", "ModuleNotFoundError"),
        (EMULATOR, "TypeError: emulator 'esim': there is one already, Esim"),
        (FORMAT, "TypeError: event format 'evt3': there is one already"),
        (PRIMITIVE, "TypeError: primitive 'cuboid': there is one already"),
        (LAYOUT, "TypeError: layout 'dsec': there is one already"),
    ],
)
def test_one_that_cannot_be_loaded_is_a_line(tmp_path, capsys, text, said):
    if text is not None:
        (tmp_path / "mine.py").write_text(text)
    assert run(["--plugin", str(tmp_path / "mine.py"), "configs"]) == 2
    line = capsys.readouterr().err
    assert said in line and line.startswith("error: ") and line.count("\n") == 1


def test_a_file_is_loaded_once_however_its_path_is_written(tmp_path, monkeypatch):
    monkeypatch.setattr(plugins, "_PATHS", {})
    monkeypatch.setattr(plugins, "_LOADED", {})
    for folder in ("sub", "other"):
        (tmp_path / folder).mkdir()
    (tmp_path / "once.py").write_text(f"open({str(tmp_path / 'log')!r}, 'a').write('x')\n")
    (tmp_path / "sub/link.py").symlink_to(tmp_path / "once.py")
    (tmp_path / "sub/once.py").symlink_to(tmp_path / "once.py")
    paths = [tmp_path / name for name in ("once.py", "sub/../once.py", "sub/once.py", "sub/link.py")]
    plugins.load_plugins(paths)
    assert (tmp_path / "log").read_text() == "x" and plugins.plugin_files() == [str(paths[0])]
    (tmp_path / "other/once.py").write_text("")
    with pytest.raises(ConfigError, match="has this name, too"):
        plugins.load_plugins([tmp_path / "other/once.py"])
