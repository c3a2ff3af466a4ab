"""V2E: frequency response, crossing times, dead time. Its twin is tests/tensors, its noise test_noise_laws.py."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from blinkgl.config.events import V2eConfig
from blinkgl.events import V2e, v2e_model as v2e
from tests.events.clips import run

MS = 10**6
QUIET = dict(threshold_sigma=0.0, leak_rate_hz=0.0, shot_noise_rate_hz=0.0, refractory_us=0.0)


def test_lin_log_is_continuous_and_as_published():
    x = np.array([0, 10, 20, 20.001, 255, 1e5], np.float32)
    expected = np.where(x <= 20, x * np.log(20) / 20, np.log(np.maximum(x, 20)))
    np.testing.assert_allclose(v2e.lin_log(x), expected, rtol=3e-7)


def test_decay_at_the_extremes():
    k = np.concatenate([[0.0], np.logspace(-12, 12, 2000)]).astype(np.float32)
    e, g = v2e.decay(k)
    exact = k.astype(float)
    np.testing.assert_allclose(e, np.exp(-exact), rtol=3e-7, atol=2e-38)
    np.testing.assert_allclose(g[1:], -np.expm1(-exact[1:]) / exact[1:], rtol=3e-7)
    assert g[0] == 1


@pytest.mark.parametrize("k", [1e-6, 0.03, 0.7, 5.0, 300.0])
def test_crossing_is_on_the_exact_curve(k):
    """The curve solves y' = k (x - y) for x linear in time, and the crossing is where that reaches the level."""
    rng = np.random.default_rng(0)
    for _ in range(40):
        base, dx, lag, drift = rng.normal(0, 1, 4) * [1, 1, 0.5, 0.05]
        ode = solve_ivp(
            lambda s, y: k * (base + dx * s - y), (0, 1), [base + lag], rtol=1e-10, atol=1e-12, method="LSODA"
        )
        curve = v2e.curve_of(base, drift, dx, lag, k)
        z = lambda s: v2e.signal_at(s, *curve, k)
        assert abs(z(1.0) - drift - ode.y[0, -1]) < 1e-7
        start, end = z(0.0), z(1.0)
        target = start + rng.uniform(0.05, 0.95) * (end - start)
        s = v2e.crossing_fraction(0.0, target, end > start, *curve, k, end)
        exact = brentq(lambda u: z(u) - target, 0, 1, xtol=1e-14)
        assert abs(z(s) - target) < 2e-6 * abs(end - start) or abs(s - exact) < 2e-6


@pytest.mark.parametrize("ratio", [0.1, 1.0, 8.0])
def test_amplitude_and_phase_response(ratio):
    """A small sinusoid in ln I through the photoreceptor: gain 1/sqrt(1 + r^2), phase -atan r, r = f/f_corner."""
    intensity, cutoff = 100.0, 50.0
    corner = cutoff * (intensity + 20) / 275
    f, n = ratio * corner, 200
    dt = 1 / (f * n)
    emulator = V2e(1, 1, V2eConfig(**QUIET, cutoff_hz=cutoff))
    t = np.arange(int(12 * n)) * dt
    amplitude = 0.02  # small: the corner moves with the intensity
    y = []
    for k, s in enumerate(amplitude * np.sin(2 * np.pi * f * t)):
        emulator.step(np.full((1, 1), intensity / 255 * np.exp(s), np.float32), round(t[k] * 1e9))
        y.append(float(emulator._x[0]) + float(emulator._lag[0]))
    last = slice(-4 * n, None)
    response = (
        2 * np.mean((np.array(y)[last] - np.log(intensity)) * np.exp(-2j * np.pi * f * t[last])) / (amplitude / 1j)
    )
    assert abs(abs(response) - 1 / np.hypot(1, ratio)) < 0.01
    assert abs(np.angle(response) + np.arctan(ratio)) < 0.02


def test_event_times_converge_with_order_two():
    """Filtered sinusoid: event times against those of a very fine run."""

    def times(n):
        emulator = V2e(1, 1, V2eConfig(**QUIET, cutoff_hz=3.0, contrast_threshold=0.1))
        s = np.linspace(0, 1, n + 1)
        intensity = 90 * np.exp(0.9 * np.sin(2 * np.pi * 0.9 * s + 0.4)) / 255
        return (
            run(emulator, [np.full((1, 1), v, np.float32) for v in intensity], np.round(s * 4e9).astype(np.int64)).t
            * 1e-6
        )

    truth = times(20_000)
    spacings = np.array([64, 128, 256, 512])
    errors = []
    for n in spacings:
        t = times(n)
        assert len(t) == len(truth)
        errors.append(np.sqrt(np.mean((t - truth) ** 2)))
    order = -np.polyfit(np.log(spacings), np.log(errors), 1)[0]
    assert abs(order - 2) < 0.3, (order, errors)


def test_refractory_dead_time_on_a_ramp():
    """Intervals on a steady ramp are the dead time plus theta/slope: no backlog, no lost microsecond."""
    theta, slope, dead = 0.2, 400.0, 700.0  # ln units, ln units per second, us
    config = V2eConfig(**{**QUIET, "refractory_us": dead}, cutoff_hz=0.0, contrast_threshold=theta)
    s = np.arange(0, 60) * 1e-4
    emulator = V2e(1, 1, config)
    events = run(
        emulator, [np.full((1, 1), 25 / 255 * np.exp(slope * v), np.float32) for v in s], np.round(s * 1e9).astype(int)
    )
    gaps = np.diff(events.t)
    assert len(gaps) >= 3 and np.abs(gaps - (dead + theta / slope * 1e6)).max() <= 2


def test_no_backlog_after_a_dead_time():
    """A step inside the dead time never comes out."""
    emulator = V2e(1, 1, V2eConfig(**{**QUIET, "refractory_us": 10_000.0}, cutoff_hz=0.0))
    frames = [0.2, 0.25, 0.9, 0.9, 0.9, 0.9]  # one event, then a large step while dead, then nothing
    events = run(
        emulator, [np.full((1, 1), v, np.float32) for v in frames], [0, 2 * MS, 4 * MS, 20 * MS, 40 * MS, 60 * MS]
    )
    assert len(events) == 1
