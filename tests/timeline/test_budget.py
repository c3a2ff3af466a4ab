"""The estimate of time errors against a slow twin: the module's text in other words (roots of
cubics, weighted moments, sorted lists of events)."""

from __future__ import annotations

import math

import numpy as np
import pytest

from blinkgl.timeline.budget import TimeError, contraharmonic_mean, weighted_percentile

PRIOR = {"linear": (0.10, 1.0), "pchip": (0.08, 1.2), "hermite": (0.05, 1.5)}
HIGHEST = {"linear": 1.0, "pchip": 2.0, "hermite": 3.0}
KEPT, STIFF = 0.9, 0.15


def cubic_time(y: float, alpha: float, beta: float) -> float:
    """Where the cubic from (0, 0) to (1, 1) with these slopes reaches y."""
    roots = np.roots([alpha + beta - 2, 3 - 2 * alpha - beta, alpha, -y])
    real = roots[np.abs(roots.imag) < 1e-5].real
    return float(real[np.argmin(np.abs(real - np.clip(real, 0, 1)))])


def parabola_slope(points: list[tuple[float, float]], at: float) -> float:
    origin = points[0][0]
    return float(
        np.polyval(np.polyder(np.polyfit([t - origin for t, _ in points], [v for _, v in points], 2)), at - origin)
    )


class SlowTimeError:
    def __init__(self, reconstruction, target, in_px, percentile):
        self.kind, self.target, self.in_px, self.percentile = reconstruction, target, in_px, percentile
        self.points, self.frames, self.events, self.correction, self.typical = (
            [(0.0, math.log(PRIOR[reconstruction][0]))],
            [],
            [],
            0.0,
            None,
        )

    def line(self):
        """Of all measurements, each counting 0.9 of the next; the prior's slope as strong as a variance of 0.15."""
        x, y = np.array(self.points).T
        w = KEPT ** np.arange(len(x))[::-1]
        x0, y0 = np.average(x, weights=w), np.average(y, weights=w)
        m = ((w * (x - x0) * (y - y0)).sum() + STIFF * PRIOR[self.kind][1]) / ((w * (x - x0) ** 2).sum() + STIFF)
        return x0, y0, min(max(m, 0.0), HIGHEST[self.kind])

    def pace(self, speed):
        x0, y0, m = self.line()
        wanted = self.target * (1 if self.in_px else speed) / math.exp(self.correction)
        # d A d^m = wanted, and never more than twice as far as what is known
        d = (wanted / math.exp(y0 - m * x0)) ** (1 / (1 + m))
        return speed / min(d, 2 * math.exp(x0))

    def observe(self, t_ns, signal, slope, speed):
        self.frames.append(
            (
                t_ns * 1e-9,
                signal.ravel().astype(float),
                None if slope is None else slope.ravel().astype(float),
                speed.ravel().astype(float),
            )
        )
        if self.kind == "pchip":
            if len(self.frames) < 4:
                return
            older = self.frames[-5] if len(self.frames) > 4 else None
            a, middle, b, newer = self.frames[-4:]
        else:
            if len(self.frames) < 3:
                return
            a, middle, b = self.frames[-3:]
        step, s = b[0] - a[0], (middle[0] - a[0]) / (b[0] - a[0])
        error, weight = [], np.abs(b[1] - a[1])
        for i, change in enumerate(b[1] - a[1]):
            if change == 0:
                error.append(0.0)
                continue
            alpha = beta = 1.0
            if self.kind == "hermite":
                alpha, beta = a[2][i] * step / change, b[2][i] * step / change
            elif self.kind == "pchip":
                at = lambda frame: (frame[0], frame[1][i])
                alpha = (
                    parabola_slope([at(f) for f in ((older, a, b) if older else (a, b, newer))], a[0]) * step / change
                )
                beta = parabola_slope([at(f) for f in (a, b, newer)], b[0]) * step / change
            alpha, beta = (min(max(v, 0.0), 3.0) for v in (alpha, beta))
            error.append(abs(cubic_time(min(max((middle[1][i] - a[1][i]) / change, 0.0), 1.0), alpha, beta) - s))
        self.measure(step, s, np.array(error), weight, np.abs(middle[1] - a[1]), np.abs(middle[1] - b[1]), middle[3])

    def measure(self, step, s, error, weight, before, after, speed):
        ok = np.isfinite(speed)
        error, weight, before, after, speed = (v[ok] for v in (error, weight, before, after, speed))
        mean = (speed**2).sum() / speed.sum() if speed.sum() > 0 else 0.0
        if mean == 0 or weight.sum() == 0:
            return
        shape = 4 * s * (1 - s)  # how the error of a parabola, or of a cubic, hangs on where the frame was left out
        error = np.minimum(error / max(shape**2 if self.kind == "hermite" else shape, 0.2), 1.0)
        g = self.sorted_percentile(error * (speed / mean if self.in_px else 1.0), weight, self.percentile)
        if g <= 0:
            return
        self.points.append((math.log(mean * step), math.log(g)))
        m = self.line()[2]
        beyond = 0.0
        for part, change in ((s, before), (1 - s, after)):
            seconds = error * step * part * part**m
            beyond += change[(seconds * speed if self.in_px else seconds) > self.target].sum()
            self.events += list(zip(seconds * 1e6, seconds * speed, change))
        total = (before + after).sum()
        self.typical = total if self.typical is None else KEPT * self.typical + (1 - KEPT) * total
        if total > 0:
            self.correction += 0.3 * (beyond / total - (1 - self.percentile / 100)) * min(total / self.typical, 3.0)
            self.correction = min(max(self.correction, -0.7), 3.0)

    @staticmethod
    def sorted_percentile(values, weights, percent):
        total, reached = float(np.sum(weights)) * percent / 100, 0.0
        for value, weight in sorted(zip(np.broadcast_to(values, np.shape(weights)), weights)):
            reached += weight
            if reached >= total * (1 - 1e-12):
                return value
        raise AssertionError

    def said(self, column, percent):
        return self.sorted_percentile([e[column] for e in self.events], [e[2] for e in self.events], percent)


@pytest.mark.parametrize("percentile, in_px", [(75.0, False), (60.0, True)])
@pytest.mark.parametrize("reconstruction", list(PRIOR))
def test_equals_slow_twin(reconstruction, percentile, in_px):
    """Unequal steps, steps in halves, pixels that stand still, turn round or leave (no
    finite speed); a burst in the middle."""
    rng = np.random.default_rng(7)
    target = 0.04 if in_px else 250e-6
    fast, slow = (kind(reconstruction, target, in_px, percentile) for kind in (TimeError, SlowTimeError))
    phase, rate = rng.uniform(0, 2 * np.pi, 60), rng.uniform(15, 60, 60)
    speed = np.where(np.arange(60) < 55, rng.uniform(20, 90, 60), 0.0)
    speed[57] = np.nan
    rate[55:57] = 0.0
    t, turned, step = 0.5, 0.0, 0.0
    for k in range(26):
        burst = 4.0 if 12 <= k < 18 else 1.0
        turned += burst * step
        wave = phase - rate * turned
        signal = (0.8 * np.sin(wave)).astype(np.float32).reshape(6, 10)
        slope = (
            (-0.8 * np.cos(wave) * rate * burst).astype(np.float32).reshape(6, 10)
            if reconstruction == "hermite"
            else None
        )
        for estimate in (fast, slow):
            estimate.observe(round(t * 1e9), signal, slope, (speed * burst).astype(np.float32).reshape(6, 10))
        for v in (1.0, 50.0, 4000.0):
            assert fast.pace(v) == pytest.approx(slow.pace(v), rel=2e-3), (k, v)
        step = rng.uniform(0.0004, 0.004) * (0.5 if k % 5 == 4 else 1.0)
        t += step
    assert fast.m == pytest.approx(slow.line()[2], rel=2e-3)
    said = fast.info()["time_error"]
    assert said["measurements"] == len(slow.points) - 1 == 26 - (3 if reconstruction == "pchip" else 2)
    assert said["order"] == round(1 + fast.m, 2) and said["percentile"] == percentile
    for column, unit in ((0, "us"), (1, "px")):
        for name, percent in (("median", 50), ("p95", 95), (f"p{percentile:g}", percentile)):
            # histograms of 100 bins a decade from 1e-3 on: the upper edge is said, in three digits
            assert 0.99 < said[f"{name}_{unit}"] / max(slow.said(column, percent), 1e-3) < 1.035, (name, unit)


def test_the_target_is_repeated_in_the_unit_it_was_given_in():
    assert TimeError("linear", 250e-6, False, 75.0).info()["time_error"]["target_us"] == 250.0
    in_px = TimeError("hermite", 0.04, True, 75.0).info()["time_error"]
    assert in_px["target_px"] == 0.04 and "target_us" not in in_px and in_px["p75_us"] is None and in_px["order"] == 2.5


def test_before_anything_is_measured_the_prior_decides():
    """g(1 px) = 0.1 and order 1: d g(d) = 0.1 d^2, so 0.4 px of error allow 2 px, the most that
    is believed of one measured pixel."""
    error = TimeError("linear", 0.1, True, 75.0)
    assert error.pace(10.0) == pytest.approx(10.0) and error.pace(0.0) == 0.0 and error.pace(-1.0) == 0.0
    assert TimeError("linear", 0.4, True, 75.0).pace(10.0) == pytest.approx(5.0)
    assert TimeError("linear", 40.0, True, 75.0).pace(10.0) == pytest.approx(5.0), (
        "and never more than twice what is known"
    )
    assert TimeError("linear", 0.01, False, 75.0).pace(10.0) == pytest.approx(10.0), "0.01 s at 10 px/s is 0.1 px"


@pytest.mark.parametrize("case", ["nothing moves", "nothing changes", "exactly on the line"])
def test_what_measures_nothing_is_not_a_measurement(case):
    error = TimeError("linear", 1e-4, False, 75.0)
    for k in range(5):
        signal = np.full((2, 3), 1.0 if case == "nothing changes" else 0.25 * k, np.float32)
        error.observe(
            k * 1_000_000, signal, None, np.full((2, 3), 0.0 if case == "nothing moves" else 10.0, np.float32)
        )
    assert error.measurements == 0 and error.pace(10.0) == TimeError("linear", 1e-4, False, 75.0).pace(10.0)
    assert error.info()["time_error"]["median_us"] is None


def test_means():
    assert contraharmonic_mean(np.array([1.0, 3.0, np.nan, -np.inf])) == 2.5
    values, weights = np.array([5.0, 1.0, 3.0]), np.array([1.0, 1.0, 2.0])
    assert [weighted_percentile(values, weights, p) for p in (25, 26, 75, 76, 100)] == [1, 3, 3, 5, 5]
