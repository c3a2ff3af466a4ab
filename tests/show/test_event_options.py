"""One name for one thing: the options about event files in every command that reads one, and what it then prints."""

from __future__ import annotations

import json
import warnings

import numpy as np
import pytest

import blinkgl
from blinkgl.cli import run
from tests.io.some_events import same, some_events

E = some_events(3000, 0, 900_000, 60, 80)


@pytest.fixture
def ns(tmp_path):
    """A table of a stranger: integers of ns, p of 1 and 2, y from the bottom, in no order, one event outside."""
    order = np.random.default_rng(0).permutation(len(E))
    x, y, t, p = E.x[order], 59 - E.y[order], E.t[order] * 1000, E.p[order] + 1
    np.savez(tmp_path / "e.npz", x=np.append(x, 500), y=np.append(y, 5), t=np.append(t, 10**6), p=np.append(p, 1))
    return str(tmp_path / "e.npz")


OPTIONS = [
    "--time-unit",
    "ns",
    "--size",
    "80x60",
    "--origin",
    "bottom",
    "--polarity",
    "1/2",
    "--damaged",
    "keep",
    "--sort",
]
DECLARED = {
    "time_unit": "ns",
    "size": (60, 80),
    "origin": "bottom",
    "polarity": (1, 2),
    "damaged": "keep",
    "sort": True,
}


def test_convert(ns, tmp_path, capsys):
    assert run(["convert", ns, str(tmp_path / "o.h5"), *OPTIONS]) == 0
    said = capsys.readouterr()
    assert "3,000 events, 80x60, from npz" in said.out
    assert "left out: events outside 80x60: 1 (first: x 500, y 5)" in said.err
    assert "put in order: events that came late" in said.err
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert same(blinkgl.read_events(tmp_path / "o.h5"), blinkgl.read_events(ns, **DECLARED))
    read = blinkgl.read_events(tmp_path / "o.h5")
    assert sorted(zip(*(getattr(read, k).tolist() for k in "txyp"))) == sorted(
        zip(*(getattr(E, k).tolist() for k in "txyp"))
    )
    assert [str(w.message).split(": ", 1)[1][:8] for w in caught] == ["left out", "put in o"]
    assert blinkgl.convert(ns, tmp_path / "o.csv", **DECLARED, write_unit="us") == 3000
    assert (tmp_path / "o.csv").read_text().startswith("t,x@80,y@60,on\n")


def test_refusals_name_the_option_and_write_nothing(ns, tmp_path, capsys):
    for arguments, line in (
        ([], "try --time-unit us if that is right"),
        (["--time-unit", "ns"], "or --polarity 1/2"),
        (OPTIONS[:-1], "keep"),
        (
            ["--time-unit", "minutes"],
            "error: --time-unit: unknown unit of time (got 'minutes'); expected s, ms, us, ns",
        ),
        (["--polarity", "on"], "error: --polarity: cannot read --polarity"),
    ):
        status = run(["convert", ns, str(tmp_path / "o.h5"), *arguments])
        said = capsys.readouterr().err
        if arguments == OPTIONS[:-1]:  # far out of order, and kept all the same: what is late is left out
            assert status == 0 and "events more than 10 ms late" in said
            (tmp_path / "o.h5").unlink()
            continue
        assert status == 2 and line in said and len(said.splitlines()) == 1
        assert not (tmp_path / "o.h5").exists()


def test_errors_of_the_output_name_it_and_no_hidden_file(tmp_path, capsys):
    np.savez(tmp_path / "e.npz", x=E.x, y=E.y, t_us=E.t + 2**40, p=E.p)
    assert run(["convert", str(tmp_path / "e.npz"), str(tmp_path / "o.raw")]) == 2
    said = capsys.readouterr().err
    assert said.startswith(
        f"error: {tmp_path}/o.raw: EVT3 times count from the recording's start; --zero-time shifts them"
    )


def test_compare_says_what_it_took(ns, tmp_path, capsys):
    assert run(["compare", ns, *OPTIONS, "--out", str(tmp_path / "c")]) == 0
    assert "left out: events outside 80x60" in capsys.readouterr().out
    assert json.loads((tmp_path / "c/compare.json").read_text())["a"]["count"] == 3000
    np.savez(tmp_path / "g.npz", x=E.x, y=E.y, t=E.t, p=E.p)
    assert run(["compare", str(tmp_path / "g.npz")]) == 2
    assert "no unit of the times 't' is stated; try --time-unit us if that is right" in capsys.readouterr().err
    assert run(["compare", str(tmp_path / "g.npz"), "--time-unit", "us"]) == 0
    assert "size taken as 240x180" in capsys.readouterr().out


def test_a_look_prints_what_is_stated_and_the_options_to_paste(ns, tmp_path, capsys):
    """The proposal reads the very file."""
    (tmp_path / "e.txt").write_text("".join(f"{k * 1000} {k % 9} {k % 7} {k % 2}\n" for k in range(60)))
    assert run(["convert", str(tmp_path / "e.txt"), "--look"]) == 0
    said = capsys.readouterr().out
    assert "no heading names the columns; try --columns t,x,y,p --time-unit us" in said and "  2000 2 2 0" in said
    options = ["--columns", "t,x,y,p", "--time-unit", "us"]
    assert run(["convert", str(tmp_path / "e.txt"), "--look", *options]) == 0
    assert "t[us] x y p\n0 0 0 0\n1000 1 1 1\n" in capsys.readouterr().out
    assert run(["convert", str(tmp_path / "e.txt"), str(tmp_path / "o.h5"), *options]) == 0
    assert "60 events" in capsys.readouterr().out
    assert run(["convert", ns]) == 2 and "OUT: no output; expected an event file, or --look" in capsys.readouterr().err


def test_a_look_at_arrays_shows_rows_as_the_proposal_has_them(tmp_path, capsys):
    rows = {"x": [1, 2], "y": [3, 4], "t": [0.000709, 0.0998], "p": [0, 1]}
    np.savez(tmp_path / "e.npz", **{name: np.array(values) for name, values in rows.items()})
    assert run(["convert", str(tmp_path / "e.npz"), "--look"]) == 0
    out = capsys.readouterr().out
    assert "missing: " in out and "with --time-unit s:\n" in out and "\n709 1 3 0\n99800 2 4 1\n" in out
    np.save(tmp_path / "e.npy", np.column_stack([rows["t"], rows["x"], rows["y"], rows["p"]]))
    assert run(["convert", str(tmp_path / "e.npy"), "--look"]) == 0
    assert "with --columns t,x,y,p --time-unit s:\n" in (out := capsys.readouterr().out) and "\n709 1 3 0\n" in out


def test_calibrate_notes_what_it_took(ns, tmp_path, capsys):
    arguments = ["calibrate", ns, "--still", "--out", str(tmp_path / "s.yaml"), "--starts", "1", *OPTIONS]
    assert run(arguments) == 0
    assert "left out: events outside 80x60: 1" in capsys.readouterr().out


def test_eflow_predict_reads_alike(ns, tmp_path, capsys):
    pytest.importorskip("torch")
    from eflow.cli import run as eflow

    assert eflow(["predict", "contrast-affine", ns, "--whole", *OPTIONS]) == 0
    assert "put in order: events that came late" in capsys.readouterr().err
