"""A short run of the configuration fuzz, and that the fuzz would notice."""

import signal

import pytest

from blinkgl.errors import ConfigError
from blinkgl.tools import fuzz_configs
from blinkgl.tools.fuzz_configs import Case, Worker, attempt, fuzz, main, make


def test_a_short_run_finds_nothing(tmp_path):
    report = fuzz(7, 100, 3, tmp_path / "failures")
    assert report["failures"] == [] and not (tmp_path / "failures").exists()
    read, run = report["outcomes"]["read"], report["outcomes"]["run"]
    assert sum(read.values()) == 100 and read["accepted"] > 10 and read["refused"] > 30 and run["made"] >= 1


def test_the_same_seed_makes_the_same_configurations():
    texts = [(c.text, c.overrides) for c in (make(5, what, k) for what in ("read", "run") for k in range(40))]
    assert texts == [(c.text, c.overrides) for c in (make(5, what, k) for what in ("read", "run") for k in range(40))]
    assert len({str(t) for t in texts}) > 70 and texts[0] != (make(6, "read", 0).text, make(6, "read", 0).overrides)
    assert any(c[1] for c in texts), "some with --set"


class TwoLines(ConfigError):
    """What errors.py would not let happen."""

    def __str__(self) -> str:
        return "two\nlines"


@pytest.mark.parametrize(
    "error, kind",
    [
        (KeyError("x"), "bug"),
        (TwoLines("two"), "lines"),
        (ConfigError("one line"), "refused"),
        (MemoryError(), "died"),
        (RecursionError("deep"), "bug"),
    ],
)
def test_what_counts_as_a_defect(tmp_path, monkeypatch, error, kind):
    def fail(*_):
        raise error

    monkeypatch.setattr(fuzz_configs, "load_run", fail)
    assert attempt("read", 0, Case({}), tmp_path).kind == kind


def test_a_refusal_of_what_was_accepted_is_a_defect(tmp_path, monkeypatch):
    case = Case({"timeline": {"min_step_us": {"uniform": [100, 900]}, "max_step_us": {"uniform": [500, 2000]}}})
    assert attempt("read", 0, case, tmp_path).kind == "refused"
    from blinkgl.config import sequence

    monkeypatch.setattr(sequence, "corners", lambda model, tree, fills: [{}])  # no corner is looked at
    outcome = attempt("read", 0, case, tmp_path)
    assert outcome.kind == "late" and "min_step_us must not exceed" in outcome.message and not outcome.good


def test_a_process_that_dies_is_started_again():
    worker = Worker(0, 2000, 20.0)
    try:
        assert worker.try_one("read", 0).good
        worker.process.send_signal(signal.SIGKILL)
        worker.process.wait()
        dead = worker.try_one("read", 1)
        assert (dead.kind, dead.message) == ("died", "exit status -9")
        assert worker.try_one("read", 1).good
    finally:
        worker.close()


def test_one_again_shows_its_yaml(capsys):
    assert main(["--seed", "0", "--only", "read:3"]) == 0
    assert make(0, "read", 3).text in capsys.readouterr().out
