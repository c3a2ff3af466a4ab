"""The ablation: what each arm asks of which command, what arms share, and the table, without an hour of training."""

import itertools
import json
from pathlib import Path
from typing import ClassVar

import pytest

pytest.importorskip("torch")

from blinkgl.config.reader import read_table
from blinkgl.config.sequence import load_run
from blinkgl.errors import ConfigError
from blinkgl.tools import ablation
from eflow.config import load_train_config

BASE = ablation.CONFIGS / "real_data.yaml"


class Fake:
    """Commands that leave what the real ones leave. The error of a training is its seed, and 0.5 more for ESIM."""

    asked: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, minutes):
        assert minutes is None

    def run(self, module, command, *arguments, timed=False, fine=(0,)):
        self.asked.append((command, *arguments))
        options = dict(itertools.pairwise(arguments))
        out = Path(options["--out"])
        out.mkdir(parents=True)
        if command == "train":
            sets = [value for key, value in itertools.pairwise(arguments) if key == "--set"]
            config = load_train_config(Path(arguments[0]), sets)
            assert config.init_from == "real_small"
            assert Path(config.data.train[0].path).is_dir()
            (out / "checkpoints" / str(config.optim.steps)).mkdir(parents=True)
            (out / "log.jsonl").write_text(json.dumps({"kind": "train", "processor_s": 30.0}) + "\n")
        elif command == "evaluate":
            run = Path(arguments[0])
            error = 1 + int(run.name.removeprefix("seed")) + 0.5 * (run.parent.name == "esim")
            methods = {"network": {"total": {"AEE": error}}, "zero flow": {"total": {"AEE": 10.0}}}
            (out / "results.json").write_text(json.dumps({"methods": methods}))


@pytest.mark.parametrize("name", ablation.ARMS)
def test_every_arm_is_a_recipe_that_differs_by_what_it_says(name, tmp_path):
    arm = ablation.ARMS[name]
    base = read_table(BASE)
    tree = ablation.recipe_of(arm, base)
    differs = bool(arm.recipe or arm.every or arm.emulators != ablation.Arm("").emulators)
    assert (tree != base) == differs
    path = tmp_path / "recipe.yaml"
    path.write_text(ablation.to_yaml(tree))
    load_run(path)
    assert sum(one["share"] for one in tree["events"]["shares"]) == pytest.approx(1)
    sets = [f"{key}={json.dumps(value)}" for key, value in arm.training.items()]
    load_train_config(ablation.CONFIGS / "real.yaml", sets)


def test_arms_share_windows_and_go_round_by_seed(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(ablation, "Steps", Fake)
    monkeypatch.setattr(Fake, "asked", [])
    arms = ["--start", "real_small", "--arms", "all", "again", "esim", "dropping", "--seeds", "0", "1"]
    monkeypatch.setattr("sys.argv", ["ablation", "--out", str(tmp_path / "o"), *arms])
    ablation.main()
    drawn = [line for line in Fake.asked if line[0] == "render"]
    assert len(drawn) == 4, "the test, all, again and esim: what changes the training alone has the windows of all"
    assert drawn[0][-3:] == ("--seed", "99", "--quiet") and drawn[2][-3:] == ("--seed", "1", "--quiet")
    trained = [Path(line[3]).relative_to(tmp_path / "o") for line in Fake.asked if line[0] == "train"]
    names = ("all", "again", "esim", "dropping")
    assert list(map(str, trained)) == [f"{name}/seed{seed}" for seed in (0, 1) for name in names]
    rows = [line.split(" | ") for line in capsys.readouterr().out.splitlines()]
    assert rows[2][1:3] == ["2", "0.150"], "0.1 of zero flow with seed 0, 0.2 with seed 1"
    assert rows[4][:3] == ["| ESIM alone", "2", "0.200 (+0.050 ± 0.000)"]
    count = len(Fake.asked)
    ablation.main()
    assert len(Fake.asked) == count, "what is done is not done again"


def test_an_interval_is_students(tmp_path):
    ours, base = {f"seed{i}": {"e": x} for i, x in enumerate((1.0, 2.0, 4.0))}, {f"seed{i}": {"e": 1.0} for i in (0, 1)}
    mean, half = ablation.difference(ours, base, "e")
    assert (mean, half) == (pytest.approx(0.5), pytest.approx(12.706 * 0.5, rel=1e-3)), "two seeds that both have"


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--start", "real_small", "--arms", "consensus"], "--arms: an arm with another network cannot start"),
        (["--steps", "7"], "begun with other numbers"),
    ],
)
def test_what_cannot_be_compared_is_refused(options, message, tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "Steps", Fake)
    (tmp_path / "asked.json").write_text('{"windows": 2000, "test": 400, "steps": 2000, "start": null}')
    monkeypatch.setattr("sys.argv", ["ablation", "--out", str(tmp_path), *options])
    with pytest.raises(ConfigError, match=message):
        ablation.main()
