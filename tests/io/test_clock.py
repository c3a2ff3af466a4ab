"""Units of time: stated by names, guessed from a whole list, never value by value."""

import numpy as np
import pytest

from blinkgl.errors import ConfigError, EventDataError
from blinkgl.io.clock import TimeUnit, checked_unit, guessed_frame_unit, named_unit, nanoseconds


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("t_us", "us"), ("t[us]", "us"), ("#timestamp [ns]", "ns"), ("time (ms)", "ms"), ("Time in seconds", "s"),
        ("t[µs]", "us"), ("t_s", "s"), ("t [s]", "s"), ("timestamps", None), ("t", None), ("events", None), ("s", None),
    ],
)  # fmt: skip
def test_a_name_states_its_unit_or_none(heading, unit):
    assert named_unit(heading) == unit


@pytest.mark.parametrize("hz", [1, 8, 30, 1000, 2000])
@pytest.mark.parametrize(("unit", "ns"), [("s", 1e9), ("ms", 1e6), ("us", 1e3), ("ns", 1)])
def test_times_of_this_century_betray_their_unit_at_any_rate(hz, unit, ns):
    values = (1.7e9 + np.arange(10) / hz) * 1e9 / ns
    assert guessed_frame_unit(values, "list").name == unit


@pytest.mark.parametrize(
    ("values", "unit"),
    [
        ([1, 1.01, 1.02, 1.03], "s"),  # a whole number among them changes nothing
        ([0, 33, 67, 100], "ms"), ([33.3, 66.6, 100.0], "ms"), ([0, 33333, 66667], "us"),
        ([0, 33_333_333, 66_666_667], "ns"), ([0, 0.0005, 0.001], "s"),
        ([0, 33, 67, 60_067, 60_100], "ms"),  # a minute's pause
    ],
)  # fmt: skip
def test_one_unit_is_guessed_from_the_whole_list(values, unit):
    found = guessed_frame_unit(np.array(values, float), "list")
    assert found.name == unit and f"taken as {unit}" in found.line and "--time-unit" in found.line


@pytest.mark.parametrize(
    "values", [[0.01, 0.02, 0.03, 40_000, 50_000, 60_000], [10_000, 20_000, 0.03, 0.04], [0.1, 0.2, 0.3, 400_000]]
)
def test_two_units_in_one_list_are_refused(values):
    with pytest.raises(EventDataError, match="list: frames 1|list: frames 2") as raised:
        guessed_frame_unit(np.array(values), "list")
    assert "times in two units" in str(raised.value) and "--time-unit" in str(raised.value)


def test_texts_are_converted_exactly():
    assert nanoseconds(["1403636579.763555584", "1e-3"], TimeUnit("s", "read")) == [1403636579763555584, 1_000_000]
    assert nanoseconds(np.array([2**62], np.int64), TimeUnit("ns", "read")) == [2**62]


def test_only_four_units_can_be_declared():
    assert checked_unit(None) is None and checked_unit("ms") == "ms"
    with pytest.raises(ConfigError, match="--time-unit: unknown unit of time .got 'min'.; expected s, ms, us, ns"):
        checked_unit("min")
