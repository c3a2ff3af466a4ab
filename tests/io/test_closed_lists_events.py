"""Every field of every event format, set to each value of its specification and to values that are in none: the events
equal what a reader written here makes of them, or one line names the field. The lists of the specifications stand here,
so a value that a reader's table forgets is found."""

from __future__ import annotations

import struct

import h5py
import numpy as np
import pytest

from blinkgl.errors import BlinkGLError
from blinkgl.io import aedat2, evt, fixed_records, hdf5, hdf5_tables, ros, tables
from blinkgl.io.formats import open_events, write_events
from blinkgl.io.reading import EventReading
from blinkgl.show.convert import looked_at
from tests.io.aedat2_files import event_addresses, header, records
from tests.io.some_events import same, some_events

E = some_events(60, 70_000, 90_000, 180, 240)
ROWS = list(zip(E.t.tolist(), E.x.tolist(), E.y.tolist(), E.p.tolist()))


def read(path, **declared):
    with open_events(path, EventReading.of(**declared)) as file:
        return file.read(), file.notes


def one_line(path, *words, **declared) -> str:
    with pytest.raises(BlinkGLError) as caught:
        read(path, **declared)
    text = str(caught.value)
    assert "\n" not in text and all(word in text for word in words), text
    return text


# ---------------------------------------------------------------------------------------------------------------------
# Prophesee's raw files. Encoders by hand, from the pages of the formats.


def evt2_words(rows=ROWS, off=0, on=1, high=8) -> bytes:
    words, last = [], None
    for t, x, y, p in rows:
        if t >> 6 != last:
            last = t >> 6
            words.append(high << 28 | last)
        words.append((on if p else off) << 28 | (t & 63) << 22 | x << 11 | y)
    return struct.pack(f"<{len(words)}I", *words)


def evt21_words(legacy: bool) -> bytes:
    words, last = [], None
    for t, x, y, p in ROWS:
        if t >> 6 != last:
            last = t >> 6
            words.append((8 << 28 | last, 0))
        words.append((p << 28 | (t & 63) << 22 | x << 11 | y, 1))
    return b"".join(struct.pack("<II", *(pair if legacy else pair[::-1])) for pair in words)


def evt3_words() -> bytes:
    words = []
    for t, x, y, p in ROWS:
        words += [0x8000 | t >> 12 & 0xFFF, 0x6000 | t & 0xFFF, y, 0x2000 | p << 11 | x]
    return struct.pack(f"<{len(words)}H", *words)


BODIES = {
    "evt2": evt2_words(), "evt21": evt21_words(False), "legacy": evt21_words(True), "evt3": evt3_words(),
    "evt4": evt2_words(off=10, on=11, high=14),
}  # fmt: skip
FORMATS_OF_OPENEB = {
    "EVT2": "evt2", "EVT21": "evt21", "EVT3": "evt3", "EVT4": "evt4", "HISTO3D": None, "DIFF3D": None, "AER-8b": None,
    "AER-4b": None, "MTR": None, "MTRU": None, "EVT": None, "evt3": None, "EVT5": None,
}  # fmt: skip
LEGACY_EVT = {"2.0": "evt2", "2.1": "evt21", "3.0": "evt3", "4.0": "evt4", "1.0": None, "2.2": None, "x": None}


@pytest.mark.parametrize(("key", "value", "kind"), [
    *(("format", value, kind) for value, kind in FORMATS_OF_OPENEB.items()),
    *(("evt", value, kind) for value, kind in LEGACY_EVT.items()),
])  # fmt: skip
def test_formats_of_raw_files(tmp_path, key, value, kind):
    path = tmp_path / "e.raw"
    path.write_bytes(f"% {key} {value}\n% end\n".encode() + BODIES[kind or "evt3"])
    if kind is None:
        one_line(path, "unknown format of events", f"got '{value}'", "EVT2, EVT21, EVT3, EVT4")
    else:
        events, notes = read(path)
        assert same(events, E) and notes == []
    assert {v for v, k in {**FORMATS_OF_OPENEB, **LEGACY_EVT}.items() if k} <= set(evt._VERSIONS)


@pytest.mark.parametrize("how", ["option", "line"])
@pytest.mark.parametrize(
    ("order", "body"), [("legacy", "legacy"), ("little", "evt21"), ("big", None), ("LEGACY", None)]
)
def test_order_of_halves(tmp_path, how, order, body):
    path = tmp_path / "e.raw"
    head = f"% format EVT21;endianness={order}\n" if how == "option" else f"% format EVT21\n% endianness {order}\n"
    path.write_bytes(f"{head}% end\n".encode() + BODIES[body or "evt21"])
    if body is None:
        one_line(path, "unknown endianness", order, "legacy, little")
    else:
        assert same(read(path)[0], E)


SYSTEMS = {
    0x15: ("evt2", 480), 0x1C: ("evt2", 480), 0x1A: ("evt2", 720), 0x17: ("evt2", 480), 0x97: ("evt2", 480),
    0x19: ("evt2", 480), 0x99: ("evt2", 480), 0x1D: ("evt2", 480), 0x23: ("evt2", 480), 0x1E: ("evt3", 720),
    0x2E: ("evt3", 720), 0x21: ("evt2", 480), 0xA1: ("evt2", 480), 0x22: ("evt2", 480), 0xA2: ("evt2", 480),
    0x29: ("evt2", 480), 0x1F: ("evt2", 720), 0x27: ("evt2", 720), 0x28: ("evt3", 480), 0x30: ("evt3", 720),
    0x32: ("evt3", 720), 0x31: ("evt3", 720),
}  # fmt: skip
"""OpenEB's table of cameras: format and height of headers that say no more."""


@pytest.mark.parametrize("system", [*SYSTEMS, 0x08, 0x14, 0x34, 0x37, 0x40, 9999])
def test_cameras_of_raw_files(tmp_path, system):
    path = tmp_path / "e.raw"
    kind, height = SYSTEMS.get(system, ("evt2", 0))
    path.write_bytes(f"% Date 2018-03-22\n% system_ID {system}\n".encode() + BODIES[kind])
    if system not in SYSTEMS:
        one_line(path, "no system_ID that says them", str(system))
        return
    with open_events(path) as file:
        assert (file.format, file.height, file.width) == (kind, height, {480: 640, 720: 1280}[height])
        assert same(file.read(), E)
    halves = BODIES["legacy" if system < 0x37 else "evt21"]
    path.write_bytes(f"% evt 2.1\n% integrator_name Prophesee\n% system_ID {system}\n% end\n".encode() + halves)
    with open_events(path) as file:
        assert file.height == height and same(file.read(), E)
    path.write_bytes(f"% evt 2.1\n% integrator_name Other\n% system_ID {system}\n% end\n".encode() + BODIES["evt21"])
    with open_events(path) as file:
        assert file.height is None and same(file.read(), E)
    assert set(SYSTEMS) == set(evt._SYSTEMS)


@pytest.mark.parametrize(
    ("head", "size", "said"),
    [
        ("% geometry 640x480\n", (480, 640), ""),
        ("% format EVT3;height=480;width=640\n", (480, 640), ""),
        ("% format EVT3;height=480;width=640\n% geometry 640x480\n", (480, 640), ""),
        ("% format EVT3;height=480;width=640\n% geometry 320x240\n", None, "geometry and format state different sizes"),
        ("% geometry 640 x 480\n", None, "unknown geometry"),
        ("% format EVT3;height=many;width=640\n", None, "unknown size in format"),
        ("% format EVT3;height=480\n", (None, None), ""),
    ],
)
def test_sizes_of_raw_files(tmp_path, head, size, said):
    path = tmp_path / "e.raw"
    path.write_bytes(f"% evt 3.0\n{head}% end\n".encode() + BODIES["evt3"])
    if said:
        one_line(path, said)
    else:
        with open_events(path) as file:
            assert (file.height, file.width) == size and same(file.read(), E)


EVT2_TYPES = {0: "event", 1: "event", 8: "time", 10: "trigger", 14: "skipped", 15: "skipped"}
EVT4_TYPES = {6: "skipped", 7: "skipped", 9: "trigger", 10: "event", 11: "event", 12: "vector", 13: "vector",
              14: "time", 15: "skipped"}  # fmt: skip
EVT3_TYPES = {0: "y", 1: "other", 2: "event", 3: "base", 4: "vector", 5: "vector", 6: "low", 7: "skipped", 8: "time",
              10: "trigger", 14: "skipped", 15: "skipped"}  # fmt: skip


@pytest.mark.parametrize("kind", range(16))
@pytest.mark.parametrize(("version", "types"), [("evt2", EVT2_TYPES), ("evt4", EVT4_TYPES)])
def test_words_of_evt2_and_evt4(tmp_path, version, types, kind):
    """A word of each type between two events; the events around it stay, and what it is is read or said."""
    path, high, on = tmp_path / "e.raw", 8 if version == "evt2" else 14, 1 if version == "evt2" else 11
    time, first = high << 28 | 1, on << 28 | 3 << 22 | 7 << 11 | 9
    word = kind << 28 | 4 << 22 | 2 << 11 | 5 if kind != high else time
    more = [0b101] if types.get(kind) == "vector" else []
    words = [time, first, word, *more, on << 28 | 9 << 22 | 8 << 11 | 9]
    path.write_bytes(f"% format {version.upper()}\n% end\n".encode() + struct.pack(f"<{len(words)}I", *words))
    what = types.get(kind)
    if what is None:
        one_line(path, f"no valid {version.upper()} word", "--damaged keep")
        assert read(path, damaged="keep")[0].x.tolist() == [7, 8]
        return
    events, notes = read(path)
    middle = {"event": [(68, 2, 5)], "vector": [(68, 2, 5), (68, 4, 5)]}.get(what, [])
    found = list(zip(events.t.tolist(), events.x.tolist(), events.y.tolist()))
    assert found == [(67, 7, 9), *middle, (73, 8, 9)]
    assert bool(notes) == (what == "trigger") and ("triggers" in "".join(notes)) == (what == "trigger")


@pytest.mark.parametrize("kind", range(16))
def test_words_of_evt3(tmp_path, kind):
    path, what = tmp_path / "e.raw", EVT3_TYPES.get(kind)
    payload = {"y": 9, "other": 9, "time": 1, "low": 5, "base": 0x805, "vector": 0b11, "trigger": 0x301}.get(
        what, 0x805
    )
    words = [0x8001, 0x6004, 9, 0x2007, 0x3000 | 20, kind << 12 | payload, 0x2008]
    path.write_bytes(b"% evt 3.0\n% end\n" + struct.pack(f"<{len(words)}H", *words))
    if what is None:
        one_line(path, "no valid EVT3 word", "--damaged keep")
        assert read(path, damaged="keep")[0].x.tolist() == [7, 8]
        return
    with open_events(path) as file:
        events, notes, triggers = file.read(), file.notes, file.triggers.tolist()
    middle = {"event": [5], "vector": [20, 21]}.get(what, [])
    assert events.x.tolist() == [7, *middle, *([] if what == "other" else [8])]
    assert events.t.tolist()[-1] == 4096 + (5 if what == "low" else 4)
    assert triggers == ([[4100, 3, 1]] if what == "trigger" else []) and bool(notes) == (what in ("trigger", "other"))


def test_padding_of_lucid_is_one_word_and_no_other(tmp_path):
    path = tmp_path / "e.raw"
    for word, fine in ((0x9999, True), (0x9998, False)):
        path.write_bytes(b"% evt 3.0\n% end\n" + struct.pack("<HHHHH", 0x8001, 9, word, 0x2007, word))
        if fine:
            assert read(path)[0].x.tolist() == [7] and read(path)[1] == []
        else:
            one_line(path, "no valid EVT3 word", "0x9998")


# ---------------------------------------------------------------------------------------------------------------------
# .dat, .es, AEDAT 2.


def dat(version: str | None, kind: int = 12, size: int = 8, p_bits: int | None = None) -> bytes:
    short = version == "1"
    head = b"% Data file\n% Height 180\n% Width 240\n" + (b"" if version is None else f"% Version {version}\n".encode())
    body = b"".join(
        struct.pack(
            "<II", t, x | y << (9 if short else 14) | (p if p_bits is None else p_bits) << (17 if short else 28)
        )
        for t, x, y, p in ROWS
    )
    return head + bytes([kind, size]) + body


@pytest.mark.parametrize("version", [None, "1", "2", "0", "3", "20", "two"])
def test_versions_of_dat(tmp_path, version):
    (tmp_path / "e.dat").write_bytes(dat(version))
    if version in (None, "1", "2"):
        with open_events(tmp_path / "e.dat") as file:
            assert (file.height, file.width) == (180, 240) and same(file.read(), E)
    else:
        one_line(tmp_path / "e.dat", "unknown Version of .dat", version)
    assert set(fixed_records._VERSIONS) == {"", "1", "2"}


@pytest.mark.parametrize(("kind", "size"), [(k, 8) for k in range(32)] + [(12, 4), (12, 16), (0, 8)])
def test_types_of_dat(tmp_path, kind, size):
    (tmp_path / "e.dat").write_bytes(dat("2", kind, size))
    if kind in (0, 12) and size == 8:
        assert same(read(tmp_path / "e.dat")[0], E)
    else:
        one_line(tmp_path / "e.dat", "not a .dat file of events", f"type {kind}, {size} bytes an event")


@pytest.mark.parametrize("bits", range(16))
def test_polarities_of_dat(tmp_path, bits):
    (tmp_path / "e.dat").write_bytes(dat("2", p_bits=bits))
    if bits < 2:
        assert set(read(tmp_path / "e.dat")[0].p.tolist()) == {bits}
    else:
        assert "--damaged" not in one_line(tmp_path / "e.dat", "polarity of event 0", f"got {bits}")


@pytest.mark.parametrize("line", ["% Height x", "% Width -3", "% Height 1000000"])
def test_sizes_of_dat(tmp_path, line):
    (tmp_path / "e.dat").write_bytes(dat("2").replace(b"% Height 180", line.encode()).replace(b"% Width 240\n", b""))
    one_line(tmp_path / "e.dat", "in the header is no number")


@pytest.mark.parametrize("version", range(4))
@pytest.mark.parametrize("kind", range(5))
def test_kinds_of_event_stream(tmp_path, version, kind):
    body = b"".join(struct.pack("<BHH", (20 if k else 0) << 1 | p, x, y) for k, (_, x, y, p) in enumerate(ROWS))
    (tmp_path / "e.es").write_bytes(
        b"Event Stream" + bytes([version, 0, 0, kind]) + struct.pack("<HH", 240, 180) + body
    )
    if (version, kind) == (2, 1):
        events, _ = read(tmp_path / "e.es", origin="top")
        assert events.x.tolist() == E.x.tolist() and events.y.tolist() == E.y.tolist()
        assert events.t.tolist() == [20 * k for k in range(len(E))]
    else:
        one_line(tmp_path / "e.es", f"version {version}, type {kind}")


CHIPS = {"DAVIS128": (128, 128), "DAVIS208": (192, 208), "DAVIS240A": (180, 240), "DAVIS240C": (180, 240),
         "Davis346B": (260, 346), "Davis346blue": (260, 346), "DAVIS640": (480, 640), "DVS128": (128, 128),
         "Tmpdiff128": (128, 128)}  # fmt: skip
OTHER_CHIPS = ("DVS132S", "CochleaAMS1c", "ATIS304", "DAVIS3460", "DVS1280", "SecDvs640Gen2", "cDVSTest30")


@pytest.mark.parametrize("chip", [*CHIPS, *OTHER_CHIPS])
def test_chips_of_aedat2(tmp_path, chip):
    path, single = tmp_path / "e.aedat", chip in ("DVS128", "Tmpdiff128")
    events = E.part((E.x < 128) & (E.y < 128))
    height, width = CHIPS.get(chip, (260, 346))
    address = events_of_a_dvs128(events) if single else event_addresses(events, height, width)
    path.write_bytes(header(f"ch.unizh.ini.jaer.chip.retina.{chip}") + records(address, events.t))
    if chip not in CHIPS:
        one_line(path, "a camera with unknown addresses", chip)
        return
    with open_events(path) as file:
        assert (file.height, file.width) == (height, width) and same(file.read(), events)
    assert {chip.upper()[:8] for chip in CHIPS} == {known.upper()[:8] for known in aedat2.SIZES}


def events_of_a_dvs128(events):
    return [(127 - x) << 1 | y << 8 | 1 - p for x, y, p in zip(events.x.tolist(), events.y.tolist(), events.p.tolist())]


def test_addresses_of_no_named_chip(tmp_path):
    """Only a DVS128 explains them, only a DAVIS of a declared size, or neither does."""
    path, events = tmp_path / "e.aedat", E.part((E.x < 128) & (E.y < 128))
    path.write_bytes(header(None) + records(events_of_a_dvs128(events), events.t))
    found, notes = read(path)
    assert same(found, events) and "a DVS128's" in notes[0]
    for size in ("346x260", "240x180"):
        one_line(path, "addresses that no DAVIS has", size=size)
    path.write_bytes(header(None) + records(event_addresses(E), E.t))
    assert "--size WIDTHxHEIGHT" in one_line(path, "no camera named in the header")
    assert same(read(path, size="240x180")[0], E)
    path.write_bytes(header(None) + records(np.array(event_addresses(E)) | 3, E.t))
    one_line(path, "addresses that no DAVIS has", "0x3")


# ---------------------------------------------------------------------------------------------------------------------
# Tables: names, units, sizes, filters; bags.

NAMES = {
    "t": "t ts time times timestamp timestamps stamp stamps t_us ts_us timestamp[us]",
    "x": "x xs col cols column x[px] event_x",
    "y": "y ys row rows y_px",
    "p": "p ps pol pols polarity polarities on",
}
NOT_NAMES = ["z", "tx", "xy", "q", "u", "v", "sign", "t_offset", "id", "index"]


@pytest.mark.parametrize(("slot", "name"), [(s, n) for s, names in NAMES.items() for n in names.split()])
def test_names_of_columns(tmp_path, slot, name):
    names = {s: s for s in "txyp"} | {slot: name}
    np.savez(tmp_path / "e.npz", **{names[s]: getattr(E, s) for s in "txyp"})
    stated = "us" in name
    events, notes = read(tmp_path / "e.npz", time_unit=None if stated else "us")
    assert same(events, E) and notes == []
    listed = {w for words in tables._NAMES.values() for w in words.split()}
    assert listed <= {w for words in NAMES.values() for w in words.split()}, "a name that this test does not have"


@pytest.mark.parametrize("name", NOT_NAMES)
def test_names_that_are_no_columns(tmp_path, name):
    np.savez(tmp_path / "e.npz", **{name if s == "x" else s: getattr(E, s) for s in "txyp"})
    one_line(tmp_path / "e.npz", "no columns of events", "--columns x=NAME", time_unit="us")
    assert same(read(tmp_path / "e.npz", time_unit="us", columns=f"x={name}")[0], E)


@pytest.mark.parametrize(
    "unit", ["s", "ms", "us", "ns", "µs", "usec", "seconds", "min", "ticks", "frames", "", "hours"]
)
@pytest.mark.parametrize("where", ["time_unit", "heading", "attribute"])
def test_units_of_times(tmp_path, unit, where):
    scale = {"s": 1e-6, "ms": 1e-3, "us": 1, "ns": 1e3, "µs": 1, "usec": 1, "seconds": 1e-6}.get(unit)
    columns = {"x": E.x, "y": E.y, "t": E.t * (scale or 1.0), "p": E.p}
    if where == "time_unit":
        path = tmp_path / "e.npz"
        np.savez(path, **columns, time_unit=unit)
    elif where == "heading":
        path = tmp_path / "e.csv"
        t = columns["t"].tolist()
        rows = "".join(f"{time!r},{x},{y},{p}\n" for time, (_, x, y, p) in zip(t, ROWS))
        path.write_text(f"t[{unit}],x,y,p\n{rows}")
    else:
        path = tmp_path / "e.h5"
        with h5py.File(path, "w") as file:
            for k, v in columns.items():
                file[f"events/{k}"] = v
            file["events/t"].attrs["units"] = unit
    if scale is None:
        one_line(path, "no unit of the times", "--time-unit")
    else:
        assert same(read(path)[0], E)


@pytest.mark.parametrize(
    ("put", "size"),
    [
        (lambda f: f.attrs.update(height=180, width=240), (180, 240)),
        (lambda f: f["events"].attrs.update(height=180, width=240), (180, 240)),
        (
            lambda f: (f.create_dataset("events/height", data=180), f.create_dataset("events/width", data=240)),
            (180, 240),
        ),
        (lambda f: f.attrs.update(sensor_resolution=[180, 240]), (180, 240)),
        (lambda f: f.attrs.update(geometry="240x180"), (180, 240)),
        (lambda f: f["events"].attrs.update(geometry=b"240x180"), (180, 240)),
        (lambda f: f.create_dataset("events/calib/resolution", data=[240, 180]), (180, 240)),
        (lambda f: f.attrs.update(sensor_resolution=[180, 240, 3]), "'sensor_resolution' is no size"),
        (lambda f: f.attrs.update(geometry="big"), "'geometry' is no size"),
        (lambda f: f.attrs.update(height="many", width=3), "'height' is no number"),
        (lambda f: None, (None, None)),
    ],
)
def test_sizes_in_hdf5(tmp_path, put, size):
    path = tmp_path / "e.h5"
    with h5py.File(path, "w") as file:
        for k in "xytp":
            file[f"events/{k}"] = getattr(E, k)
        put(file)
    if isinstance(size, str):
        one_line(path, size, time_unit="us")
    else:
        with open_events(path, EventReading("us", columns=None)) as file:
            assert (file.height, file.width) == size
    assert set(hdf5_tables._SIZES) == {"sensor_resolution", "geometry", "resolution"}


@pytest.mark.parametrize(
    "options",
    [
        {}, {"compression": "gzip"}, {"compression": "gzip", "shuffle": True}, {"compression": "lzf"}, {"fletcher32":
        True}, {"compression": "gzip", "fletcher32": True}, {"compression": "szip"}, {"scaleoffset": 0},
    ],
)  # fmt: skip
def test_filters_of_hdf5(tmp_path, options):
    path = tmp_path / "e.h5"
    if options.get("compression") == "szip" and not h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
        pytest.skip("this HDF5 has no szip")
    with h5py.File(path, "w") as file:
        for k in "xytp":
            file.create_dataset(f"events/{k}", data=getattr(E, k), chunks=(16,), **options)
        file["events/t"].attrs["unit"] = "us"
    if "szip" in options.values() or "scaleoffset" in options:
        one_line(path, "packed by an HDF5 filter that is not run here", "gzip")
    else:
        assert same(read(path)[0], E)
    assert set(hdf5._FILTERS.values()) == {"gzip", "shuffle", "Fletcher32", "lzf", "Blosc", "LZ4", "zstd"}


ENCODINGS = {"evt3": BODIES["evt3"], "evt21": BODIES["evt21"], "mono": None, "evt2": b"", "libcaer": b"",
             "libcaer_cmp": b"", "trigger": b"", "": b""}  # fmt: skip
"""Of event_camera_codecs' packets, and some that are none."""


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_encodings_of_packets(tmp_path, encoding):
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    from rosbags import rosbag1

    data = ENCODINGS[encoding]
    if encoding == "mono":
        data = b"".join(struct.pack("<Q", t * 1000 | x << 32 | y << 48 | p << 63) for t, x, y, p in ROWS)
    store, name = ros.typestore(False), "event_camera_msgs/msg/EventPacket"
    with rosbag1.Writer(tmp_path / "e.bag") as writer:
        connection = writer.add_connection("/events", name, typestore=store)
        stamp = store.types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
        message = store.types[name](
            header=store.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=""), height=180, width=240, seq=0,
            time_base=0, encoding=encoding, is_bigendian=False, events=np.frombuffer(data or b"\1\2", np.uint8),
        )  # fmt: skip
        writer.write(connection, 0, store.serialize_ros1(message, name))
    if data:
        assert same(read(tmp_path / "e.bag")[0], E)
    else:
        for declared in ({}, {"damaged": "keep"}):
            text = one_line(tmp_path / "e.bag", "unknown encoding of events", encoding, **declared)
            assert "--damaged" not in text
    assert set(ros._ENCODINGS) == {"evt3", "evt21", "mono"}


def test_a_packet_of_an_odd_length_is_one_line(tmp_path):
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    from rosbags import rosbag1

    store, name = ros.typestore(False), "event_camera_msgs/msg/EventPacket"
    with rosbag1.Writer(tmp_path / "e.bag") as writer:
        connection = writer.add_connection("/events", name, typestore=store)
        for k, data in enumerate((BODIES["evt3"], b"\1\2\3")):
            stamp = store.types["builtin_interfaces/msg/Time"](sec=k, nanosec=0)
            message = store.types[name](
                header=store.types["std_msgs/msg/Header"](seq=0, stamp=stamp, frame_id=""), height=180, width=240,
                seq=k, time_base=0, encoding="evt3", is_bigendian=False, events=np.frombuffer(data, np.uint8),
            )  # fmt: skip
            writer.write(connection, k, store.serialize_ros1(message, name))
    one_line(tmp_path / "e.bag", "packet 1 is cut (got '3 bytes')", "a multiple of 2; or --damaged keep")
    events, notes = read(tmp_path / "e.bag", damaged="keep")
    assert same(events, E) and "kept: events before the damage: 60" in notes[0]


# ---------------------------------------------------------------------------------------------------------------------
# Outputs, read back by readers that are not ours.


@pytest.mark.parametrize("ending", ["H5", "Raw", "TXT", "Csv", "NPZ", "NPY", "AEDAT4", "HDF5"])
def test_endings_are_read_without_regard_to_case(tmp_path, ending):
    path = tmp_path / f"out.{ending}"
    write_events(path, E, 180, 240)
    assert same(open_events(path).read(), E)
    begin = {"H5": b"\x89HDF", "HDF5": b"\x89HDF", "NPZ": b"PK", "NPY": b"\x93NUMPY", "AEDAT4": b"#!AER-DAT4.0"}
    assert path.read_bytes().startswith(begin.get(ending, b""))


def test_every_output_is_read_by_another(tmp_path):
    for name in ("e.npz", "e.npy", "e.txt", "e.csv", "e.h5", "e.raw", "e.aedat4"):
        write_events(tmp_path / name, E, 180, 240)
    with np.load(tmp_path / "e.npz") as file:
        assert all(np.array_equal(file[k], getattr(E, k)) for k in "xytp") and file["time_unit"] == "us"
    table = np.load(tmp_path / "e.npy")
    assert all(np.array_equal(table[k], getattr(E, k)) for k in "xytp")
    for name, rows in (("e.txt", 0), ("e.csv", 1)):
        lines = (tmp_path / name).read_text().splitlines()[rows:]
        found = [line.replace(",", " ").split() for line in lines]
        assert [(round(float(t) * 1e6), int(x), int(y), int(p)) for t, x, y, p in found] == ROWS
    hdf5plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "e.h5") as file:
        assert hdf5plugin and file["events/t"][:].tolist() == (E.t - file["t_offset"][()]).tolist()
    aedat = pytest.importorskip("aedat")
    packets = [p["events"] for p in aedat.Decoder(str(tmp_path / "e.aedat4"))]
    assert np.concatenate(packets)["t"].tolist() == E.t.tolist()
    words = np.frombuffer((tmp_path / "e.raw").read_bytes().partition(b"% end\n")[2], "<u2")
    high = low = y = 0
    found = []
    for word in words.tolist():
        kind, value = word >> 12, word & 0xFFF
        high, low, y = (value if kind == 8 else high, value if kind == 6 else low, value if kind == 0 else y)
        if kind == 2:
            found.append((high << 12 | low, value & 0x7FF, y, value >> 11))
    assert found == ROWS


@pytest.mark.parametrize("t", [-5, -5_000_000, 2**62 - 1])
@pytest.mark.parametrize("name", ["e.h5", "e.raw", "e.aedat4", "e.txt", "e.csv", "e.npz", "e.npy"])
def test_times_that_a_format_does_not_hold(tmp_path, name, t):
    """Written and read back, or one line; nothing is left half-written."""
    events = E.part(slice(1)).copy()
    events.t[:] = t
    try:
        write_events(tmp_path / name, events, 180, 240)
    except BlinkGLError as error:
        assert "\n" not in str(error) and not list(tmp_path.iterdir())
    else:
        assert open_events(tmp_path / name).read().t.tolist() == [t]


@pytest.mark.parametrize("count", [0, 1, 65_536, 65_537, 140_000])
def test_aedat4_of_any_length(tmp_path, count):
    """By the package aedat and by dv-processing, which refuses a file without a sound table of its packets."""
    events = some_events(count, 1, 10**7, 480, 640)
    write_events(tmp_path / "e.aedat4", events, 480, 640)
    assert same(open_events(tmp_path / "e.aedat4").read(), events)
    dv = pytest.importorskip("dv_processing", reason="optional extra [formats]")
    recording, parts = dv.io.MonoCameraRecording(str(tmp_path / "e.aedat4")), []
    while (batch := recording.getNextEventBatch()) is not None:
        parts.append(batch.numpy())
    assert sum(map(len, parts)) == count
    if count:
        whole = np.concatenate(parts)
        for ours, theirs in (("t", "timestamp"), ("x", "x"), ("y", "y"), ("p", "polarity")):
            assert np.array_equal(whole[theirs], getattr(events, ours))


# ---------------------------------------------------------------------------------------------------------------------
# EVIMO2v2: three arrays in one folder.


def evimo2(folder, rows=ROWS, **instead):
    """Write them; ``instead`` : another array, or None to leave it out."""
    t, x, y, p = np.array(rows, np.int64).reshape(-1, 4).T
    arrays = {"t": t / 1e6, "xy": np.stack([x, y], 1).astype(np.uint16), "p": p.astype(np.uint8)} | instead
    folder.mkdir()
    for name, array in arrays.items():
        if array is not None:
            np.save(folder / f"dataset_events_{name}.npy", array)
    return folder


@pytest.mark.parametrize("named", ["", "dataset_events_t.npy", "dataset_events_xy.npy", "dataset_events_p.npy"])
def test_the_three_arrays_of_evimo2_are_one_recording(tmp_path, named):
    events, notes = read(evimo2(tmp_path / "seq") / named)
    assert list(zip(events.t.tolist(), events.x.tolist(), events.y.tolist(), events.p.tolist())) == ROWS
    assert notes == ["read as EVIMO2's three arrays: seconds"]


def test_evimo2_is_read_from_disk_piece_by_piece(tmp_path):
    """Thirteen gigabytes that are holes on the disk."""
    folder, n = evimo2(tmp_path / "seq"), 1_000_000_000
    for name, shape, kind in (("t", (n,), "f8"), ("xy", (n, 2), "u2"), ("p", (n,), "u1")):
        np.lib.format.open_memmap(folder / f"dataset_events_{name}.npy", "w+", kind, shape)
    with open_events(folder) as file:
        first = next(file.chunks())
    assert 0 < len(first) < 10_000_000 and not first.t.any()


@pytest.mark.parametrize("missing", ["t", "xy", "p"])
def test_evimo2_without_one_of_the_three(tmp_path, missing):
    folder = evimo2(tmp_path / "seq", **{missing: None})
    for path in (folder, folder / "dataset_events_xy.npy", folder / "dataset_events_p.npy"):
        one_line(path, f"dataset_events_{missing}.npy: no such file", "in one folder")


@pytest.mark.parametrize(
    ("array", "value", "words"),
    [
        ("xy", np.zeros((60, 3), np.uint16), ("dataset_events_xy.npy", "no rows of x and y", "(60, 3)")),
        ("xy", np.zeros(60, np.uint16), ("dataset_events_xy.npy", "no rows of x and y")),
        ("p", np.zeros(59, np.uint8), ("event columns differ in length", "59")),
        ("p", np.full(60, 7, np.uint8), ("polarity", "7")),
        ("t", np.arange(60), ("no unit of the times", "--time-unit")),
        ("p", np.array([{}] * 60), ("dataset_events_p.npy", "Python objects")),
    ],
)
def test_evimo2_in_another_form(tmp_path, array, value, words):
    one_line(evimo2(tmp_path / "seq", **{array: value}), *words)


def test_evimo2_with_a_unit_with_one_event_and_with_none(tmp_path):
    t = np.array([row[0] for row in ROWS])
    assert read(evimo2(tmp_path / "us", t=t), time_unit="us")[0].t.tolist() == t.tolist()
    assert len(read(evimo2(tmp_path / "one", ROWS[:1]))[0]) == 1
    assert len(read(evimo2(tmp_path / "none", []))[0]) == 0


def test_a_look_at_evimo2(tmp_path):
    lines = list(looked_at(evimo2(tmp_path / "seq")))
    assert lines[0].endswith("seq: a folder") and lines[1].startswith("format evimo2; size not stated")
    assert list(looked_at(tmp_path / "none"))[0].endswith("none: no file")
