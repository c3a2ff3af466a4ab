"""Jumps that the resets of a frame camera make: against the times and numbers that ESIM's levels give for them."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.config.readout import FrameResetsConfig, ReadoutConfig
from blinkgl.config.sensor import load_sensor
from blinkgl.events import Events, resets as resets_module
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.events.resets import BEFORE, RISE_NS

H, W, MS = 20, 30, 1_000_000
EXACT = EsimConfig(contrast_threshold=0.2, contrast_threshold_off=0.17, threshold_sigma=0.0, log_eps=1e-6)


def events_of(frames, resets=None, config=EXACT):
    readout = None if resets is None else ReadoutConfig(frame_resets=resets)
    camera = EventCamera(config, readout, H, W, 0)
    out = Events.concatenate([events for _, events in emulate((EventFrame(t, f) for t, f in frames), camera)])
    assert camera.frames == len(frames)  # what is shown in between is nobody's frame
    return out


def still(times_ms):
    return [(round(t * MS), np.full((H, W), 0.3, np.float32)) for t in times_ms]


@pytest.mark.parametrize("times_ms", [[0, 40], np.arange(0, 40.01, 0.25), [0, 1.13, 7.2, 7.9, 30, 40]])
def test_a_still_pixel_fires_as_the_jump_passes_its_levels_whenever_frames_come(monkeypatch, times_ms):
    """Up by 2.5 thresholds and down again: one or two events each way, at the crossings of straight lines, from the
    level at which the resets before the first frame have left the pixels."""
    monkeypatch.setattr(FrameResetsConfig, "length_ms", 2.0)
    resets = FrameResetsConfig(interval_ms=20, kick=0.5 / 0.17, first_ms=5)
    events, level, expected = events_of(still(times_ms), resets), 0.0, []
    for number in range(-BEFORE, 2):
        ups, downs = [], []
        while level + 0.2 <= 0.5:
            ups.append(level := level + 0.2)
        while level - 0.17 >= 0:
            downs.append(level := level - 0.17)
        rises = [RISE_NS / 1000 * up / 0.5 for up in ups]
        falls = [RISE_NS / 1000 + 2000 * (1 - down / 0.5) for down in downs]
        if number >= 0:
            reset = 5000 + 20_000 * number
            expected += [(reset + t, p) for times, p in ((rises, 1), (falls, 0)) for t in times]
    at, polarity = np.repeat(np.array(expected), H * W, axis=0).T
    assert len(events) == len(at) > 4 * H * W and (events.p == polarity).all()
    assert np.abs(events.t - at).max() <= 2


def test_of_moving_pixels_the_share_fires_that_stands_within_the_jump_of_its_threshold():
    """Light that rises slowly, each pixel at another phase: a jump of a tenth of a threshold takes a tenth of them."""
    rng = np.random.default_rng(0)
    start, slope = rng.uniform(-0.2, 0, (H, W)), 0.2 / 0.2  # a threshold in 0.2 s
    frames = [(t * MS, np.exp(start + slope * t / 1000).astype(np.float32)) for t in range(0, 401, 5)]
    first = [(0, np.ones((H, W), np.float32)), *[(t + MS, f) for t, f in frames]]  # phases: levels hang on the first
    resets = FrameResetsConfig(interval_ms=50, kick=0.02 / 0.17, first_ms=21)
    quiet, jumping = events_of(first), events_of(first, resets)
    times = np.arange(21, 400, 50)
    burst = sum(len(jumping.window(t * 1000, t * 1000 + 300)) for t in times if t > 200)
    expected = 0.1 * H * W * np.count_nonzero(times > 200)
    assert abs(burst - expected) < 4 * np.sqrt(expected)
    # They fire before their time, and not instead of other events.
    assert abs(len(jumping.window(250_000, 400_000)) - len(quiet.window(250_000, 400_000))) < 0.15 * H * W
    after = [(e.window(t * 1000 + 300, t * 1000 + 1300)).p.sum() for e in (quiet, jumping) for t in times if t > 200]
    assert sum(after[4:]) < 0.2 * sum(after[:4])  # those that would have come next have come


def test_codes_and_rows_are_as_light_and_whole_frames(monkeypatch):
    monkeypatch.setattr(resets_module, "BEFORE", 3)  # of a kick so high that pixels end between two levels
    light = np.linspace(0.1, 0.9, H * W).reshape(H, W).astype(np.float32)
    resets = FrameResetsConfig(interval_ms=10, kick=0.3 / 0.17, first_ms=2.9)
    whole = events_of([(t * MS, light) for t in range(12)], resets)
    camera = EventCamera(EXACT, ReadoutConfig(frame_resets=resets), H, W, 0)
    parts = [camera.step(EventFrame(t * MS, light, (3, 5) if t else None)) for t in range(12)]
    assert len(whole) and Events.concatenate(parts).t.tolist() == whole.t.tolist()
    codes = EventCamera(EXACT, ReadoutConfig(frame_resets=resets), H, W, 0)
    coded = [codes.step(EventFrame(t * MS, np.full((H, W), 80, np.uint8))) for t in range(12)]
    assert len(Events.concatenate(coded)) == 2 * H * W and codes.tensor_device is None


SHARP = dict(preset="clean", threshold_sigma=0.0, contrast_threshold=0.2, contrast_threshold_off=0.26)


@pytest.mark.parametrize("luminance", [0.1, 0.6])
@pytest.mark.parametrize(
    ("config", "kick", "expected"),
    [
        (V2eConfig(**SHARP, cutoff_hz=0.0), 2.2, 2.0),  # level before each: 0, 0.7, 0.4, 0.1 thresholds
        (V2eConfig(**SHARP, cutoff_hz=150.0), 0.9, 0.0),  # behind a low-pass
        (V2eConfig(**SHARP, cutoff_hz=150.0), 1.8, 0.0),  # 0, 1, 1, 1
        (V2eConfig(**SHARP, cutoff_hz=150.0), 2.2, 2.0),
        (V2eConfig(**SHARP, cutoff_hz=150.0), 3.2, 2.0),  # 0, 0.4, 1.1, 0.5
        (VoltmeterConfig(k1=5.0, k2=1.0), 0.9, 0.0),
        (VoltmeterConfig(k1=5.0, k2=1.0), 1.5, 0.5),  # from anywhere between two levels
        (VoltmeterConfig(k1=5.0, k2=1.0), 2.5, 1.5),
    ],
)
def test_the_signal_of_any_emulator_jumps_by_so_many_thresholds(monkeypatch, config, kick, expected, luminance):
    """A low-pass that light has to go through takes nothing of it. The fourth jump counts, after three before the first
    frame."""
    monkeypatch.setattr(resets_module, "BEFORE", 3)
    light = [(t * MS, np.full((H, W), luminance, np.float32)) for t in range(40)]
    events = events_of(light, FrameResetsConfig(interval_ms=100, kick=kick, first_ms=10), config)
    quiet = events_of(light, None, config)
    on = lambda one: int(one.window(10_000, 10_400).p.sum())
    assert abs((on(events) - on(quiet)) / (H * W) - expected) < 0.1
    assert not expected or np.ptp(events.window(10_000, 10_400).t) < 305


def test_the_highest_jump_stays_within_the_emulators_range():
    light = [(t * MS, np.full((H, W), 1e9, np.float32)) for t in range(20)]
    resets = FrameResetsConfig(interval_ms=100, kick=5, first_ms=5)
    config = EsimConfig(contrast_threshold=0.05, contrast_threshold_off=0.05)
    assert len(events_of(light, resets, config)) > 0
    high = EsimConfig(contrast_threshold=5.0)
    assert len(events_of([(t, one / 1e9) for t, one in light], resets, high)) > 0


def test_a_still_davis240c_of_the_voltmeter_is_quiet_from_its_first_frame_on():
    """Recorded: .005 Hz a pixel. Diffusion brings pixels near their thresholds again, and resets carry them over."""
    known = load_sensor("davis240c")
    camera = EventCamera(known.emulator("voltmeter"), known.readout, 120, 160, 1)
    frames = (EventFrame(t * 10 * MS, np.full((120, 160), 0.5, np.float32)) for t in range(51))
    assert sum(len(events) for _, events in emulate(frames, camera)) / (120 * 160 * 0.5) <= 0.02


@pytest.mark.parametrize(
    "config",
    [
        EsimConfig(contrast_threshold=0.2, contrast_threshold_off=0.3),
        V2eConfig(preset="clean", contrast_threshold=0.2, cutoff_hz=150.0, leak_rate_hz=0.5, start="stationary"),
        VoltmeterConfig(k1=5.0, k3=0.0, k4=5e-7, k5=0.0, k6=0.0),
    ],
    ids=lambda config: config.emulator,
)
def test_a_still_scene_is_as_still_at_first_as_later(config):
    """Resets bring pixels over their threshold that leak brings near it, and no others: as many per second from the
    first frame on."""
    frames = [(t * 10 * MS, np.full((H, W), 0.4, np.float32)) for t in range(401)]
    events = events_of(frames, FrameResetsConfig(interval_ms=40, kick=0.4, first_ms=3), config)
    early, late = (len(events.window(*span)) / (H * W) / 2 for span in ((0, 2_000_000), (2_000_000, 4_000_000)))
    leak = {"esim": 0.0, "v2e": 0.5, "voltmeter": 0.5}[config.emulator]
    assert abs(early - leak) < 0.08 and abs(late - leak) < 0.08
