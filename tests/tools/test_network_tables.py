"""Networks at equal processor time: what is asked of which command, what is kept, and the table, without an hour of
training."""

import itertools
import json
from pathlib import Path
from typing import ClassVar

import pytest

pytest.importorskip("torch")


from blinkgl.config.sequence import load_run
from blinkgl.tools import network_tables as tables
from eflow.config import load_train_config


class Fake:
    """Commands that leave what the real ones leave: empty data sets, a log, an error that grows with every command."""

    asked: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, minutes):
        assert minutes is None

    def run(self, module, command, *arguments, timed=False, fine=(0,)):
        self.asked.append((command, *arguments))
        options = dict(itertools.pairwise(arguments))
        out = Path(options["--out"])
        sets = [value for key, value in itertools.pairwise(arguments) if key == "--set"]
        out.mkdir(parents=True)
        if command == "generate":
            assert fine == (0, 3), "some sequences may be set aside"
            if Path(arguments[0]).name != "converted.yaml":
                load_run(Path(arguments[0]), sets)
            for number in range(6):
                (out / "train" / f"s{number}").mkdir(parents=True)
        elif command == "train":
            config = load_train_config(Path(arguments[0]), sets)
            assert (config.optim.clock, config.optim.minutes, config.data.workers) == ("processor", 10.0, 0)
            assert Path(config.data.train[0].path).is_dir()
            line = {"kind": "train", "step": 70, "processor_s": 600.0}
            (out / "log.jsonl").write_text(json.dumps(line) + "\n")
        else:
            error = lambda value: {"total": {"AEE": value}}
            methods = {"network": error(float(len(self.asked))), "zero flow": error(99.0)}
            (out / "results.json").write_text(json.dumps({"methods": methods, "parameters": 1_250_000}))


def test_every_row_is_trained_and_judged_once(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(tables, "Steps", Fake)
    monkeypatch.setattr(Fake, "asked", [])
    few = ["--networks", "ev_flownet", "eraft", "--few", "ev_flownet", "--sequences", "2", "--seeds", "0", "1"]
    monkeypatch.setattr("sys.argv", ["network_tables", "--out", str(tmp_path / "o"), *few])
    tables.main()
    text = capsys.readouterr().out
    by = lambda command: [line for line in Fake.asked if line[0] == command]
    assert len(by("generate")) == 3 + len(tables.CUSTOM)
    assert len(by("train")) == 3 * 2 and len(by("evaluate")) == 3 * 2 * len(tables.SUBSETS)
    assert [p.name for p in sorted((tmp_path / "o/few_2").iterdir())] == ["s0", "s3"]
    rows = [line.split(" | ") for line in text.splitlines()]
    assert [row[0] for row in rows] == [
        "| ",
        "|---|---|---|---|---|---|---|---|---|",
        "| ev_flownet",
        "| eraft",
        "| ev_flownet, 2 sequences",
        "| zero flow",
    ]
    first = len(by("generate")) + 2  # a training goes before its four evaluations; a seed is fifteen commands
    assert rows[2][1:5] == ["2", "1.25", "70", f"{first + 7.5:.2f} ({first}.00–{first + 15}.00)"]
    count = len(Fake.asked)
    tables.main()
    assert len(Fake.asked) == count, "what is done is not done again"
    monkeypatch.setattr("sys.argv", ["network_tables", "--out", str(tmp_path / "o"), "--minutes", "3"])
    with pytest.raises(tables.BlinkGLError, match="begun with other numbers"):
        tables.main()
