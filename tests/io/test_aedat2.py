"""AEDAT 2.0: what is written bit by bit is read, a real recording holds what is known of it, and damage is refused by
its place."""

from __future__ import annotations

import numpy as np
import pytest

from aedat2_files import (
    CHIP,
    event_addresses,
    frame_addresses,
    header,
    imu_addresses,
    records,
)
from blinkgl.cli import run
from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.aedat2 import Aedat2Reader
from blinkgl.io.formats import convert, open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import Declared
from blinkgl.types.events import Events
from tests.io.some_events import same, some_events
from tests.shared_data import shared

H, W = 180, 240


def events(n=5000, t0=10_000) -> Events:
    return some_events(n, t0, t0 + 300_000, H, W)


def put(path, data: bytes):
    path.write_bytes(data)
    return path


def test_events_as_they_were(tmp_path):
    given = events()
    path = put(tmp_path / "e.aedat", header() + records(event_addresses(given), given.t))
    file = open_events(path)
    assert (file.format, file.height, file.width) == ("aedat2", H, W)
    assert same(file.read(), given)
    parts = list(Aedat2Reader(path).chunks(records=777))
    assert len(parts) == 7 and same(Events.concatenate(parts), given)


def test_times_go_on_where_32_bits_end(tmp_path):
    t = np.array([2**31 - 5, 2**31 + 5, 2**32 - 3, 2**32 + 4, 2**32 + 2**31 + 1, 2**33 - 1, 2**33 + 7])
    given = Events(*(np.arange(len(t)).astype(np.uint16) for _ in "xy"), t, np.zeros(len(t), np.uint8))
    path = put(tmp_path / "e.aedat", header() + records(event_addresses(given), given.t))
    assert open_events(path).read().t.tolist() == t.tolist()
    assert np.concatenate([e.t for e in Aedat2Reader(path).chunks(records=2)]).tolist() == t.tolist()


# ---- frames and IMU --------------------------------------------------------------------------------------------------


def pictures(count=3, seed=1, height=H, width=W) -> list[tuple[np.ndarray, np.ndarray]]:
    rng = np.random.default_rng(seed)
    reset = rng.integers(600, 1024, (count, height, width))
    return [(r, np.clip(r - rng.integers(-20, 500, r.shape), 0, 1023)) for r in reset]


def global_frames(frames, t0=1000, exposure=5000, period=40_000) -> list[tuple[np.ndarray, np.ndarray]]:
    """(addresses, times): the resets are read from t0 on, for 1 ms, the signals ``exposure`` later."""
    parts = []
    for k, (reset, signal) in enumerate(frames):
        for read, is_signal, begin in ((reset, False, 0), (signal, True, 1000 + exposure)):
            address = frame_addresses(read, is_signal)
            t = t0 + k * period + begin + np.arange(len(address)) * 1000 // len(address)
            parts.append((address, t))
    return parts


def file_of(*parts) -> bytes:
    address, t = (np.concatenate([p[i] for p in parts]) for i in (0, 1))
    order = np.argsort(t, kind="stable")
    return records(address[order], t[order])


def test_frames_are_reset_minus_signal(tmp_path):
    shown, given = pictures(), events(t0=0)
    path = put(tmp_path / "f.aedat", header() + file_of((event_addresses(given), given.t), *global_frames(shown)))
    file = open_events(path)
    assert same(file.read(), given)
    found = list(file.frames())
    assert len(found) == 3
    for k, (frame, (reset, signal)) in enumerate(zip(found, shown)):
        assert frame.image.dtype == np.uint16
        np.testing.assert_array_equal(frame.image, np.maximum(reset - signal, 0))
        assert (frame.begin_us, frame.end_us) == (1000 + 40_000 * k + 999, 1000 + 40_000 * k + 6000)
        assert frame.t_us == (frame.begin_us + frame.end_us) // 2
    small = list(Aedat2Reader(path).frames(records=1000))
    assert [f.begin_us for f in small] == [f.begin_us for f in found]
    assert all(np.array_equal(a.image, b.image) for a, b in zip(small, found))


def test_frames_go_through_the_door_of_frames(tmp_path):
    path = put(tmp_path / "f.aedat", header() + file_of(*global_frames(pictures(3))))
    source = open_frames(path)
    assert (source.height, source.width, source.count) == (H, W, None)
    assert [t for _, t, _ in source] == [1000 * (1000 + 40_000 * k + 3499) for k in range(3)]
    assert [t for _, t, _ in open_frames(path, Declared(fps=100))] == [0, 10**7, 2 * 10**7]
    with pytest.raises(EventDataError, match=r"events need at least two frames \(got '0 frames'\)"):
        open_frames(put(tmp_path / "e.aedat", header() + records([0], [1])))


def test_the_inertial_unit(tmp_path):
    values = np.array([[4096, -8192, 0, -1828, 328, -3280, 32767]] * 3 + [[-32768, 1, 2, 3, 4, 5, 6]])
    t = np.repeat([10, 20, 30, 40], 7)
    given = events(500, t0=0)
    imu = (imu_addresses(values), t)
    path = put(tmp_path / "i.aedat", header() + file_of(imu, (event_addresses(given), given.t)))
    found = open_events(path).imu()
    assert len(found) == 4 and found.t.tolist() == [10, 20, 30, 40]
    # jAER's usual full scales: 8 g and 1000 degrees/s over 15 bits.
    np.testing.assert_allclose(found.acceleration[0], np.array([1, -2, 0]) * 9.80665)
    np.testing.assert_allclose(found.rate[0], np.radians(np.array([328, -3280, 32767]) * 1000 / 32768))
    np.testing.assert_allclose(found.temperature[0], 35 - 1828 / 340)
    np.testing.assert_allclose(found.acceleration[3, 0], -8 * 9.80665)
    said = header(
        CHIP,
        '#<entry key="ImuGyroScale" value="GyroFullScaleDegPerSec250"/>',
        '#<entry key="ImuAccelScale" value="ImuAccelScaleG2"/>',
    )
    other = open_events(put(tmp_path / "j.aedat", said + file_of(imu))).imu()
    np.testing.assert_allclose(other.acceleration, found.acceleration / 4)
    np.testing.assert_allclose(other.rate, found.rate / 4)


# ---- a real recording ------------------------------------------------------------------------------------------------


def test_a_recording_of_a_davis240c(tmp_path):
    """What is known of it: 162,771 events, IMU at about 2.33 kHz, a camera that stands upright under gravity."""
    path = shared("data/events/rueckauer2016/IMU_translBoxes.aedat")
    file = open_events(path)
    assert (file.height, file.width) == (180, 240)
    found = file.read()
    assert len(found) == 162_771
    assert int(found.t[-1] - found.t[0]) == 2_072_651 and (found.x.max(), found.y.max()) == (239, 179)
    imu = file.imu()
    assert len(imu) == 4833
    assert (len(imu) - 1) / (imu.t[-1] - imu.t[0]) * 1e6 == pytest.approx(2332, abs=1)
    assert np.linalg.norm(imu.acceleration.mean(0)) == pytest.approx(9.9, abs=0.1)
    assert 20 < imu.temperature.mean() < 40
    assert list(file.frames()) == [] and convert(path, tmp_path / "e.npz")[1] == 162_771
    assert same(open_events(tmp_path / "e.npz").read(), found)


def test_the_commands_read_it(tmp_path, capsys):
    given = events()
    path = put(tmp_path / "e.aedat", header() + file_of((event_addresses(given), given.t), *global_frames(pictures(4))))
    assert run(["convert", str(path), str(tmp_path / "e.csv")]) == 0
    assert same(open_events(tmp_path / "e.csv").read(), given)
    assert run(["compare", str(path), "--frames", str(path)]) == 0
    assert "correlation" in capsys.readouterr().out
    assert run(["simulate", str(path), "--out", str(tmp_path / "s.h5"), "--quiet"]) == 0
    assert len(open_events(tmp_path / "s.h5").read()) > 1000


# ---- bad input -------------------------------------------------------------------------------------------------------

START = len(header())


@pytest.mark.parametrize(
    "data, message",
    [
        (b"#!AER-DAT3.1\r\n", r"another version of AEDAT \(got '3.1'\)"),
        (b"\x89PNG", r"not an AEDAT file: wrong magic \(got b'\\x89PNG'\)"),
        (b"", r"not an AEDAT file: wrong magic"),
        (header(None) + records([0], [1]), r"no camera named in the header"),
        (header("ch.unizh.ini.jaer.chip.retina.DVS132"), r"a camera with unknown addresses \(got 'DVS132'\)"),
    ],
)
def test_files_that_are_not_opened(tmp_path, data, message):
    with pytest.raises(AssetError, match=message):
        open_events(put(tmp_path / "e.aedat", data))


@pytest.mark.parametrize(
    "data, message",
    [
        (records([0] * 3, [1, 2, 3])[:-3], rf"truncated: 5 stray bytes after record 1, at byte {START + 16}"),
        (
            records([0, 0, 240 << 12], [1, 2, 3]),
            rf"outside the sensor: record 2, at byte {START + 16} \(got 'x 240, y 0 .address 0x000f0000.'\)",
        ),
        (records([180 << 22], [1]), rf"outside the sensor: record 0, at byte {START} \(got 'x 0, y 180"),
        (records([0, 1 << 31 | 200 << 22], [1, 2]), rf"outside the sensor: record 1, at byte {START + 8}"),
        (
            records([0] * 4, [100, 200, 150, 300]),
            rf"times decrease: record 2, at byte {START + 16} \(got 150\); expected at least 200 µs, or a wrap",
        ),
        (records([0] * 2, [2**32 - 1, 2**31 + 10]), rf"times decrease: record 1, at byte {START + 8}"),
    ],
)
def test_damage_is_refused_by_its_place(tmp_path, data, message):
    path = put(tmp_path / "e.aedat", header() + data)
    for read in (lambda f: f.read(), lambda f: list(f.frames()), lambda f: f.imu()):
        with pytest.raises(AssetError, match=message):
            read(open_events(path))
    with pytest.raises(AssetError, match=message.split(":")[0]):
        list(Aedat2Reader(path).chunks(records=2))


def test_a_header_without_an_end(tmp_path):
    with pytest.raises(AssetError, match=rf"a header without an end, at byte {START}"):
        open_events(put(tmp_path / "e.aedat", header() + b"#" + b"x" * 200_000))


def test_a_time_below_zero_names_what_would_do(tmp_path):
    """A frame's sample after an event of 100 µs, by the clock 101 µs before it: no time precedes the recording."""
    data = header() + records([0, 1 << 31], [100, 2**32 - 1])
    with pytest.raises(AssetError, match=r"times decrease: record 1, .*expected at least 0 µs"):
        list(open_events(put(tmp_path / "e.aedat", data)).chunks())
