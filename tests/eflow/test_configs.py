"""The configurations that ship: every one is valid, and what the README says about them holds."""

import json
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.errors import ConfigError
from blinkgl.io.flow import write_flow_png
from eflow.cli import run
from eflow.load_config import load_train_config
from eflow.models import model_config
from flow_data import blinkgl_set, constant_flow, dsec_set

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


def test_dsec_2026_trains_on_dsecs_layout(tmp_path, capsys):
    """Real folders, sizes, rectification and sparse truth; only the network and the number of steps are small."""
    root = dsec_set(tmp_path / "train", tuple(f"zurich_city_{k:02d}_a" for k in range(4)), labels=1)
    sparse = np.random.default_rng(0).random((480, 640)) < 0.3
    for path in root.glob("*/flow/forward/*.png"):
        write_flow_png(path, constant_flow(480, 640), sparse)
    words = ["model={name: eraft, size: tiny, train_iterations: 1, iterations: 1}", f"data.train=[{{path: {root}}}]"]
    words += ["data.batch=2", "data.workers=0", "data.validate_samples=1", "optim.steps=2", "run.precision=fp32"]
    words += ["data.validate_on={share: 0.6}", "data.augment.scale_probability=1", "run.picture_every=1"]
    options = [word for pair in words for word in ("--set", pair)]
    out = tmp_path / "run"
    assert run(["train", str(FOLDER / "dsec_2026.yaml"), "--out", str(out), "-q", *options]) == 0, (
        capsys.readouterr().err
    )
    rows = [json.loads(line) for line in (out / "log.jsonl").read_text().splitlines()]
    assert [row["kind"] for row in rows] == ["train", "validation"] and 0 < rows[0]["epe"] < 20
    assert rows[1]["train/zero"] == pytest.approx(np.hypot(4, 2), abs=0.01)  # of the whole frame, not of a crop


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


@pytest.mark.parametrize(
    ("text", "options", "said"),
    [
        ("data: [1]", {"data": ["set"]}, "data: not a table of keys (got [1])"),
        (
            "data: {train: [{path: set}], crop: [64, 64]}\noptim: 3",
            {"minutes": 5},
            "optim: not a table of keys (got 3)",
        ),
    ],
)
def test_a_section_that_is_no_table(text, options, said, tmp_path):
    path = tmp_path / "train.yaml"
    path.write_text(f"model: {{name: ev_flownet}}\n{text}\n", encoding="utf-8")
    with pytest.raises(ConfigError) as caught:
        load_train_config(path, **options)
    assert str(caught.value).startswith(said)


def test_without_a_file_nothing_is_scaled_unless_asked_for():
    model, data = {"name": "ev_flownet"}, ["set"]
    augment = load_train_config(None, ["data.augment.horizontal_flip=0"], model=model, data=data).data.augment
    assert (augment.horizontal_flip, augment.scale_probability) == (0, 0)
    own = ["data.augment.scale_probability=0.2", "data.crop=[64,64]"]
    assert load_train_config(None, own, model=model, data=data).data.augment.scale_probability == 0.2
    assert load_train_config(None, ["data.augment=null"], model=model, data=data).data.augment is None
