"""Windows as files: what was rendered comes back, damaged folders are refused, and a training reads them."""

import json
import shutil

import numpy as np
import pytest
import yaml

torch = pytest.importorskip("torch")

from blinkgl.errors import AssetError, OutputError  # noqa: E402
from eflow.cli import run  # noqa: E402
from eflow.data.online import open_online  # noqa: E402
from eflow.data.pool import PoolSource, render_pool  # noqa: E402
from eflow.data.sources import open_source  # noqa: E402
from small_recipe import asked, said  # noqa: E402


@pytest.fixture(scope="module")
def folder(recipe):
    out = recipe.parent / "windows"
    command = ["render", str(recipe), "--out", str(out), "-n", "6", "--per-sequence", "2", "--window-ms", "5-20"]
    assert run([*command, "--min-events", "1", "--seed", "4", "--workers", "0", "--quiet"]) == 0
    return out


def test_what_was_rendered_comes_back(recipe, folder):
    with open_online(asked(recipe, window_ms=(5, 20), max_flow=40), 4) as source:
        online = [said(source[n]) for n in range(6)]
    source = open_source(folder)
    assert isinstance(source, PoolSource) and len(source) == 6 and source.has_backward
    assert [said(source[n]) for n in range(6)] == online
    about = json.loads((folder / "windows.json").read_text())
    assert about["samples"] == 6 and about["window_ms"] == [5, 20] and about["recipe"] == "recipe.yaml"


def test_a_training_and_an_evaluation_read_it(folder, tmp_path, capsys):
    config = {
        "model": {"name": "ev_flownet", "size": "tiny", "input": "voxel", "consensus": True},
        "data": {"train": [{"path": str(folder)}], "batch": 2, "augment": {"time_reversal": 1, "scale_probability": 0}},
        "optim": {"steps": 3, "loss": {"l1": 0.5, "length": 1}},
        "run": {"device": "cpu"},
    }
    (tmp_path / "train.yaml").write_text(yaml.safe_dump(config))
    assert run(["train", str(tmp_path / "train.yaml"), "--out", str(tmp_path / "run"), "--quiet"]) == 0
    assert run(["evaluate", str(tmp_path / "run"), str(folder), "--out", str(tmp_path / "scores")]) == 0
    assert json.loads((tmp_path / "scores" / "results.json").read_text())


def test_an_interruption_keeps_what_is_there(recipe, tmp_path):
    def stop(done):
        if done == 3:
            raise KeyboardInterrupt

    with open_online(asked(recipe), 0) as source:
        assert render_pool(source.stream, 10, tmp_path / "some", progress=stop) == 3
    assert len(open_source(tmp_path / "some")) == 3
    assert [p.name for p in tmp_path.iterdir()] == ["some"]
    with open_online(asked(recipe), 0) as source, pytest.raises(OutputError, match="exists"):
        render_pool(source.stream, 10, tmp_path / "some")


def renamed(path, **changes):
    """Replace some arrays of a window."""
    with np.load(path) as file:
        arrays = {**{name: file[name] for name in file.files}, **changes}
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: (f / "0000002.npz").unlink(), "windows are missing"),
        (lambda f: (f / "windows.json").write_text("{"), "not the description of a folder of windows: not JSON"),
        (
            lambda f: (f / "windows.json").write_text('{"version": 9}'),
            "not the description of a folder of windows: version: ",
        ),
        (
            lambda f: (f / "windows.json").write_text('{"version": 1, "samples": "6"}'),
            "not the description of a folder of windows",
        ),
        (lambda f: (f / "0000000.npz").write_bytes((f / "0000000.npz").read_bytes()[:900]), "0000000.npz"),
        (lambda f: (f / "0000000.npz").write_bytes(b"no zip"), "0000000.npz"),
        (lambda f: np.savez(f / "0000000.npz", t=3), "0000000.npz"),
        (lambda f: renamed(f / "0000000.npz", name=".."), "names not a path inside the folder"),
        (lambda f: renamed(f / "0000000.npz", name="x" * 300), "names not a file name: too long"),
        (lambda f: renamed(f / "0000000.npz", valid=np.ones((3, 3), bool)), "flow of another shape"),
        (lambda f: renamed(f / "0000000.npz", new_x=np.full(5, 60000, np.uint16)), "0000000.npz"),
    ],
)
def test_a_damaged_folder_is_one_line(folder, tmp_path, spoil, message):
    copy = tmp_path / "copy"
    shutil.copytree(folder, copy)
    spoil(copy)
    with pytest.raises(AssetError, match=message):
        open_source(copy)[0]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--window-ms", "long"], "error: --window-ms: not a range of window lengths"),
        (["--split", "judge"], "error: --split: unknown choice"),
        (["--max-flow", "-1"], "error: max_flow: "),
        (["--window-ms", "500"], "holds no two windows of 500 ms"),
    ],
)
def test_bad_questions(recipe, tmp_path, capsys, arguments, message):
    assert run(["render", str(recipe), "--out", str(tmp_path / "out"), "--workers", "0", *arguments]) == 2
    said = capsys.readouterr().err
    assert message in said and len(said.strip().splitlines()) == 1
    assert not list(tmp_path.iterdir())
