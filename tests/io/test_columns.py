"""What a file claims and Events cannot hold is refused by every reader, with event and value;
nothing wraps round, nothing is skipped."""

from __future__ import annotations

import h5py
import numpy as np
import pytest

from blinkgl.errors import BlinkGLError, EventDataError
from blinkgl.io.dsec import DsecEventReader
from blinkgl.io.formats import convert, open_events, write_events
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events
from tests.io.some_events import some_events

GOOD = {"x": [1, 2, 3], "y": [4, 5, 6], "t": [10, 20, 30], "p": [0, 1, 1]}


def dsec(path, **columns):
    """A DSEC file of 64-bit columns, as a careless tool may write it."""
    with h5py.File(path, "w") as file:
        for k, v in {**GOOD, **columns}.items():
            file[f"events/{k}"] = np.asarray(v)
        file["ms_to_idx"] = [0]
        file["events/t"].attrs["unit"] = "us"
    return path


def mvsec(path, **columns):
    rows = {**GOOD, **columns}
    with h5py.File(path, "w") as file:
        file["davis/left/events"] = np.stack(
            [np.asarray(rows[k], float) * (1e-6 if k == "t" else 1) for k in "xytp"], axis=1
        )
    return path


def npz(path, **columns):
    np.savez(path, **{k: np.asarray(v) for k, v in {**GOOD, **columns}.items()}, time_unit="us")
    return path


MAKERS = {"dsec": (dsec, "e.h5"), "mvsec": (mvsec, "e.hdf5"), "npz": (npz, "e.npz")}


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize(
    "columns, message",
    [
        ({"x": [1, 70000, 3]}, r"x of event 1 \(got 70000"),
        ({"y": [4, 5, -1]}, r"y of event 2 \(got -1"),
        ({"p": [0, 2, 1]}, r"(p|polarity) of event 1 \(got 2"),
        ({"t": [10, 30, 20]}, r"decrease at event 2 \(got \(30, 20\)\)"),
    ],
)
def test_what_events_cannot_hold_is_refused(tmp_path, kind, columns, message):
    make, name = MAKERS[kind]
    assert len(open_events(make(tmp_path / name)).read()) == 3
    with pytest.raises(EventDataError, match=rf"{name}: .*{message}"):
        open_events(make(tmp_path / name, **columns)).read()


@pytest.mark.parametrize(
    "columns, message",
    [
        ({"x": [1.0, 1.5, 2.0]}, r"x of event 1 \(got 1.5\); expected whole numbers"),
        ({"t": [10.0, np.nan, 30.0]}, r"time of event 1 \(got nan"),
        ({"t": [1.0, 2.0, 1e300]}, r"time of event 2"),
        ({"y": [1.0, np.nan, 2.0]}, r"y of event 1 \(got nan"),
        ({"x": ["a", "b", "c"]}, "holds no numbers"),
        ({"x": np.zeros((3, 2))}, "differ in length"),
        ({"height": [1, 2], "width": [1, 2]}, "'height' is no integer"),
        ({"height": 0, "width": 5}, "impossible sensor size"),
        ({"height": 70000, "width": 5}, "impossible sensor size"),
    ],
)
def test_npz_columns(tmp_path, columns, message):
    with pytest.raises(BlinkGLError, match=message):
        open_events(npz(tmp_path / "e.npz", **columns)).read()


def test_times_beyond_int64(tmp_path):
    path = npz(tmp_path / "e.npz", t=np.array([1, 2, 2**64 - 1], np.uint64))
    with pytest.raises(EventDataError, match=r"time of event 2 \(got 18446744073709551615"):
        open_events(path, EventReading(time_unit="us")).read()


@pytest.mark.parametrize(
    "kind, name",
    [
        ("dsec", "e.h5"),
        ("evt3", "e.raw"),
        ("npz", "e.npz"),
        ("csv", "e.csv"),
    ],
)
def test_events_outside_the_declared_sensor(tmp_path, kind, name):
    """The files say 20x20; they are patched, or their reader is told, to be smaller than the events."""
    events = Events(
        np.array([3, 9], np.uint16), np.array([4, 4], np.uint16), np.array([1, 2]), np.array([0, 1], np.uint8)
    )
    path = tmp_path / name
    write_events(path, events, 20, 20, write_unit="us" if kind == "csv" else "s")
    with open_events(path) as file:
        assert (file.height, file.width) == (20, 20)
    with pytest.raises(EventDataError, match=r"e\.\w+: event 1 is outside the sensor \(got \(9, 4\)\); expected x < 8"):
        convert(path, tmp_path / "out.h5", EventReading(size=(8, 8)))
    assert not (tmp_path / "out.h5").exists()
    if kind == "dsec":
        with h5py.File(path, "r+") as raw:
            raw.attrs["width"] = 8
    elif kind == "npz":
        np.savez(path, **{k: getattr(events, k) for k in "xytp"}, height=8, width=8, time_unit="us")
    else:
        path.write_bytes(
            path.read_bytes().replace(b"20x20", b"08x20").replace(b"width=20", b"width=08").replace(b"x@20", b"x@08")
        )
    with pytest.raises(EventDataError, match=r"event 1 is outside the sensor \(got \(9, 4\)\)"):
        open_events(path).read()


def test_slices_are_checked_too(tmp_path):
    events = some_events(5000, 0, 90_000, 48, 64)
    path = tmp_path / "e.h5"
    write_events(path, events, 48, 64)
    for change, message in (
        (lambda f: f["events/x"].__setitem__(3000, 64), r"event 3000 is outside the sensor"),
        (lambda f: f["events/t"].__setitem__(3000, 5), r"decrease at event 3000"),
        (
            lambda f: f["ms_to_idx"].__setitem__(40, 2900),
            r"'ms_to_idx' does not lead to the events of \[40000, 60000\) µs",
        ),
        (lambda f: f["ms_to_idx"].__setitem__(60, 2900), r"'ms_to_idx' does not lead"),
        (lambda f: f["ms_to_idx"].__setitem__(40, 2**63), r"'ms_to_idx' does not lead"),
        (lambda f: f.attrs.__setitem__("height", "many"), "attribute 'height' is no integer"),
    ):
        write_events(path, events, 48, 64)
        with DsecEventReader(path) as reader:
            assert len(reader.slice(40_000, 60_000))
        with h5py.File(path, "r+") as file:
            change(file)
        with pytest.raises(BlinkGLError, match=message), DsecEventReader(path) as reader:
            reader.slice(40_000, 60_000)


@pytest.mark.parametrize(
    "text, message",
    [
        ("the quick brown fox\njumps over\n", "line 1 is not an event, and not a heading that names t, x, y and p"),
        ('# fine\n{"a": 1}\n', "line 2 is not an event"),
        ("\x00\x01\x02\x03", "line 1 is not an event"),
        ("x,y,p,time,time\n1,2,1,5\n", "line 1.*not a heading that names t, x, y and p"),
        ("t,x,y,p\nt,x,y,p\n1,2,3,1\n", "line 2 is not an event"),
        ("# " + "c" * 70_000 + "\n1 2 3 1\n", "line 1 is longer than 65536 bytes"),
        ("0 480\nt_us x y p\n1 2 3 1\n", "impossible sensor size"),
        ("1.000000 2 3 1\n0.000002 2 3 1\n", "times decrease at event 1.*or --sort$"),
        ("1 2 3 1\n2 2 3 1\n", "no heading names the columns; try --columns t,x,y,p --time-unit us if that is right"),
        ("t,x,y,p\n1,2,3,1\n", "no unit of the times is stated; try --time-unit us if that is right"),
        (
            "t_us,x,y,p\n0.5,2,3,9\n",
            "line 2 has a polarity that is not known .*expected 0/1, -1/1 or True/False.*--polarity",
        ),
        ("4 4\nt_us x y p\n1 2 3 1\n2 4 3 1\n", r"event 1 is outside the sensor \(got \(4, 3\)\)"),
        ("t_min,x,y,p\n5,2,3,1\n", "line 1"),
    ],
)
def test_text_that_is_no_events(tmp_path, text, message):
    (tmp_path / "e.txt").write_text(text)
    with pytest.raises(BlinkGLError, match=message):
        open_events(tmp_path / "e.txt").read()


def test_csv_in_microseconds_is_faerys(tmp_path):
    events = Events(
        np.array([1, 639], np.uint16),
        np.array([2, 479], np.uint16),
        np.array([5, 1_500_000]),
        np.array([0, 1], np.uint8),
    )
    write_events(tmp_path / "a.csv", events, 480, 640)
    convert(tmp_path / "a.csv", tmp_path / "b.csv", EventReading(size=(480, 640)), write_unit="us")
    assert (tmp_path / "b.csv").read_text() == "t,x@640,y@480,on\n5,1,2,0\n1500000,639,479,1\n"
    convert(tmp_path / "b.csv", tmp_path / "c.csv")
    assert (tmp_path / "c.csv").read_text() == (tmp_path / "a.csv").read_text()
    with pytest.raises(BlinkGLError, match="unit of time"):
        convert(tmp_path / "a.csv", tmp_path / "d.h5", write_unit="us")
    faery = pytest.importorskip("faery", reason="optional extra [formats]")
    stream = faery.events_stream_from_file(tmp_path / "b.csv", dimensions_fallback=(640, 480))
    a = stream.to_array()
    assert a["t"].tolist() == [5, 1_500_000] and a["on"].tolist() == [False, True] and a["x"].tolist() == [1, 639]
    stream.to_file(tmp_path / "f.csv")
    assert open_events(tmp_path / "f.csv").read().t.tolist() == [5, 1_500_000]


def test_times_with_and_without_names(tmp_path):
    from blinkgl.io.times import read_timestamps

    (tmp_path / "t.txt").write_text("0 a.png\n10000\n")
    with pytest.raises(EventDataError, match="t.txt: times with a name and times without one"):
        read_timestamps(tmp_path / "t.txt")
