"""The parts of verification by themselves: every limit from both sides, every kind of file
that two machines may write differently."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import hdf5plugin  # noqa: F401
import pytest

from blinkgl.dataset.verify import cross_checks as between, reproduce as again
from blinkgl.dataset.verify.problems import Known, Verification, guarded

# --- two machines -----------------------------------------------------------------------------------------------------


def test_what_sets_two_machines_apart():
    here = {"blinkgl": "1.0", "versions": {"numpy": "2"}, "opengl": {"renderer": "llvmpipe", "version": "4.5"}}
    assert again._apart(here, dict(here)) == ""
    assert again._apart({**here, "blinkgl": "0.9"}, here) == "made with BlinkGL 0.9, this machine has 1.0"
    assert (
        again._apart({**here, "opengl": {"renderer": "Voodoo", "version": "1"}}, here)
        == "made with opengl Voodoo, 1, this machine has llvmpipe, 4.5"
    )
    assert again._apart({**here, "versions": {"numpy": "1", "numba": "3"}}, here) == (
        "made with numba 3, this machine has None; made with numpy 1, this machine has 2"
    )
    assert between.made_with({"versions": None, "opengl": None}) == {}


@pytest.mark.parametrize(
    "a, b, where",
    [
        ({"a": 1}, {"a": 1}, ""),
        ({"a": 1}, {"a": 2}, "a"),
        ({"a": {"b": [1, 2]}}, {"a": {"b": [1, 3]}}, "a.b"),
        ({"a": {"b": 1}, "c": 1}, {"a": {"b": 1}, "c": 2}, "c"),
        ({"a": 1}, {"a": 1, "b": 0}, "b"),
        ({"b": 1, "a": 1}, {"b": 2, "a": 2}, "a"),
        ({"a": {}}, {"a": 3}, "a"),
    ],
)
def test_where_two_configurations_differ(a, b, where):
    assert between.first_difference(a, b) == where


# --- what lies between sequences --------------------------------------------------------------------------------------


def test_what_belongs_to_no_sequence(tmp_path):
    for name in ("train/a_000000", "train/b_000000", ".run", "train/nothing", "deep/er/empty"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("train/a_000000/events.h5", "index.jsonl", "report.html", ".run/run.json"):
        (tmp_path / name).write_text("")
    folders = [tmp_path / "train/a_000000", tmp_path / "train/b_000000"]
    assert between.strangers(tmp_path, folders) == ["deep: belongs to no sequence"]
    (tmp_path / "deep").rename(tmp_path / "train/.c_000001.blinkgl-tmp-0123456789ab-1-0")
    (tmp_path / "train/index.jsonl").write_text("")
    (tmp_path / "train/nothing/x").write_text("")
    (tmp_path / "link").symlink_to(tmp_path / "train")
    assert between.strangers(tmp_path, folders) == [
        "link: belongs to no sequence",
        "train/.c_000001.blinkgl-tmp-0123456789ab-1-0: left by a run that was cut off",
        "train/index.jsonl: belongs to no sequence",
        "train/nothing: belongs to no sequence",
    ]


def known(
    name: str,
    seed: int,
    sequence: int,
    events: int = 5,
    sha: str = "e",
    poses: str = "p",
    kind: str = "random",
    frames=None,
    **noise,
):
    config = SimpleNamespace(
        frames=frames,
        scene=SimpleNamespace(kind=kind),
        seed=seed,
        events=SimpleNamespace(**noise),
        readout=None,
        sensors=None,
    )
    return name, Known(
        Path(name),
        {
            "files": {"events.h5": {"sha256": sha}, "poses.npz": {"sha256": poses}},
            "events": events,
            "sequence": sequence,
        },
        config,
    )


@pytest.mark.parametrize(
    "first, second, problems, notes",
    [
        (
            known("a", 1, 0),
            known("b", 1, 1),
            {
                "b": [
                    "events.h5: the same as in a, a sequence of another draw",
                    "poses.npz: the same as in a, a sequence of another draw",
                ]
            },
            [],
        ),
        (
            known("a", 1, 0),
            known("b", 1, 1, sha="f"),
            {"b": ["poses.npz: the same as in a, a sequence of another draw"]},
            [],
        ),
        (known("a", 1, 0), known("b", 2, 0, sha="f", poses="q"), {}, []),
        (known("a", 1, 0), known("b", 1, 0), {}, ["b: the same events as a, as their configurations have it"]),
        (known("a", 1, 0, events=0), known("b", 1, 1, events=0, poses="q"), {}, []),
        (
            known("a", 1, 0, kind="explicit"),
            known("b", 1, 1, kind="explicit"),
            {},
            ["b: the same events as a, as their configurations have it"],
        ),
        (
            known("a", 1, 0, frames="film"),
            known("b", 1, 1, frames="film"),
            {},
            ["b: the same events as a, as their configurations have it"],
        ),
    ],
)
def test_twins(first, second, problems, notes):
    result = Verification()
    assert between.twins(dict([first, second]), result) == problems and result.notes == notes


def test_a_check_that_stops_is_a_line():
    assert guarded(lambda: 1 / 0) == ["cannot be checked: ZeroDivisionError: division by zero"] and guarded(
        lambda: ["x"]
    ) == ["x"]
