"""V2E: frequency response, crossing times, dead time. Its twin is tests/tensors, its noise test_random.py."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from blinkgl.config.events import V2eConfig, VoltmeterConfig
from blinkgl.events import V2e, make_emulator, v2e_model as v2e
from blinkgl.events.noise import noise_size
from tests.events.clips import run
from tests.events.noise_laws import shot_rate

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


# --- Photoreceptor noise with a dead time: the events of the stated equation, at the rate that is asked for. The
# equation: stationary Gaussian noise of the low-pass's correlation, seen at the frames and on straight lines between
# them; an event where it has gone a threshold from the reference; for the dead time nothing, then the reference is
# the noise. It is simulated here in NumPy, all pixels at once, without the emulator's kernels.

LEVEL, THETA, DEAD_S, SIDE = 0.4, 0.2, 1e-3, 30
FRAMES = {"50": 50.0, "500": 500.0, "5000": 5000.0, "uneven": None}


def frame_times(fps: float | None, seconds: float) -> np.ndarray:
    """int64 ns; None: from 0.2 to 20 ms apart, log-uniform."""
    if fps:
        return np.round(np.arange(round(seconds * fps) + 1) * 1e9 / fps).astype(np.int64)
    steps = np.exp(np.random.default_rng(8).uniform(np.log(0.2), np.log(20), round(seconds * 1200))) * 1e6
    times = np.concatenate([[0], np.cumsum(steps.astype(np.int64))])
    return times[times <= seconds * 1e9]


def exact(times_ns: np.ndarray, rate_hz: float, cutoff_hz: float, pixels: int, seed: int) -> list[np.ndarray]:
    """Times of events of each pixel, s."""
    rng, corner = np.random.default_rng(seed), 2 * np.pi * cutoff_hz * (255 * LEVEL + 20) / 275
    noise = THETA * noise_size(0.0, rate_hz / corner) * rng.normal(size=pixels)
    reference, asleep, release = noise.copy(), np.zeros(pixels, bool), np.zeros(pixels)
    fired: list[tuple[np.ndarray, np.ndarray]] = []
    for t0, t1 in zip(times_ns[:-1] * 1e-9, times_ns[1:] * 1e-9):
        dt = t1 - t0
        k = corner * dt
        size = THETA * noise_size(k, rate_hz / corner, DEAD_S / dt)
        now = np.exp(-k) * noise + size * np.sqrt(-np.expm1(-2 * k)) * rng.normal(size=pixels)
        line = lambda t, noise=noise, now=now, t0=t0, dt=dt: noise + (now - noise) * (t - t0) / dt
        look = np.full(pixels, t0)
        while True:
            wakes = asleep & (release <= t1)
            reference, look = np.where(wakes, line(release), reference), np.where(wakes, release, look)
            asleep &= ~wakes
            fires = np.flatnonzero(~asleep & (np.abs(now - reference) >= THETA))
            if not fires.size:
                break
            level = reference[fires] + THETA * np.sign(now - reference)[fires]
            at = t0 + dt * (level - noise[fires]) / (now - noise)[fires]
            at = np.maximum(at, look[fires])
            fired.append((fires, at))
            asleep[fires], release[fires] = True, at + DEAD_S
        noise = now
    who, when = (np.concatenate([part[i] for part in fired]) for i in (0, 1))
    order = np.lexsort((when, who))
    return np.split(when[order], np.cumsum(np.bincount(who, minlength=pixels))[:-1])


def emulated(times_ns: np.ndarray, rate_hz: float, cutoff_hz: float, side: int, seed: int, **keys) -> list[np.ndarray]:
    config = V2eConfig(
        preset="clean", contrast_threshold=THETA, threshold_sigma=0.0, cutoff_hz=cutoff_hz, photoreceptor_noise=True,
        shot_noise_rate_hz=rate_hz, refractory_us=DEAD_S * 1e6, **keys,
    )  # fmt: skip
    emulator, frame = V2e(side, side, config, seed=seed), np.full((side, side), LEVEL, np.float32)
    parts = [emulator.step(frame, int(t)) for t in times_ns]
    when = np.concatenate([e.t for e in parts]) * 1e-6 + 0.5e-6  # they are floored
    who = np.concatenate([e.y.astype(int) * side + e.x for e in parts])
    order = np.lexsort((when, who))
    return np.split(when[order], np.cumsum(np.bincount(who, minlength=side**2))[:-1])


def one_interval(pixels: list[np.ndarray], after: float) -> np.ndarray:
    """The first whole interval of each pixel after a time: independent of one another."""
    late = [t[np.searchsorted(t, after) :] for t in pixels]
    return np.array([t[1] - t[0] for t in late if len(t) > 1])


@pytest.mark.parametrize("frames", FRAMES)
def test_rate_intervals_and_spread_are_the_equations(frames):
    times, rate, cutoff = frame_times(FRAMES[frames], 1.2), 25.0, 300.0
    ours, theirs = emulated(times, rate, cutoff, SIDE, 3, start="zero"), exact(times, rate, cutoff, SIDE**2, 4)
    counts = [np.array([(t > 0.3).sum() for t in pixels]) for pixels in (ours, theirs)]
    error = np.hypot(*(c.std() / SIDE for c in counts))
    assert abs(counts[0].mean() - counts[1].mean()) < 4 * error
    assert counts[0].std() == pytest.approx(counts[1].std(), rel=0.15)
    mine, exacts = (one_interval(pixels, 0.3) for pixels in (ours, theirs))
    assert min(len(mine), len(exacts)) > 500 and min(mine.min(), exacts.min()) >= DEAD_S - 2e-6
    assert stats.ks_2samp(mine, exacts).pvalue > 1e-4


# --- The emulators beside the recursions of their authors' programs, of which golden counts are kept.
# ``tests/golden/authors.npz`` was made at commit 348eebef, whose ``compat: authors`` computed both programs frame by
# frame: that of V2E made the same events as v2e itself (commit cac6384 of its repository) given the same draws, 4.9
# million of 4.9 million in twelve cases; that of the Voltmeter is the published recursion. Arrays are events per
# pixel of :func:`clip`, (polarity, H, W): ``v2e`` and ``v2e_cutoff`` (a low-pass of 100 Hz) without noise, spread or
# dead time, and ``voltmeter_mean``, the mean over seeds 0 to 7 of DVS346 with V = 0 at the start.

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "authors.npz")
QUIET_AUTHORS = {
    "preset": "clean",
    "threshold_sigma": 0.0,
    "leak_rate_hz": 0.0,
    "shot_noise_rate_hz": 0.0,
    "refractory_us": 0.0,
    "start": "zero",
}
FRAMES_AUTHORS, FPS = 120, 500


def clip():
    """Frames (24, 32) float32 of a pattern that moves, and their times, ns."""
    y, x = np.mgrid[:24, :32].astype(np.float64)
    for k in range(FRAMES_AUTHORS):
        t = k / FPS
        picture = 0.35 + 0.3 * np.sin((x + 60 * t) / 4) * np.cos((y - 35 * t) / 6)
        yield picture.astype(np.float32), k * 10**9 // FPS


def counts(config, seed):
    """Events per pixel, (polarity, H, W)."""
    emulator, found = make_emulator(config, 24, 32, seed), np.zeros((2, 24, 32), np.int64)
    for frame, t_ns in clip():
        events = emulator.step(frame, t_ns)
        np.add.at(found, (events.p.astype(int), events.y, events.x), 1)
    return found


def test_v2e_without_a_low_pass_makes_as_many_events_at_every_pixel():
    np.testing.assert_array_equal(counts(V2eConfig(**QUIET_AUTHORS), 1), GOLDEN["v2e"])


def test_v2e_with_a_low_pass_differs_by_how_a_frame_is_integrated():
    """Theirs filters frame by frame, ours in continuous time."""
    found, theirs = counts(V2eConfig(**{**QUIET_AUTHORS, "cutoff_hz": 100.0}), 1), GOLDEN["v2e_cutoff"]
    assert abs(found - theirs).max() <= 2
    assert found.sum() / theirs.sum() == pytest.approx(0.987, abs=0.002)


def test_the_voltmeters_mean_is_theirs():
    found = np.mean([counts(VoltmeterConfig(start="zero"), seed) for seed in range(8)], axis=0)
    theirs = GOLDEN["voltmeter_mean"]
    assert abs(found - theirs).mean() < 0.01
    assert found.sum() / theirs.sum() == pytest.approx(1, abs=0.002)


def test_the_first_shot_noise_comes_after_as_long_as_any_other():
    """Blocks of pixels share a clock, whose first interval begins at the first frame."""
    height, width, t_ns = 200, 320, 50 * MS
    light = np.full((height, width), 0.4, np.float32)
    asked = 31 / (height * width * t_ns * 1e-9)  # half an event a block
    counts = []
    for seed in range(12):
        emulator = make_emulator(
            V2eConfig(**{**QUIET, "shot_noise_rate_hz": asked}, cutoff_hz=0.0), height, width, seed
        )
        emulator.step(light, 0)
        counts.append(len(emulator.step(light, t_ns)))
    expected = 12 * 31 * shot_rate(1.0, 0.4)
    assert abs(sum(counts) - expected) < 4 * np.sqrt(expected)
