"""Light over time: what waveforms are at each nanosecond, where they jump and turn, and their means, against sums over
densely sampled formulas."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from blinkgl.scene.waveforms import Code, Keys, Pwm, Sine

MS = 1_000_000
WAVES = {
    "sine": (Sine(120, 0.8, 0.1), lambda t: 1 + 0.8 * np.sin(2 * np.pi * (120 * t + 0.1))),
    "pwm": (Pwm(1000, 0.3, 0.25, 0.1), lambda t: np.where((1000 * t + 0.25) % 1 < 0.3, 1.0, 0.1)),
    "thirds": (Pwm(3000, 0.5), lambda t: np.where((3000 * t) % 1 < 0.5, 1.0, 0.0)),
    "code": (Code("1101", 700, 0.2), lambda t: np.array([0.2, 1.0])[(np.floor(700 * t) % 4 != 2).astype(int)]),
    "once": (Code("101", 100, repeat=False), lambda t: np.isin(np.floor(100 * t), (0, 2)).astype(float)),
    "keys": (
        Keys((5 * MS, 10 * MS, 30 * MS), (2.0, 0.5, 1.0)),
        lambda t: np.interp(t, [0.005, 0.01, 0.03], [2, 0.5, 1]),
    ),
    "held": (
        Keys((5 * MS, 10 * MS), (2.0, 0.5), hold=True),
        lambda t: np.where(t < 0.01, 2.0, 0.5),
    ),
}


@pytest.mark.parametrize("name", WAVES)
def test_a_waveform_is_its_formula(name):
    wave, formula = WAVES[name]
    # Between whole microseconds, so that no rounding of an edge to its nanosecond decides.
    times = np.arange(40 * MS // 1000) * 1000 + 500
    factors = np.array([wave.factor(int(t)) for t in times])
    np.testing.assert_allclose(factors, formula(times * 1e-9), atol=1e-9)
    mean = wave.mean(3 * MS, 37 * MS)
    inside = (times > 3 * MS) & (times < 37 * MS)
    assert mean == pytest.approx(formula(times[inside] * 1e-9).mean(), abs=1e-4)


@pytest.mark.parametrize("name", WAVES)
def test_between_its_jumps_and_corners_it_is_monotone_and_no_steeper_than_it_says(name):
    wave, _ = WAVES[name]
    jumps, corners = wave.jumps(0, 40 * MS), wave.corners(0, 40 * MS)
    assert all(wave.factor(t) != wave.factor(t - 1) for t in jumps) and jumps == sorted(set(jumps))
    for a, b in itertools.pairwise([0, *sorted({*jumps, *corners}), 40 * MS]):
        inside = np.linspace(a, b - 1, 200).astype(np.int64)
        factors = np.array([wave.factor(int(t)) for t in inside])
        steps = np.diff(factors)
        assert (steps >= -1e-12).all() or (steps <= 1e-12).all()
        steep = (
            np.abs(steps)
            / np.maximum(np.maximum(factors[1:], factors[:-1]), 0.1)
            / np.maximum(np.diff(inside) * 1e-9, 1e-9)
        )
        assert steep.max() <= wave.steepness(int(inside[100])) * (1 + 1e-6) + 1e-9
    # Outside of them nothing jumps: no neighbouring microseconds differ by more than a smooth change.
    rest = [t for t in range(0, 40 * MS, 1000) if not any(t <= j < t + 1000 for j in jumps)]
    assert max(abs(wave.factor(t + 999) - wave.factor(t)) for t in rest) < 0.002


@pytest.mark.parametrize("duty", [0.0, 1.0])
def test_a_duty_of_nothing_or_all_is_constant(duty):
    wave = Pwm(1e6, duty, low=0.25)
    assert wave.jumps(0, 10 * MS) == [] and wave.per_second() == 0
    assert {wave.factor(t) for t in range(0, 5000, 7)} == {1.0 if duty else 0.25}


def test_an_edge_has_its_own_nanosecond():
    wave = Pwm(1000, 0.3)
    assert wave.jumps(0, 2 * MS) == [300_000, MS, 1_300_000]
    assert [wave.factor(t) for t in (0, 299_999, 300_000, 999_999, MS)] == [1, 1, 0, 0, 1]
    assert Keys((MS, 2 * MS), (1.0, 0.0), hold=True).jumps(0, 3 * MS) == [2 * MS]


def test_keys_that_are_all_zero_are_dark_and_steady():
    wave = Keys((0, 5 * 10**8), (0.0, 0.0))
    assert [wave.steepness(t) for t in (0, 10**8, 5 * 10**8, 10**9)] == [0.0] * 4
    assert Keys((0, 10**9, 2 * 10**9), (0.0, 0.0, 1.0)).steepness(15 * 10**8) > 0


def test_a_code_that_is_shown_once_changes_once():
    once, again = (Code("10", 1e6, repeat=repeat) for repeat in (False, True))
    assert once.per_second() == 0 and again.per_second() == 1e6
    assert once.jumps(-10, 10**9) == [0, 1000]
