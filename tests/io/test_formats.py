"""Event formats: write → read, independent libraries, real recordings, bad input."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.formats import FORMATS, EventFormat, convert, ending_of, open_events, write_events
from blinkgl.io.reading import EventReading
from blinkgl.types.events import Events
from tests.io.some_events import same, some_events
from tests.shared_data import shared

H, W = 480, 640
FILES = {
    "dsec": "e.h5",
    "evt3": "e.raw",
    "text": "e.txt",
    "csv": "e.csv",
    "npz": "e.npz",
    "npy": "e.npy",
}


def random_events(n=20_000, duration_us=40_000_000, t0=0, seed=0, height=H, width=W) -> Events:
    """Bursts, equal times and gaps longer than EVT3's 16.8 s counter."""
    rng = np.random.default_rng(seed)
    t = np.sort(
        np.concatenate(
            [rng.integers(0, 50_000, n // 2), rng.integers(0, 2_000_000, n - n // 2 - 3), [duration_us - 2] * 3]
        )
    )
    return Events(
        rng.integers(0, width, n).astype(np.uint16),
        rng.integers(0, height, n).astype(np.uint16),
        t + t0,
        rng.integers(0, 2, n).astype(np.uint8),
    )


def pieces(events: Events, seed=0):
    rng, i = np.random.default_rng(seed), 0
    while i < len(events):
        n = int(rng.choice([1, 10, 5000]))
        yield Events(*(getattr(events, k)[i : i + n] for k in "xytp"))
        i += n


@pytest.mark.parametrize("kind", FILES)
def test_write_then_read_is_exact(tmp_path, kind):
    events = random_events()
    path = tmp_path / FILES[kind]
    assert write_events(path, pieces(events), H, W) == len(events)
    file = open_events(path)
    assert file.format == ("text" if kind == "text" else kind)
    assert (file.height, file.width) == ((None, None) if kind in ("text", "csv", "npy") else (H, W))
    assert same(file.read(), events)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_faery_reads_what_we_write(tmp_path):
    faery = pytest.importorskip("faery", reason="optional extra [formats]")
    events = random_events()
    write_events(tmp_path / "e.raw", pieces(events), H, W)
    stream = faery.events_stream_from_file(tmp_path / "e.raw")
    assert stream.dimensions() == (W, H)
    a = stream.to_array()
    assert same(Events(a["x"], a["y"], a["t"].astype(np.int64), a["on"].astype(np.uint8)), events)


@pytest.mark.parametrize("version", ["evt2", "evt3"])
def test_we_read_what_faery_writes(tmp_path, version):
    faery = pytest.importorskip("faery", reason="optional extra [formats]")
    events = random_events(duration_us=15_000_000)  # within one turn of EVT3's counter, which faery does not fill
    a = np.empty(len(events), faery.EVENTS_DTYPE)
    a["t"], a["x"], a["y"], a["on"] = events.t, events.x, events.y, events.p
    faery.events_stream_from_array(a, (W, H)).to_file(tmp_path / "e.raw", zero_t0=False, version=version)
    file = open_events(tmp_path / "e.raw")
    assert file.format == version and same(file.read(), events)


@pytest.mark.parametrize(
    "name, kind, size, count",
    [
        ("prophesee/faery_evt2_gen3vga.raw", "evt2", (480, 640), 521_252),
        ("prophesee/expelliarmus_evt3_gen41hd.raw", "evt3", (720, 1280), 219_596),
        ("aedat4/davis346_events_frames_imu.aedat4", "aedat4", (260, 346), 6_676),
        ("slider_depth/events_chunk.txt", "text", (180, 240), 50_000),
        ("ecd_rotation/boxes_rotation/events.txt", "text", (180, 240), 30_000),
    ],
)
def test_real_recordings(tmp_path, name, kind, size, count):
    path = shared(f"data/events/{name}")
    file = open_events(path).sized()
    assert (file.format, file.height, file.width) == (kind, *size)
    events = file.read()
    assert len(events) == count
    if kind == "text":
        table = np.loadtxt(path)
        assert np.array_equal(events.t, np.rint(table[:, 0] * 1e6)) and np.array_equal(events.p, table[:, 3])
    else:
        faery = pytest.importorskip("faery", reason="optional extra [formats]")
        a = faery.events_stream_from_file(path).to_array()
        assert all(np.array_equal(a[k], getattr(events, ours)) for k, ours in (("x", "x"), ("y", "y"), ("on", "p")))
        # The EVT3 recording has TIME_LOW words up to 11 µs ahead that the next word takes back before any event; faery
        # keeps them.
        assert np.abs(a["t"].astype(np.int64) - events.t).max() <= (11 if kind == "evt3" else 0)
    source, written = convert(path, tmp_path / "e.h5")
    assert written == count and (source.height, source.width) in (size, (None, None))
    with open_events(tmp_path / "e.h5") as back:  # a size that the source lacks is not made up
        assert (back.height, back.width) == (source.height, source.width) and same(back.read(), events)


def test_event_stream(tmp_path):
    """Gaps longer than a byte holds, padding, and events that lie across two reads."""
    e = some_events(500, 0, 60_000, 180, 240)
    data, last = bytearray(b"Event Stream" + bytes([2, 0, 0, 1]) + (240).to_bytes(2, "little") + bytes([180, 0])), 0
    for x, y, t, p in zip(e.x.tolist(), e.y.tolist(), e.t.tolist(), e.p.tolist(), strict=True):
        gap, last = t - last, t
        data += b"\xff" * (gap // 127) + b"\xfe" + bytes([gap % 127 << 1 | p])
        data += x.to_bytes(2, "little") + (179 - y).to_bytes(2, "little")  # y counts from the bottom
    (tmp_path / "e.es").write_bytes(data)
    with open_events(tmp_path / "e.es") as file:
        assert (file.height, file.width) == (180, 240) and same(file.read(), e)
        upside_down = replace(e, y=179 - e.y)
        assert same(Events.concatenate(list(file._reader.chunks(7))), upside_down)
    with open_events(tmp_path / "e.es", EventReading(origin="top")) as file:
        assert same(file.read(), upside_down)
    (tmp_path / "e.es").write_bytes(data[:-1])
    with pytest.raises(AssetError, match="the last event is not whole"):
        open_events(tmp_path / "e.es").read()
    (tmp_path / "e.es").write_bytes(bytes(data).replace(bytes([2, 0, 0, 1]), bytes([2, 0, 0, 2]), 1))
    with pytest.raises(AssetError, match=r"version 2, type 2.*expected version 2, type 1 \(DVS\)"):
        open_events(tmp_path / "e.es")


def test_matlab(tmp_path):
    """A recording's variables; MATLAB's doubles, as µs and as s; a struct; what is no such file."""
    real = open_events(shared("data/events/evbench_davis240/seq_0001_e.mat")).read()
    assert len(real) == 132_784 and int(real.t[0]) == 274_260_989 and real.x.max() == 189
    e = some_events(50, 0, 60_000, 180, 240)
    columns = {"x": e.x * 1.0, "y": e.y * 1.0, "p": e.p * 2.0 - 1}
    for k, (t, unit, wrap) in enumerate(((e.t * 1.0, "us", False), (e.t * 1e-6, "s", False), (e.t * 1.0, "us", True))):
        table = {**columns, "ts": t}
        savemat(tmp_path / f"{k}.mat", {"TD": table} if wrap else {n: v[:, None] for n, v in table.items()})
        with pytest.raises(AssetError, match=f"no unit of the times 'ts' is stated; try --time-unit {unit} if"):
            open_events(tmp_path / f"{k}.mat")
        assert same(open_events(tmp_path / f"{k}.mat", EventReading(time_unit=unit)).read(), e)
    whole = (tmp_path / "0.mat").read_bytes()
    for size in range(129, len(whole) - 100, 97):
        (tmp_path / "cut.mat").write_bytes(whole[:size])
        with pytest.raises(AssetError, match="damaged .mat|no columns|no unit"):
            open_events(tmp_path / "cut.mat")


def test_blinkflow_and_mvsec(tmp_path):
    events = random_events(5000, duration_us=3_000_000)
    with h5py.File(tmp_path / "blinkflow.h5", "w") as file:  # u8 times, no t_offset, table without the final ms
        for k, dtype in (("x", "u2"), ("y", "u2"), ("t", "u8"), ("p", "u1")):
            file.create_dataset(f"events/{k}", data=getattr(events, k).astype(dtype), compression="gzip")
        file["ms_to_idx"] = np.searchsorted(events.t, np.arange(0, events.t[-1] // 1000) * 1000).astype(np.uint64)
    assert same(open_events(tmp_path / "blinkflow.h5").read(), events)
    from blinkgl.io.dsec import DsecEventReader

    with DsecEventReader(tmp_path / "blinkflow.h5") as reader:
        assert same(reader.slice(1_000_000, 3_000_000), events.window(1_000_000, 3_000_000))
        assert same(reader.slice(2_999_500, 3_000_000), events.window(2_999_500, 3_000_000))
    events = random_events(5000, 3_000_000, t0=1_506_117_887_000_000, height=260, width=346)
    with h5py.File(tmp_path / "mvsec.hdf5", "w") as file:
        file["davis/left/events"] = np.stack([events.x, events.y, events.t / 1e6, events.p * 2.0 - 1], axis=1)
    file = open_events(tmp_path / "mvsec.hdf5")
    assert (file.format, file.height, file.width) == ("mvsec", 260, 346) and same(file.read(), events)
    convert(tmp_path / "mvsec.hdf5", tmp_path / "dsec.h5")
    with h5py.File(tmp_path / "dsec.h5") as dsec:
        assert dsec["t_offset"][()] == events.t[0] // 10**6 * 10**6
    assert same(open_events(tmp_path / "dsec.h5").read(), events)


def _bad(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    return tmp_path / name


@pytest.mark.parametrize(
    "name, data, message",
    [
        ("e.raw", b"\x00\x01" * 100, "neither '% evt' nor"),
        ("e.raw", b"% evt 2.2\n% end\n", "unknown format of events"),
        ("e.raw", b"% format EVT22;width=1\n% end\n", "unknown format of events"),
        ("e.raw", b"% evt 5.0\n% end\n", "unknown format of events"),
        ("e.raw", b"% evt 2.0\n% end\n" + b"\0" * 7, "truncated: 3 stray bytes"),
        ("e.h5", b"\x89HDF", "not an HDF5"),
        ("e.npz", b"PK\x03\x04garbage", "cannot read"),
        ("e.npy", b"\x93NUMPY", "cannot read"),
        ("e.xyz", b"", "unknown event file ending"),
    ],
)
def test_damaged_files(tmp_path, name, data, message):
    with pytest.raises(AssetError, match=message) as caught:
        open_events(_bad(tmp_path, name, data)).read()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["e.h5", "e.raw", "e.txt", "e.npy", "e.npz", "f.npy", "f.npz"])
def test_random_damage_never_ends_in_a_traceback(tmp_path, name):
    """Flipped and missing bytes either go unnoticed (a flipped coordinate is one) or give one line."""
    from blinkgl.io.frames import open_frames
    from blinkgl.io.reading import Declared

    path, rng, errors = tmp_path / name, np.random.default_rng(0), 0
    if name.startswith("e"):
        write_events(path, random_events(1000), H, W)
    elif name == "f.npy":
        np.save(path, rng.random((3, 8, 8)))
    else:
        np.savez_compressed(path, frames=rng.random((3, 8, 8)), t=[0, 1, 2])
    whole = path.read_bytes()
    for k in range(60):
        data = bytearray(whole)
        if k % 3 == 0:
            data = data[: rng.integers(0, len(data))]
        else:
            data[int(rng.integers(0, len(data) if k % 3 == 1 else min(300, len(data))))] ^= int(rng.integers(1, 256))
        path.write_bytes(data)
        try:
            open_events(path).sized().read() if name.startswith("e") else list(
                open_frames(path, Declared(fps=None if name == "f.npz" else 10))
            )
        except BlinkGLError as error:
            errors += 1
            assert "\n" not in str(error)
    assert errors >= (5 if name == "e.raw" else 10)  # how many depends on where a library puts its bytes


@pytest.mark.parametrize(
    "array, message",
    [
        (np.zeros((5, 3)), "array '' has no names of columns; try --columns"),
        (np.zeros((5, 5)), "array '' has no names of columns; try --columns"),
        (np.zeros(3, [("t", "f8"), ("x", "i4"), ("y", "i4")]), r"no columns of events .got \['t', 'x', 'y'\]"),
        (
            np.array([(np.nan, 1, 1, 1)], [("t_s", "f8"), ("x", "i4"), ("y", "i4"), ("p", "i4")]),
            r"time of event 0 .got nan",
        ),
        (np.array([(1, -1, 1, 1)], [("t_s", "f8"), ("x", "i4"), ("y", "i4"), ("p", "i4")]), r"x of event 0 .got -1"),
    ],
)
def test_arrays_that_are_not_events(tmp_path, array, message):
    np.save(tmp_path / "e.npy", array)
    with pytest.raises(BlinkGLError, match=message):
        open_events(tmp_path / "e.npy").read()


@pytest.mark.parametrize(
    "largest, size",
    [
        ((0, 0), (180, 240)),
        ((179, 239), (180, 240)),
        ((180, 239), (240, 304)),
        ((179, 240), (240, 304)),
        ((239, 304), (260, 346)),
        ((259, 345), (260, 346)),
        ((260, 300), (320, 320)),
        ((319, 319), (320, 320)),
        ((319, 320), (480, 640)),
        ((479, 639), (480, 640)),
        ((480, 0), (720, 1280)),
        ((719, 1279), (720, 1280)),
        ((1079, 1919), (1080, 1920)),
        ((1080, 5), (1081, 6)),
    ],
)
def test_a_size_that_is_not_said_is_that_of_the_smallest_sensor_that_holds_all(tmp_path, largest, size):
    """DAVIS240, ATIS, DAVIS346, GENX320, VGA, HD and full HD; else as large as the events are."""
    y, x = largest
    (tmp_path / "e.txt").write_text(f"t_us x y p\n1 0 {y} 1\n2 {x} 0 1\n")
    file = open_events(tmp_path / "e.txt")
    assert (file.height, file.width) == (None, None)
    assert (file.sized().height, file.sized().width) == size


@pytest.mark.parametrize(
    ("name", "ending"), [("a.txt", ".txt"), ("a.b.txt", ".txt"), ("a.TXT.gz", ".txt.gz"), ("a.evt.json", ".evt.json")]
)
def test_an_ending_has_two_dots_where_a_format_s_has(monkeypatch, name, ending):
    monkeypatch.setitem(FORMATS, "two", EventFormat("two", (".evt.json",), "text", "TextReader"))
    assert ending_of(Path(name)) == ending
