"""The configurations that ship: every one is valid, and what the README says about them holds."""

import re
from pathlib import Path

import pytest

pytest.importorskip("torch")

from blinkgl.config.recipe import all_groups
from blinkgl.config.run import load_run
from eflow.cli import run
from eflow.config import load_train_config
from eflow.models import NETWORKS, model_config
from flow_data import blinkgl_set

REPOSITORY = Path(__file__).resolve().parents[2]
FOLDER = REPOSITORY / "configs" / "eflow"
TRAINING = sorted(p.name for p in FOLDER.glob("*.yaml") if not p.name.endswith("_data.yaml"))
DATA = ["eflow/" + p.name for p in sorted(FOLDER.glob("*_data.yaml"))] + ["blinkflow.yaml"]


@pytest.mark.parametrize("name", TRAINING)
def test_training_configurations(name):
    config = load_train_config(FOLDER / name)
    model = model_config(config.model.model_dump())
    assert model == config.model
    if config.data.crop is not None:
        assert all(side % 16 == 0 and side >= 128 for side in config.data.crop)


@pytest.mark.parametrize("name", DATA)
def test_generation_configurations(name):
    """Backward flow for time reversal; train and test differ in trajectories (each group has its own seed) and, by
    content hash, in meshes and textures."""
    groups = [g for g in all_groups(load_run(REPOSITORY / "configs" / name)) if g.enabled]
    sides = {
        side: [g.template.check() for g in groups if g.template.tree["output"].get("split", "train") == side]
        for side in ("train", "test")
    }
    seeds = {
        side: {g.template.seed for g in groups if g.template.tree["output"].get("split", "train") == side}
        for side in sides
    }
    assert sides["train"] and sides["test"] and not seeds["train"] & seeds["test"]
    for first in sides["train"]:
        assert set(first.labels.flow) == {"forward", "backward"}
        assert first.scene.pool.test_fraction > 0 and first.scene.textures.test_fraction > 0


@pytest.mark.parametrize(
    "text", [*(f"configs/eflow/{n}" for n in TRAINING), *(f"configs/{n}" for n in DATA), "docs/eflow.md", "README.md"]
)
def test_documented_commands_do_not_refuse_each_other(text):
    """One folder takes one recipe; a training configuration reads the folders that its own commands make."""
    content = (REPOSITORY / text).read_text(encoding="utf-8")
    made: dict[str, set[str]] = {}
    for config, folder, options in re.findall(r"generate (\S+) --out (\S+)([^\n#]*)", content):
        assert (REPOSITORY / config).is_file(), config
        made.setdefault(folder, set()).add(config + re.sub(r"--(workers \d+|resume)", "", options).rstrip(" \\"))
    assert all(len(commands) == 1 for commands in made.values()), made
    if Path(text).name in TRAINING:
        config = load_train_config(REPOSITORY / text)
        sets = (*config.data.train, *config.data.validate_on)
        if all(s.online for s in sets):  # no folder at all
            assert all(Path(s.recipe).is_file() for s in sets) and not made
            return
        read = {Path(s.path).resolve().relative_to(REPOSITORY) for s in sets}
        said = made or {"out/blinkflow": set()}  # the baselines refer to eflowformer.yaml
        assert {p.parent.as_posix() for p in read} == set(said) and {p.name for p in read} == {"train", "test"}


def test_one_per_network_and_a_smoke_run():
    models = {load_train_config(FOLDER / n).model.name for n in TRAINING}
    assert models == set(NETWORKS)
    assert {"smoke.yaml", "eflowformer.yaml", "h100_30min.yaml"} <= set(TRAINING)


def test_what_is_printed_is_what_is_trained(tmp_path, capsys):
    """--print-config: every key, paths absolute; read again it is the same configuration, from any folder."""
    (tmp_path / "c.yaml").write_text(
        "model: {name: eraft, size: tiny}\ndata: {train: [{path: set}], crop: [64, 64]}\noptim: {steps: 7}\n"
    )
    words = ["train", str(tmp_path / "c.yaml"), "--set", "optim.lr=1e-3", "--print-config"]
    assert run(words) == 0
    (tmp_path / "elsewhere").mkdir()
    again = tmp_path / "elsewhere" / "printed.yaml"
    again.write_text(printed := capsys.readouterr().out)
    wanted = load_train_config(tmp_path / "c.yaml", ["optim.lr=1e-3"])
    assert load_train_config(again) == wanted and wanted.optim.lr == 1e-3
    assert str(tmp_path / "set") in printed and "picture_every: 2000" in printed and "match_weight" in printed


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
