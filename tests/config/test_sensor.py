"""Sensor files: what they may say, distributions over units, and where a run takes them from."""

from __future__ import annotations

import pytest

from blinkgl.config.draw import middle
from blinkgl.config.run import RunTemplate, load_run
from blinkgl.config.sensor import load_sensor
from blinkgl.errors import ConfigError

UNITS = """
name: three of a kind
width: 40
height: 30
contrast_threshold: 0.3
refractory_us: 200
emulators:
  esim: {contrast_threshold: {uniform: [0.2, 0.4]}, log_eps: {log_uniform: [0.01, 0.04]}}
  v2e: {choice: [{cutoff_hz: 30}, {cutoff_hz: 60, contrast_threshold: 0.25}, {cutoff_hz: 90}]}
readout: {events_per_second: 1.0e+6}
sources: {emulators.esim: fitted to three recordings, contrast_threshold: a data sheet}
uncertainty: {emulators.esim.log_eps: 0.002}
"""


@pytest.fixture
def units(tmp_path):
    (tmp_path / "units.yaml").write_text(UNITS)
    return tmp_path / "units.yaml"


def test_the_middle_and_the_units(units):
    camera = load_sensor(str(units))
    esim = camera.emulator("esim")
    assert (esim.contrast_threshold, esim.log_eps) == (pytest.approx(0.3), pytest.approx(0.02))
    assert esim.refractory_us == 200, "what holds for any emulator holds where its own table says nothing"
    v2e = camera.emulator("v2e")
    assert (v2e.cutoff_hz, v2e.contrast_threshold) == (60, 0.25) and v2e.leak_rate_hz == 0.01, "null: the default"
    drawn = [load_sensor(str(units), unit) for unit in range(40)]
    thresholds = [one.emulator("esim").contrast_threshold for one in drawn]
    assert 0.2 <= min(thresholds) < 0.23 and 0.37 < max(thresholds) < 0.4
    assert {one.emulator("v2e").cutoff_hz for one in drawn} == {30, 60, 90}
    assert load_sensor(str(units), 3) == drawn[3]


def test_what_the_middle_of_a_distribution_is():
    tree = {
        "a": {"uniform": [1, 2]},
        "b": {"log_uniform": [1, 4]},
        "c": {"integer": [1, 4]},
        "d": {"choice": [1, 2, 3, 4]},
        "e": {"weighted": {"x": 1, "y": 5, "z": 1}},
        "f": {"shares": [{"share": 0.5, "value": {"uniform": [2, 4]}}, {"share": 0.5, "value": 9}]},
        "g": {"weighted": {"x": 1, "y": 0, "z": 1.5}},
    }
    assert middle(tree) == {"a": 1.5, "b": pytest.approx(2), "c": 2, "d": 2, "e": "y", "f": 3.0, "g": "z"}


def test_a_run_draws_a_unit_a_sequence_and_says_which(units, tmp_path):
    (tmp_path / "run.yaml").write_text("sensor: units.yaml\noutput: {sequences: 30}\n")
    template = load_run(tmp_path / "run.yaml")
    drawn = [template.sequence(k) for k in range(30)]
    assert {c.camera.width for c in drawn} == {40} and drawn[0].readout.events_per_second == 1e6
    thresholds = {c.events.contrast_threshold for c in drawn}
    assert len(thresholds) == 30 and min(thresholds) >= 0.2 and max(thresholds) < 0.4
    for c in drawn:
        assert c.sensor.emulators["esim"]["contrast_threshold"] == c.events.contrast_threshold
    units.unlink()  # the template says all by itself, as workers in other folders need
    assert RunTemplate(template.tree, tmp_path / "elsewhere").sequence(3) == drawn[3]


def test_a_sensor_of_a_choice_and_of_a_group(units, tmp_path):
    recipe = """
    sensor: davis346
    groups:
      a: {sensor: {choice: [units.yaml, dvxplorer]}, output: {sequences: 20}}
      b: {sensor: {name: mine, width: 12, height: 8}, events: {contrast_threshold: 0.5}}
      c: {}
    """
    (tmp_path / "run.yaml").write_text(recipe)
    a, b, c = load_run(tmp_path / "run.yaml").groups
    assert {a.template.sequence(k).camera.width for k in range(20)} == {40, 640}
    one = b.template.sequence(0)
    assert (one.camera.width, one.events.contrast_threshold, one.readout) == (12, 0.5, None)
    assert c.template.sequence(0).sensor.name == "DAVIS346", "its values are drawn, so a sequence says which"


@pytest.mark.parametrize(
    "change, where, problem",
    [
        (("width: 40", "width: 0"), "width", "too small"),
        (("width: 40", "wide: 40"), "wide", "unknown key"),
        (("[0.2, 0.4]", "[0.2, 40]"), "emulators.esim.contrast_threshold", "too large"),
        (("esim: {contrast_threshold", "esim: {kontrast"), "emulators.esim.kontrast", "unknown key"),
        (("  esim:", "  dvs:"), "emulators", "unknown emulator"),
        (("esim: {contrast", "esim: {emulator: v2e, contrast"), "emulators.esim", "name of the table"),
        (("{emulators.esim: f", "{emulators.voltmeter: f"), "sources", "no such value"),
        (("uncertainty: {emulators", "uncertainty: {emulatorz"), "uncertainty", "no such value"),
        (("[{cutoff_hz: 30}", "[{cutoff_hz: -1}"), "emulators.v2e.cutoff_hz", "too small"),
        (
            ("v2e: {choice: [{cutoff_hz: 30}", "v2e: {choice: [{cutoff_hz: 0, photoreceptor_noise: true}"),
            "emulators.v2e",
            "needs cutoff_hz",
        ),
    ],
)
def test_a_bad_file_is_refused_when_it_is_read(units, tmp_path, change, where, problem):
    assert change[0] in UNITS
    units.write_text(UNITS.replace(*change))
    (tmp_path / "run.yaml").write_text("sensor: units.yaml\n")
    for read in (lambda: load_sensor(str(units)), lambda: load_run(tmp_path / "run.yaml")):
        with pytest.raises(ConfigError, match=problem) as caught:
            read()
        assert caught.value.where == f"{units}.{where}"


def test_files_that_are_not_there_or_no_sensor(tmp_path):
    with pytest.raises(ConfigError, match="nothing.yaml"):
        load_sensor(str(tmp_path / "nothing.yaml"))
    (tmp_path / "list.yaml").write_text("- 3\n")
    with pytest.raises(ConfigError, match="not a table of keys"):
        load_sensor(str(tmp_path / "list.yaml"))
    with pytest.raises(ConfigError, match="or a sensor file"):
        load_sensor("davis999")
