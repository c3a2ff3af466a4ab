"""The configurations that ship: every one is valid, and what the README says about them holds."""

from pathlib import Path

import pytest

pytest.importorskip("torch")

from blinkgl.errors import ConfigError
from eflow.cli import run
from eflow.load_config import load_train_config
from eflow.models import model_config
from flow_data import blinkgl_set

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDER = REPOSITORY / "configs" / "eflow"
TRAINING = sorted(p.name for p in FOLDER.glob("*.yaml") if not p.name.endswith("_data.yaml"))


@pytest.mark.parametrize("name", TRAINING)
def test_training_configurations(name):
    config = load_train_config(FOLDER / name)
    model = model_config(config.model.model_dump())
    assert model == config.model
    if config.data.crop is not None:
        assert all(side % 16 == 0 and side >= 128 for side in config.data.crop)


@pytest.mark.parametrize("crop", ["[128, 144]", "null"])
def test_samples_of_two_sizes_are_refused(capsys, crop):
    words = ["train", str(FOLDER / "smoke.yaml"), "--print-config", "--set", f"data.crop={crop}", "--set"]
    assert run([*words, "data.augment.transpose=0.5"]) == 2
    error = capsys.readouterr().err
    assert (
        error.startswith("error: data: transposed samples differ in size: set a square crop") and "\n" not in error[:-1]
    )
    assert run([*words, "data.augment.transpose=0"]) == 0


def test_a_training_from_the_command_line_alone(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    blinkgl_set(tmp_path / "set", sequences=1, labels=1)
    words = ["train", "--model", "ev_flownet-tiny", "--data", "set", "--set", "model.width=4", "--set", "data.batch=1"]
    assert run([*words, "--out", "run", "--set", "optim.steps=1", "--quiet"]) == 0, capsys.readouterr().err
    trained = load_train_config("run/config.yaml")
    assert trained.model.name == "ev_flownet" and trained.data.train[0].path == str(tmp_path / "set")
    assert run([*words, "--data", "r.yaml", "--minutes", "5", "--print-config"]) == 0
    (tmp_path / "p.yaml").write_text(capsys.readouterr().out)
    asked = load_train_config("p.yaml")
    assert asked.optim.minutes == 5 and [s.online for s in asked.data.train] == [False, True]
    mended = load_train_config("p.yaml", model={"name": "eraft"}, data=["other"])
    assert mended.model.name == "eraft" and mended.data.train[0].path.endswith("/other") and mended.optim.minutes == 5


@pytest.mark.parametrize(
    "words, said",
    [
        (["--out", "run"], "no network to train; expected a YAML file, or --model"),
        (["--model", "eraft", "--out", "run"], "nothing to train on; expected a YAML file, or --data"),
        (["--model", "raft", "--data", "set", "--out", "run"], "--model: unknown model"),
        (["--model", "eraft", "--data", "set"], "--out: no run folder"),
    ],
)
def test_a_training_that_was_said_in_part(words, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert run(["train", *words]) == 2
    err = capsys.readouterr().err
    assert said in err and err.count("\n") == 1 and not list(tmp_path.iterdir())


def test_an_empty_start_without_a_network_is_a_missing_network(tmp_path):
    path = tmp_path / "train.yaml"
    path.write_text('init_from: ""\ndata: {train: [{path: set}], crop: [64, 64]}\n', encoding="utf-8")
    with pytest.raises(ConfigError, match="model: is required; expected a table of keys"):
        load_train_config(path)
