"""What lies beside the columns of events is said, in every container; NumPy's dates state their unit."""

import zipfile

import cv2
import h5py
import numpy as np
import pytest
import scipy.io
from PIL import Image

from blinkgl import AssetError, ConfigError, EventDataError, Events, open_events, simulate, write_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import Declared

T, X, Y, P = np.arange(20) * 1000, np.arange(20) % 7, np.arange(20) % 5, np.arange(20) % 2
COLUMNS = {"t_us": T, "x": X, "y": Y, "p": P}
LINE = "left out: columns that are none of t, x, y, p: instance"


def records():
    made = np.zeros(len(T), [("t_us", "i8"), ("x", "u2"), ("y", "u2"), ("p", "?"), ("instance", "u2")])
    for name, column in COLUMNS.items():
        made[name] = column
    return made


def hdf5(path, group, **columns):
    with h5py.File(path, "w") as file:
        for name, column in columns.items():
            file[f"{group}{name}"] = column


def dsec(path):
    hdf5(path, "events/", t=T, x=X, y=Y, p=P.astype(bool), instance=X)
    with h5py.File(path, "r+") as file:
        file["ms_to_idx"], file["t_offset"] = np.arange(len(T) + 1), 0


def record_file(path):
    with h5py.File(path, "w") as file:
        file["events"] = records()


WRITERS = {
    "columns.npz": lambda path: np.savez(path, **COLUMNS, instance=X),
    "records.npy": lambda path: np.save(path, records()),
    "records.npz": lambda path: np.savez(path, events=records()),
    "group.h5": lambda path: hdf5(path, "events/", **COLUMNS, instance=X, frames=np.zeros((3, 2, 2))),
    "root.h5": lambda path: hdf5(path, "", **COLUMNS, instance=X),
    "records.h5": record_file,
    "dsec.h5": dsec,
    "variables.mat": lambda path: scipy.io.savemat(path, {**COLUMNS, "instance": X}),
    "struct.mat": lambda path: scipy.io.savemat(path, {"events": {**COLUMNS, "instance": X}}),
    "text.csv": lambda path: path.write_text(
        "t_us,x,y,p,instance\n" + "".join(f"{t},{x},{y},{p},{x}\n" for t, x, y, p in zip(T, X, Y, P))
    ),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_column_that_is_not_read_is_said(tmp_path, name):
    WRITERS[name](tmp_path / name)
    with open_events(tmp_path / name) as file:
        (events,) = file.chunks()
        assert LINE in file.notes and (events.t == T).all() and (events.x == X).all()


def test_names_of_strangers_are_one_short_line(tmp_path):
    hdf5(
        tmp_path / "e.h5",
        "events/",
        **COLUMNS,
        **{"\x1b[31mred\nline": X, **{f"column_{k:03d}": X for k in range(400)}},
    )
    with open_events(tmp_path / "e.h5") as file:
        (line,) = (one for one in file.notes if "columns" in one)
    assert line.isprintable() and r"\x1b[31mred\nline" in line and line.endswith("and 389 more") and len(line) < 400


def test_an_archive_of_one_event_names_no_settings_as_columns(tmp_path):
    np.savez(tmp_path / "one.npz", **{name: column[:1] for name, column in COLUMNS.items()}, gain=np.array([3.0]))
    with open_events(tmp_path / "one.npz") as file:
        assert not any("columns" in line for line in file.notes)


@pytest.mark.parametrize("kind", ["datetime64", "timedelta64"])
@pytest.mark.parametrize("unit, per_us", [("ns", 1000), ("us", 1)])
def test_dates_state_their_unit(tmp_path, kind, unit, per_us):
    np.savez(tmp_path / "dates.npz", x=X, y=Y, t=(T * per_us).astype(f"{kind}[{unit}]"), p=P)
    with open_events(tmp_path / "dates.npz") as file:
        assert np.concatenate([events.t for events in file.chunks()]).tolist() == T.tolist()


def test_no_date_and_other_steps_are_refused(tmp_path):
    dates = (T * 1000).astype("datetime64[ns]")
    dates[3] = "NaT"
    np.savez(tmp_path / "nat.npz", x=X, y=Y, t=dates, p=P)
    with open_events(tmp_path / "nat.npz") as file, pytest.raises(EventDataError, match="time of event 3"):
        list(file.chunks())
    with open_events(tmp_path / "nat.npz", damaged="keep") as file:
        assert sum(map(len, file.chunks())) == len(T) - 1
    np.savez(tmp_path / "steps.npz", x=X, y=Y, t=T.astype("timedelta64[25us]"), p=P)
    with open_events(tmp_path / "steps.npz") as file, pytest.raises(AssetError, match="dates in s, ms, us or ns"):
        list(file.chunks())


def test_the_folder_of_macos_is_no_text(tmp_path):
    with zipfile.ZipFile(tmp_path / "mac.zip", "w") as archive:
        archive.writestr("a.csv", "t_us,x,y,p\n1,2,3,1\n")
        archive.writestr("__MACOSX/._a.csv", b"\0\5\x16\7")
    with open_events(tmp_path / "mac.zip") as file:
        assert [events.x.tolist() for events in file.chunks()] == [[2]]


FRAMES = np.random.default_rng(0).integers(0, 255, (4, 24, 32), dtype=np.uint8)


@pytest.mark.parametrize("declared, left", [({}, "exposure, masks"), ({"fps": 30}, "exposure, masks")])
def test_arrays_beside_frames_are_said(tmp_path, declared, left):
    beside = {"exposure": np.ones(4), "masks": FRAMES[:, :2]}
    np.savez(tmp_path / "f.npz", frames=FRAMES, timestamps_us=np.arange(4) * 1000, **beside)
    frames = open_frames(str(tmp_path / "f.npz"), Declared(**declared))
    assert len(list(frames)) == 4 and f"left out: {left}, beside the frames" in frames.notes


def test_frames_with_dates_have_their_times(tmp_path):
    dates = (np.arange(4) * 33_333_333).astype("datetime64[ns]")
    np.savez(tmp_path / "f.npz", frames=FRAMES, timestamps=dates)
    assert [t_ns for _, t_ns, _ in open_frames(str(tmp_path / "f.npz"), Declared())] == dates.astype(int).tolist()


def test_pictures_in_a_folder_below_are_said(tmp_path):
    for place in (tmp_path, tmp_path / "masks", tmp_path / "notes"):
        place.mkdir(exist_ok=True)
    for k in range(3):
        cv2.imwrite(str(tmp_path / f"{k}.png"), FRAMES[k])
        cv2.imwrite(str(tmp_path / f"masks/{k}.png"), FRAMES[k])
    (tmp_path / "notes/read.txt").write_text("nothing to see")
    frames = open_frames(str(tmp_path), Declared(fps=30))
    assert len(list(frames)) == 3 and "masks: a folder, so its files are left out" in frames.notes
    assert not any("notes" in line for line in frames.notes)


def one_of_each(folder):
    """Files that state their unit and their columns."""
    np.savez(folder / "a.npz", **{name.removesuffix("_us"): column for name, column in COLUMNS.items()}, time_unit="us")
    hdf5(folder / "a.h5", "events/", **COLUMNS)
    np.save(folder / "a.npy", records())
    (folder / "a.csv").write_text("t_us,x,y,p\n" + "".join(f"{t},1,2,1\n" for t in T))
    events = Events(X.astype(np.uint16), Y.astype(np.uint16), T, P.astype(np.uint8))
    for name in ("a.raw", "a.aedat4", "a.bin"):
        write_events(folder / name, events, 60, 80)


@pytest.mark.parametrize("name", ["a.npz", "a.h5", "a.npy", "a.csv", "a.raw", "a.aedat4", "a.bin"])
def test_what_is_declared_against_the_file_is_said(tmp_path, name):
    one_of_each(tmp_path)
    own = name in ("a.raw", "a.aedat4", "a.bin")
    with open_events(tmp_path / name, time_unit="ns") as file:
        times = np.concatenate([events.t for events in file.chunks()])
        assert times.tolist() == (T if own else T // 1000).tolist()
        line = "in µs; --time-unit is not used" if own else "the file says us; --time-unit ns is used"
        assert sum(line in one for one in file.notes) == 1
    with open_events(tmp_path / name, time_unit="us") as file:
        assert not any("--time-unit" in one for one in file.notes)
    if name != "a.csv":  # there the declared order counts, whatever the heading says
        with open_events(tmp_path / name, columns="x,y,t,p") as file:
            assert np.concatenate([events.t for events in file.chunks()]).tolist() == T.tolist()
            assert sum("--columns is not used" in one for one in file.notes) == 1


@pytest.mark.parametrize(
    "declared, line",
    [
        ({"stream": "5"}, "there is one series of frames; --stream is not used"),
        ({"time_unit": "us"}, "no list of times is read; --time-unit is not used"),
        ({}, None),
    ],
)
@pytest.mark.parametrize("kind", ["folder", "a.gif"])
def test_what_is_declared_of_frames_and_not_used_is_said(tmp_path, kind, declared, line):
    if kind == "a.gif":
        first, *others = (Image.fromarray(frame) for frame in FRAMES)
        first.save(tmp_path / kind, save_all=True, append_images=others, duration=10)
    else:
        (tmp_path / kind).mkdir()
        for k, frame in enumerate(FRAMES):
            cv2.imwrite(str(tmp_path / f"{kind}/{k}.png"), frame)
    frames = open_frames(str(tmp_path / kind), Declared(fps=50, **declared))
    assert [t_ns for _, t_ns, _ in frames][:2] == [0, 20_000_000]
    assert ("the times in the file are not used, because of --fps" in frames.notes) == (kind == "a.gif")
    assert [one for one in frames.notes if "not used" in one and "--fps" not in one] == ([line] if line else [])


def test_no_code_of_8_bits_is_a_white_of_12():
    with pytest.raises(ConfigError, match=r"--white-level.*4095.*at most 255 of uint8"):
        list(simulate(list(FRAMES), fps=30, white_level=4095))
