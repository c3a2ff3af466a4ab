"""Fit of single-pixel noise (``readout.pixels``) to a camera's recording of a static scene: how many pixels are noisy
or hot, how much, how often a noise event is followed by one of the opposite polarity, and the polarity of hot pixels.

Maximum likelihood of the number of events of each pixel in the first half of the recording (the Poisson process of
:class:`~blinkgl.events.pixels.PixelNoise`, its rates a mixture of two log-normal laws, counts of answered events
compound), of the time between the two events of pixels with two, and of the number of a hot pixel's ON events. The
other half tests the fit.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid
from scipy.optimize import minimize
from scipy.special import expit, log_expit, ndtr
from scipy.stats import binom, ks_2samp, poisson

from blinkgl.config.readout import PixelsConfig
from blinkgl.errors import EventDataError
from blinkgl.events.pixels import PixelNoise
from blinkgl.io.reading import AS_FILE, EventReading
from blinkgl.recordings.clip import read_recording
from blinkgl.types.events import Events
from blinkgl.types.trees import Tree

LEAST_EVENTS = 500
"""Events per half; fewer do not determine a spread over pixels."""
WORTH = 6.0
"""Gain of log-likelihood that hot pixels, or answers, must give."""
_EXACT, _PER_DECADE = 64, 12
"""Counts up to the first are separate; larger ones are in bins, this many per decade."""
_GRID = np.linspace(np.log(1e-7), np.log(1e6), 480)
"""Logarithms of expected counts over which laws of rates are summed."""
# Number of steps between shares of answered events of 0 and 1 for which tables are made.
_SHARES = 20
_TEN = float(np.log(10.0))


@dataclass(frozen=True, eq=False)
class PixelFit:
    """Result of :func:`fit_pixels`.

    config : as fitted.   uncertainty : standard deviations of what was fitted, by key.   undetermined : why the rest
    was not.   recorded, simulated : events of the half that was not fitted.
    counts_distance, intervals_distance : Kolmogorov and Smirnov's, of the number of events of the pixels that fired,
    and of the intervals between a pixel's events.   counts, intervals : these, recorded and simulated; µs.
    seconds : of both halves."""

    recording: str
    size: tuple[int, int]
    config: PixelsConfig
    uncertainty: dict[str, float]
    undetermined: dict[str, str]
    recorded: int
    simulated: int
    counts: tuple[np.ndarray, np.ndarray]
    intervals: tuple[np.ndarray, np.ndarray]
    seconds: tuple[float, float]

    @property
    def fired(self) -> tuple[int, int]:
        """Return the number of pixels that fired, recorded and simulated."""
        return len(self.counts[0]), len(self.counts[1])

    @property
    def counts_distance(self) -> float:
        return _distance(*self.counts)

    @property
    def intervals_distance(self) -> float:
        return _distance(*self.intervals)

    @property
    def rate_ratio(self) -> float:
        return self.simulated / max(self.recorded, 1)

    def sensor(self) -> Tree:
        """Return the table of a sensor file (:class:`~blinkgl.config.sensor.SensorConfig`)."""
        file = os.path.basename(self.recording)
        values = {k: float(f"{v:.4g}") for k, v in self.config.model_dump(exclude_defaults=True).items()}
        return {
            "name": os.path.splitext(file)[0],
            "width": self.size[1],
            "height": self.size[0],
            "readout": {"pixels": values},
            "sources": {
                "readout.pixels": f"blinkgl calibrate --still --emulator pixels, fitted to the first "
                f"{self.seconds[0]:.3g} s of {file}; in the other {self.seconds[1]:.3g} s {self.rate_ratio:.2f} of its "
                f"events, events of a pixel KS {self.counts_distance:.3f}, intervals KS {self.intervals_distance:.3f}",
                **{f"readout.pixels.{key}": why for key, why in self.undetermined.items()},
            },
            "uncertainty": {f"readout.pixels.{key}": float(f"{v:.2g}") for key, v in self.uncertainty.items()},
        }


def fit_pixels(
    recording: str | os.PathLike,
    reading: EventReading = AS_FILE,
    *,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[PixelFit, list[str]]:
    """Fit :func:`fit_pixels_of` to a file; return also what was guessed or left out, a line each.

    Raises EventDataError (too few events), AssetError (unreadable)."""
    if progress:
        progress("reading", 0.0)
    events, size, notes = read_recording(recording, reading, least=2 * LEAST_EVENTS)
    return fit_pixels_of(events, size, name=os.fspath(recording), seed=seed, progress=progress), notes


def fit_pixels_of(
    events: Events,
    size: tuple[int, int],
    *,
    used: np.ndarray | None = None,
    name: str = "events",
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> PixelFit:
    """Fit ``readout.pixels`` to a static scene in constant light. size : (height, width) of the sensor.
    used : (height, width) bool, the pixels to use; None: all."""
    say = progress or (lambda *_: None)
    height, width = size
    looked = np.ones(height * width, bool) if used is None else np.asarray(used, bool).reshape(-1)
    halves, seconds = _halves(events.part(looked[events.pixel(width)]), name)
    pixel = halves[0].pixel(width)
    counts = np.bincount(pixel, minlength=height * width)
    say("counts of pixels", 0.1)
    dead = _dead_time(halves[0], pixel, counts)
    law = _Counts(counts[looked], seconds[0], dead)
    answered = law.best(say)
    values, uncertainty = answered.values, answered.uncertainty
    if dead:
        values["refractory_us"] = 1e6 * dead
    is_hot = law.hot_chance(answered, counts) > 0.5
    if answered.hot:
        preferences, spread = _preferences(halves[0], pixel, counts, is_hot)
        values |= preferences
        uncertainty |= spread
    first_on = float((halves[0].p[~is_hot[pixel]] > 0).mean()) if (~is_hot[pixel]).any() else 0.5
    if answered.answers:
        share = values.pop("share")
        delay, wide, first_on = _delays(halves[0], pixel, counts, seconds[0])
        q = _answered(share, _seen(delay, wide, seconds[0]))
        values |= {"answered": q, "answer_ms": 1e3 * delay, "answer_spread_decades": wide}
        uncertainty["answered"] = uncertainty.pop("share") * q / share
    values["on_share"] = float(np.clip(first_on, 0.0, 1.0))
    config = PixelsConfig(**{key: _within(key, value) for key, value in values.items()})
    say("judging", 0.9)
    # As long as the half that was not fitted, with another seed: the law is judged, not its draws.
    noise = PixelNoise(config, height, width, seed + 1)
    noise.step(Events.empty(), 0)
    made = noise.step(Events.empty(), round(1e6 * seconds[1]))
    made = made.part(looked[made.pixel(width)])
    numbers = [one.pixel(width) for one in (halves[1], made)]
    fired = [np.bincount(of, minlength=height * width) for of in numbers]
    return PixelFit(
        recording=name,
        size=size,
        config=config,
        uncertainty={key: value for key, value in uncertainty.items() if value > 0},
        undetermined=_undetermined(answered, dead),
        recorded=len(halves[1]),
        simulated=len(made),
        counts=(fired[0][fired[0] > 0], fired[1][fired[1] > 0]),
        intervals=(_gaps(halves[1], numbers[0]), _gaps(made, numbers[1])),
        seconds=seconds,
    )


def _halves(events: Events, name: str) -> tuple[list[Events], tuple[float, float]]:
    """Return the events of both halves of the recording's time, and their lengths, s. Raises EventDataError: too few
    in one."""
    if len(events) < 2 * LEAST_EVENTS:
        raise _too_few(name, len(events) // 2)
    t0, t1 = int(events.t[0]), int(events.t[-1]) + 1
    middle = (t0 + t1) // 2
    halves = [events.window(t0, middle), events.window(middle, t1)]
    if min(map(len, halves)) < LEAST_EVENTS:
        raise _too_few(name, min(map(len, halves)))
    return halves, ((middle - t0) / 1e6, (t1 - middle) / 1e6)


def _undetermined(law: _Found, dead: float) -> dict[str, str]:
    """Return why keys could not be determined."""
    why = {
        "hot_fraction": (law.hot, "one law of rates says as much as two"),
        "refractory_us": (dead, "no pixel fires so often that it would show"),
        "answered": (law.answers, "events of a pixel are as many as if none answered another"),
    }
    return {key: reason for key, (known, reason) in why.items() if not known}


def _answered(share: float, seen: float) -> float:
    """Return the share of events that are answered, of the one that shows and the fraction of answers that is
    ``seen``."""
    # Answers after the end are lost; those of noise before the beginning are single events.
    return min(share / max(seen + share * (seen - 1.0), 1e-3), 1.0)


def _distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(ks_2samp(a, b).statistic) if len(a) and len(b) else float("nan")


def _too_few(name: str, count: int) -> EventDataError:
    return EventDataError(
        "too few events to estimate the noise of single pixels",
        where=name,
        value=count,
        accepted=f"{LEAST_EVENTS:,} or more in each half of its time",
    )


def _within(key: str, value: float) -> float:
    """Return a value within the key's limits."""
    ends = {"ge": -np.inf, "le": np.inf}
    for rule in PixelsConfig.model_fields[key].metadata:
        ends |= {side: getattr(rule, side) for side in ends if getattr(rule, side, None) is not None}
    return float(np.clip(value, ends["ge"], ends["le"]))


def _gaps(events: Events, pixel: np.ndarray) -> np.ndarray:
    """Return times between a pixel's events, µs.   pixel : (N,) where each is."""
    order = np.lexsort((events.t, pixel))
    return np.diff(events.t[order])[np.diff(pixel[order]) == 0]


def _delays(events: Events, pixel: np.ndarray, counts: np.ndarray, seconds: float) -> tuple[float, float, float]:
    """(median s, spread in decades) of a log-normal law of the time to an answer: by maximum likelihood from pixels
    with two events of opposite polarity, of which a share are two by chance. And the share of them that begin ON."""
    pairs = counts[pixel] == 2
    # Sorted by pixel, the two events of each are neighbours.
    order = np.lexsort((events.t[pairs], pixel[pairs]))
    t, p = events.t[pairs][order].reshape(-1, 2), events.p[pairs][order].reshape(-1, 2)
    opposite = p[:, 0] != p[:, 1]
    # At least a microsecond, the resolution of the times.
    gap = np.maximum((t[:, 1] - t[:, 0]) * 1e-6, 1e-6)[opposite]
    if len(gap) < 20:
        return 0.03, 0.5, float((events.p > 0).mean())
    grid = np.linspace(np.log(1e-6), np.log(seconds), 400)

    def loss(at: np.ndarray) -> float:
        # at: the logarithms of the median and the spread, and the logit of the share of pairs by chance.
        median, spread, chance = at[0], np.exp(at[1]), expit(at[2])
        pdf = lambda x: np.exp(-0.5 * ((x - median) / spread) ** 2) / spread
        whole = trapezoid(pdf(grid) * (1 - np.exp(grid) / seconds), grid)
        room = np.maximum(1 - gap / seconds, 1e-9)
        # The law of ln(delay) becomes one of the delay by 1 / gap. Both events must be within the recording, which
        # for two independent ones gives the triangular law 2 (1 - gap / T) / T.
        density = (1 - chance) * pdf(np.log(gap)) * room / max(whole, 1e-12) / gap + chance * 2 * room / seconds
        return -float(np.log(np.maximum(density, 1e-300)).sum())

    start = np.array([np.log(np.median(gap)), 0.0, -1.5])
    best = minimize(loss, start, method="Nelder-Mead", options={"maxiter": 600}).x
    return float(np.exp(best[0])), float(np.exp(best[1]) / _TEN), float((p[opposite, 0] > 0).mean())


def _preferences(
    events: Events, pixel: np.ndarray, counts: np.ndarray, hot: np.ndarray
) -> tuple[dict[str, float], dict[str, float]]:
    """``hot_on_share`` and ``hot_on_spread`` of the pixels that are ``hot``, and their standard deviations: by maximum
    likelihood from how many of a pixel's events are ON, binomial with a logit-normal share."""
    on = np.bincount(pixel, weights=events.p, minlength=len(counts))[hot]
    n = counts[hot]
    if len(n) < 2:
        return {"hot_on_share": float(on.sum() / max(n.sum(), 1)) if len(n) else 0.5}, {}
    logit = np.linspace(-15, 15, 1201)  # a step of 0.025: a pixel of 1,000 events tells its own to 0.06
    chances = on[:, None] * log_expit(logit) + (n - on)[:, None] * log_expit(-logit)
    # Products of a thousand chances underflow. Each pixel's largest becomes 1, which moves no maximum.
    chances = np.exp(chances - chances.max(axis=1, keepdims=True))

    def loss(at: np.ndarray) -> float:
        spread = np.exp(np.clip(at[1], -4.0, 4.0))
        weight = np.exp(-0.5 * ((logit - at[0]) / spread) ** 2)
        return -float(np.log(np.maximum(chances @ weight / weight.sum(), 1e-300)).sum())

    start = np.array([np.log((on.sum() + 1) / ((n - on).sum() + 1)), 0.0])
    best = minimize(loss, start, method="Nelder-Mead", options={"maxiter": 400}).x
    # The inverse of the curvature of the negative log-likelihood is the covariance.
    deviation = np.sqrt(np.clip(np.diag(np.linalg.pinv(_curvature(loss, best))), 0.0, None))
    share, spread = float(expit(best[0])), float(np.exp(best[1]))
    # d(expit) = share (1 - share) d(logit), d(exp) = spread d(log): from the search's numbers to the parameters.
    return (
        {"hot_on_share": share, "hot_on_spread": 0.0 if spread < 0.05 else spread},
        {"hot_on_share": share * (1 - share) * float(deviation[0]), "hot_on_spread": spread * float(deviation[1])},
    )


def _dead_time(events: Events, pixel: np.ndarray, counts: np.ndarray) -> float:
    """Return the dead time of a pixel after an event, s: a low percentile of the intervals of the most active pixels,
    if no shorter ones are expected; 0 where no pixel is active enough."""
    # Only pixels that fire nearly without a pause show the shortest possible interval.
    busy = counts >= max(100, 0.3 * counts.max())
    gap = _gaps(events.part(busy[pixel]), pixel[busy[pixel]]) * 1e-6
    if len(gap) < 200:
        return 0.0
    low = float(np.percentile(gap, 2))
    # By chance alone, two of a hundred exponential intervals are below a fiftieth of their mean.
    return low if low > 5 * 0.02 * gap.mean() else 0.0


def _seen(delay: float, decades: float, seconds: float) -> float:
    """Return the fraction of answers that fall into a recording of that length together with their events."""
    if decades <= 0:
        return max(1 - delay / seconds, 0.0)
    # The mean over log-normal delays, up to six standard deviations of their logarithm on both sides.
    x = np.linspace(-6, 6, 600)
    weight = np.exp(-0.5 * x**2)
    late = delay * np.exp(_TEN * decades * x)
    return float((weight * np.maximum(1 - late / seconds, 0)).sum() / weight.sum())


@dataclass(frozen=True, eq=False)
class _Found:
    hot: bool
    answers: bool
    likelihood: float
    values: dict[str, float]
    uncertainty: dict[str, float]
    at: np.ndarray


class _Counts:
    """The likelihood of each pixel's number of events. counts : (pixels,).   seconds : duration.   dead : dead time
    after an event, s."""

    def __init__(self, counts: np.ndarray, seconds: float, dead: float = 0.0):
        self._seconds, self._dead = seconds, dead
        top = max(int(counts.max()), _EXACT) + 1
        decades = int(np.ceil(_PER_DECADE * np.log10(top / _EXACT))) + 1
        # Hot pixels have up to millions of events; bins of equal ratio keep the table small.
        edges = _EXACT * 10 ** (np.arange(decades + 1) / _PER_DECADE)
        # Upper ends of the bins; the last one is open.
        self._edges = np.concatenate([np.arange(_EXACT + 1), edges[1:]]) + 0.5
        where = np.searchsorted(self._edges, counts)
        self._observed = np.bincount(where, minlength=len(self._edges) + 1)
        self._mean = float(counts.mean())
        self._busiest = float(np.sort(counts)[-max(len(counts) // 1000, 1)])
        self._kept: dict[int, np.ndarray] = {}

    def best(self, say: Callable[[str, float], None]) -> _Found:
        """Return the simplest law that each of its parts, hot pixels and answers, makes likelier by :data:`WORTH`."""
        plain = self.fit(False, False)
        say("counts of pixels", 0.3)
        hot = self.fit(True, False)
        say("counts of pixels", 0.5)
        # Where the counts without answers have no hump of hot pixels that one with answers has, the first is no start.
        answered = max(self.fit(True, True, hot.at), self.fit(True, True), key=lambda found: found.likelihood)
        say("counts of pixels", 0.8)
        if answered.likelihood - hot.likelihood < WORTH:
            answered = hot
        # Without hot pixels, answers are tried alone: each of the two must be worth it by itself.
        if hot.likelihood - plain.likelihood < WORTH:
            alone = self.fit(False, True, plain.at)
            answered = alone if alone.likelihood - plain.likelihood >= WORTH else plain
        return answered

    def _of_rates(self, q: float) -> np.ndarray:
        """(expected counts, bins) probabilities; ``q``: share of events that are answered. In between a few shares they
        are nearly straight."""
        place = q * _SHARES
        below = min(int(place), _SHARES - 1)
        return (below + 1 - place) * self._at_share(below) + (place - below) * self._at_share(below + 1)

    def _at_share(self, number: int) -> np.ndarray:
        if number in self._kept:
            return self._kept[number]
        q = number / _SHARES
        # A pixel that sleeps after each event fires 1 / (1 / rate + dead) times a second.
        mean = np.exp(_GRID) / (1 + np.exp(_GRID) * self._dead / self._seconds)
        k = np.arange(_EXACT + 1)
        # Of m events m / (1 + q) are noise, and the others answers to it, at most one to each.
        few = poisson.pmf(k[None, :], mean[:, None] / (1 + q))
        if q > 0:
            # Of n noise events, a row, k - n are answered, which makes k events, a column.
            few = few @ binom.pmf(k[None, :] - k[:, None], k[:, None], q)
        asleep = mean * self._dead / self._seconds
        # A normal law does for more than _EXACT events. Noise with its answers comes in ones and twos, so the
        # variance is m / (1 + q) E[n²], and E[n²] = 1 + 3q.
        deviation = np.sqrt(mean * (1 + 3 * q) / (1 + q)) * np.maximum(1 - asleep, 1e-2)
        above = ndtr((self._edges[None, _EXACT:] - mean[:, None]) / deviation[:, None])
        many = np.diff(above, axis=1, append=1.0)
        moments = np.concatenate([few, many], axis=1)
        self._kept[number] = moments / np.maximum(moments.sum(axis=1, keepdims=True), 1e-12)
        return self._kept[number]

    def _law(self, median: float, decades: float) -> np.ndarray:
        """Return weights of the grid, of a log-normal law of rates (1/s)."""
        weight = np.exp(-0.5 * ((_GRID - np.log(median * self._seconds)) / (_TEN * decades)) ** 2)
        return weight / max(weight.sum(), 1e-300)

    def _chances(self, v: dict[str, float]) -> tuple[np.ndarray, np.ndarray]:
        """(bins,) probabilities that a pixel is not hot and its count in the bin, and that it is hot and so."""
        plain = self._law(v["rate_hz"], max(v["spread_decades"], 0.02)) @ self._of_rates(v.get("share", 0.0))
        if "hot_rate_hz" not in v:
            return plain, np.zeros_like(plain)
        own = self._law(v["hot_rate_hz"], max(v["hot_spread_decades"], 0.02)) @ self._of_rates(0.0)
        return (1 - v["hot_fraction"]) * plain, v["hot_fraction"] * own

    def hot_chance(self, found: _Found, counts: np.ndarray) -> np.ndarray:
        """Return the probability, (pixels,), that a pixel with this number of events is hot."""
        plain, own = self._chances(found.values)
        share = own / np.maximum(plain + own, 1e-300)
        return share[np.searchsorted(self._edges, counts)]

    def fit(self, hot: bool, answers: bool, before: np.ndarray | None = None) -> _Found:
        """hot : two laws of rates.   answers : some events are answered.   before : where the same without answers
        ended."""

        def read(at: np.ndarray) -> dict[str, float]:
            # The simplex moves in unbounded numbers: logarithms of rates, logits of shares; a spread is 0 to 3 decades.
            values = {"rate_hz": np.exp(min(at[0], 700.0)), "spread_decades": 3 * expit(at[1])}
            if hot:
                values |= {
                    "hot_fraction": expit(at[2]),
                    "hot_rate_hz": np.exp(min(at[3], 700.0)),
                    "hot_spread_decades": 3 * expit(at[4]),
                }
            if answers:
                values["share"] = expit(at[-1])
            return {key: float(value) for key, value in values.items()}

        def loss(at: np.ndarray) -> float:
            if np.abs(at).max() > 40:
                # The simplex may wander to where exp() overflows; this turns it back.
                return 1e300
            v = read(at)
            chances = np.sum(self._chances(v), axis=0)
            return -float((self._observed * np.log(np.maximum(chances, 1e-300))).sum())

        ends: list[tuple[float, np.ndarray]] = []
        tail = np.log(max(self._busiest, 3.0) / self._seconds)
        starts = [] if before is None else [before]
        for below, spread in ((1.0, -1.5), (5.0, -0.5)) if before is None else ():
            rate = np.log(max(self._mean, 1e-6) / self._seconds) - below
            # Few pixels have most of the events, so the median rate is far below the mean. A first guess of hot ones:
            # 0.25 % of the pixels, nearly alike, as busy as the busiest thousandth.
            starts.append(np.array([rate, spread, *((-6.0, tail, -2.0) if hot else ())]))
        for start in starts:
            start = np.append(start, 0.0) if answers else start
            for _ in range(2):  # the simplex restarts where it ended
                options = {"maxiter": 400 * len(start), "xatol": 1e-3, "fatol": 1e-2}
                start = minimize(loss, start, method="Nelder-Mead", options=options).x
            ends.append((loss(start), start))
        least, best = min(ends, key=lambda end: end[0])
        values, step = read(best), {}
        deviations = np.sqrt(np.clip(np.diag(np.linalg.pinv(_curvature(loss, best))), 0.0, None))
        # Half of the difference between one standard deviation up and down, in the parameters' own units.
        for d in np.diag(deviations):
            apart = read(best + d), read(best - d)
            step |= {key: abs(apart[0][key] - apart[1][key]) / 2 for key in values if apart[0][key] != apart[1][key]}
        # The two laws have no order of their own: the busier one is called hot.
        if hot and values["hot_rate_hz"] < values["rate_hz"]:
            for table in (values, step):
                for key in ("rate_hz", "spread_decades"):
                    table[key], table[f"hot_{key}"] = table.get(f"hot_{key}", 0.0), table.get(key, 0.0)
            values["hot_fraction"] = 1 - values["hot_fraction"]
        for key in ("spread_decades", "hot_spread_decades"):
            values |= {key: 0.0} if values.get(key, 1.0) < 0.005 else {}
        return _Found(hot, answers, -least, values, step, best)


def _curvature(loss: Callable[[np.ndarray], float], at: np.ndarray, step: float = 0.02) -> np.ndarray:
    """Return (n, n) second differences."""
    n = len(at)
    hessian, unit = np.zeros((n, n)), step * np.eye(n)
    for i in range(n):
        for j in range(i + 1):
            a, b = unit[i], unit[j]
            # For i = j these are differences over twice the step, so the divisor is the same.
            hessian[i, j] = loss(at + a + b) - loss(at + a - b) - loss(at - a + b) + loss(at - a - b)
            hessian[j, i] = hessian[i, j]
    return hessian / (4 * step**2)
