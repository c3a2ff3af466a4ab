"""Frame times: exact grids, and a displacement bound that holds."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

from blinkgl.timeline import displacement_times, uniform_times

MS = 1_000_000


def test_uniform_times_do_not_drift():
    times = list(uniform_times(300.0, 5, 5 + 10_000 * MS))
    assert times[0] == 5 and times[-1] == 5 + 10_000 * MS and len(times) == 3001
    assert times[300] == 5 + 1000 * MS, "rounding is per frame, so whole seconds are hit exactly"
    assert set(np.diff(times)) == {3_333_333, 3_333_334}


def test_uniform_end_is_included_even_off_the_grid():
    assert list(uniform_times(1000.0, 0, 2_500_000)) == [0, 1 * MS, 2 * MS, 2_500_000]


@pytest.mark.parametrize("speed, expected", [(0.0, 20 * MS), (100.0, 49 * MS // 10), (1e9, 1 * MS)])
def test_constant_speed_gives_the_obvious_step(speed, expected):
    times = list(displacement_times(0.5, 1 * MS, 20 * MS, 0, 200 * MS, lambda t: speed))
    assert times[0] == 0 and times[-1] == 200 * MS
    assert set(np.diff(times)[:-1]) == {expected} and 0 < times[-1] - times[-2] <= expected


def test_acceleration_inside_a_step_is_noticed():
    """Speed 10 px/s, then 1000 px/s from 50 ms on: the step that meets the jump has to be cut."""
    speed = lambda t: 10.0 if t < 50 * MS else 1000.0
    times = np.array(list(displacement_times(0.5, MS // 10, 20 * MS, 0, 100 * MS, speed)))
    for a, b in itertools.pairwise(times):
        assert max(speed(a), speed(b)) * (b - a) <= 0.5 * 1e9 * 1.001 or b - a <= MS // 10 + 1


@settings(max_examples=60, deadline=None)
@given(st.floats(0.05, 5), st.floats(0, 5000), st.floats(0, 2000), st.floats(0.5, 40), st.integers(0, 10**15))
def test_bound_and_order_hold_for_any_oscillation(max_px, mean, swing, rate, t0):
    low, high = MS // 10, 20 * MS
    speed = lambda t: abs(mean + swing * math.sin(2 * math.pi * rate * (t - t0) * 1e-9))
    times = np.array(list(displacement_times(max_px, low, high, t0, t0 + 100 * MS, speed)), dtype=np.int64)
    steps = np.diff(times)
    assert times[0] == t0 and times[-1] == t0 + 100 * MS
    assert (steps > 0).all() and (steps <= high).all() and (steps[:-1] >= low).all()
    for a, step, b in zip(times[:-1], steps, times[1:]):
        assert max(speed(a), speed(b)) * step <= max_px * 1e9 * (1 + 1e-6) or step <= low


@pytest.mark.parametrize("speed", [lambda t: 100 + 60 * np.sin(t / 3e7), lambda t: 5e-6 * t, lambda t: 300 - 2e-6 * t])
def test_few_steps_are_refused_where_the_pace_changes_smoothly(speed):
    """A tenth more paces than frames at most, and a tenth more frames than the bound takes."""
    asked = []
    times = list(displacement_times(0.5, MS // 10, 20 * MS, 0, 100 * MS, lambda t: asked.append(t) or speed(t)))
    least = np.trapezoid(speed(np.linspace(0, 100 * MS, 10_001)), dx=1e-5) / 0.5
    assert len(asked) <= 1.1 * len(times)
    assert len(times) <= 1.1 * least + 2
