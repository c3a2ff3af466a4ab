"""The noise of single pixels: what is known comes back, what is not there is not found, and the file can be used."""

from __future__ import annotations

import pytest
import yaml
from shared_data import shared

from blinkgl.cli import run
from blinkgl.config.readout import PixelsConfig
from blinkgl.config.sensor import load_sensor
from blinkgl.errors import EventDataError
from blinkgl.events.pixels import PixelNoise
from blinkgl.io.formats import write_events
from blinkgl.recordings.pixel_noise import fit_pixels, fit_pixels_of
from blinkgl.types.events import Events

SIZE = (200, 300)
KNOWN = PixelsConfig(
    rate_hz=0.3, spread_decades=0.3, hot_fraction=0.01, hot_rate_hz=60, hot_spread_decades=0.4, hot_on_share=0.6,
    hot_on_spread=1.5, on_share=0.65, answered=0.6, answer_ms=20, answer_spread_decades=0.3, refractory_us=1500,
)  # fmt: skip


def recorded(config: PixelsConfig, seconds: float = 4.0, seed: int = 3) -> Events:
    noise = PixelNoise(config, *SIZE, seed)
    noise.step(Events.empty(), 0)
    return noise.step(Events.empty(), round(1e6 * seconds))


@pytest.fixture(scope="module")
def known():
    return fit_pixels_of(recorded(KNOWN), SIZE)


def test_known_values_come_back(known):
    found = known.config
    for key, room in (
        ("rate_hz", 0.1), ("spread_decades", 0.15), ("hot_fraction", 0.15), ("hot_rate_hz", 0.2),
        ("hot_spread_decades", 0.2), ("hot_on_share", 0.06), ("hot_on_spread", 0.1), ("on_share", 0.05),
        ("answered", 0.1), ("answer_ms", 0.15),
        ("answer_spread_decades", 0.2), ("refractory_us", 0.4),
    ):  # fmt: skip
        assert abs(getattr(found, key) / getattr(KNOWN, key) - 1) < room, (key, getattr(found, key))
    assert abs(known.rate_ratio - 1) < 0.1 and known.counts_distance < 0.03 and known.intervals_distance < 0.05
    assert known.undetermined == {}
    for key in ("rate_hz", "hot_rate_hz", "hot_on_share", "hot_on_spread", "answered"):
        assert 0 < known.uncertainty[key] < 0.2 * getattr(KNOWN, key)


def test_what_is_not_there_is_not_found():
    result = fit_pixels_of(recorded(PixelsConfig(rate_hz=0.5)), SIZE)
    assert set(result.undetermined) == {"hot_fraction", "answered", "refractory_us"}
    assert result.config.answered == 0 and result.config.hot_fraction == 0 and result.config.spread_decades < 0.1
    assert abs(result.config.rate_hz / 0.5 - 1) < 0.03


def test_the_command_writes_a_sensor_file_that_can_be_used(tmp_path, capsys):
    events = recorded(KNOWN, seconds=1.0)
    write_events(tmp_path / "still.npz", events, *SIZE)
    out = tmp_path / "mine.yaml"
    options = ["--still", "--emulator", "pixels", "--out", str(out)]
    assert run(["calibrate", str(tmp_path / "still.npz"), *options]) == 0
    said = capsys.readouterr().out
    assert "readout.pixels.answered" in said and "mine.html" in said
    sensor = load_sensor(str(out))
    assert sensor.readout.pixels.answered > 0.4 and (sensor.width, sensor.height) == (300, 200)
    assert (
        "not seen" in out.with_suffix(".html").read_text()
        and "readout.pixels" in yaml.safe_load(out.read_text())["sources"]
    )
    assert run(["calibrate", str(tmp_path / "still.npz"), *options]) == 2  # not written over
    assert "mine.yaml: output file exists" in capsys.readouterr().err
    for wrong, said in (
        (["--emulator", "pixels"], "--emulator: the noise of single pixels is measured in a static scene"),
        (["--emulator", "pixels", "--still", "--set", "a=1"], "--set: this is an option of emulators"),
        (["--emulator", "pixels", "--still", "--sensor", "DVXplorer"], "--sensor: this is an option of emulators"),
    ):
        assert run(["calibrate", str(tmp_path / "still.npz"), *wrong, "--out", str(tmp_path / "no.yaml")]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and said in error and error.count("\n") == 1
    assert not (tmp_path / "no.yaml").exists()


def test_too_few_events_are_refused():
    with pytest.raises(EventDataError, match="too few events to estimate the noise of single pixels"):
        fit_pixels_of(recorded(PixelsConfig(rate_hz=0.001)), SIZE)


@pytest.mark.slow
def test_the_noise_of_a_real_camera():
    """Half of the recording judges what the other was fitted to."""
    path = shared("data/events/noise/dvxplorer_constant_light.aedat4")
    result, _ = fit_pixels(path)
    assert result.counts_distance < 0.05 and 0.7 < result.rate_ratio < 1.4 and 0.4 < result.config.answered < 0.8
