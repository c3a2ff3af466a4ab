"""ECF: bytes that Prophesee's own plugin wrote, round trips, damage, and the plugin itself where there is one."""

import h5py
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given, settings

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io import ecf
from blinkgl.io.formats import open_events, write_events
from blinkgl.io.prophesee import EVENT
from blinkgl.types.events import Events

H, W = 480, 640


def columns(x, y, t, p):
    return np.array(x, "u2"), np.array(y, "u2"), np.array(t, "i8"), np.array(p, "u1")


# What hdf5_ecf 1.0.1 made of these events (h5py 3.16, chunk = all of them): one of each form, and every long run.
WRITTEN = {
    "all in one": (
        columns(
            [2047, 0, 5, 1279, 640, 9], [0, 2047, 719, 3, 4, 5], [5, 5, 19, 20, 1 << 40, 1 << 40], [1, 0, 1, 1, 0, 1]
        ),
        "1a000000050000000000000002e111fcfeffffffffffffffff0200ff0f000bf0f07fff39002c130045000000500000000000",
    ),
    "x with p": (
        columns([2047, 5, 900, 4, 1000, 3] * 3, [7] * 18, np.arange(18) * 14, [1, 0] * 9),
        (
            "49000000000000000000000001e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1e1f2"
            "00faff09000870167dff000af09870d1000670faff09000870167d00000000"
        ),
    ),
    "masks": (
        columns([*range(10, 16), 20, *range(100, 140)], [7] * 47, [1000] * 7 + [1015] * 40, [1] * 7 + [0] * 40),
        "bc000000e80300000000000007ff0f2800ff002f005f0180029f0c5f0d1f0edf0e9f0f5f101c118728",
    ),
    "one polarity": (
        columns(range(200), [2047] * 200, [9] * 200, [1] * 200),
        (
            "2003000009000000000000000fc800ffffc8001f00df009f015f021f03df039f045f051f06df069f075f081f09df099f0a5f0b1f0cdf0c9f"
            "0d5f0e1f0fdf0f9f105f111f12df129f135f141f15df159f165f171f18d018ffc800"
        ),
    ),
}


def check(got, want):
    for a, b in zip(got, want):
        assert a.dtype == b.dtype
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize("name", WRITTEN)
def test_bytes_of_prophesees_plugin(name):
    events, text = WRITTEN[name]
    data = bytes.fromhex(text)
    check(ecf.decode(data, 16384, "e"), events)
    ours = ecf.encode(*events)
    assert ours[12:16] == b"\xf0" * 4  # for evlib: a number of no bits
    ours = ours[:12] + ours[16:]
    assert len(ours) <= len(data)
    if ours[0] & 3 == data[0] & 3:  # of two forms of one length we take the other
        assert ours == data


@st.composite
def chunks(draw):
    """Runs of rows, neighbours, equal times and gaps, in any mixture."""
    runs = draw(
        st.lists(
            st.tuples(
                st.integers(0, 2047),
                st.integers(0, 2047),
                st.integers(1, 6) | st.sampled_from([14, 15, 16, 30, 31, 32, 126, 127, 128, 300]),
                st.integers(0, 2),  # columns to the right from event to event
                st.sampled_from([0, 1, 14, 15, 16, 255, 1 << 32]) | st.integers(0, 1 << 40),
                st.integers(0, 1),
            ),
            min_size=1,
            max_size=12,
        )
    )
    start = draw(st.sampled_from([0, -(1 << 62), -1, 1_700_000_000_000_000]))
    x, y, t, p = [], [], [], []
    for left, row, n, step, gap, sign in runs:
        start += gap
        x += [min(left + step * k, 2047) for k in range(n)]
        y, t, p = y + [row] * n, t + [start] * n, p + [sign] * n
    return columns(x, y, t, p)


@settings(max_examples=150, deadline=None, derandomize=True)
@given(chunks())
def test_there_and_back(events):
    check(ecf.decode(ecf.encode(*events), len(events[0]), "e"), events)


@pytest.mark.parametrize("count", [1, 3, 4, 5, 16384, ecf.MAX_EVENTS])
@pytest.mark.parametrize("kind", ["dense", "sparse", "same", "neighbours"])
def test_whole_chunks(count, kind):
    rng = np.random.default_rng(count)
    x, y, p = rng.integers(0, 2048, count), rng.integers(0, 2048, count), rng.integers(0, 2, count)
    t = np.sort(rng.integers(0, 1 << (40 if kind == "sparse" else 12), count))
    if kind == "same":
        x, y, t, p = x[:1].repeat(count), y[:1].repeat(count), t[:1].repeat(count), p[:1].repeat(count)
    elif kind == "neighbours":
        x, y = np.arange(count) % 2048, np.arange(count) // 2048
    events = columns(x, y, t, p)
    data = ecf.encode(*events)
    check(ecf.decode(data, count, "e"), events)
    assert len(data) <= 12 + 20 * count
    if kind == "neighbours" and count > 5:  # form 0: six neighbours in two bytes
        assert data[0] & 3 == 0
    if kind == "sparse" and count > 5:
        assert data[0] & 3 == 2


def test_the_longest_gap():
    events = columns([0, 2047], [2047, 0], [-(1 << 62), 1 << 62], [1, 0])
    check(ecf.decode(ecf.encode(*events), 2, "e"), events)


@pytest.mark.parametrize("name", WRITTEN)
def test_damage_is_one_line(name):
    """Cut anywhere, or with bytes too many; flipped bits give events or that line, and never another exception."""
    data = bytes.fromhex(WRITTEN[name][1])
    for end in range(len(data)):
        with pytest.raises(AssetError, match="damaged: an ECF chunk"):
            ecf.decode(data[:end], 16384, "e.h5")
    with pytest.raises(AssetError, match="2 bytes after its last event"):
        ecf.decode(data + b"\0\0", 16384, "e.h5")
    with pytest.raises(AssetError, match="of an unknown form .got 3."):
        ecf.decode(bytes([data[0] | 3]) + data[1:], 16384, "e.h5")
    with pytest.raises(AssetError, match="too many events .got .*at most 2"):
        ecf.decode(data, 2, "e.h5")
    for k in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[k // 8] ^= 1 << k % 8
        try:
            ecf.decode(bytes(flipped), 16384, "e.h5")
        except AssetError as error:
            assert str(error).startswith("e.h5: damaged") and "\n" not in str(error)


def some(n=40_000, t0=1_000_000):
    rng = np.random.default_rng(4)
    x, y, p = rng.integers(0, W, n), rng.integers(0, H, n), rng.integers(0, 2, n)
    y[: n // 2] = np.sort(y[: n // 2])  # the first chunk in runs
    return Events(*columns(x, y, np.sort(rng.integers(0, 200_000, n)) + t0, p))


def table_of(path, chunks, count, *, filters=((ecf.FILTER, ()),), step=16384):
    """A file with such packed chunks, (bytes, filter mask) each."""
    with h5py.File(path, "w") as file:
        layout = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        layout.set_chunk((step,))
        for number, values in filters:
            layout.set_filter(number, h5py.h5z.FLAG_OPTIONAL, values)
        space = h5py.h5s.create_simple((count,), (h5py.h5s.UNLIMITED,))
        made = h5py.h5d.create(
            file.create_group("CD").id, b"events", h5py.h5t.py_create(EVENT, logical=True), space, layout
        )
        for k, (data, mask) in enumerate(chunks):
            made.write_direct_chunk((k * step,), data, mask)


def test_a_chunk_that_was_not_packed(tmp_path):
    """The filter is optional: a program without it stores rows, and says so in the chunk's mask."""
    rows = np.zeros(16, EVENT)
    rows["x"], rows["t"] = np.arange(16), np.arange(16)
    packed = ecf.encode(rows["x"][:9], rows["y"][:9], rows["t"][:9] + 16, rows["p"][:9])
    table_of(tmp_path / "e.h5", [(rows.tobytes(), 1), (packed, 0)], 25, step=16)
    events = open_events(tmp_path / "e.h5").read()
    np.testing.assert_array_equal(events.t, np.arange(25))
    np.testing.assert_array_equal(events.x, [*range(16), *range(9)])


def test_a_chunk_may_hold_more_than_the_table(tmp_path):
    """HDF5's own way through the filter packs the last chunk whole, with rows of zeros behind the last event."""
    x, t = np.arange(16), np.r_[100:110, [0] * 6]
    packed = ecf.encode(x, x * 0, t, x * 0)
    table_of(tmp_path / "e.h5", [(packed, 0)], 10, step=16)
    np.testing.assert_array_equal(open_events(tmp_path / "e.h5").read().t, t[:10])


@pytest.mark.parametrize(
    "change, says",
    [
        (dict(chunks=[(bytes(13), 0)]), "1 bytes after its last event"),
        (dict(chunks=[(bytes(2), 0)]), "truncated"),
        (dict(chunks=[(ecf.encode(*columns([1, 2], [3, 4], [5, 6], [1, 0])), 0)]), "fewer events .*got 2.; expected 7"),
        (dict(chunks=[(bytes(16), 1)]), "fewer events .*got 1.; expected 7"),
        (dict(chunks=[]), "damaged HDF5 file"),
        (dict(chunks=[], filters=((1, (4,)), (ecf.FILTER, ()))), "packed with ECF and another filter"),
    ],
    ids=["left over", "truncated", "fewer", "fewer rows", "no chunk", "two filters"],
)
def test_damaged_files_are_one_line(tmp_path, change, says):
    table_of(tmp_path / "e.h5", count=7, **change)
    with pytest.raises(AssetError, match=says) as caught:
        open_events(tmp_path / "e.h5").read()
    assert str(tmp_path / "e.h5") in str(caught.value) and "\n" not in str(caught.value)


def test_what_metavisions_reader_takes_for_granted(tmp_path):
    """It reads ``CD/events`` through its codec, all other tables as their chunks lie in the file, strings of variable
    length alone, and the last chunk with its events only."""
    events = some()
    write_events(tmp_path / "e.h5", events, H, W, format="prophesee")
    with h5py.File(tmp_path / "e.h5") as file:
        for holder in (file, file["CD/indexes"]):
            for name in holder.attrs:
                assert holder.attrs.get_id(name).get_type().is_variable_str(), name
        assert (file.attrs["format"], file.attrs["geometry"], file.attrs["version"]) == ("ECF", "640x480", "1.0")
        for name in ("CD/indexes", "EXT_TRIGGER/events", "EXT_TRIGGER/indexes"):
            assert file[name].id.get_create_plist().get_nfilters() == 0 and file[name].chunks == (16384,)
        table = file["CD/events"]
        layout = table.id.get_create_plist()
        assert layout.get_nfilters() == 1 and layout.get_filter(0)[:2] == (0x8ECF, h5py.h5z.FLAG_OPTIONAL)
        sizes = []
        for at in range(0, len(table), 16384):
            skipped, data = table.id.read_direct_chunk((at,))
            sizes.append(int.from_bytes(data[:4], "little") >> 2)
            assert not skipped
        assert sizes == [16384, 16384, 40_000 - 2 * 16384]


def test_too_large_a_sensor(tmp_path):
    with pytest.raises(EventDataError, match="11-bit coordinates .*2048 px a side"):
        write_events(tmp_path / "e.h5", some(4), 2049, 640, format="prophesee")
    assert not (tmp_path / "e.h5").exists()


needs_plugin = pytest.mark.skipif(
    not h5py.h5z.filter_avail(ecf.FILTER), reason="Prophesee's plugin (hdf5_ecf) is not in HDF5_PLUGIN_PATH"
)


@needs_plugin
def test_prophesees_plugin_reads_what_we_write(tmp_path):
    events = some()
    write_events(tmp_path / "e.h5", events, H, W, format="prophesee")
    with h5py.File(tmp_path / "e.h5") as file:
        rows = file["CD/events"][:]
    for name in "xytp":
        np.testing.assert_array_equal(rows[name], getattr(events, name))


@needs_plugin
def test_we_read_what_prophesees_plugin_writes(tmp_path):
    events = some()
    rows = np.zeros(len(events), EVENT)
    for name in "xytp":
        rows[name] = getattr(events, name)
    with h5py.File(tmp_path / "e.h5", "w") as file:
        file.create_dataset("CD/events", data=rows, chunks=(1024,), compression=ecf.FILTER)
    read = open_events(tmp_path / "e.h5").read()
    for name in "xytp":
        np.testing.assert_array_equal(getattr(read, name), getattr(events, name))
