"""Clips: key frames of many joints' translations, rotations and scales, and their timing on a sequence's clock.

Reference: Khronos glTF 2.0 specification, 3.11 and appendix C (interpolation), of which a clip is the general form.
Values between key frames are exact, and so are their rates: nothing is resampled.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.scene.shapes.skeleton import NEVER, Locals

PATHS = ("translation", "rotation", "scale")
KINDS = ("LINEAR", "STEP", "CUBICSPLINE")
LEAP_S = 1e-3
"""Longest time between two key frames, at most an eighth of the mean, in which a motion counts as a jump: how programs
without STEP write one."""
MOST_JUMPS = 100_000
"""Most jumps of a clip in a sequence that have frames of their own, two each."""


@dataclass(frozen=True, eq=False)
class Track:
    """Key frames of one property. joint : index in its skeleton.   path : of PATHS, or "weights".
    times : (K,) s, increasing.   values : (K, n), of a CUBICSPLINE (K, 3, n): in-tangent, value, out-tangent."""

    joint: int
    path: str
    times: np.ndarray
    values: np.ndarray
    interpolation: str = "LINEAR"

    def at(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Return ((n,), (n,)): value at a time of the clip and its rate per second; held outside the key frames. For a
        rotation use :class:`Clip`."""
        times = self.times
        cubic = self.interpolation == "CUBICSPLINE"
        # A key of a cubic spline has the tangent before it, its value, and the tangent after it.
        values = self.values[:, 1] if cubic else self.values
        # i: the last key that is not later than the time; -1 before the first one.
        i = int(np.searchsorted(times, time, side="right")) - 1
        if i < 0 or i >= len(times) - 1 or self.interpolation == "STEP":
            held = values[min(max(i, 0), len(times) - 1)]
            return held, np.zeros_like(held)
        h = times[i + 1] - times[i]
        s = (time - times[i]) / h
        if not cubic:
            return (1 - s) * values[i] + s * values[i + 1], (values[i + 1] - values[i]) / h
        a, b, u, v = values[i], values[i + 1], h * self.values[i, 2], h * self.values[i + 1, 0]
        # Cubic Hermite: the tangents are per second, the curve is over h seconds.
        value = (
            (2 * s**3 - 3 * s**2 + 1) * a + (s**3 - 2 * s**2 + s) * u + (3 * s**2 - 2 * s**3) * b + (s**3 - s**2) * v
        )
        rate = (6 * s**2 - 6 * s) * (a - b) + (3 * s**2 - 4 * s + 1) * u + (3 * s**2 - 2 * s) * v
        return value, rate / h


@dataclass(frozen=True)
class Playing:
    """Timing of a clip on the sequence's clock. first, last : s, its own times.   speed : clip seconds per second,
    negative: backwards.   phase : clip seconds after ``first`` at time 0.   loop : repeats; otherwise it is held at its
    ends."""

    first: float
    last: float
    speed: float = 1.0
    phase: float = 0.0
    loop: bool = True

    @property
    def period_ns(self) -> int | None:
        """Return the period of a loop; None otherwise."""
        if not self.loop or self.speed == 0 or self.last <= self.first:
            return None
        return max(round((self.last - self.first) / abs(self.speed) * 1e9), 1)

    @property
    def span_ns(self) -> int:
        """Return the time from 0 on in which it takes all its values: a round of a loop; 0: it stands still by then."""
        if self.is_static:
            return 0
        # Without a loop it plays once, and begins late where the phase puts it before the end it comes from.
        passed = 0.0 if self.loop else self.phase if self.speed > 0 else self.last - self.first - self.phase
        return max(round((self.last - self.first - passed) / abs(self.speed) * 1e9), 0)

    @property
    def is_static(self) -> bool:
        return self.speed == 0 or self.last <= self.first

    def timescale_ns(self, tracks: Iterable[Track]) -> int:
        """Return half of the time between the closest two key frames of these tracks between which nothing jumps;
        without any, :data:`~blinkgl.scene.shapes.skeleton.NEVER`."""
        gaps = [np.diff(t.times)[~self._leaps(t)] for t in tracks if t.interpolation != "STEP"]
        closest = float(np.concatenate([*gaps, [np.inf]]).min())
        return max(round(closest / abs(self.speed) * 0.5e9), 1) if closest < np.inf and self.speed else NEVER

    def _leaps(self, track: Track) -> np.ndarray:
        """Return (K - 1,) bool, whether the track jumps between two key frames (:data:`LEAP_S`)."""
        gaps = np.diff(track.times)
        return gaps <= min(LEAP_S * abs(self.speed), 0.125 * (self.last - self.first) / max(len(gaps), 1))

    def jumps(self, tracks: Iterable[Track], t0_ns: int, t1_ns: int) -> list[int]:
        """Return the times in (t0, t1), ns, increasing, at which the value of a track jumps a nanosecond later: at the
        keys of a STEP, before and after a leap between others (:data:`LEAP_S`), and where a loop begins anew with other
        values than it ends with. [] where there are more than
        :data:`MOST_JUMPS`: such a clip jumps at all times."""
        if self.is_static:
            return []
        tracks, places = list(tracks), set()
        for track in tracks:
            values = track.values.reshape(len(track.times), -1)
            changed, leaps = (np.diff(values, axis=0) != 0).any(axis=1), self._leaps(track)
            if track.interpolation == "STEP":
                places |= set(track.times[1:][changed].tolist())
            else:
                places |= {*track.times[1:][changed & leaps].tolist(), *track.times[:-1][changed & leaps].tolist()}
        if self.loop and any(_differs(track, track.at(self.first)[0], track.at(self.last)[0]) for track in tracks):
            places.add(self.first)
        period, times = self.period_ns, set()
        if len(places) * (1 if period is None else (t1_ns - t0_ns) // period + 1) > MOST_JUMPS:
            return []
        for place in places:
            # The sequence's time at which the clip is at ``place``, in one of its rounds.
            at = round(((place - self.first - self.phase) / self.speed) * 1e9)
            rounds = [0] if period is None else range((t0_ns - at) // period, (t1_ns - at) // period + 1)
            times |= {self._last_before(place, at + k * (period or 0)) for k in rounds}
        return sorted(t for t in times if t0_ns < t < t1_ns)

    def _last_before(self, place: float, about_ns: int) -> int:
        """Return the last time before the clip passes a time of its own, which is known to a nanosecond or two."""
        for t_ns in range(about_ns - 2, about_ns + 2):
            # Passed between these two nanoseconds, or the loop begins anew there and its time moves far.
            a, b = self.at(t_ns)[0], self.at(t_ns + 1)[0]
            if (a < place) != (b < place) or abs(b - a) > 0.5 * (self.last - self.first):
                return t_ns
        return about_ns - 1

    def at(self, t_ns: int) -> tuple[float, float]:
        """Return (time of the clip, its rate)."""
        length, period = self.last - self.first, self.period_ns
        if length <= 0:
            return self.first, 0.0
        if self.loop:
            # Whole periods are subtracted in ns, so that every round of a loop is bitwise the same.
            passed = self.speed * (int(t_ns) if period is None else int(t_ns) % period) * 1e-9 + self.phase
            # fmod has the sign of its first argument: a clip that runs backwards comes from below 0.
            within = math.fmod(passed, length)
            return self.first + (within if within >= 0 else within + length), self.speed
        time = self.first + self.phase + self.speed * int(t_ns) * 1e-9
        return min(max(time, self.first), self.last), self.speed if self.first <= time < self.last else 0.0


def _differs(track: Track, a: np.ndarray, b: np.ndarray) -> bool:
    """Return whether two values of a track differ by more than float32 files round; q and -q are one rotation."""
    apart = min(np.abs(a - b).max(), np.abs(a + b).max() if track.path == "rotation" else np.inf)
    return bool(apart > 1e-5 * max(np.abs(a).max(), np.abs(b).max(), 1.0))


class Clip:
    """Tracks on a skeleton. rest : transforms of joints without a track.   tracks : of the others.   playing : timing.

    The motion of :class:`~blinkgl.scene.shapes.skeleton.Skeleton`."""

    def __init__(self, rest: Locals, tracks: Sequence[Track], playing: Playing):
        self.rest, self.playing = rest, playing
        moving = [track for track in tracks if track.path in PATHS]
        self.is_static = playing.is_static or not moving
        self.period_ns, self.span_ns = playing.period_ns, playing.span_ns
        self.timescale_ns = playing.timescale_ns(moving)
        self.jumps = partial(playing.jumps, moving)
        scales = [track for track in moving if track.path == "scale"]
        # A cubic may go below 0 between positive keys.
        self.mirrors = any(track.interpolation == "CUBICSPLINE" or (track.values < 0).any() for track in scales)
        self._joint = np.array([track.joint for track in moving], np.int64)
        self._path = np.array([PATHS.index(track.path) for track in moving], np.int64)
        self._kind = np.array([KINDS.index(track.interpolation) for track in moving], np.int64)
        self._first = np.cumsum([0, *(len(track.times) for track in moving)]).astype(np.int64)
        self._times = np.concatenate([np.zeros(0), *(np.asarray(track.times, np.float64) for track in moving)])
        self._values = np.zeros((len(self._times), 3, 4))
        for track, first in zip(moving, self._first):
            values = np.asarray(track.values, np.float64)
            # One layout for all kinds: in-tangent, value, out-tangent; the tangents of straight lines
            # are unused zeros.
            values = values if values.ndim == 3 else np.stack([0 * values, values, 0 * values], axis=1)
            if track.path == "rotation":
                values = values / np.where(
                    track.interpolation == "CUBICSPLINE", 1.0, np.linalg.norm(values[:, 1:2], axis=2, keepdims=True)
                )
            self._values[first : first + len(values), :, : values.shape[2]] = values

    def locals(self, t_ns: int) -> Locals:
        time, speed = self.playing.at(t_ns)
        out = self.rest.copy()
        _evaluate(time, speed, self._joint, self._path, self._kind, self._first, self._times, self._values, out)
        return out


@kernel(error_model="numpy")
def _evaluate(time, speed, joint, path, kind, first, times, values, out):
    """Write the tracks' values at a time of the clip to ``out``, :class:`Locals`, with rates per second of the
    sequence's clock."""
    T, R, S, dT, dR, dS = out
    value, rate = np.zeros(4), np.zeros(4)
    for track in range(len(joint)):
        begin, end = first[track], first[track + 1]
        # path 1 is a rotation, of four numbers; kind 1 is STEP and 2 is CUBICSPLINE.
        n = 4 if path[track] == 1 else 3
        i, high = begin - 1, end  # the last key that is not later
        while high - i > 1:
            middle = (i + high) // 2
            if times[middle] <= time:
                i = middle
            else:
                high = middle
        rate[:] = 0.0
        if i < begin or i >= end - 1 or kind[track] == 1:
            value[:] = values[min(max(i, begin), end - 1), 1]
        else:
            h = times[i + 1] - times[i]
            s = (time - times[i]) / h
            if kind[track] == 2:
                for k in range(n):
                    a, b = values[i, 1, k], values[i + 1, 1, k]
                    u, v = h * values[i, 2, k], h * values[i + 1, 0, k]
                    value[k] = (
                        (2 * s**3 - 3 * s**2 + 1) * a
                        + (s**3 - 2 * s**2 + s) * u
                        + (3 * s**2 - 2 * s**3) * b
                        + (s**3 - s**2) * v
                    )
                    rate[k] = ((6 * s**2 - 6 * s) * (a - b) + (3 * s**2 - 4 * s + 1) * u + (3 * s**2 - 2 * s) * v) / h
            elif n == 3:
                for k in range(3):
                    value[k] = (1 - s) * values[i, 1, k] + s * values[i + 1, 1, k]
                    rate[k] = (values[i + 1, 1, k] - values[i, 1, k]) / h
            else:
                _slerp(values[i, 1], values[i + 1, 1], s, 1.0 / h, value, rate)
        # A unit quaternion's rate has no part along the quaternion: that part is removed.
        if n == 4:
            length, along = 0.0, 0.0
            for k in range(4):
                length += value[k] * value[k]
            length = np.sqrt(length)
            for k in range(4):
                value[k] /= length
                rate[k] /= length
                along += value[k] * rate[k]
            for k in range(4):
                R[joint[track], k] = value[k]
                dR[joint[track], k] = speed * (rate[k] - value[k] * along)
        else:
            for k in range(3):
                if path[track] == 0:
                    T[joint[track], k], dT[joint[track], k] = value[k], speed * rate[k]
                else:
                    S[joint[track], k], dS[joint[track], k] = value[k], speed * rate[k]


@kernel(error_model="numpy")
def _slerp(a, b, s, ds, value, rate):
    """Interpolate along the shorter arc between unit quaternions, with the rate where s grows by ds per second."""
    cosine = 0.0
    for k in range(4):
        cosine += a[k] * b[k]
    # q and -q are one rotation; the nearer of the two is the target.
    side = 1.0 if cosine >= 0 else -1.0
    distance = 0.0
    for k in range(4):
        distance += (side * b[k] - a[k]) ** 2
    angle = 2 * np.arcsin(min(0.5 * np.sqrt(distance), 1.0))  # exact for small angles, unlike acos
    # Both sines vanish: a straight line is exact to rounding.
    if angle < 1e-9:
        for k in range(4):
            value[k] = a[k] + s * (side * b[k] - a[k])
            rate[k] = ds * (side * b[k] - a[k])
        return
    whole = np.sin(angle)
    u, v = np.sin((1 - s) * angle) / whole, side * np.sin(s * angle) / whole
    du, dv = -angle * np.cos((1 - s) * angle) / whole, side * angle * np.cos(s * angle) / whole
    for k in range(4):
        value[k] = u * a[k] + v * b[k]
        rate[k] = ds * (du * a[k] + dv * b[k])
