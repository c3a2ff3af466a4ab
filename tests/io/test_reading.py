"""What event files of others say, what is declared, what is asked for, and what is kept of damaged ones."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from blinkgl.errors import AssetError, BlinkGLError, ConfigError, EventDataError
from blinkgl.io.formats import convert, open_events, write_events
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events
from tests.io.some_events import same, some_events
from tests.shared_data import shared

E = some_events(400, 700, 99_800, 260, 346)
ROWS = np.stack([E.x, E.y, E.t, E.p], axis=1).astype(float)
UNITS = {"s": 1e-6, "ms": 1e-3, "us": 1.0, "ns": 1e3}


def read(path, **declared) -> tuple[Events, list[str]]:
    with open_events(path, EventReading.of(**declared)) as file:
        return file.read(), file.notes


# ---------------------------------------------------------------------------------------------------------------------
# Names, orders, units and polarities, of every format that holds columns.


def as_npz(path, names, columns):
    np.savez(path, **dict(zip(names, columns)))


def as_npy(path, names, columns):
    table = np.empty(len(columns[0]), [(name, column.dtype) for name, column in zip(names, columns)])
    for name, column in zip(names, columns):
        table[name] = column
    np.save(path, table)


def as_mat(path, names, columns):
    savemat(path, dict(zip(names, columns)))


def as_text(path, names, columns):
    lines = [",".join(names), *(",".join(f"{v:.9g}" for v in row) for row in zip(*columns))]
    path.write_text("\n".join(lines) + "\n")


def as_root(path, names, columns, group="/"):
    with h5py.File(path, "w") as file:
        for name, column in zip(names, columns):
            file[f"{group}{name}"] = column


def as_h5(path, names, columns):
    as_root(path, names, columns, "events/")


def as_mat73(path, names, columns):
    """As MATLAB's save(…, '-v7.3'): HDF5 behind 512 bytes, vectors of two axes."""
    with h5py.File(path, "w", userblock_size=512) as file:
        for name, column in zip(names, columns):
            file[name] = column[None]
    with open(path, "r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\2IM")


MAKERS = {
    "e.npz": as_npz,
    "e.npy": as_npy,
    "e.mat": as_mat,
    "e.txt": as_text,
    "e.h5": as_h5,
    "root.h5": as_root,
    "e73.mat": as_mat73,
}


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize(
    "names", [("x", "y", "t", "p"), ("xs", "ys", "ts", "ps"), ("timestamps", "x", "y", "polarities")]
)
def test_columns_are_found_by_their_names(tmp_path, name, names):
    slots = [n[0] for n in names]
    MAKERS[name](tmp_path / name, names, [getattr(E, s) for s in slots])
    with pytest.raises(AssetError, match="no unit of the times .*is stated; try --time-unit us if that is right"):
        read(tmp_path / name)
    events, said = read(tmp_path / name, time_unit="us")
    assert same(events, E) and said == []


@pytest.mark.parametrize("name", MAKERS)
@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("p", ["0/1", "-1/1", "bool"])
def test_units_and_polarities(tmp_path, name, unit, p):
    """In the name and declared; t as integers and floats."""
    signs = {"0/1": E.p, "-1/1": E.p.astype(np.int8) * 2 - 1, "bool": E.p.astype(bool)}[p]
    if p == "bool" and name in ("e.txt", "e73.mat", "e.mat"):
        signs = E.p
    t = E.t * UNITS[unit]
    path = tmp_path / name
    for heading, declared in ((f"t_{unit}", {}), ("t", {"time_unit": unit})):
        MAKERS[name](path, (heading, "x", "y", "p"), [t, E.x, E.y, signs])
        events, said = read(path, **declared)
        assert same(events, E) and said == [], (unit, heading)


@pytest.mark.parametrize("name", ["e.npz", "e.npy", "e.h5", "e.txt"])
def test_rows_without_names(tmp_path, name):
    """(N, 4): the refusal proposes the options, which are right here and read the very file; _ leaves a column out."""
    path = tmp_path / name
    for order in ("txyp", "xytp", "xypt", "t_xyp"):
        table = np.stack([E.x * 0.0 + 7 if s == "_" else getattr(E, s) * 1.0 for s in order], axis=1)
        if name == "e.npz":
            np.savez(path, events=table)
        elif name == "e.npy":
            np.save(path, table)
        elif name == "e.txt":
            np.savetxt(path, table)
        else:
            with h5py.File(path, "w") as file:
                file["events"] = table
        columns = ",".join(order)
        if order != "t_xyp":
            with pytest.raises(AssetError, match=rf"try --columns {columns} --time-unit us if that is right .*--look"):
                read(path)
        events, said = read(path, columns=columns, time_unit="us")
        assert same(events, E) and said == []
    with pytest.raises(ConfigError, match=r"--columns.*got 'x,y,t'.*expected x, y, t and p in the file's order"):
        read(path, columns="x,y,t")


def test_names_that_mean_nothing_can_be_declared(tmp_path):
    np.savez(tmp_path / "e.npz", u=E.x, v=E.y, stamp_us=E.t, sign=E.p)
    with pytest.raises(
        AssetError, match=r"no columns of events.*expected x, y, t, p in one place, .*or --columns x=NAME"
    ):
        read(tmp_path / "e.npz")
    assert same(read(tmp_path / "e.npz", columns="x=u,y=v,p=sign")[0], E)


def test_a_polarity_that_is_none_of_the_usual(tmp_path):
    np.savez(tmp_path / "e.npz", x=E.x, y=E.y, t_us=E.t, p=E.p + 1)
    with pytest.raises(EventDataError, match=r"got 2\); expected 0 or 1, -1 or 1; or --polarity 1/2"):
        read(tmp_path / "e.npz")
    assert same(read(tmp_path / "e.npz", polarity="1/2")[0], E)
    assert same(read(tmp_path / "e.npz", polarity=(2, 1))[0], replace(E, p=1 - E.p))
    write_events(tmp_path / "e.raw", E, 260, 346)  # a format with a polarity of its own, written by a confused program
    assert same(read(tmp_path / "e.raw", polarity="1/0")[0], replace(E, p=1 - E.p))
    (tmp_path / "e.txt").write_text("t_us x y p\n5 1 2 True\n6 1 2 False\n7 3 4 1\n")
    assert read(tmp_path / "e.txt")[0].p.tolist() == [1, 0, 1]
    (tmp_path / "e.txt").write_text("t_us x y p\n5 1 2 2\n6 1 2 1\n")
    assert read(tmp_path / "e.txt", polarity="1/2")[0].p.tolist() == [1, 0]


def test_headings_of_text(tmp_path):
    path = tmp_path / "e.txt"
    for heading, row in (
        ("# x y t p", "3 4 5 1"),
        ("% x;y;t[us];p", "3;4;5;1"),
        ("id,x,y,timestamp (ms),polarity", "9,3,4,0.005,1"),
        ('"t_ns","x","y","on"', "5000,3,4,1"),
        (",t_us,x,y,p", "0,5,3,4,1"),
        ("event_x,event_y,ts_nsec,polarity", "3,4,5000,1"),
    ):
        path.write_text(f"{heading}\n{row}\n")
        events, said = read(path, time_unit="us" if "t p" in heading else None)
        assert [events.x[0], events.y[0], events.t[0], events.p[0]] == [3, 4, 5, 1]
        others = ["left out: columns that are none of t, x, y, p: id"] if heading.startswith("id") else []
        assert said == others
    path.write_bytes(b"\xef\xbb\xbf5 3 4 1\r\n6 3 4 0\r\n")
    assert read(path, time_unit="us", columns="t,x,y,p")[0].t.tolist() == [5, 6]
    np.savez(tmp_path / "a.npz", ROWS[:, [2, 0, 1, 3]], height=260, width=346)
    with open_events(tmp_path / "a.npz", EventReading.of("us", columns="t,x,y,p")) as file:
        assert same(file.read(), E) and (file.height, file.width) == (260, 346)
    with gzip.open(tmp_path / "e.csv.gz", "wt") as file:
        file.writelines(["x,y,t_us,p\n", *(f"{x},{y},{t},{p}\n" for x, y, t, p in ROWS.astype(int).tolist())])
    assert same(read(tmp_path / "e.csv.gz")[0], E)


def test_offsets_and_sizes_in_hdf5(tmp_path):
    """t_offset of one number in any shape, in the unit of t; sizes as attributes or data sets."""
    for offset, where in ((np.int64(5_000_000), "t_offset"), (np.array([5_000_000]), "t_offset")):
        with h5py.File(tmp_path / "e.h5", "w") as file:
            for slot in "xytp":
                file[f"events/{slot}"] = getattr(E, slot) if slot != "p" else E.p.astype(np.int8) * 2 - 1
            file[where], file["events/height"], file["events/width"] = offset, 260, 346
        with open_events(tmp_path / "e.h5", EventReading(time_unit="us")) as file:
            assert (file.height, file.width) == (260, 346) and same(file.read(), replace(E, t=E.t + 5_000_000))
    with h5py.File(tmp_path / "e.h5", "r+") as file:
        del file["t_offset"]
        file["t_offset"] = np.zeros(3)
    with pytest.raises(AssetError, match=r"'t_offset' is no number .got '\(3,\)'"):
        open_events(tmp_path / "e.h5")


def test_both_cameras_of_mvsec(tmp_path):
    with h5py.File(tmp_path / "m.hdf5", "w") as file:
        file["davis/left/events"] = ROWS * [1, 1, 1e-6, 1]
        file["davis/right/events"] = ROWS[:7] * [1, 1, 1e-6, 1]
    listed = "expected one of --stream 0 .davis/left/events., --stream 1 .davis/right/events.$"
    with pytest.raises(AssetError, match=f"2 arrays of events, and none is chosen; {listed}"):
        read(tmp_path / "m.hdf5")
    for stream, count in ((0, len(E)), ("davis/left/events", len(E)), ("1", 7), ("davis/right/events", 7)):
        events, said = read(tmp_path / "m.hdf5", stream=stream)
        assert len(events) == count and said == []
    with pytest.raises(AssetError, match=f"no such one of the arrays of events .got '2'.; {listed}"):
        read(tmp_path / "m.hdf5", stream=2)


def struct_array(rows):
    table = np.empty((1, len(rows)), [(name, object) for name in rows[0]])
    for name in rows[0]:
        table[name][0] = [row[name] for row in rows] if np.isscalar(rows[0][name]) else None
        for k, row in enumerate(rows):
            table[name][0, k] = row[name]
    return table


def test_struct_arrays_of_matlab(tmp_path):
    """One event an element; whole columns an element; another struct beside the variables."""
    savemat(tmp_path / "e.mat", {"events": struct_array([{"x": r[0], "y": r[1], "ts": r[2], "p": r[3]} for r in ROWS])})
    assert same(read(tmp_path / "e.mat", time_unit="us")[0], E)
    parts = [{"x": r[:, 0], "y": r[:, 1], "ts": r[:, 2], "p": r[:, 3]} for r in (ROWS[:150], ROWS[150:])]
    savemat(tmp_path / "e.mat", {"info": {"camera": "D"}, "td": struct_array(parts)})
    assert same(read(tmp_path / "e.mat", time_unit="us")[0], E)
    savemat(
        tmp_path / "e.mat", {"info": {"fps": 30}, "x": ROWS[:, 0], "y": ROWS[:, 1], "t": ROWS[:, 2], "p": ROWS[:, 3]}
    )
    assert same(read(tmp_path / "e.mat", time_unit="us")[0], E)
    savemat(tmp_path / "e.mat", {"events": ROWS[:, [2, 0, 1, 3]]})
    assert same(read(tmp_path / "e.mat", time_unit="us", columns="t,x,y,p")[0], E)


# ---------------------------------------------------------------------------------------------------------------------
# Units that are asked for.


def test_what_is_written_says_its_unit(tmp_path):
    np.savez(tmp_path / "e.npz", x=E.x, y=E.y, t=E.t * 1000, p=E.p)
    with pytest.raises(AssetError, match="no unit of the times 't' is stated; try --time-unit us if that is right"):
        read(tmp_path / "e.npz")
    assert read(tmp_path / "e.npz", time_unit="us")[0].t.tolist() == (E.t * 1000).tolist()
    for name in ("o.npz", "o.npy", "o.h5", "o.raw"):  # what is written here says its unit
        convert(tmp_path / "e.npz", tmp_path / name, EventReading("ns"))
        events, said = read(tmp_path / name)
        assert same(events, E) and said == []


def test_the_unit_of_text_that_is_written_has_a_name_of_its_own(tmp_path):
    write_events(tmp_path / "e.raw", E, 260, 346)
    with pytest.raises(
        ConfigError, match=r"--time-unit: evt3 files count µs .got 'ms'.*--write-unit is the unit of text"
    ):
        convert(tmp_path / "e.raw", tmp_path / "e.txt", EventReading(time_unit="ms"))
    convert(tmp_path / "e.raw", tmp_path / "e.csv", write_unit="us")
    events, said = read(tmp_path / "e.csv")
    assert same(events, E) and said == []


def test_a_guessed_size_is_no_fact(tmp_path):
    (tmp_path / "e.txt").write_text("t_us x y p\n5 300 200 1\n")
    with open_events(tmp_path / "e.txt") as file:
        sized = file.sized()
        assert (sized.height, sized.width) == (240, 304)
        assert (
            sized.notes[-1]
            == "size taken as 304x240, the smallest sensor that holds all events (--size if that is wrong)"
        )
    for name in ("e.h5", "e.raw", "e.npz", "e.csv"):
        convert(tmp_path / "e.txt", tmp_path / name)
        with open_events(tmp_path / name) as file:
            assert (file.height, file.width) == (None, None) and file.read().x.tolist() == [300]
        convert(
            tmp_path / "e.txt",
            tmp_path / name,
            EventReading(size=(300, 400)),
            write_unit="us" if ".csv" in name else "s",
        )
        with open_events(tmp_path / name) as file:
            assert (file.height, file.width) == (300, 400)
    write_events(tmp_path / "s.npz", E, 260, 346)
    assert read(tmp_path / "s.npz", size="640x480")[1] == ["the file says 346x260; --size is used"]


def test_y_from_the_bottom(tmp_path):
    write_events(tmp_path / "e.npz", E, 260, 346)
    assert same(read(tmp_path / "e.npz", origin="bottom")[0], replace(E, y=(259 - E.y).astype(np.uint16)))
    np.savez(tmp_path / "n.npz", x=E.x, y=E.y, t_us=E.t, p=E.p)
    with pytest.raises(ConfigError, match="n.npz: y counts from the bottom of an unknown height; expected --size"):
        read(tmp_path / "n.npz", origin="bottom")


@pytest.mark.parametrize(
    "declared, message",
    [
        ({"time_unit": "min"}, "--time-unit: unknown unit of time .got 'min'.; expected s, ms, us, ns"),
        ({"origin": "left"}, "--origin.*expected top or bottom"),
        ({"damaged": "drop"}, "--damaged.*expected refuse or keep"),
        ({"polarity": "on"}, "--polarity.*expected the numbers of OFF and ON"),
        ({"size": "640"}, "--size: not a size"),
        ({"columns": "a,b,c,d"}, "--columns"),
    ],
)
def test_declarations_that_cannot_be_read(declared, message):
    with pytest.raises(ConfigError, match=message):
        EventReading.of(**declared)


# ---------------------------------------------------------------------------------------------------------------------
# Salvage.


def test_events_outside_the_sensor(tmp_path):
    outside = replace(E, x=E.x.copy())
    outside.x[[3, 5]] = 900, 901
    for name in ("e.npz", "e.raw", "e.txt"):
        write_events(tmp_path / name, outside, 1000, 1000)
        with pytest.raises(EventDataError, match=r"event 3 is outside.*x < 346, y < 260; or a larger --size$"):
            read(tmp_path / name, size="346x260")
        events, said = read(tmp_path / name, size="346x260", damaged="keep")
        assert (
            len(events) == len(E) - 2 and said[-1] == f"left out: events outside 346x260: 2 (first: x 900, y {E.y[3]})"
        )


def test_times_that_run_backwards(tmp_path):
    """Packets that overlap are put in place in constant memory; --sort puts anything in order; a late stray is left
    out and counted."""
    events = some_events(5000, 0, 3_000_000, 260, 346)
    order = np.arange(5000)
    order[2000:2010] = order[2000:2010][::-1]
    near = events.part(order)
    np.savez(tmp_path / "near.npz", x=near.x, y=near.y, t_us=near.t, p=near.p)
    with pytest.raises(EventDataError, match="event times decrease at event 200.*or --sort$"):
        read(tmp_path / "near.npz")
    for declared in ({"damaged": "keep"}, {"sort": True}):
        kept, said = read(tmp_path / "near.npz", **declared)
        assert kept.t.tolist() == events.t.tolist() and len(said) == 1 and "events that came late" in said[0]
    far = events.part(np.roll(np.arange(5000), -1))  # the first event comes last
    np.savez(tmp_path / "far.npz", x=far.x, y=far.y, t_us=far.t, p=far.p)
    assert same(read(tmp_path / "far.npz", sort=True)[0], events)
    kept, said = read(tmp_path / "far.npz", damaged="keep")
    assert same(kept, events.part(slice(1, None)))
    assert "left out: events more than 10 ms late: 1 (--sort keeps them)" in said


def test_cut_files(tmp_path):
    """What is before the cut, and how much; the default names the option."""
    for name in ("e.raw", "e.txt"):
        write_events(tmp_path / name, E, 260, 346)
        data = (tmp_path / name).read_bytes()
        (tmp_path / name).write_bytes(data[:-3])
        with pytest.raises(AssetError, match="or --damaged keep$"):
            read(tmp_path / name)
        events, said = read(tmp_path / name, damaged="keep", time_unit=None)
        assert same(events, E.part(slice(len(E) - 1))), said
        assert any(
            "left out: rows that are no events: 1" in s or "kept: events before the damage: 399" in s for s in said
        )


def test_words_and_rows_that_are_none(tmp_path):
    words = [0x8000, 0x6064, 5, 0x280A, 0x9123, 0x280B, 0x8000, 0x280C]
    (tmp_path / "e.raw").write_bytes(b"% evt 3.0\n% end\n" + np.array(words, "<u2").tobytes())
    events, said = read(tmp_path / "e.raw", damaged="keep")
    assert events.x.tolist() == [10, 11, 12] and said == ["left out: words that EVT3 does not have: 1"]
    np.savez(tmp_path / "e.npz", x=[1.0, np.nan, 70000, 4], y=[1, 2, 3, -4], t_us=[1, 2, 3, 4], p=[0, 1, 0, 1])
    events, said = read(tmp_path / "e.npz", damaged="keep")
    assert events.t.tolist() == [1] and said == ["left out: rows that are no events: 3"]


def test_evt3_without_its_time_high_words(tmp_path):
    """Where the low bits begin again another 4096 µs have passed: said, and never done unasked."""
    path = tmp_path / "e.raw"
    path.write_bytes(
        b"% evt 3.0\n% end\n"
        + np.array([0x8000, 0x6F00, 5, 0x2001, 0x6010, 0x2002, 0x6F00, 0x2003, 0x6001, 0x2004], "<u2").tobytes()
    )
    with pytest.raises(EventDataError, match="times decrease at event 1"):
        read(path)
    events, said = read(path, damaged="keep")
    assert events.t.tolist() == [3840, 4096 + 16, 4096 + 3840, 8192 + 1]
    assert said == ["4096 µs counted for each of 2 TIME_HIGH words that are missing"]
    path.write_bytes(b"% evt 3.0\n% end\n" + np.array([0x2001, 0x8001, 0x2002], "<u2").tobytes())
    assert read(path)[1] == ["left out: events before the first TIME_HIGH, which have no time: 1"]


# ---------------------------------------------------------------------------------------------------------------------
# Formats of fixed records.


def test_prophesees_dat(tmp_path):
    """Version 2 and 1; a counter that wraps; a cut; independent packing."""
    t = np.array([5, 4_294_967_290, 2**32 + 94, 2**32 + 3 * 10**9, 2 * 2**32 + 7], np.int64)
    x, y, p = np.array([3, 300, 16000, 0, 5]), np.array([9, 200, 1999, 1, 5]), np.array([1, 0, 1, 0, 0])
    head = b"% Data file containing Event2D events.\n% Version 2\n% Height 2000\n% Width 16384\n"
    body = b"".join(
        struct.pack("<II", int(a) % 2**32, int(b) | int(c) << 14 | int(d) << 28) for a, b, c, d in zip(t, x, y, p)
    )
    (tmp_path / "e.dat").write_bytes(head + bytes([12, 8]) + body)
    with open_events(tmp_path / "e.dat") as file:
        events = file.read()
        assert (file.format, file.height, file.width, file.notes) == ("dat", 2000, 16384, [])
    assert [events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist()] == [
        x.tolist(), y.tolist(), t.tolist(), p.tolist(),
    ]  # fmt: skip
    (tmp_path / "e.dat").write_bytes(head + bytes([12, 8]) + body[:-3])
    with pytest.raises(
        AssetError, match="truncated: 5 stray bytes after the last event; expected a whole file; or --dam"
    ):
        read(tmp_path / "e.dat")
    assert len(read(tmp_path / "e.dat", damaged="keep")[0]) == 4
    old = b"".join(struct.pack("<II", a, b | c << 9 | d << 17) for a, b, c, d in ((5, 300, 200, 1), (6, 3, 4, 0)))
    (tmp_path / "old.dat").write_bytes(b"% Version 1\n" + bytes([0, 8]) + old)
    events, _ = read(tmp_path / "old.dat")
    assert [events.x.tolist(), events.y.tolist(), events.p.tolist()] == [[300, 3], [200, 4], [1, 0]]
    (tmp_path / "e.dat").write_bytes(b"no such thing at all")
    with pytest.raises(AssetError, match="not a .dat file of events"):
        read(tmp_path / "e.dat")


def test_n_mnist(tmp_path):
    """40 bits an event, as tonic and the authors' MATLAB read them; y = 240 says that 2^13 µs have passed."""
    rows, expected, passed = [(3, 4, 100, 1), (0, 240, 0, 0), (5, 6, 50, 0), (33, 33, (1 << 23) - 1, 1)], [], 0
    data = b""
    for x, y, t, p in rows:
        data += bytes([x, y, p << 7 | t >> 16, t >> 8 & 255, t & 255])
        passed += 8192 * (y == 240)
        if y != 240:
            expected.append((x, y, t + passed, p))
    (tmp_path / "1.bin").write_bytes(data)
    events, _ = read(tmp_path / "1.bin")
    assert list(zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist())) == expected


# ---------------------------------------------------------------------------------------------------------------------
# The failing inputs of the field.


@pytest.mark.parametrize(
    "name, declared, count, first, said",
    [
        ("th_no_low_after.raw", {}, 4, (10, 5, 8096, 1), 0),
        ("structarrayN.mat", {"time_unit": "us"}, 50, (163, 23, 709, 1), 0),
        ("dv_stereo.aedat4", {"stream": 0}, 1471, None, 0),
        ("dv_stereo.aedat4", {"stream": "1"}, 1529, None, 0),
        ("vid2e_ns.npz", {}, 50, (163, 23, 709, 1), 1),
        ("float_us.npz", {"time_unit": "us"}, 50, (163, 23, 709, 1), 0),
        ("savetxt_us.txt", {"columns": "t,x,y,p", "time_unit": "us"}, 50, (163, 23, 709, 1), 0),
        ("c_us.txt", {}, 50, (163, 23, 709, 1), 0),
        ("ms_frac.mat", {"time_unit": "ms"}, 50, (163, 23, 709, 1), 0),
        ("vars_and_info.mat", {"time_unit": "us"}, 50, (163, 23, 709, 1), 0),
        ("outlier_y.raw", {"damaged": "keep"}, 2, (10, 5, 100, 1), 1),
        ("overlap.aedat4", {"damaged": "keep"}, 202, None, 1),
        ("dv_trunc.aedat4", {"damaged": "keep"}, 2000, None, 1),
        ("th_back.raw", {"damaged": "keep"}, 3, (11, 5, 16434, 1), 1),
        ("v4_named.aedat", {}, 100, None, 0),
        ("v2e346.aedat", {"size": "346x260"}, 50, (163, 23, 709, 1), 0),
        ("em_y.raw", {}, 2, (10, 5, 100, 1), 1),
        ("no_packets.aedat4", {}, 0, None, 0),
        ("imu_empty.aedat4", {}, 100, None, 0),
        ("etram_outlier.h5", {"size": "346x260", "damaged": "keep", "time_unit": "us"}, 49, (163, 23, 709, 1), 1),
    ],
)
def test_files_of_the_field(name, declared, count, first, said):
    path = shared(f"field/events/{name}")
    events, lines = read(path, **declared)
    assert len(events) == count and len(lines) == said, lines
    if first:
        assert (events.x[0], events.y[0], events.t[0], events.p[0]) == first


def test_an_inertial_stream_without_samples():
    with (
        open_events(shared("field/events/imu_empty.aedat4")) as file,
        pytest.raises(AssetError, match="no samples of an"),
    ):
        file.imu()


@pytest.mark.parametrize(
    "name", ["fletcher32_1byte_sigsegv.h5", "sz3_sigsegv.h5", "sz_sigsegv.h5", "szip_block0_sigfpe.h5"]
)
def test_filters_that_would_end_the_process_are_not_run(name):
    refused = r"packed by an HDF5 filter that is not run here .*expected gzip, shuffle, Fletcher32, lzf"
    with pytest.raises(AssetError, match=f"{refused}|Unknown SZIP configuration"):  # the latter by h5py 3.12
        read(shared(f"field/attack/hdf5_filters/{name}"))


def test_a_sensor_of_gigabytes(tmp_path):
    """Said by the file, declared, or guessed from one stray event: nothing of its size is made."""
    np.savez(tmp_path / "e.npz", x=E.x, y=E.y, t_us=E.t, p=E.p, height=65535, width=65535)
    for declared in ({}, {"size": "60000x60000"}):
        with pytest.raises(AssetError, match=r"impossible sensor size .*at most 33554432 px: --size WIDTHxHEIGHT"):
            read(tmp_path / "e.npz", **declared)
    assert len(read(tmp_path / "e.npz", size="346x260")[0]) == len(E)
    (tmp_path / "e.txt").write_text("t_us x y p\n1 65535 65535 1\n")
    with open_events(tmp_path / "e.txt") as file, pytest.raises(AssetError, match="got '65536x65536'"):
        file.sized()


def test_a_small_mat_that_unpacks_to_gigabytes(tmp_path):
    zeros = {k: np.zeros(12_000_000) for k in "xytp"}
    savemat(tmp_path / "e.mat", zeros, do_compression=True)
    np.savez_compressed(tmp_path / "e.npz", **zeros)
    for name in ("e.mat", "e.npz"):
        with pytest.raises(BlinkGLError, match="unpacks to more than 100 times its size"):
            read(tmp_path / name)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_polarity_that_is_no_number_is_named(tmp_path, value):
    events = np.zeros(4, [("t", "i8"), ("x", "i4"), ("y", "i4"), ("p", "f4")])
    events["t"], events["p"] = [10, 20, 30, 40], [0, 1, value, 1]
    np.save(tmp_path / "e.npy", events)
    for rows in (slice(None), slice(2, 3)):
        np.save(tmp_path / "e.npy", events[rows])
        with pytest.raises(EventDataError, match="polarity|p of event|event"):
            open_events(tmp_path / "e.npy", EventReading.of(time_unit="us")).read()


@pytest.mark.parametrize("place", ["CD/events", "elsewhere/events"])
@pytest.mark.parametrize("geometry", [None, "file", "data"])
def test_records_of_metavision_are_in_microseconds(tmp_path, place, geometry):
    """Known by their place, or by the sensor's geometry; other records need their unit."""
    events, path = some_events(50, 0, 10**6, 480, 640), tmp_path / "e.h5"
    rows = np.zeros(len(events), [("x", "u2"), ("y", "u2"), ("p", "i2"), ("t", "i8")])
    for slot in "xypt":
        rows[slot] = getattr(events, slot)
    with h5py.File(path, "w") as file:
        data = file.create_dataset(place, data=rows)
        if geometry is not None:
            {"file": file, "data": data}[geometry].attrs["geometry"] = "640x480"
    if geometry is None and place != "CD/events":
        with pytest.raises(AssetError, match="no unit of the times"):
            open_events(path)
        return
    with open_events(path) as file:
        assert same(file.read(), events)
        assert "read as Metavision's records of events: µs" in file.notes


@pytest.mark.parametrize("unit", ["ns", np.bytes_("ns"), np.array("ns", "S4")], ids=["text", "bytes", "padded"])
def test_a_unit_of_fixed_length_counts(tmp_path, unit):
    """C, C++ and MATLAB write text so; a table of milliseconds beside the events says nothing else."""
    events = some_events(50, 0, 10**6, 260, 346)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        for slot in "xyp":
            file[f"events/{slot}"] = getattr(events, slot)
        file["events/t"], file["ms_to_idx"] = events.t * 1000, np.zeros(3, np.int64)
        file["events/t"].attrs["unit"] = unit
    with open_events(tmp_path / "e.h5") as file:
        assert same(file.read(), events)


@pytest.mark.parametrize("kind", ["sides", "flat", "row", "npz"])
def test_sizes_written_as_floats_are_sizes(tmp_path, kind):
    events, path = some_events(50, 0, 10**6, 100, 120), tmp_path / ("e.npz" if kind == "npz" else "e.h5")
    columns = {"t_us": events.t, **{slot: getattr(events, slot) for slot in "xyp"}}
    if kind == "npz":
        np.savez(path, **columns, height=260.0, width=346.0)
    else:
        with h5py.File(path, "w") as file:
            for name, column in columns.items():
                file[name] = column
            if kind == "sides":
                file["height"], file["width"] = np.array([[260.0]]), np.array([[346.0]])
            else:
                file["sensor_resolution"] = np.array([260.0, 346.0]).reshape((1, 2) if kind == "row" else 2)
    with open_events(path) as file:
        assert (file.height, file.width) == (260, 346)
        assert not any("none of t, x, y, p" in line for line in file.notes)
    if kind == "sides":
        with h5py.File(path, "a") as file:
            file["height"][...] = 260.5
        with pytest.raises(AssetError, match="'height' is no size"):
            open_events(path)


def test_whole_packets_before_a_wrong_time_are_kept(tmp_path):
    events, path = (
        Events(*(np.zeros(200_000, np.uint16),) * 2, np.arange(200_000), np.zeros(200_000, np.uint8)),
        tmp_path / "e.aedat4",
    )
    write_events(path, events, 100, 100)
    data = bytearray(path.read_bytes())
    at = data.find(struct.pack("<qhhB3x", 199_990, 0, 0, 0))
    data[at : at + 8] = struct.pack("<q", 2**63 - 1)
    path.write_bytes(data)
    kept = open_events(path, EventReading.of(damaged="keep")).read()
    assert 100_000 < len(kept) < 200_000 and np.array_equal(kept.t, np.arange(len(kept)))


def test_a_dsec_file_keeps_its_offset_of_zero(tmp_path):
    late = Events(*(np.ones(3, np.uint16),) * 2, np.array([5_000_000, 5_000_001, 5_000_002]), np.ones(3, np.uint8))
    write_events(tmp_path / "a.h5", late, 10, 10, t_offset_us=0)
    convert(tmp_path / "a.h5", tmp_path / "b.h5")
    with h5py.File(tmp_path / "b.h5") as file:
        assert file["t_offset"][()] == 0 and file["events/t"][0] == 5_000_000
