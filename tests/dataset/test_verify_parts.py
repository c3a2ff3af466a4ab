"""The parts of verification by themselves: every limit from both sides, every kind of file
that two machines may write differently."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import hdf5plugin  # noqa: F401
import pytest

from blinkgl.dataset.verify import cross_checks as between
from blinkgl.dataset.verify.problems import Known, Verification, guarded

# --- what lies between sequences --------------------------------------------------------------------------------------


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
