"""The emulators where thresholds, intervals, clocks, counts and durations are extreme;
against closed forms and exact integers."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, make_emulator
from blinkgl.events.arith import Q_ONE, log_q25
from tests.render.render_scenes import SECOND

DAY = 86_400 * SECOND
LONGEST = 1000 * SECOND  # below the emulators' limit of 17 minutes
EVERY = {"esim": EsimConfig(), "v2e": V2eConfig(), "voltmeter": VoltmeterConfig()}
QUIET = {
    "esim": EsimConfig(threshold_sigma=0.02),
    "v2e": V2eConfig(preset="clean"),
    "voltmeter": VoltmeterConfig(k3=0, k4=0, k5=0, k6=0),
}


def picture(seed=0, shape=(12, 16), low=0.05, high=1.0):
    return np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)


def plain(c, **keys):
    return EsimConfig(contrast_threshold=c, threshold_sigma=0, log_eps=1e-9, **keys)


@pytest.mark.parametrize("c", [1e-3, 1e-2, 1.0, 10.0])
def test_thresholds_from_a_thousandth_to_ten(promise, c):
    """Times on a straight line in ln I. The level is a multiple of C rounded to 2^-25 (1.5e-8 each): the j-th is j
    1.5e-8 off, and the line's ends 1.3e-7."""
    rise = 35.0
    esim = Esim(1, 1, plain(c))
    esim.step(np.full((1, 1), 1e-9 + 1e-7, np.float32), 0)
    start = np.log(np.float64(np.float32(1e-9 + 1e-7)) + 1e-9)
    top = np.float32(np.exp(start + rise))
    events = esim.step(np.full((1, 1), top, np.float32), 100 * SECOND)
    rise = np.log(np.float64(top) + 1e-9) - start
    count = int(rise / c)
    promise(f"C = {c:g}: events too many or few of {count}", abs(len(events) - count), 1)
    n = min(len(events), count)
    expected = np.arange(1, n + 1) * c / rise * 1e8  # us
    bound = (n * 1.5e-8 + 2.6e-7) / rise * 1e8 + 1.0
    promise(f"C = {c:g}: event times over 100 s", np.abs(events.t[:n] - expected).max(), bound, "us")


@pytest.mark.parametrize("interval_ns", [1, 999, 10**6, 100 * SECOND])
@pytest.mark.parametrize("emulator", EVERY)
def test_frame_intervals_from_a_nanosecond_to_100_seconds(emulator, interval_ns):
    """Sorted, inside the interval, to the microsecond; nothing more is promised of noise over 100 s."""
    run, last = make_emulator(EVERY[emulator], 12, 16, 3), 0
    total = 0
    for k in range(6):
        t = 7_777_777 + k * interval_ns
        events = run.step(picture(k % 2), t)
        assert (np.diff(events.t) >= 0).all()
        if len(events):
            assert events.t[0] >= last // 1000 and events.t[-1] <= t // 1000
        last, total = t, total + len(events)
    if emulator != "v2e" or interval_ns > 1e5:  # its low-pass sees nothing of a change within a microsecond
        assert total > 100


def test_times_are_exact_at_any_clock(promise):
    """Shifting the clock by 10^6 s, or 10^9, shifts the events and changes nothing else: times
    are integers throughout."""
    frames, times = [picture(k) for k in range(6)], np.cumsum([0, 1, 999_999, 10**6, 33_333_333, SECOND])
    runs = []
    for shift in (0, 10**6 * SECOND, 10**9 * SECOND):
        esim = Esim(12, 16, EsimConfig(threshold_jitter=0.02, refractory_us=100), seed=5)
        events = [esim.step(f, int(t) + shift) for f, t in zip(frames, times)]
        runs.append(
            [np.concatenate([getattr(e, k) for e in events]) - (shift // 1000 if k == "t" else 0) for k in "xytp"]
        )
    for other in runs[1:]:
        for a, b in zip(runs[0], other):
            np.testing.assert_array_equal(a, b)
    assert len(runs[0][0]) > 2000
    promise("ESIM, clock at 1e6 s and 1e9 s: change of any event", 0, 0)


def test_ten_thousand_events_per_pixel(promise):
    """One frame pair, every one of the events at its own time: ln I rises by 10, C = 0.001."""
    esim = Esim(3, 4, plain(0.001))
    low, high = np.full((3, 4), 1e-3, np.float32), np.full((3, 4), 1e-3 * np.exp(10.0005), np.float32)
    esim.step(low, 0)
    events = esim.step(high, SECOND)
    per_pixel = np.bincount(events.y.astype(int) * 4 + events.x, minlength=12)
    promise("10^4 events per pixel: too many or few", np.abs(per_pixel - 10_000).max(), 1)
    mine = events.t[(events.x == 1) & (events.y == 2)]
    expected = np.arange(1, len(mine) + 1) * 1e-3 / 10.0005 * 1e6
    # 10^4 x 1.5e-8 / 10 of 1 s, + 1 us + ends.
    promise("10^4 events per pixel: event times over 1 s", np.abs(mine - expected).max(), 18.0, "us")
    assert esim.saturated == 0 and (np.diff(events.t) >= 0).all()
    back = esim.step(low, 2 * SECOND)
    assert len(back) == len(events)


def test_more_events_than_asked_for_are_cut_and_counted():
    esim = Esim(32, 32, plain(0.001, max_events_per_step=10_000))
    esim.step(np.full((32, 32), 1e-3, np.float32), 0)
    events = esim.step(np.full((32, 32), 1e3, np.float32), SECOND)
    wanted = 1024 * int(np.log(1e6) / 0.001)
    assert len(events) <= 10_000 and abs(len(events) + esim.saturated - wanted) <= 1024


def soak(frames: int, emulator, shape=(4, 8)):
    """A flickering picture with a slow trend: (ON - OFF events per pixel, first frame, last frame)."""
    base, net, t = picture(1, shape), np.zeros((2, *shape), np.int64), 0
    wobble = picture(2, (64, *shape), 0.3, 3.0)
    first = last = (base * wobble[0]).astype(np.float32)
    emulator.step(first, 0)
    for k in range(1, frames):
        last = base * wobble[k % 64] if k < frames - 1 else first
        t += 1_000_003
        events = emulator.step(last, t)
        np.add.at(net, (events.p, events.y, events.x), 1)
    return net, first, last


@pytest.mark.parametrize("frames", [20_000, pytest.param(1_000_000, marks=pytest.mark.slow)])
def test_references_do_not_drift(promise, frames):
    """ESIM's reference after N frames is the first log plus (ON C+ - OFF C-), in integers: exact, hence no drift at any
    N. (A float32 reference would have moved by 2^-24 x 4 x sqrt(events): 1e-4 to 1e-3 after 10^6 frames.)"""
    esim = Esim(4, 8, EsimConfig(threshold_sigma=0.03), seed=1)
    net, first, _ = soak(frames, esim)
    assert net.sum() > 50 * frames
    reference = esim._upper.astype(np.int64) - esim._on
    expected = (
        log_q25(first + np.float32(1e-3)).ravel().astype(np.int64)
        + net[1].ravel() * esim._on
        - net[0].ravel() * esim._off
    )
    promise(
        f"ESIM, {frames:.0e} frames, {net.sum():.0e} events: drift of the reference",
        np.abs(reference - expected).max() / Q_ONE,
        0.0,
        "ln",
    )


@pytest.mark.parametrize("frames", [5_000, pytest.param(200_000, marks=pytest.mark.slow)])
def test_v2e_reference_drift(promise, frames):
    """V2E keeps float32 levels of size 4 to 8 ln units, rounded to 4.8e-7 at every event, 1.4e-7 rms. A clip that
    repeats after 150 events per pixel repeats its roundings, so that their mean, 1.4e-7 / sqrt(150), adds up: 1.1e-8
    per event, three times that in the worst of 32 pixels. (At the default leak rate the leak moves
    the reference a hundred times faster.)"""
    run = make_emulator(V2eConfig(preset="clean", threshold_sigma=0.0), 4, 8, 1)
    net, _first, _ = soak(frames, run)
    assert net.sum() > 20 * frames
    start = run._x.astype(np.float64)  # the last frame is the first one
    expected = start + (net[1] - net[0]).ravel() * np.float64(np.float32(0.2))
    drift = np.abs(run._upper.astype(np.float64) - np.float64(np.float32(0.2)) - expected).max()
    promise(
        f"V2E, {frames:.0e} frames, {net.sum():.0e} events: drift of the reference",
        drift,
        4e-8 * net.sum(0).max(),
        "ln",
    )


@pytest.mark.parametrize("emulator", QUIET)
@pytest.mark.parametrize("interval", [LONGEST, 1, 30 * SECOND])
def test_a_still_day_makes_no_event(promise, emulator, interval):
    run, frame = make_emulator(QUIET[emulator], 12, 16, 2), picture()
    steps = min(DAY // interval, 3000)
    events, t = len(run.step(frame, 0)), 0
    for k in range(1, steps + 1):
        t = DAY * k // steps if interval > 1 else k
        events += len(run.step(frame, t))
    state = run.state_dict()
    promise(f"{emulator}, a still day in {steps} frames: events", events, 0)
    moved = picture() * np.float32(np.exp(0.5))
    a = run.step(moved, t + SECOND)
    other = make_emulator(QUIET[emulator], 12, 16, 2)
    other.step(frame, t)
    b = other.step(moved, t + SECOND)
    assert len(a) > 100 and state["clock"][3] == 0
    for k in "xytp":
        np.testing.assert_array_equal(getattr(a, k), getattr(b, k))  # as if the day had not been


def test_beyond_the_limits_there_is_a_message():
    esim, frame = Esim(2, 2), np.ones((2, 2), np.float32)
    esim.step(frame, 0)
    with pytest.raises(EventDataError, match="time stamp out of range .* at most 17 minutes between two frames"):
        esim.step(frame, 2000 * SECOND)
    with pytest.raises(EventDataError, match="time stamp out of range"):
        Esim(2, 2).step(frame, 2**61)
    for c in (9e-4, 10.1):
        with pytest.raises(ValueError):
            EsimConfig(contrast_threshold=c)
