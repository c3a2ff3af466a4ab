"""Every feature with every other that it meets: any two kinds are in some data set here,
and all who look at that agree.

The rows come from ``features.py``; what agreement means is in ``agreement.py``.
"""

import hashlib
import json
import shutil
from pathlib import Path

import pytest
import yaml

from agreement import of_data_set, of_explanation
from blinkgl.cli import run
from blinkgl.config.run import load_run
from blinkgl.config.sequence import SequenceConfig
from blinkgl.dataset.executor import Local
from blinkgl.dataset.explain import explain
from blinkgl.dataset.generate import generate_run
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.work import report_of
from features import (
    ELSEWHERE,
    FEATURES,
    OF_PAIRS,
    REFUSED,
    RUN_LEVEL,
    all_pairs,
    configuration,
    covering_rows,
    fits,
    merged,
    options_of_the_schema,
    options_of_the_table,
    pairs,
)

ROWS = covering_rows()
BATCH = 9
"""Rows of a data set: several, so that several processes of a test run share them."""
FIRST = 2
"""Batches that always run: 63 % of the pairs are in the first 18 rows; the others bring the rest (`make slow`)."""
BATCHES = [
    pytest.param(number, marks=[pytest.mark.slow] * (number >= FIRST)) for number in range(-(-len(ROWS) // BATCH))
]


def recipe(assets: Path, name: str, groups: dict[str, dict]) -> Path:
    path = assets / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"seed": 3, "groups": groups}))
    return path


def tree(out: Path) -> dict[str, str]:
    """Hash of every file of a data set, its record left out."""
    return {
        p.relative_to(out).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in sorted(out.rglob("*"))
        if p.is_file() and p.relative_to(out).parts[0] != ".run"
    }


class Reports(dict):
    """A run's listener: name -> report of every sequence it made."""

    def __bool__(self) -> bool:
        return True

    def begin(self, plan, outcome) -> None:
        pass

    def message(self, name, message) -> None:
        if message["kind"] == "done":
            self[name] = report_of(message)

    def end(self, outcome) -> None:
        pass


# ---- the table -------------------------------------------------------------------------------------------------------


def test_no_feature_is_without_a_row():
    """A new top-level key, a new emulator, timeline, sensor, label, anti-aliasing … has to be added to FEATURES."""
    told = {key for kinds in FEATURES.values() for change in kinds.values() for key in change} | RUN_LEVEL.keys()
    assert told == set(SequenceConfig.model_fields), (
        "features.py: top-level keys of the configuration without a kind, or the other way round"
    )
    lacking = options_of_the_schema() - options_of_the_table() - {(f"labels.{name}", True) for name in OF_PAIRS}
    assert not lacking, f"no kind for {sorted(lacking, key=str)}"
    assert {path.split(".")[0] for path in ELSEWHERE} <= set(SequenceConfig.model_fields)


def test_every_pair_of_kinds_is_in_a_row():
    covered = set().union(*map(pairs, ROWS))
    assert all_pairs() <= covered and all(map(fits, ROWS))
    assert len(ROWS) < 100 and covering_rows() == ROWS
    often = set().union(*map(pairs, ROWS[: FIRST * BATCH]))
    met = len(all_pairs() & often) / len(all_pairs())
    assert met > 0.58, f"FIRST x BATCH rows, which every run takes, meet {met:.0%} of the pairs: raise FIRST"


@pytest.mark.parametrize(
    "pair, said",
    [pytest.param(pair, said, id=" + ".join(f"{f} {k}" for f, k in pair)) for pair, said in REFUSED.items()],
)
def test_what_contradicts_is_refused_in_one_line(assets, tmp_path, capsys, pair, said):
    path = assets / "refused.yaml"
    path.write_text(yaml.safe_dump(configuration(dict(pair))))
    for command in (["generate", str(path), "--out", str(tmp_path / "out")], ["explain", str(path)]):
        assert run(command) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and said in error and error.count("\n") == 1 and "expected" in error
    assert not (tmp_path / "out").exists()


# ---- the rows --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("batch", BATCHES)
def test_all_agree(assets, tmp_path, batch):
    rows = {f"row{number:02d}": row for number, row in enumerate(ROWS) if number // BATCH == batch}
    groups = {name: merged(configuration(row), {"output": {"name": name}}) for name, row in rows.items()}
    template = load_run(recipe(assets, f"batch{batch}", groups))
    plan = Plan.of(template)
    out = tmp_path / "out"
    outcome = run_dataset(template, out, listener=(reports := Reports()))
    assert outcome.set_aside == {} and len(reports) == len(rows) == len(plan.tasks)
    found = of_data_set(out, reports, tmp_path)
    found.same("events", run=outcome.made.events, reports=sum(r.events for r in reports.values()))
    for task in plan.tasks:
        config = plan.config(task)
        told = explain(plan.by_name[task.group].template, task.index)
        found += [f"{task.name}: {line}" for line in of_explanation(told, config, reports[task.name])]
    # One sequence lost and one with a byte too many: made again, the others are left alone, and nothing differs.
    before, (lost, damaged) = tree(out), list(reports)[:2]
    shutil.rmtree(out / lost)
    with open(out / damaged / "events.h5", "ab") as file:
        file.write(b"x")
    run_dataset(template, out, resume=True, listener=(again := Reports()))
    found.same("resume", made=sorted(again), missing=sorted([lost, damaged]))
    (out / "report.html").unlink(missing_ok=True)
    found.expect(tree(out) == before, "resume: other bytes")
    # The configuration as drawn, by hand.
    alone = assets / f"alone{batch}.yaml"
    shutil.copy(out / lost / "config.yaml", alone)
    list(generate_run(load_run(alone), tmp_path / "alone"))
    found.expect(
        tree(tmp_path / "alone") == {k: v for k, v in tree(out).items() if k.startswith(lost + "/")},
        f"{lost}: config.yaml makes other bytes",
    )
    assert not found, "\n".join([f"{len(found)} disagreements", *found, json.dumps(rows, indent=1)])


# ---- what a pair of rows has to say to each other --------------------------------------------------------------------


@pytest.mark.parametrize("source", ["random", "explicit", "frames, linear"])
def test_a_read_out_neither_makes_nor_hides_events(assets, tmp_path, source):
    """With each emulator: what a slow bus sent, lost and kept back is what was made."""
    groups = {}
    for number, emulator in enumerate(FEATURES["emulator"]):
        for readout in ("unsaid", "slow"):
            tree = configuration(
                {
                    "source": source,
                    "emulator": emulator,
                    "readout": readout,
                    "timeline": "uniform",
                    "images": "no images",
                    "flow": "none",
                }
            )
            groups[f"e{number}_{readout}"] = {**tree, "seed": 9}
    run_dataset(load_run(recipe(assets, f"readout {source}", groups)), tmp_path / "out")
    for number, emulator in enumerate(FEATURES["emulator"]):
        free, slow = (
            json.loads((tmp_path / f"out/train/e{number}_{r}_000000/manifest.json").read_text())
            for r in ("unsaid", "slow")
        )
        assert slow["events_lost_in_readout"] + slow["events_late_in_readout"] > 0 < slow["events"], emulator
        assert free["events"] == slow["events"] + slow["events_lost_in_readout"] + slow["events_late_in_readout"], (
            emulator
        )


def test_executors_and_resume_and_groups(assets, tmp_path):
    """Scenes, one that lives, a scene file and frames by two workers, cut short and continued by other
    means: the bytes of one process."""
    groups = {
        name: merged(configuration({"source": source, "timeline": "displacement"}), {"output": {"sequences": 2}})
        for name, source in (
            ("scene", "random"),
            ("living", "living"),
            ("file", "file"),
            ("recorded", "frames, motion"),
        )
    }
    template = load_run(recipe(assets, "executors", groups))
    run_dataset(template, tmp_path / "one")
    outcome = run_dataset(template, tmp_path / "two", Local(workers=2))
    assert len(outcome.made) == 8 and tree(tmp_path / "two") == tree(tmp_path / "one")
    for name in ("train/scene_000001", "train/living_000000", "train/recorded_000000"):
        shutil.rmtree(tmp_path / "two" / name)
    assert len(run_dataset(template, tmp_path / "two", resume=True).made) == 3
    assert tree(tmp_path / "two") == tree(tmp_path / "one")
