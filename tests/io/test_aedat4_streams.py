"""AEDAT4's frames and inertial unit, of recordings of which is known what they hold."""

from __future__ import annotations

import itertools
import sys
from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.cli import run
from blinkgl.errors import AssetError, EventDataError
from blinkgl.io import aedat4
from blinkgl.io.aedat4 import Aedat4Reader
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import EventReading
from blinkgl.recordings.comparison import compare
from tests.shared_data import shared

CRADLE = "data/events/cuke_davis346/demo-01.aedat4"
STILL = "data/events/aedat4/davis346_events_frames_imu.aedat4"


def opened(name: str):
    path = shared(name)
    return open_events(path)


@pytest.mark.parametrize("name, count, exposure_us", [(CRADLE, 13, 20_000), (STILL, 4, 500)])
def test_frames(name, count, exposure_us):
    """25 Hz of 346x260."""
    file = opened(name)
    frames = list(file.frames())
    assert len(frames) == count and {f.image.shape for f in frames} == {(260, 346)}
    assert {f.image.dtype for f in frames} == {np.dtype(np.uint8)} and frames[0].image.std() > 5
    assert {f.end_us - f.begin_us for f in frames} == {exposure_us}
    assert {b.begin_us - a.begin_us for a, b in itertools.pairwise(frames)} == {40_000}
    source = open_frames(file.path)
    assert [t for _, t, _ in source] == [1000 * (f.begin_us + exposure_us // 2) for f in frames]


def test_frames_and_events_are_on_one_clock():
    """The change of ln(frame + 10) from middle to middle of the exposures is what the events say; half an exposure off,
    it is not."""
    path = opened(CRADLE).path
    right, early = (
        float(
            np.mean(
                compare(str(path), frames=str(path), gamma="linear", frame_delay_ms=ms).to_dict()["a"][
                    "frame_correlation"
                ]
            )
        )
        for ms in (0.0, -20.0)
    )
    assert right > 0.88 and early < right - 0.2


@pytest.mark.parametrize(
    "name, count, hertz, gravity",
    [
        (STILL, 160, 1001, 10.1),
        ("data/events/aermanager/head_turn.aedat4", 1176, 805, 10.5),
        (CRADLE, 510, 999, 0.0),
    ],
)
def test_the_inertial_unit(name, count, hertz, gravity):
    """(The cradle's camera had its accelerometer off.)"""
    imu = opened(name).imu()
    assert len(imu) == count and imu.acceleration.shape == imu.rate.shape == (count, 3)
    assert (count - 1) / (imu.t[-1] - imu.t[0]) * 1e6 == pytest.approx(hertz, abs=1)
    assert np.linalg.norm(imu.acceleration.mean(0)) == pytest.approx(gravity, abs=0.1)
    assert np.abs(imu.rate.mean(0)).max() < 0.05 and 25 < imu.temperature.mean() < 40


def test_what_a_recording_does_not_hold():
    file = opened("data/events/noise/dvxplorer_constant_light.aedat4")
    with pytest.raises(AssetError, match=r"constant_light.aedat4: no frames in the recording$"):
        list(file.frames())
    with pytest.raises(AssetError, match=r"no samples of an inertial unit in the recording$"):
        file.imu()
    with pytest.raises(AssetError, match="no frames in the recording"):
        open_frames(file.path)


def recorded(monkeypatch, kind, packets):
    """A recording of such packets, by a library of our own."""

    class Decoder:
        def __init__(self, path):
            self.packets = iter([{"stream_id": 1, kind: packet} for packet in packets])

        def id_to_stream(self):
            return {0: {"type": "events", "height": 480, "width": 640}, 1: {"type": kind}}

        def __iter__(self):
            return self.packets

    monkeypatch.setitem(sys.modules, "aedat", SimpleNamespace(Decoder=Decoder))
    monkeypatch.setattr(aedat4, "_check_claims", lambda path: iter(()))
    monkeypatch.setattr(aedat4, "_descriptions", lambda path: {})
    return Aedat4Reader("e.aedat4")


def test_damage_is_one_line(monkeypatch):
    def decoder(path):
        raise RuntimeError("no  such\n stream")

    monkeypatch.setitem(sys.modules, "aedat", SimpleNamespace(Decoder=decoder))
    monkeypatch.setattr(aedat4, "_check_claims", lambda path: iter(()))
    with pytest.raises(AssetError, match="^e.aedat4: damaged AEDAT4 file: no such stream$"):
        Aedat4Reader("e.aedat4")


@pytest.mark.parametrize("times", [[(10, 20), (10, 20)], [(10, 5)], [(30, 40), (20, 50)]])
def test_frames_whose_times_do_not_increase(monkeypatch, times):
    frames = [
        {"exposure_begin_t": begin, "exposure_end_t": end, "pixels": np.zeros((2, 2), np.uint8)} for begin, end in times
    ]
    with pytest.raises(EventDataError, match=rf"times of frame {len(times) - 1} do not increase"):
        list(recorded(monkeypatch, "frame", frames).frames())


def test_samples_whose_times_run_backwards(monkeypatch):
    rows = np.zeros(3, [("t", "<u8")])
    rows["t"] = (5, 9, 8)
    with pytest.raises(EventDataError, match=r"times decrease at sample 2 of the inertial unit \(got \(9, 8\)\)"):
        recorded(monkeypatch, "imus", [rows]).imu()


def test_a_packet_longer_than_the_file_is_refused_before_memory_is_set_aside(tmp_path):
    """The decoder would ask for what is claimed; what comes before is kept on request."""
    data = bytearray(shared("field/events/overlap.aedat4").read_bytes())
    begin = 18 + int.from_bytes(data[14:18], "little")
    second = begin + 8 + int.from_bytes(data[begin + 4 : begin + 8], "little")
    data[second + 4 : second + 8] = (0x7FFFFFF0).to_bytes(4, "little")
    (tmp_path / "e.aedat4").write_bytes(data)
    with pytest.raises(AssetError, match=rf"a packet at byte {second} of 2147483632 bytes; .*or --damaged keep"):
        open_events(tmp_path / "e.aedat4").read()
    with open_events(tmp_path / "e.aedat4", EventReading(damaged="keep")) as file:
        assert len(file.read()) == 100 and "kept: events before the damage: 100" in file.notes[0]
    data[14:18] = (0x7FFFFFF0).to_bytes(4, "little")
    (tmp_path / "e.aedat4").write_bytes(data)
    with pytest.raises(AssetError, match="a header of 2147483632 bytes"):
        open_events(tmp_path / "e.aedat4")


def test_a_recording_of_frames_alone(tmp_path, capsys):
    """Written by iniVation's own library: its frames are simulated, and a reader of events says that there are none."""
    dv = pytest.importorskip("dv_processing", reason="optional extra [formats]")
    path = tmp_path / "frames.aedat4"
    rng = np.random.default_rng(0)
    images = [rng.integers(0, 256, (48, 64)).astype(np.uint8) for _ in range(5)]
    writer = dv.io.MonoCameraWriter(str(path), dv.io.MonoCameraWriter.FrameOnlyConfig("DAVIS346_1", (64, 48)))
    for k, image in enumerate(images):
        writer.writeFrame(dv.Frame(1_000_000 + 10_000 * k, image))
    del writer  # which closes the file
    source = list(open_frames(path))
    assert [t for _, t, *_ in source] == [1_000_000_000 + 10_000_000 * k for k in range(5)]
    assert all(np.array_equal(frame, image) for (frame, *_), image in zip(source, images, strict=True))
    with open_events(path) as file:
        assert (file.height, file.width) == (None, None) and len(list(file.frames())) == 5
        with pytest.raises(AssetError, match=r"^\S+frames.aedat4: no events in the recording$"):
            file.read()
    assert run(["simulate", str(path), "--out", str(tmp_path / "e.h5")]) == 0
    assert "from 5 frames" in capsys.readouterr().out
    assert run(["convert", str(path), str(tmp_path / "none.h5")]) == 2
    assert capsys.readouterr().err.endswith("frames.aedat4: no events in the recording\n")
    assert not (tmp_path / "none.h5").exists()


def two_cameras(monkeypatch, reading: EventReading, broken: bool = False) -> Aedat4Reader:
    """Streams 0 and 1 are events and triggers of camera A, 2 and 3 of camera B; a fault ends the recording."""
    row = lambda kind, t: np.array([(t, kind)], [("t", "<u8"), ("source", "u1")])
    event = np.array([(5, 1, 2, True)], [("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])
    packets = [{"stream_id": n, "events": event} for n in (0, 2)]
    packets[1:1] = [{"stream_id": 1, "triggers": row(7, 11)}, {"stream_id": 3, "triggers": row(9, 12)}]
    types = dict(zip(range(4), ("events", "triggers", "events", "triggers"), strict=True))

    class Decoder:
        def __init__(self, path):
            pass

        def id_to_stream(self):
            return {n: {"type": kind, "height": 4, "width": 4} for n, kind in types.items()}

        def __iter__(self):
            yield from packets
            if broken:
                raise RuntimeError("cut")

    monkeypatch.setitem(sys.modules, "aedat", SimpleNamespace(Decoder=Decoder))
    monkeypatch.setattr(aedat4, "_check_claims", lambda path: iter(()))
    monkeypatch.setattr(aedat4, "_descriptions", lambda path: {n: {"source": "AABB"[n]} for n in range(4)})
    return Aedat4Reader("e.aedat4", reading)


@pytest.mark.parametrize("broken", [False, True], ids=["whole", "cut"])
@pytest.mark.parametrize(("stream", "expected"), [("0", [[11, 0, 7]]), ("2", [[12, 0, 9]])])
def test_triggers_are_those_of_the_events_camera_also_before_damage(monkeypatch, stream, expected, broken):
    reader = two_cameras(monkeypatch, EventReading.of(stream=stream), broken)
    for _ in range(2):
        try:
            list(reader.chunks())
        except AssetError:
            assert broken
        assert reader.triggers.tolist() == expected
        assert reader.notes == ["1 triggers are no events: blinkgl convert --triggers FILE.csv writes them"]
