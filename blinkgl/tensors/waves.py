"""V2E's events of the firing pixels, on tensors: their first events together, then their second ones, and so on.

The sums and products of :mod:`blinkgl.events.v2e_blocks`, in its order, on float64 rows: over an interval a pixel's
signal is z(s) = c + rise s + fall e^(-k s) for s in [0, 1] (``v2e_model.curve_of``). A wave finds where each pixel's
signal meets its level, lets earlier shot noise come first, and sets the levels around the new reference; pixels with
another event continue in the next wave. Their number is known only then, so there is one synchronisation per wave.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from blinkgl.events.packing import CAUSE_SHIFT
from blinkgl.events.philox import Stream
from blinkgl.tensors.arith import PerEnv, fall_f64, rough_normal
from blinkgl.types.events import Cause

_TURNS = 60  # of the root finder, as in the kernel
Rows = dict[str, Tensor]
"""Quantities of the pixels that fire, (M,) float64 or int64 each."""


@dataclass(frozen=True, eq=False)
class Shots:
    """Shot noise of an interval, sorted by pixel, then time, then polarity: (N,) int64 each."""

    flat: Tensor
    after_ns: Tensor
    polarity: Tensor


@dataclass(frozen=True)
class Parts:
    """Parts of the model that are on."""

    low_pass: bool
    refractory_ns: int
    leak_jitter: float
    causes: bool


class Step(NamedTuple):
    """Values of a step that are the same for all pixels of an environment: a number, or (M,) for the firing pixels.

    t0_ns, dt_ns, dt, since_0, since_1, kappa : of v2e.py's Interval.   start_ns : t0 after the base's microsecond.
    low, high : the seeds' words."""

    t0_ns: PerEnv
    start_ns: PerEnv
    dt_ns: PerEnv
    dt: PerEnv
    since_0: PerEnv
    since_1: PerEnv
    kappa: PerEnv
    low: PerEnv
    high: PerEnv

    def of(self, which: Tensor) -> Step:
        """Return the step for these pixels, or for pixels of these environments."""
        return Step(*(value[which] if isinstance(value, Tensor) else value for value in self))


def add_curves(r: Rows, v: Step, has: Parts) -> None:
    """Compute c, rise, fall, k and end of the rows' signals, from the interval's start (s = 0, e = e^(-k s) = 1)."""
    # z(s) = c + rise s + fall e^(-k s), as in v2e_model.curve_of; noise and leak change linearly.
    dx = r["x1"] - r["x0"]
    base, drift = r["x0"] + r["noise"] + r["leak"] * v.since_0, r["shift"] + r["leak"] * v.dt
    r["rise"], r["s"], r["e"] = drift + dx, torch.zeros_like(dx), torch.ones_like(dx)
    if has.low_pass:
        r["k"] = ((r["i0"] + r["i1"]) * 0.5 + 20.0) * v.kappa
        # behind: the final lag of a low-pass behind a ramp.
        behind = dx / r["k"]
        r["c"], r["fall"], r["end"] = base - behind, r["lag0"] + behind, base + drift + dx + r["lag1"]
    else:
        # k = -1: no low-pass.
        r["k"], r["c"], r["fall"] = torch.full_like(dx, -1.0), base, torch.zeros_like(dx)
        r["end"] = base + drift + dx


def _curve_at(r: Rows, s: Tensor, e: Tensor, low_pass: bool) -> Tensor:
    straight = r["c"] + r["rise"] * s
    return straight + r["fall"] * e if low_pass else straight


def _decayed(r: Rows, s: Tensor, low_pass: bool) -> Tensor:
    return fall_f64(r["k"] * s) if low_pass else r["e"]


def wake(r: Rows, v: Step, has: Parts, waking: Tensor) -> None:
    """Set the levels of the pixels whose dead time ends in the interval, at its end (row ``now``)."""
    # The signal at the end of the dead time is the new reference.
    s = r["now"].to(torch.float64) / v.dt_ns
    e = _decayed(r, s, has.low_pass)
    reference = _curve_at(r, s, e, has.low_pass)
    for name, value in (("s", s), ("e", e), ("up", reference + r["on"]), ("down", reference - r["off"])):
        r[name] = torch.where(waking, value, r[name])
    if has.causes:
        r["since"] = torch.where(waking, r["now"], r["since"])
        r["noise_then"] = torch.where(waking, r["noise"] + r["shift"] * s, r["noise_then"])


def _aim(r: Rows) -> None:
    """Find the level that each pixel reaches by the interval's end, if any."""
    above = r["end"] >= r["up"]
    # At most one of both levels has been reached.
    r["target"] = torch.where(above, r["up"], r["down"])
    r["sign"] = above.to(torch.float64) * 2.0 - 1.0
    r["polarity"] = above.to(torch.int64)
    r["fires"] = above | (r["end"] <= r["down"])


def _turn(s: Tensor, low: Tensor, high: Tensor, r: Rows) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return (s, bracket, whether s is accurate enough) after a Newton step, or after a bisection where that leaves
    the bracket."""
    k, sign = r["k"], r["sign"]
    e = r["fall"] * fall_f64(k * s)
    f = sign * (r["c"] + r["rise"] * s + e - r["target"])
    slope = sign * (r["rise"] - k * e)
    following = s - f / slope
    # A bracket has f < 0 at its low end and f >= 0 at its high end.
    low, high = torch.where(f < 0, s, low), torch.where(f < 0, high, s)
    newton = (slope > 0) & (low <= following) & (following <= high)
    following = torch.where(newton, following, (low + high) * 0.5)
    moved = (following - s).abs()
    # After a Newton step the error is moved^2 |z''| / (2 z'): no further step where that is below 1e-6.
    done = (newton & (moved * moved * k * k * e.abs() <= slope * 2e-6)) | (moved < 1e-9)
    return following, low, high, done


def _meet(r: Rows) -> None:
    """Compute row ``at``: where the signal of a pixel with a low-pass meets its level."""
    c, rise, fall, k, end = (r[name] for name in ("c", "rise", "fall", "k", "end"))
    low, e_low, target, sign = (r[name] for name in ("s", "e", "target", "sign"))
    f_low, f_high = sign * (c + rise * low + fall * e_low - target), sign * (end - target)
    # The inverse cubic Hermite interpolant of z guesses; its slopes are 1 / z' at both ends.
    # At s = 1 the term fall e^(-k s) is end - c - rise.
    v_low, v_high = sign * (rise - k * fall * e_low), sign * (rise - k * (end - c - rise))
    width, height = 1.0 - low, f_high - f_low
    # u: where the chord meets the level.
    u = -f_low / height
    s = low + width * u
    stretch = height / (width * v_low * v_high)
    v = 1.0 - u
    guess = u * (v * stretch * (v * v_high - u * v_low) + u * (3.0 - u * 2.0))
    s = torch.where((v_low > 0) & (v_high > 0) & (guess > 0.0) & (guess < 1.0), low + width * guess, s)
    # The signal is beyond the level at the start.
    at_once = f_low >= 0
    following, lower, upper, done = _turn(s, low, torch.ones_like(low), r)
    r["at"] = torch.where(at_once, low, following)
    # The few pixels that need more iterations are gathered.
    left = torch.nonzero(r["fires"] & ~(at_once | done)).view(-1)
    names = ("c", "rise", "fall", "k", "target", "sign")
    part = {name: r[name][left] for name in names}
    s, lower, upper = r["at"][left], lower[left], upper[left]
    for _ in range(_TURNS - 1):
        if not len(left):
            break
        s, lower, upper, done = _turn(s, lower, upper, part)
        r["at"][left] = s
        open_ = ~done
        left, s, lower, upper = left[open_], s[open_], lower[open_], upper[open_]
        part = {name: value[open_] for name, value in part.items()}


def _meet_lines(r: Rows) -> None:
    # Without a low-pass the signal is the line c + rise s.
    s = (r["target"] - r["c"]) / r["rise"]
    # 0 / 0 is NaN where the signal is on the level; the comparison then selects s.
    s = torch.where(s > r["s"], s, r["s"])
    r["at"] = torch.where(s < 1.0, s, torch.ones_like(s))


def _let_shots_come_first(r: Rows, shots: Shots, v: Step) -> None:
    """Replace the crossing by shot noise where that comes first. Row ``shot``: a pixel's next one, or their end."""
    end = len(shots.flat)
    # Indices are limited to the list; ``mine`` says whether they are valid.
    at = lambda column, key: column[key.clamp(max=end - 1)]
    mine = lambda key: (key < end) & (at(shots.flat, key) == r["flat"])
    key = r["shot"]
    while bool((early := mine(key) & (at(shots.after_ns, key) < r["now"])).any()):
        # Shot noise of the pixel's dead time is skipped.
        key = key + early.to(torch.int64)
    noise_ns = at(shots.after_ns, key)
    # At the same ns noise comes before the crossing.
    first = mine(key) & (~r["fires"] | (noise_ns <= r["at_ns"]))
    r["fires"], r["by_noise"] = r["fires"] | first, first
    r["polarity"] = torch.where(first, at(shots.polarity, key), r["polarity"])
    r["at_ns"] = torch.where(first, noise_ns, r["at_ns"])
    r["at"] = torch.where(first, noise_ns.to(torch.float64) / v.dt_ns, r["at"])
    key = key + first.to(torch.int64)
    r["shot"] = torch.where(mine(key), key, end)


def _change_leaks(r: Rows, v: Step, jitter: float) -> None:
    """Draw a new leak after every event, and move the rest of the curve to the new drift."""
    drawn = rough_normal((v.low, v.high), r["pixel"], int(Stream.LEAK_JITTER), r["at_ns"] + v.t0_ns)
    spread = drawn * jitter + 1.0
    # A leak interval is at least a tenth of its mean.
    spread = torch.where(spread > 0.1, spread, torch.full_like(spread, 0.1))
    # Through float32, as it is stored, so that later steps see the same number.
    fresh = (r["mean_leak"] / spread).to(torch.float32).to(torch.float64)
    change = torch.where(r["fires"], fresh - r["leak"], torch.zeros_like(fresh))
    r["leak"] = r["leak"] + change
    # The reference stays; its value relative to the new drift changes.
    r["target"] = r["target"] + change * (r["at"] * v.dt + v.since_0)
    r["c"] = r["c"] + change * v.since_0
    r["rise"] = r["rise"] + change * v.dt
    r["end"] = r["end"] + change * v.since_1


def _cause_bits(r: Rows) -> Tensor:
    """Return the cause of each event, in its place in the packed word: the largest part of the pixel's change."""
    sign, size = r["sign"], torch.where(r["polarity"].bool(), r["on"], r["off"])
    # Change of the signal by leak and noise since the reference was taken; light is the rest.
    by_leak = sign * r["leak"] * ((r["at_ns"] - r["since"]).to(torch.float64) * 1e-9)
    by_noise = sign * (r["noise"] + r["shift"] * r["at"] - r["noise_then"])
    light = size - by_leak - by_noise
    leak = torch.where(r["hot"].bool(), int(Cause.HOT), int(Cause.LEAK))
    cause = torch.where(by_leak >= by_noise, leak, int(Cause.SHOT))
    cause = torch.where((light >= by_leak) & (light >= by_noise), int(Cause.SIGNAL), cause)
    return torch.where(r["by_noise"], int(Cause.SHOT), cause) << CAUSE_SHIFT


def _new_references(r: Rows, v: Step, has: Parts, shots: Shots | None) -> None:
    """Set the levels after the wave's events, and find the pixels in their dead time at the interval's end
    (``dead``)."""
    fires = r["fires"]
    if has.refractory_ns:
        # After an event the reference is taken at the end of the dead time, else at the event.
        r["now"] = torch.where(fires, r["at_ns"] + has.refractory_ns, r["now"])
        s = r["now"].to(torch.float64) / v.dt_ns
        e = _decayed(r, s, has.low_pass)
        r["target"] = _curve_at(r, s, e, has.low_pass)
        r["s"], r["e"] = torch.where(fires, s, r["s"]), torch.where(fires, e, r["e"])
        r["dead"] = fires & (r["now"] > v.dt_ns)
    else:
        r["now"], r["s"], r["dead"] = r["at_ns"], r["at"], torch.zeros_like(fires)
        # After shot noise the reference is the signal itself.
        if shots is not None:
            here = _curve_at(r, r["at"], _decayed(r, r["at"], has.low_pass), has.low_pass)
            r["target"] = torch.where(r["by_noise"], here, r["target"])
    r["up"] = torch.where(fires, r["target"] + r["on"], r["up"])
    r["down"] = torch.where(fires, r["target"] - r["off"], r["down"])


def waves(
    r: Rows, v: Step, has: Parts, shots: Shots | None, put_back: Callable[[Rows, Step], None]
) -> list[tuple[Tensor, Tensor, Tensor]]:
    """(word, microseconds after the base, cause) of every wave's events.

    r : rows of the pixels with levels, in raster order.   put_back : called with the rows after each wave."""
    events = []
    while len(r["flat"]):
        _aim(r)
        if has.low_pass:
            # After an event without dead time s has moved, and e follows it.
            if events and not has.refractory_ns:
                r["e"] = fall_f64(r["k"] * r["s"])
            _meet(r)
        else:
            _meet_lines(r)
        # Pixels that do not fire may have NaN here.
        at = torch.where(r["fires"], r["at"], torch.zeros_like(r["at"]))
        r["at_ns"], r["by_noise"] = torch.floor(at * v.dt_ns).to(torch.int64), torch.zeros_like(r["fires"])
        if shots is not None:
            _let_shots_come_first(r, shots, v)
        fires = r["fires"]
        # Number of the pixel in the whole batch, and the polarity in bit 0.
        word = (r["flat"] << 1) | r["polarity"]
        cause = _cause_bits(r) if has.causes else word
        after = torch.div(r["at_ns"] + v.start_ns, 1000, rounding_mode="trunc")
        events.append((word[fires], after[fires], cause[fires] >> CAUSE_SHIFT))
        if has.leak_jitter > 0.0:
            _change_leaks(r, v, has.leak_jitter)
        _new_references(r, v, has, shots)
        if has.causes:
            new = fires & ~r["dead"]
            r["since"] = torch.where(new, r["now"], r["since"])
            r["noise_then"] = torch.where(new, r["noise"] + r["shift"] * r["s"], r["noise_then"])
        put_back(r, v)
        # Another event follows if the end of the curve is beyond a level, or shot noise of the
        # pixel is left.
        passed = (r["end"] >= r["up"]) | (r["end"] <= r["down"])
        if shots is not None:
            passed = passed | (r["shot"] != len(shots.flat))
        keep = fires & ~r["dead"] & passed
        r, v = {name: value[keep] for name, value in r.items()}, v.of(keep)
    return events
