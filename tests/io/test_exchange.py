"""Formats of other ecosystems: ROS 2's MCAP, read by mcap's own decoder, and the tables of Prophesee's HDF5, whose
codec is in test_ecf.py."""

import h5py
import numpy as np
import pytest

from blinkgl.errors import AssetError, EventDataError, OutputError
from blinkgl.io.formats import convert, open_events, write_events
from blinkgl.io.prophesee import EVENT
from blinkgl.types.events import Events

H, W = 48, 64


def some_events(n=5000, t0=1_700_000_000_000_000, gap_us=9_000_000_000):
    """An hour and a half with a gap longer than 32 bits of ns."""
    rng = np.random.default_rng(3)
    t = np.sort(np.concatenate([rng.integers(0, 40_000, n // 2), gap_us + rng.integers(0, 40_000, n - n // 2)])) + t0
    pick = lambda top, dtype: rng.integers(0, top, n).astype(dtype)
    return Events(pick(W, np.uint16), pick(H, np.uint16), t, pick(2, np.uint8))


def same(a, b):
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in "xytp")


def messages(path):
    """(channel, schema, what ROS 2's own rules make of the bytes) of every message."""
    reader = pytest.importorskip("mcap.reader", reason="optional extra [exchange]")
    ros2 = pytest.importorskip("mcap_ros2.decoder", reason="optional extra [exchange]")
    with open(path, "rb") as file:
        for one in reader.make_reader(file, decoder_factories=[ros2.DecoderFactory()]).iter_decoded_messages():
            yield one.channel, one.schema, one.message, one.decoded_message


def test_ros_decodes_our_packets(tmp_path):
    pytest.importorskip("mcap", reason="optional extra [exchange]")
    events = some_events()
    write_events(tmp_path / "e.mcap", events, H, W)
    columns, last = {k: [] for k in "xytp"}, -1
    for number, (channel, schema, message, packet) in enumerate(messages(tmp_path / "e.mcap")):
        assert (schema.name, schema.encoding) == ("event_camera_msgs/msg/EventPacket", "ros2msg")
        assert channel.message_encoding == "cdr" and (packet.height, packet.width) == (H, W)
        assert packet.encoding == "mono" and not packet.is_bigendian and packet.seq == number
        stamp = packet.header.stamp.sec * 10**9 + packet.header.stamp.nanosec
        assert stamp == packet.time_base == message.log_time and packet.time_base > last
        last = packet.time_base
        words = np.frombuffer(bytes(packet.events), "<u8")  # event_camera_msgs' README: 63, 62..48, 47..32, 31..0
        columns["p"].append((words >> 63).astype("u1"))
        columns["y"].append(((words >> 48) & 0x7FFF).astype("u2"))
        columns["x"].append((words >> 32 & 0xFFFF).astype("u2"))
        columns["t"].append((packet.time_base + (words & 0xFFFFFFFF).astype("i8")) // 1000)
    assert same(Events(*(np.concatenate(columns[k]) for k in "xytp")), events)


def test_mcap_of_a_prophesee_camera_is_read(tmp_path):
    """The driver sends Prophesee's own words, whose state goes on from message to message."""
    writer = pytest.importorskip("mcap.writer", reason="optional extra [exchange]")
    from blinkgl.io.mcap import _DEFINITION, SCHEMA, _message

    halves = ([0x8001, 0x6010, 0x0007, 0x2805], [0x2006, 0x6020, 0x2009])
    with open(tmp_path / "e.mcap", "wb") as file:
        out = writer.Writer(file)
        out.start()
        channel = out.register_channel("/cam", "cdr", out.register_schema(SCHEMA, "ros2msg", _DEFINITION.encode()))
        for number, words in enumerate(halves):
            data = _message(H, W, number, 0, "evt3", np.array(words, "<u2").tobytes())
            out.add_message(channel, number, data, number)
        out.finish()
    events = open_events(tmp_path / "e.mcap").read()
    assert events.t.tolist() == [4096 + 16, 4096 + 16, 4096 + 32]
    assert (events.x.tolist(), events.y.tolist(), events.p.tolist()) == ([5, 6, 9], [7, 7, 7], [1, 0, 0])


def test_mcap_that_cannot_be(tmp_path):
    pytest.importorskip("mcap", reason="optional extra [exchange]")
    early = Events(*(np.array([v], d) for v, d in ((1, "u2"), (1, "u2"), (-5, "i8"), (1, "u1"))))
    with pytest.raises(EventDataError, match="zero-time"):
        write_events(tmp_path / "e.mcap", early, H, W)
    assert not list(tmp_path.iterdir())
    write_events(tmp_path / "e.mcap", some_events(), H, W)
    data = (tmp_path / "e.mcap").read_bytes()
    for name, broken in (("cut", data[: len(data) // 2]), ("text", b"hello"), ("flip", _flipped(data))):
        (tmp_path / f"{name}.mcap").write_bytes(broken)
        with pytest.raises(AssetError):
            open_events(tmp_path / f"{name}.mcap").read()


def _flipped(data):
    at = len(data) // 3
    return data[:at] + bytes([data[at] ^ 0xFF]) + data[at + 1 :]


def test_without_the_package_a_line_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(__import__("sys").modules, "mcap", None)
    with pytest.raises(OutputError, match="pip install mcap"):
        write_events(tmp_path / "e.mcap", some_events(), H, W)
    (tmp_path / "e.mcap").write_bytes(b"")
    with pytest.raises(AssetError, match="pip install mcap"):
        open_events(tmp_path / "e.mcap")


def test_prophesee_layout_by_hand(tmp_path):
    events = some_events(gap_us=20_000)
    write_events(tmp_path / "e.hdf5", (events.part(slice(i, i + 700)) for i in range(0, 5000, 700)), H, W,
                 format="prophesee")  # fmt: skip
    with h5py.File(tmp_path / "e.hdf5") as file:
        assert file.attrs["geometry"] == "64x48" and file.attrs["version"] == "1.0"
        table, indexes = file["CD/events"], file["CD/indexes"]
        assert table.dtype == EVENT and table.dtype.itemsize == 16 and table.dtype.names == ("x", "y", "p", "t")
        assert len(file["EXT_TRIGGER/events"]) == 0
        t = open_events(tmp_path / "e.hdf5").read().t
        np.testing.assert_array_equal(t, events.t)
        assert len(table) == len(t)
        first, offset = int(t[0]), int(indexes.attrs["offset"])
        assert offset == -first and indexes[0].tolist() == (0, -1)
        # Their reader's seek: entry 1 + (time since the first event) // 2 ms is the first event that is not before it.
        for k, (number, since) in enumerate(indexes[1:].tolist()):
            mark = first + 2000 * k
            assert t[number] >= mark and (number == 0 or t[number - 1] < mark) and t[number] - first == since
        assert first + 2000 * (len(indexes) - 1) > t[-1]
    assert open_events(tmp_path / "e.hdf5").format == "prophesee"


def test_from_a_sequences_file_to_each(tmp_path):
    events = some_events(gap_us=1_000_000)
    write_events(tmp_path / "e.h5", events, H, W, t_offset_us=int(events.t[0]))
    for name, kind in (("p.h5", "prophesee"), ("e.mcap", "mcap")):
        if kind == "mcap":
            pytest.importorskip("mcap", reason="optional extra [exchange]")
        convert(tmp_path / "e.h5", tmp_path / name, format=kind)
        file = open_events(tmp_path / name)
        assert (file.format, file.height, file.width) == (kind, H, W) and same(file.read(), events)


@pytest.mark.parametrize("name, kind", [("e.raw", "evt3"), ("e.raw", "evt2"), ("e.h5", "dsec"), ("e.h5", "prophesee")])
def test_evlib_reads_what_we_write(tmp_path, name, kind):
    evlib = pytest.importorskip("evlib", reason="not an extra of ours: pip install evlib")
    # Of Prophesee's HDF5 several chunks; evlib 0.13.2 wants times after 0.
    events = some_events(40_000, t0=1, gap_us=50_000) if kind == "prophesee" else some_events(t0=0, gap_us=50_000)
    write_events(tmp_path / name, events, H, W, format=kind)
    table = evlib.load_events(str(tmp_path / name)).collect()
    np.testing.assert_array_equal(table["t"].dt.total_microseconds().to_numpy(), events.t)
    for column, ours in (("x", events.x), ("y", events.y)):
        np.testing.assert_array_equal(table[column].to_numpy(), ours)
    np.testing.assert_array_equal(table["polarity"].to_numpy() > 0, events.p > 0)
