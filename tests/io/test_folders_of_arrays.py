"""Recordings that lie in several files: BS-ERGB's and EventScape's folders of arrays, EVIMO2's three arrays."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.reading import EventReading
from tests.io.some_events import same, some_events

E = some_events(120, 70_000, 90_000, 180, 240)


def bs_ergb(x, y, t, p) -> dict[str, np.ndarray]:
    return {
        "x": np.uint32(x) * np.uint32(32),
        "y": np.uint32(y) * np.uint32(32),
        "timestamp": t.astype("f8"),
        "polarity": p,
    }


def eventscape(x, y, t, p) -> dict[str, np.ndarray]:
    return {"x": x.astype("i2"), "y": y.astype("i2"), "t": t * 1000, "p": p.astype("i1") * 2 - 1}


def plain(x, y, t, p) -> dict[str, np.ndarray]:
    return {"x": x, "y": y, "t_us": t, "p": p}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "events").mkdir()
    (tmp_path / "events/timestamps.txt").write_text("0.07\n0.08\n")
    return tmp_path / "events"


def put(folder, form, shift=lambda k: 0, more=lambda k: {}) -> None:
    for k in range(12):
        part = slice(10 * k, 10 * k + 10)
        columns = form(E.x[part], E.y[part], E.t[part] - shift(k), E.p[part])
        np.savez(folder / f"{k}_events.npz", **columns, **more(k))


@pytest.mark.parametrize(("form", "said"), [(bs_ergb, "BS-ERGB's"), (eventscape, "vid2e's"), (plain, "")])
def test_a_folder_of_arrays_is_one_recording(folder, capsys, form, said):
    """In the order of the numbers, 2 before 10; compare and convert read it as the same events in one file."""
    put(folder, form)
    with open_events(folder) as file:
        assert same(file.read(), E) and f"{said}" in file.notes[0] and "12 files" in file.notes[-1]
    np.savez(folder.parent / "one.npz", **plain(E.x, E.y, E.t, E.p))
    assert run(["convert", str(folder), str(folder.parent / "out.npy")]) == 0
    with open_events(folder.parent / "out.npy") as file:
        assert same(file.read(), E)
    assert run(["compare", str(folder.parent / "one.npz"), str(folder)]) == 0
    assert "frames" not in capsys.readouterr().out


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ({"shift": lambda k: int(E.t[10 * k])}, "the times begin again in this file"),
        ({"more": lambda k: {"height": 180 + k, "width": 240}}, "another sensor than in the file before"),
    ],
)
def test_files_that_are_no_one_recording(folder, how, said):
    put(folder, plain, **how)
    for declared in ({}, {"sort": True}, {"damaged": "keep"}):
        with pytest.raises(BlinkGLError) as caught:
            open_events(folder, EventReading.of(**declared)).read()
        text = str(caught.value)
        assert "\n" not in text and said in text and "1_events.npz" in text


def test_steps_between_pixels_are_named(folder):
    columns = bs_ergb(E.x, E.y, E.t, E.p)
    columns["x"][3] += 5
    np.savez(folder / "0.npz", **columns)
    with pytest.raises(BlinkGLError, match="x of event 3 .*whole numbers"):
        open_events(folder).read()


@pytest.mark.parametrize("name", ["", "dataset_events_t.npy", "dataset_events_xy.npy", "dataset_events_p.npy"])
def test_three_arrays_as_either_side_of_compare(tmp_path, name):
    (tmp_path / "seq").mkdir()
    np.save(tmp_path / "seq/dataset_events_t.npy", E.t / 1e6)
    np.save(tmp_path / "seq/dataset_events_xy.npy", np.stack([E.x, E.y], axis=1))
    np.save(tmp_path / "seq/dataset_events_p.npy", E.p)
    np.savez(tmp_path / "one.npz", **plain(E.x, E.y, E.t, E.p))
    for pair in (("one.npz", f"seq/{name}"), (f"seq/{name}", "one.npz")):
        assert run(["compare", *(str(tmp_path / one) for one in pair)]) == 0


@pytest.mark.parametrize("frames", [False, True])
@pytest.mark.parametrize("kind", ["npz", "npy"])
def test_arrays_of_events_and_of_frames_as_the_other_side(tmp_path, frames, kind):
    """Frames have three axes or more; rows and columns of events do not."""
    np.savez(tmp_path / "one.npz", **plain(E.x, E.y, E.t, E.p))
    rows = np.stack([E.t, E.x, E.y, E.p], axis=1)
    film = np.random.default_rng(0).integers(0, 255, (5, 180, 240)).astype(np.uint8)
    path = tmp_path / f"b.{kind}"
    if kind == "npz":
        np.savez(path, **({"frames": film} if frames else {"events": rows}))
    else:
        np.save(path, film if frames else rows)
    stamps = tmp_path / "t.txt"
    stamps.write_text("".join(f"{70_000 + 4000 * k}\n" for k in range(5)))
    options = ["--timestamps", str(stamps), "--frames-time-unit", "us"] if frames else ["--columns", "t,x,y,p"]
    options += [] if frames else ["--time-unit", "us"]
    if not frames:
        np.save(tmp_path / "one.npy", rows)
    first = "one.npz" if frames else "one.npy"
    assert run(["compare", str(tmp_path / first), str(path), *options]) == 0


@pytest.mark.parametrize(
    ("beside", "known"),
    [
        ((), False),
        (("K",), False),
        (("K", "other"), False),
        (("index", "K"), True),
        (("K", "D", "index", "discretization", "meta"), True),
    ],
)
def test_rows_without_names_are_ev_imos_only_beside_two_of_its_arrays(tmp_path, beside, known):
    rows = np.array([[0.1, 2, 3, 1], [0.2, 4, 5, 0]])
    np.savez(tmp_path / "one.npz", events=rows, **{name: np.eye(3) for name in beside})
    if known:
        events = open_events(tmp_path / "one.npz").read()
        assert events.t.tolist() == [100_000, 200_000] and events.x.tolist() == [2, 4] and events.p.tolist() == [1, 0]
    else:
        with pytest.raises(AssetError, match="array 'events' has no names of columns"):
            open_events(tmp_path / "one.npz")
