"""Sensors and the read-out bus."""

from __future__ import annotations

import itertools
from collections import deque

import numpy as np
import pytest
from scipy.stats import ks_2samp
from shared_data import shared

from blinkgl.config.events import EmulatorConfig, V2eConfig
from blinkgl.config.readout import ReadoutConfig
from blinkgl.config.sensor import SensorConfig, load_sensor, other_size, sensor_names, sensor_table
from blinkgl.errors import ConfigError, EventDataError
from blinkgl.events import Events, make_emulator
from blinkgl.events.camera import EventCamera, EventFrame, Readout
from blinkgl.recordings.clip import read_recording
from tests.events.clips import assert_same


def random_events(rng, n, span_us):
    t = np.sort(rng.integers(0, span_us, n))
    x, y = (rng.integers(0, 100, n).astype(np.uint16) for _ in range(2))
    return Events(x, y, t, rng.integers(0, 2, n).astype(np.uint8))


def slow_bus(events, config):
    """A list of departure times, nothing clever."""
    event, row_cost = max(1, round(1e12 / config.events_per_second)), round(config.row_ns * 1000)
    free, row, queue, out = -(2**62), -1, deque(), []
    for i in range(len(events)):
        now = int(events.t[i]) * 10**6
        while queue and queue[0] <= now:
            queue.popleft()
        if len(queue) == config.queue_events:
            continue
        start = max(now, free)
        if row_cost and (int(events.y[i]) != row or start > free):
            start += row_cost
        row, free = int(events.y[i]), start + event
        queue.append(free)
        out.append((i, free // 10**6))
    index, t = np.array(out, np.int64).reshape(-1, 2).T
    return Events(events.x[index], events.y[index], np.ascontiguousarray(t), events.p[index])


@pytest.mark.parametrize(
    "config",
    [
        ReadoutConfig(events_per_second=2e6, queue_events=50),
        ReadoutConfig(events_per_second=1e8),
        ReadoutConfig(events_per_second=1e7, row_ns=400, queue_events=7),
    ],
)
def test_bus_equals_slow_twin_at_any_chunking_and_resumes(config):
    events = random_events(np.random.default_rng(0), 5000, 1000)
    readout = Readout(config)
    edges = [0, 10, 11, 700, 3000, 5000]
    parts = []
    for a, b in itertools.pairwise(edges):
        parts.append(readout.step(events.part(slice(a, b)), int(events.t[b - 1])))
        state, readout = readout.state_dict(), Readout(config)
        readout.load_state_dict(state)
    parts.append(readout.step(Events.empty()))
    expected = slow_bus(events, config)
    assert_same(Events.concatenate(parts), expected)
    assert readout.dropped == 5000 - len(expected)


def test_what_has_not_left_the_bus_waits_for_the_next_step():
    """A step gives what left until its time; at the end of the recording the rest is counted and no part of it."""
    events = random_events(np.random.default_rng(4), 6000, 1000)
    config = ReadoutConfig(events_per_second=4e6, queue_events=300)
    readout, parts = Readout(config), []
    for start in range(0, 1000, 100):
        parts.append(readout.step(events.window(start, start + 100), start + 99))
        assert len(parts[-1]) and parts[-1].t[-1] <= start + 99
    assert readout.late > 100, "the bus is behind"
    sent, everything = Events.concatenate(parts), slow_bus(events, config)
    assert_same(sent, everything.window(0, 1000))
    assert len(sent) + readout.late + readout.dropped == 6000
    assert_same(Events.concatenate([sent, readout.step(Events.empty())]), everything)
    assert readout.late == 0


def test_five_sensors_serve_every_emulator():
    assert len(sensor_names()) >= 5
    for name in sensor_names():
        sensor = load_sensor(name)
        for emulator in ("esim", "v2e", "voltmeter"):
            make_emulator(sensor.emulator(emulator), 4, 5, 0)
    assert (load_sensor("Davis-346").width, load_sensor("DAVIS346").height) == (346, 260)
    assert load_sensor("dvxplorer").emulator("voltmeter").k1 == pytest.approx(1 / 0.24)
    own = V2eConfig(leak_rate_hz=0, shot_noise_rate_hz=0)
    assert load_sensor("gen31_vga").emulator("v2e") == own, "what has no source is the emulator's own"
    known = {name for name in sensor_names() if load_sensor(name).threshold_known}
    assert {"davis240c", "davis346", "dvxplorer", "imx636"} <= known and "gen31_vga" not in known
    assert load_sensor("davis346").emulator("v2e", cutoff_hz=50).cutoff_hz == 50


@pytest.mark.parametrize("name", ["davis240c", "davis346"])
def test_a_davis_is_its_recordings_middle_and_its_units_lie_around(name):
    """Of a file with distributions: the middle stands for the camera, a unit is drawn by its number."""
    for emulator, key in (("esim", "contrast_threshold"), ("v2e", "contrast_threshold"), ("voltmeter", "k1")):
        low, high = sensor_table(name)["emulators"][emulator][key]["log_uniform"]
        units = [getattr(load_sensor(name, unit).emulator(emulator), key) for unit in range(40)]
        assert low <= min(units) < np.sqrt(low * high) < max(units) <= high
        assert getattr(load_sensor(name).emulator(emulator), key) == pytest.approx(np.sqrt(low * high))
    with_resets = load_sensor(name).readout.frame_resets
    assert (with_resets is not None) == (name == "davis240c"), "recordings of the DAVIS346 show none"


def test_every_value_of_every_shipped_sensor_has_a_source():
    for name in sensor_names():
        table = sensor_table(name)
        said = [
            *(key for key in table if key not in ("name", "emulators", "readout", "sources", "uncertainty")),
            *(f"emulators.{emulator}" for emulator in table.get("emulators", {})),
            *(f"readout.{key}" for key in table.get("readout", {})),
        ]
        assert set(said) == set(table["sources"]), name
        assert all(len(text) > 3 and "memory" not in text for text in table["sources"].values())


def test_unknown_names_are_told():
    with pytest.raises(ConfigError, match="davis346"):
        load_sensor("davis999")
    with pytest.raises(ConfigError, match="events.emulator"):
        load_sensor("davis346").emulator("dvs")
    with pytest.raises(ConfigError, match="cutoff_hz"):
        load_sensor("davis346").emulator("v2e", cutof_hz=1)


def still(sensor: SensorConfig, emulator: str, us: int, *, pixels: bool = True, luminance: float = 0.4) -> Events:
    """What that camera makes of constant light."""
    assert sensor.readout is not None
    readout = sensor.readout if pixels else sensor.readout.model_copy(update={"pixels": None})
    camera = EventCamera(sensor.emulator(emulator), readout, sensor.height, sensor.width, 0)
    frame = np.full((sensor.height, sensor.width), luminance, np.float32)
    return Events.concatenate([camera.step(EventFrame(int(t), frame)) for t in np.linspace(0, 1000 * us, 5)])


def half_seconds(config: EmulatorConfig, luminance: float) -> np.ndarray:
    """Rate of a still picture in each half of its first second, Hz a pixel."""
    height, width = 150, 200
    emulator, frame = make_emulator(config, height, width, 3), np.full((height, width), luminance, np.float32)
    counts = [len(emulator.step(frame, k * 5_000_000)) for k in range(201)]
    return np.add.reduceat(counts, [0, 101]) / (height * width * 0.5)


@pytest.mark.parametrize("name", sensor_names())
@pytest.mark.parametrize("emulator", ["esim", "v2e", "voltmeter"])
def test_a_still_scene_is_nearly_silent(name, emulator):
    """From the first half second, in dim and in bright light: not the noise of another camera in another light."""
    for luminance in (0.03, 0.4):
        assert half_seconds(load_sensor(name).emulator(emulator), luminance).max() < 0.02


def test_every_emulator_has_a_sensors_noise():
    """Leak of its ON events in any light, shot noise in the dark, in V2E and in the Voltmeter."""
    sensor = SensorConfig(name="noisy", width=8, height=8, leak_rate_hz=2.0, shot_noise_rate_hz=0.0)
    for emulator, luminance in itertools.product(("v2e", "voltmeter"), (0.03, 0.4)):
        assert half_seconds(sensor.emulator(emulator), luminance) == pytest.approx(2.0, rel=0.05)
    dark = sensor.model_copy(update={"leak_rate_hz": 0.0, "shot_noise_rate_hz": 3.0})
    assert half_seconds(dark.emulator("voltmeter"), 0.0) == pytest.approx(3.0, rel=0.05)


@pytest.mark.parametrize("emulator", ["esim", "v2e", "voltmeter"])
def test_a_dvxplorers_noise_is_its_single_pixels_and_counts_once(emulator):
    """Beside readout.pixels an emulator's own noise is off: nothing of ESIM and V2E, and of the Voltmeter what its
    diffusion sets off."""
    sensor = load_sensor("dvxplorer")
    noise, rest = still(sensor, emulator, 300_000), still(sensor, emulator, 300_000, pixels=False)
    assert len(noise) > 20_000 and len(rest) < 0.01 * len(noise)
    assert len(rest) == 0 or emulator == "voltmeter"
    assert (noise.t % 200 == 0).all()


def test_a_still_scene_is_as_noisy_as_the_recorded_one():
    """Rates and hot pixels of dvxplorer.yaml against the recording; its first half was fitted, so the second judges."""
    events, (_, width), _ = read_recording(shared("data/events/noise/dvxplorer_constant_light.aedat4"), least=1000)
    begin, end = (int(events.t[0]) + int(events.t[-1])) // 2, int(events.t[-1])
    made = still(load_sensor("dvxplorer"), "esim", end - begin)
    halves = [(e, e.y.astype(int) * width + e.x) for e in (events.window(begin, end), made)]
    counts = [np.bincount(pixel) for _, pixel in halves]
    recorded, simulated = (c[c > 0] for c in counts)
    assert ks_2samp(recorded, simulated).statistic < 0.05
    assert abs(len(simulated) / len(recorded) - 1) < 0.1 and abs(simulated.sum() / recorded.sum() - 1) < 0.25
    for least in (5, 50):  # hot pixels
        assert abs((simulated >= least).sum() / (recorded >= least).sum() - 1) < 0.2
    on = [np.bincount(pixel, weights=e.p) for e, pixel in halves]
    theirs, ours = (np.corrcoef(k[n > 1], (n - k)[n > 1])[0, 1] for k, n in zip(on, counts, strict=True))
    assert abs(ours - theirs) < 0.2, "ON and OFF events of a pixel: hot ones prefer either"


# --- The event rate controller and the region of interest.


def _burst(rates_per_period):
    """Return events of the given numbers in periods of 200 µs, evenly within each."""
    t = np.concatenate([200 * k + (np.arange(n) * 200) // max(n, 1) for k, n in enumerate(rates_per_period)])
    x = (np.arange(len(t)) * 7) % 40
    return Events(x=x.astype(np.uint16), y=(x // 2).astype(np.uint16), t=t.astype(np.int64), p=(x % 2).astype(np.uint8))


@pytest.mark.parametrize("chunks", [1, 7, 100])
def test_the_rate_controller_thins_a_burst_evenly_to_its_target(chunks):
    """4,000 events in 200 µs are Prophesee's default, 20 million a second; here a hundredth of that."""
    events = _burst([10, 40, 400, 400, 400, 20, 0, 39, 400])
    readout = Readout(ReadoutConfig(max_rate=40 / 200e-6))
    edges = np.linspace(0, len(events), chunks + 1).astype(int)
    parts = [readout.step(events.part(slice(a, b))) for a, b in itertools.pairwise(edges)]
    kept = Events.concatenate(parts)
    counts = np.bincount(kept.t // 200, minlength=9)
    # Never more than 40; a burst's first period keeps its first 40, later ones every tenth.
    assert counts.tolist() == [10, 40, 40, 40, 40, 19, 0, 39, 40]
    assert readout.dropped == len(events) - len(kept)
    second = kept.t[kept.t // 200 == 3]
    assert np.diff(second).min() >= 4 and np.diff(second).max() <= 6, "even in time"
    first = kept.t[kept.t // 200 == 2] - 400
    assert first.max() < 21


def test_a_rate_controller_that_is_never_needed_changes_nothing():
    events = _burst([30] * 20)
    kept = Readout(ReadoutConfig(max_rate=30 / 200e-6)).step(events)
    assert len(kept) == len(events) and (kept.t == events.t).all()


def test_a_region_of_interest_switches_the_other_pixels_off():
    events = _burst([200])
    kept = Readout(ReadoutConfig(roi=(10, 5, 8, 4))).step(events)
    inside = (events.x >= 10) & (events.x < 18) & (events.y >= 5) & (events.y < 9)
    assert len(kept) == inside.sum() > 0 and set(kept.x) == set(events.x[inside])
    with pytest.raises(ValueError, match="a region without pixels"):
        ReadoutConfig(roi=(10, 5, 0, 4))
    with pytest.raises(EventDataError, match="outside the picture"):
        EventCamera(EmulatorConfig.members["esim"](), ReadoutConfig(roi=(40, 0, 4, 4)), 30, 40, 0)


def test_the_state_of_a_rate_controller_is_saved_with_the_read_out():
    events, config = _burst([400] * 6), ReadoutConfig(max_rate=2e5)
    whole = Readout(config).step(events)
    first = Readout(config)
    begun = first.step(events.part(slice(0, 1111)))
    second = Readout(config)
    second.load_state_dict(first.state_dict())
    rest = second.step(events.part(slice(1111, None)))
    assert (Events.concatenate([begun, rest]).t == whole.t).all() and second.dropped == len(events) - len(whole)


def test_a_recipe_of_another_size_than_its_sensor_says_so():
    assert other_size(None, 3, 2) == other_size("davis240c", 240, 180) == ()
    (line,) = other_size("davis240c", 346, 260)
    assert line == "the sensor DAVIS240C has 240x180 px, the recipe says 346x260 px (camera.width, camera.height)"
