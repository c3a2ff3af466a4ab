"""Bags and MCAP files that rosbags' own serialisation wrote are read event for event; AEDAT4 by three libraries."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.errors import AssetError, BlinkGLError
from blinkgl.io.formats import convert, open_events, write_events
from blinkgl.io.reading import EventReading
from blinkgl.io.ros import typestore
from tests.io.some_events import same, some_events

E = some_events(1000, 1_700_000_000_000_000, 1_700_000_003_000_000, 260, 346)


def messages(store, ros2, kind, events, size):
    """Yield (time, message) of a few hundred events each, some empty."""
    header = lambda t: store.types["std_msgs/msg/Header"](
        **({} if ros2 else {"seq": 7}), stamp=stamp(t), frame_id="camera_optical"
    )
    stamp = lambda t: store.types["builtin_interfaces/msg/Time"](sec=t // 10**6, nanosec=t % 10**6 * 1000)
    for part in (events.part(slice(max(i, 0), i + 301)) for i in range(-301, len(events), 301)):
        t = int(part.t[0]) if len(part) else int(events.t[0])
        rows = zip(part.x.tolist(), part.y.tolist(), part.t.tolist(), part.p.tolist(), strict=True)
        if kind == "event_camera_msgs":
            columns = (part.t - t).astype(np.uint64) * 1000, part.x.astype(np.uint64), part.y.astype(np.uint64)
            words = columns[0] | columns[1] << 32 | columns[2] << 48 | part.p.astype(np.uint64) << 63
            yield t, store.types["event_camera_msgs/msg/EventPacket"](
                header=header(t), height=size[0], width=size[1], seq=1, time_base=t * 1000, encoding="mono",
                is_bigendian=False, events=words.view(np.uint8),
            )  # fmt: skip
        else:
            one = store.types[f"{kind}/msg/Event"]
            array = [one(x=x, y=y, ts=stamp(t), polarity=bool(p)) for x, y, t, p in rows]
            yield (
                t,
                store.types[f"{kind}/msg/EventArray"](header=header(t), height=size[0], width=size[1], events=array),
            )


def bag(path, form, topics):
    """form : "bag", "sqlite3" or "mcap".   topics : name -> (package of messages, events)."""
    from rosbags import rosbag1, rosbag2

    ros2, store = form != "bag", typestore(form != "bag")
    make = {
        "bag": lambda: rosbag1.Writer(path),
        "sqlite3": lambda: rosbag2.Writer(path, version=9),
        "mcap": lambda: rosbag2.Writer(path, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP),
    }
    with make[form]() as writer:
        for topic, (kind, events) in topics.items():
            name = f"{kind}/msg/{'EventPacket' if kind == 'event_camera_msgs' else 'EventArray'}"
            connection = writer.add_connection(topic, name, typestore=store)
            for t, message in messages(store, ros2, kind, events, (260, 346)):
                data = store.serialize_cdr(message, name) if ros2 else store.serialize_ros1(message, name)
                writer.write(connection, t * 1000, data)
    return path


@pytest.mark.parametrize("form, name", [("bag", "e.bag"), ("sqlite3", "e"), ("mcap", "e")])
@pytest.mark.parametrize("kind", ["dvs_msgs", "prophesee_event_msgs", "event_camera_msgs"])
def test_bags_of_every_kind(tmp_path, form, name, kind):
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    path = bag(tmp_path / name, form, {"/dvs/events": (kind, E)})
    inner = [path, *path.glob(f"*.{'db3' if form == 'sqlite3' else form}")] if path.is_dir() else [path]
    for one in inner:  # the folder, and the file in it
        with open_events(one) as file:
            assert (file.format, file.height, file.width) == ("rosbag", 260, 346)
            assert same(file.read(), E) and file.notes == []


def test_several_topics_and_none(tmp_path):
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    path = bag(tmp_path / "e.bag", "bag", {"/right": ("dvs_msgs", E.part(slice(9))), "/left": ("dvs_msgs", E)})
    listed = r"expected one of --stream 0 ./left., --stream 1 ./right.$"
    with pytest.raises(AssetError, match=f"2 topics of events, and none is chosen; {listed}"):
        open_events(path)
    for stream, count in (("0", len(E)), ("/left", len(E)), ("1", 9), ("/right", 9)):
        with open_events(path, EventReading(stream=stream)) as file:
            assert len(file.read()) == count and file.notes == []
    with pytest.raises(AssetError, match=rf"no such one of the topics of events .got '2'.; {listed}"):
        open_events(path, EventReading(stream="2"))
    data = path.read_bytes()
    for size in range(0, len(data), 997):
        (tmp_path / "cut.bag").write_bytes(data[:size])
        with pytest.raises(BlinkGLError) as caught:
            open_events(tmp_path / "cut.bag").read()
        assert "\n" not in str(caught.value)


def test_evt3_packets(tmp_path):
    """The camera's own words go on from packet to packet, which may break anywhere."""
    pytest.importorskip("rosbags.rosbag1", reason="optional extra [formats]")
    from rosbags import rosbag1

    events = some_events(500, 0, 40_000_000, 720, 1280)
    write_events(tmp_path / "e.raw", events, 720, 1280)
    words = (tmp_path / "e.raw").read_bytes().partition(b"% end\n")[2]
    store, name = typestore(False), "event_camera_msgs/msg/EventPacket"
    with rosbag1.Writer(tmp_path / "e.bag") as writer:
        connection = writer.add_connection("/events", name, typestore=store)
        for k in range(0, len(words), 602):
            stamp = store.types["builtin_interfaces/msg/Time"](sec=k, nanosec=0)
            message = store.types[name](
                header=store.types["std_msgs/msg/Header"](seq=k, stamp=stamp, frame_id=""), height=720, width=1280,
                seq=k, time_base=0, encoding="evt3", is_bigendian=False,
                events=np.frombuffer(words[k : k + 602], np.uint8),
            )  # fmt: skip
            writer.write(connection, k, store.serialize_ros1(message, name))
    with open_events(tmp_path / "e.bag") as file:
        assert same(file.read(), events)


def test_aedat4_is_written(tmp_path):
    dv = pytest.importorskip("dv_processing", reason="optional extra [formats]")
    write_events(tmp_path / "e.npz", E, 260, 346)
    convert(tmp_path / "e.npz", tmp_path / "e.aedat4")
    with open_events(tmp_path / "e.aedat4") as file:  # the package aedat
        assert (file.format, file.height, file.width) == ("aedat4", 260, 346) and same(file.read(), E)
    recording, parts = dv.io.MonoCameraRecording(str(tmp_path / "e.aedat4")), []
    while (batch := recording.getNextEventBatch()) is not None:
        parts.append((batch.timestamps(), batch.coordinates(), batch.polarities()))
    assert np.concatenate([t for t, _, _ in parts]).tolist() == E.t.tolist()
    assert np.concatenate([xy for _, xy, _ in parts])[:, 0].tolist() == E.x.tolist()
    faery = pytest.importorskip("faery", reason="optional extra [formats]")
    a = faery.events_stream_from_file(tmp_path / "e.aedat4").to_array()
    assert np.array_equal(a["on"], E.p) and np.array_equal(a["y"], E.y)
    np.savez(tmp_path / "n.npz", x=E.x, y=E.y, t_us=E.t, p=E.p)
    with pytest.raises(
        BlinkGLError, match="aedat4 stores the sensor's size, and the file does not give it; expected --size"
    ):
        convert(tmp_path / "n.npz", tmp_path / "n.aedat4")
    assert [p.name for p in tmp_path.glob("n.aedat4*")] == []
