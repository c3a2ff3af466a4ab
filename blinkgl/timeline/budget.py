"""How wrong event times are, measured on the frames as they come, and the step that keeps that within a budget.

The estimate is embedded, as in solvers of differential equations: of three frames in a row the middle one is left out,
the curve through the others (of the reconstruction in use) is compared with it, and the distance *in time* between the
curve and the frame's value is the error that steps of twice the length would have. Each pixel counts by how much its
signal changed, that is by the number of its events. Now and then a step is drawn in two halves, which measures the
error of that very step. With g the error as a fraction of the step and d the displacement per step, px, all these
measurements are points (log d, log g); the line g = A d^m through them, older ones forgotten, gives the error of any
other step, and the image speed at a time, known before the frame is drawn, gives d: when
something speeds up, the step does not lag behind.

The halved steps are what tells the order m of one length of step, and the correction (by how many events were beyond
the target) what makes a mean of logarithms a percentile over events: without it the *estimated* error is 1.6 to 1.9
times the target where motion comes in bursts that the image speed does not tell of. On five rendered scenes (three
reconstructions, three targets) the achieved error grows by 9 % without either one and by 25 % without both, with 10 and
23 % fewer frames (geometric means): most in the scenes where it is above the target already.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numba
import numpy as np

from blinkgl.events.curve import curve_time, end_slopes, limited

_LINEAR, _PCHIP, _HERMITE = 0, 1, 2
_SCHEMES = {"linear": _LINEAR, "pchip": _PCHIP, "hermite": _HERMITE}
_PRIOR = {"linear": (0.10, 1.0), "pchip": (0.08, 1.2), "hermite": (0.05, 1.5)}
"""(g at one pixel per step, m) to begin with: of textured scenes, see docs/results.md."""
_HIGHEST = {"linear": 1.0, "pchip": 2.0, "hermite": 3.0}
"""m of smooth signals, the largest that is believed."""
FORGET, STIFFNESS, SPREAD = 0.9, 1.0, 0.15
"""Share of a measurement left after the next one; weight of the prior m, in squared units
of log d; smallest variance of it."""
FOLLOW, CORRECTION = 0.3, (-0.7, 3.0)
"""Step of the correction per measurement with too many events beyond the target; its limits,
log of the target's reduction."""
# Bins of the histograms, us or px, 100 to a decade.
_EDGES = np.logspace(-3, 8, 1101)


@numba.njit(cache=True, nogil=True)
def _left_out(scheme, older, a, middle, b, newer, slope_a, slope_b, t, error, weight):
    """Compute per sample the error at the left-out frame, as a fraction of the step over it, and the change across
    it.

    t : (5,) float64 s, times of the five frames; t[0] = t[1] or t[4] = t[3] where there is no such frame."""
    step, s_middle = t[3] - t[1], (t[2] - t[1]) / (t[3] - t[1])
    for i in range(a.size):
        change = np.float64(b[i]) - np.float64(a[i])
        weight[i] = abs(change)
        error[i] = 0.0
        if change == 0.0:
            # A pixel that does not change makes no event.
            continue
        alpha = beta = 1.0
        if scheme == _HERMITE:
            alpha, beta = limited(slope_a[i] * step / change), limited(slope_b[i] * step / change)
        elif scheme == _PCHIP:
            alpha, beta = end_slopes(
                np.float64(older[i]),
                np.float64(a[i]),
                np.float64(b[i]),
                np.float64(newer[i]),
                step,
                t[1] - t[0],
                t[4] - t[3],
            )
        # Where the frame's value lies between its neighbours', as a fraction of the change.
        y = (np.float64(middle[i]) - np.float64(a[i])) / change
        error[i] = abs(curve_time(min(max(y, 0.0), 1.0), alpha, beta, 0.0) - s_middle)


def contraharmonic_mean(speed: np.ndarray) -> float:
    """sum v^2 / sum v: the mean over events, of which a pixel makes as many as its speed is large. 0
    of nothing; what is not finite is left out."""
    speed = speed[np.isfinite(speed)].astype(np.float64)
    total = speed.sum()
    return float((speed * speed).sum() / total) if total > 0 else 0.0


def weighted_percentile(values: np.ndarray, weights: np.ndarray, percent: float) -> float:
    """The smallest value that, with all below it, has ``percent`` % of the weight."""
    order = np.argsort(values)
    cumulative = np.cumsum(weights[order])
    return float(values[order[min(np.searchsorted(cumulative, percent / 100 * cumulative[-1]), len(values) - 1)]])


class TimeError:
    """target : s, or px when ``in_px``, for the given percentile of the events' time errors."""

    def __init__(self, reconstruction: str, target: float, in_px: bool, percentile: float):
        self.reconstruction, self.target, self.in_px, self.percentile = reconstruction, target, in_px, percentile
        self._scheme, self._frames = _SCHEMES[reconstruction], deque(maxlen=5)
        g, self.m = _PRIOR[reconstruction]
        # Begins with one measurement, the prior at one pixel per step.
        self._sums = np.array([1.0, 0.0, np.log(g), 0.0, 0.0])  # of 1, x, y, x^2, xy; x = log d, y = log g
        self._us, self._px = np.zeros(len(_EDGES) + 1), np.zeros(len(_EDGES) + 1)
        self.measurements, self._correction, self._mean_change = 0, 0.0, 0.0

    def pace(self, speed: float) -> float:
        """Steps per second that meet the target at an image speed, px/s."""
        if speed <= 0:
            return 0.0
        x, y, m = self._line()
        # d g(d) = target px, or d / speed g(d) = target s.
        wanted = self.target if self.in_px else self.target * speed
        # log of d g(d) = A d^(1 + m), solved for d; never more than twice the mean of what was
        # measured.
        log_d = (np.log(wanted) - self._correction - y + m * x) / (1 + m)
        return float(speed / np.exp(min(log_d, x + np.log(2.0))))

    def _line(self) -> tuple[float, float, float]:
        """Return a point (log d, log g) of the line and its slope."""
        n, sx, sy, sxx, sxy = self._sums
        x, y = sx / n, sy / n
        m0 = _PRIOR[self.reconstruction][1]
        # Least squares for the slope with a prior of weight STIFFNESS at m0.
        m = (sxy - n * x * y + STIFFNESS * SPREAD * m0) / (sxx - n * x * x + STIFFNESS * SPREAD)
        return x, y, float(np.clip(m, 0.0, _HIGHEST[self.reconstruction]))

    def observe(self, t_ns: int, signal: np.ndarray, slope: np.ndarray | None, speed: np.ndarray) -> None:
        """signal, speed : (h, w) float32 of the sampled pixels, speed px/s.   slope : (h, w)
        d(signal)/dt per second, for hermite."""
        nothing = signal if slope is None else slope
        self._frames.append((t_ns, signal.ravel(), nothing.ravel(), speed.ravel()))
        f = list(self._frames)
        if self._scheme == _PCHIP:
            if len(f) < 4:
                return
            # The first interval has no older neighbour.
            five = [f[0], *f] if len(f) == 4 else f
        elif len(f) < 3:
            return
        else:
            # The straight line has no neighbours: only the last three frames count.
            five = [f[-3], *f[-3:], f[-1]]
        t = np.array([frame[0] - five[1][0] for frame in five]) * 1e-9
        error, weight = np.empty(signal.size), np.empty(signal.size)
        _left_out(self._scheme, *(frame[1] for frame in five), five[1][2], five[3][2], t, error, weight)
        self._measure(t, error, weight, *(np.abs(five[2][1] - five[k][1]) for k in (1, 3)), five[2][3])

    def _measure(
        self,
        t: np.ndarray,
        error: np.ndarray,
        weight: np.ndarray,
        before: np.ndarray,
        after: np.ndarray,
        speed: np.ndarray,
    ) -> None:
        """before, after : |change| of the signal in the two intervals."""
        ok = np.isfinite(speed)
        mean_speed = contraharmonic_mean(speed)
        if mean_speed <= 0 or not weight[ok].any():
            return
        step, s = t[3] - t[1], (t[2] - t[1]) / (t[3] - t[1])
        # The error vanishes at both ends: 4 s (1 - s) is its shape, squared where slopes are given,
        # too.
        shape = (4 * s * (1 - s)) ** (2 if self._scheme == _HERMITE else 1)
        error = np.minimum(error / max(shape, 0.2), 1.0)
        relative = speed / mean_speed if self.in_px else np.ones_like(speed)
        g = weighted_percentile((error * relative)[ok], weight[ok], self.percentile)
        if g <= 0:
            return
        x, y = np.log(mean_speed * step), np.log(g)
        self._sums = FORGET * self._sums + np.array([1.0, x, y, x * x, x * y])
        self.m = self._line()[2]
        self.measurements += 1
        beyond = 0.0
        for part, change in ((s, before), (1 - s, after)):
            # The error of a part of the step: the fraction grows as the step^m, the step itself
            # shrinks.
            seconds = error[ok] * step * part ** (1 + self.m)
            beyond += change[ok][(seconds * speed[ok] if self.in_px else seconds) > self.target].sum()
            self._us += np.bincount(np.searchsorted(_EDGES, seconds * 1e6), change[ok], len(self._us))
            self._px += np.bincount(np.searchsorted(_EDGES, seconds * speed[ok]), change[ok], len(self._px))
        total = float((before + after)[ok].sum())
        self._mean_change = total if self._mean_change == 0 else FORGET * self._mean_change + (1 - FORGET) * total
        if total > 0:
            # Too many events beyond the target make later steps shorter, more so after much change.
            off = (beyond / total - (1 - self.percentile / 100)) * min(total / self._mean_change, 3.0)
            self._correction = float(np.clip(self._correction + FOLLOW * off, *CORRECTION))

    def info(self) -> dict[str, Any]:
        """The achieved errors as estimated: percentiles over the events of the whole sequence."""

        def of(histogram: np.ndarray, percent: float) -> float | None:
            if not histogram.any():
                return None
            cumulative = np.cumsum(histogram)
            return float(
                f"{_EDGES[min(np.searchsorted(cumulative, percent / 100 * cumulative[-1]), len(_EDGES) - 1)]:.3g}"
            )

        wanted = {"median": 50.0, "p95": 95.0, f"p{self.percentile:g}": self.percentile}
        return {
            "time_error": {
                "reconstruction": self.reconstruction,
                "percentile": self.percentile,
                ("target_px" if self.in_px else "target_us"): float(
                    f"{self.target if self.in_px else self.target * 1e6:.9g}"
                ),
                "measurements": self.measurements,
                "order": round(1 + self.m, 2),
                **{f"{name}_us": of(self._us, p) for name, p in wanted.items()},
                **{f"{name}_px": of(self._px, p) for name, p in wanted.items()},
            }
        }
