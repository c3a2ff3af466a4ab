"""Noise by the light: rates, over-dispersion, frame spacing, changing light, and bad curves by message."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import kstest, nbinom

from blinkgl.config.problems import validate
from blinkgl.config.readout import LightNoiseConfig, ReadoutConfig
from blinkgl.config.sensor import load_sensor
from blinkgl.errors import ConfigError
from blinkgl.events.camera import EventCamera, EventFrame, emulate
from blinkgl.types.events import Cause, Events

H, W = 120, 160


def still(camera: EventCamera, luminance: float, seconds: float, frames: int = 21) -> Events:
    times = np.linspace(0, seconds * 1e9, frames).astype(np.int64)
    light = np.full((camera.emulator.height, camera.emulator.width), luminance, np.float32)
    return Events.concatenate([events for _, events in emulate((EventFrame(int(t), light) for t in times), camera)])


def camera_of(sensor: str, emulator: str, size=(H, W), **overrides) -> EventCamera:
    known = load_sensor(sensor)
    return EventCamera(known.emulator(emulator, **overrides), known.readout, *size, 5)


# Noise2Params' Gaussian law at factory biases, as its authors' parameters give it: (lux, ON, OFF), Hz a pixel.
PUBLISHED = [(5, 0.517, 0.647), (10, 0.215, 0.375), (20, 0.043, 0.130), (50, 0.0099, 0.0361), (900, 0.0096, 0.0318)]


@pytest.mark.parametrize("emulator", ["v2e", "voltmeter"])
@pytest.mark.parametrize(("lux", "on", "off"), PUBLISHED)
def test_rates_of_an_imx636_are_the_published_ones_in_every_light(emulator, lux, on, off):
    seconds = 10 if lux <= 20 else 100
    events = still(camera_of("imx636", emulator), lux / 1000, seconds)
    assert np.count_nonzero(events.p) / (H * W * seconds) == pytest.approx(on, rel=0.1)
    assert np.count_nonzero(events.p == 0) / (H * W * seconds) == pytest.approx(off, rel=0.1)


def test_counts_of_pixels_are_negative_binomial():
    events = still(camera_of("imx636", "v2e"), 0.01, 10.0)
    counts = np.bincount(events.pixel(W), minlength=H * W)
    mean = counts.mean()
    law = nbinom(0.5, 0.5 / (0.5 + mean))
    assert kstest(counts + np.random.default_rng(1).uniform(-0.5, 0.5, counts.size), lambda x: (
        # The law of counts spread evenly over their unit, so that it is continuous.
        law.cdf(np.floor(x + 0.5) - 1) + law.pmf(np.floor(x + 0.5)) * (x + 0.5 - np.floor(x + 0.5))
    )).statistic < 0.02  # fmt: skip


def test_noise_does_not_depend_on_the_frames():
    few, many = (still(camera_of("imx636", "v2e"), 0.01, 1.0, frames) for frames in (3, 201))
    assert len(few) > 5000 and few.t.tobytes() == many.t.tobytes() and few.x.tobytes() == many.x.tobytes()


def test_noise_follows_light_that_changes():
    """From 20 to 5 lux in a second: half of the events are where the integral of the law has them."""
    camera = camera_of("imx636", "v2e", contrast_threshold=9.0, threshold_sigma=0)
    dark = lambda t: np.full((H, W), (20 - 15 * t) / 1000, np.float32)
    times = np.linspace(0, 1, 4)
    events = Events.concatenate([e for _, e in emulate((EventFrame(int(t * 1e9), dark(t)) for t in times), camera)])
    lux = 20 - 15 * (np.arange(1000) + 0.5) / 1000
    known = load_sensor("imx636").readout.light_noise
    rate = sum(np.exp(np.interp(np.log(lux), np.log(known.lux), np.log(hz))) for hz in (known.on_hz, known.off_hz))
    law = np.cumsum(rate) / rate.sum()
    assert len(events) / (H * W) == pytest.approx(rate.mean(), rel=0.05)
    assert kstest(events.t / 1e6, lambda t: np.interp(t, np.arange(1000) / 1000, law)).statistic < 0.02


def test_an_emulator_without_noise_says_that_it_leaves_it_out():
    camera = camera_of("imx636", "esim")
    assert not len(still(camera, 0.005, 2.0))
    assert camera.notes == (
        "events: esim models no noise and leaves out readout.light_noise; v2e and voltmeter have it",
    )
    assert camera_of("imx636", "v2e").notes == camera_of("davis346", "esim").notes == ()


def test_without_light_the_darkest_rates_hold_and_causes_are_known():
    events = still(camera_of("imx636", "v2e", causes=True), 0.0, 1.0)
    assert len(events) / (H * W) == pytest.approx(0.572 + 0.599, rel=0.05)
    assert (events.cause == Cause.SHOT).all()


@pytest.mark.parametrize(
    ("tree", "message"),
    [
        ({"lux": [1, 2], "on_hz": [1, 1]}, "light_noise.off_hz: "),
        ({"lux": [2, 1], "on_hz": [1, 1], "off_hz": [1, 1]}, "light_noise.lux: must increase"),
        ({"lux": [1, 2], "on_hz": [1, 1], "off_hz": [1]}, "off_hz: a rate for each light .got 1.*2, as of lux"),
        ({"lux": [], "on_hz": [], "off_hz": []}, "light_noise.lux: "),
        ({"lux": [0, 2], "on_hz": [1, 1], "off_hz": [1, 1]}, r"light_noise.lux\S*: "),
        ({"lux": [1, 2], "on_hz": [1, -1], "off_hz": [1, 1]}, r"light_noise.on_hz\S*: "),
    ],
)  # fmt: skip
def test_bad_curves_are_one_line(tree, message):
    with pytest.raises(ConfigError, match=message) as error:
        validate(ReadoutConfig, {"light_noise": tree})
    assert len(str(error.value).splitlines()) == 1


def test_no_rate_is_no_event():
    config = ReadoutConfig(light_noise=LightNoiseConfig(lux=(1, 1000), on_hz=(0, 0), off_hz=(0, 0)))
    clean = load_sensor("imx636").emulator("v2e")
    assert not len(still(EventCamera(clean, config, 720, 1280, 3), 0.5, 1000.0, 3))


def test_all_pixels_are_alike_without_a_shape():
    config = ReadoutConfig(light_noise=LightNoiseConfig(lux=(1,), on_hz=(2.0,), off_hz=(0,)))
    known = load_sensor("imx636")
    events = still(EventCamera(known.emulator("v2e"), config, H, W, 3), 0.5, 5.0)
    counts = np.bincount(events.pixel(W), minlength=H * W)
    assert (events.p == 1).all() and counts.mean() == pytest.approx(10, rel=0.02)
    assert counts.var() == pytest.approx(10, rel=0.05)  # Poisson
