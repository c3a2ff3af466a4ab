"""Units of time: stated by names or declared."""

import numpy as np
import pytest

from blinkgl.errors import ConfigError
from blinkgl.io.times import checked_unit, named_unit, nanoseconds


@pytest.mark.parametrize(
    ("heading", "unit"),
    [
        ("t_us", "us"), ("t[us]", "us"), ("#timestamp [ns]", "ns"), ("time (ms)", "ms"), ("Time in seconds", "s"),
        ("t[µs]", "us"), ("t_s", "s"), ("t [s]", "s"), ("timestamps", None), ("t", None), ("events", None), ("s", None),
    ],
)  # fmt: skip
def test_a_name_states_its_unit_or_none(heading, unit):
    assert named_unit(heading) == unit


def test_texts_are_converted_exactly():
    assert nanoseconds(["1403636579.763555584", "1e-3"], "s") == [1403636579763555584, 1_000_000]
    assert nanoseconds(np.array([2**62], np.int64), "ns") == [2**62]


def test_only_four_units_can_be_declared():
    assert checked_unit(None) is None and checked_unit("ms") == "ms"
    with pytest.raises(ConfigError, match="--time-unit: unknown unit of time .got 'min'.; expected s, ms, us, ns"):
        checked_unit("min")
