"""ESIM on tensors: the events of :class:`blinkgl.events.esim.Esim`, bit for bit, for many environments.

The model is that of :mod:`blinkgl.events.esim` (Rebecq et al., CoRL 2018, section 3): logarithms and levels are
integers in units of 2^-25, times are in nanoseconds. Between two frames the path is a straight line, so all levels that
a pixel passes are known at once: the first lies ``whole - gap`` units along a path of ``whole``, and each further one a
threshold farther. Two features need a loop over the levels: a refractory period, which depends on the last event that
was kept, and jitter, which draws the next thresholds at every level.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from blinkgl.config.events import EsimConfig
from blinkgl.events.arith import Q_ONE
from blinkgl.events.bands import BLOCK
from blinkgl.events.emulator import NEVER_NS
from blinkgl.events.esim import to_q25
from blinkgl.events.philox import Stream
from blinkgl.events.thresholds import MIN_THRESHOLD, pixel_thresholds
from blinkgl.tensors.arith import PerEnv, log_q25_, normal2
from blinkgl.tensors.batch import Batch, Found, Interval, TensorEvents, configured, places

_ASLEEP = 2**30 + 2**28
"""A level that no signal reaches, and whose distance from any signal fits 32 bits: for pixels without a first frame."""
_LONG_NS = 2**31


class Firing(NamedTuple):
    """The pixels at or beyond a level, (M,) int64 each, except shared thresholds."""

    flat: Tensor  # pixel number over all environments, ascending
    env: Tensor
    log: Tensor  # log intensity now
    whole: Tensor  # length of the path from the previous frame
    gap: Tensor  # how far the signal ends beyond the level being passed
    polarity: Tensor
    on: PerEnv  # thresholds of the pixel
    off: PerEnv
    step: PerEnv  # the one of its polarity


class Sizes(NamedTuple):
    """Numbers for the host: events of all pixels and of the busiest one, before any is dropped; how far the farthest
    signal is beyond its level (negative: none is)."""

    total: int
    most: int
    farthest: int


def crossing_ns(part: Tensor, whole: Tensor, dt_ns: PerEnv, longest_ns: int) -> Tensor:
    """Return floor(part / whole * dt_ns) for 0 <= part <= whole < 2^31, exactly: ``crossing_ns`` of
    blinkgl.events.esim."""
    # Both factors are below 2^31, so the product fits int64.
    if longest_ns < _LONG_NS:
        return torch.div(part * dt_ns, whole, rounding_mode="trunc")
    # Schoolbook division: no product reaches 2^63.
    # dt = 2^20 high + low: first the quotient of the upper part, then its rest together with the lower one.
    high, low = dt_ns >> 20, dt_ns & 0xFFFFF
    ahead = part * high
    quotient = torch.div(ahead, whole, rounding_mode="trunc")
    rest = ahead - quotient * whole
    return (quotient << 20) + torch.div((rest << 20) + part * low, whole, rounding_mode="trunc")


def _known(flags: Tensor, size: int) -> Tensor:
    """Return indices of the ``size`` set flags, without synchronising to count them."""
    try:
        return torch.nonzero_static(flags, size=size).view(-1)
    except (NotImplementedError, RuntimeError):  # early versions of torch support it only on CPUs
        return torch.nonzero(flags).view(-1)


class TensorEsim(Batch):
    """ESIM of ``envs`` environments of one size and configuration on ``device``.

        emulator = blinkgl.TensorEsim(480, 640, envs=8, device="cuda", seed=1)
        events = emulator.step(frames, t_ns)  # frames (8, 480, 640) float32, linear luminance

    Environment k makes the events of ``blinkgl.Esim`` with the seed ``seed + k`` (modulo 2^64), bit for bit and in
    their order. A step synchronises with the host once, to get the numbers of pixels and events; once more where a
    refractory period or ``max_events_per_step`` drops events, and once per level where thresholds jitter.

    State: 16 bytes per pixel; 4 more with jitter, 8 with a refractory period, 8 for spread thresholds. Raises
    EventDataError: a size that does not fit.   Source: Rebecq, Gehrig, Scaramuzza, CoRL 2018, section 3."""

    def __init__(
        self,
        height: int,
        width: int,
        config: EsimConfig | None = None,
        *,
        envs: int = 1,
        device: str | torch.device = "cpu",
        seed: int = 0,
    ):
        super().__init__(height, width, envs, device, seed)
        self.config = config = configured(config, EsimConfig)
        total = self.envs * self._pixels
        zeros = lambda dtype, wanted=True: torch.zeros(total if wanted else 0, dtype=dtype, device=self.device)
        on, off = config.thresholds
        # Fixed point from here on; one number where all pixels share it, else a tensor.
        self._on: PerEnv = int(to_q25(on))
        self._off: PerEnv = int(to_q25(off))
        smallest = min(self._on, self._off)
        self._spread = config.threshold_sigma > 0 or config.threshold_map is not None
        if self._spread:
            self._on, self._off = zeros(torch.int32), zeros(torch.int32)
            smallest = min(self._draw(k) for k in range(self.envs))
        self._floor_on, self._floor_off = (int(to_q25(min(MIN_THRESHOLD, c / 2))) for c in (on, off))
        # With jitter every event may draw the smallest threshold, which bounds the number of events.
        self._jitter = config.threshold_jitter * Q_ONE
        if self._jitter:
            smallest = min(self._floor_on, self._floor_off)
        self._inverse_threshold = 1.0 / smallest
        self._refractory_ns = round(config.refractory_us * 1000)
        # Each block of 1024 pixels has its share of max_events_per_step, at least one event per pixel.
        self._share = max(BLOCK, config.max_events_per_step // -(-self._pixels // BLOCK))
        self._log, self._upper, self._lower = (zeros(torch.int32) for _ in range(3))
        # Levels out of reach until the environment's first frame.
        self._upper += _ASLEEP
        self._lower -= _ASLEEP
        self._fired = zeros(torch.int32, self._jitter > 0)
        self._last_ns = zeros(torch.int64, self._refractory_ns > 0) + NEVER_NS
        # Of the first half.
        self._now, self._beyond = zeros(torch.int32), zeros(torch.int32)
        # For one piece: a row for the light and two for the logarithm's intermediate values.
        self._scratch = torch.empty((3, len(self._now[self._chunks()[0]])), device=self.device)
        self._state = ("_log", "_upper", "_lower", "_fired", "_last_ns")

    def _draw(self, k: int) -> int:
        """Set the thresholds of environment k, which stay fixed, and return the smallest."""
        here, seed = self._rows(k), np.uint64(self.seeds[k])
        drawn = pixel_thresholds(self.height, self.width, self.config, seed)
        for tensor, values in zip((self._on, self._off), map(to_q25, drawn)):
            tensor[here] = torch.from_numpy(values.astype(np.int32)).to(self.device)
        return int(min(to_q25(one.min()) for one in drawn))

    def _rows(self, k: int) -> slice:
        """Return the slice of environment k's pixels."""
        return slice(k * self._pixels, (k + 1) * self._pixels)

    def _forget(self, k: int) -> None:
        here = self._rows(k)
        self._upper[here], self._lower[here] = _ASLEEP, -_ASLEEP
        self._last_ns[here if self._refractory_ns else slice(0)] = NEVER_NS
        self._fired[here if self._jitter else slice(0)] = 0

    def _first_levels(self, k: int) -> None:
        """Set the levels around the first frame of environment k."""
        here = self._rows(k)
        on, off = (self._on[here], self._off[here]) if self._spread else (self._on, self._off)
        if self._jitter:
            pixel, key = torch.arange(self._pixels, device=self.device), tuple(self._keys[k])
            on, off = self._jittered(key, pixel, torch.zeros_like(pixel), on, off)
        self._upper[here] = (self._log[here] + on).to(torch.int32)
        self._lower[here] = (self._log[here] - off).to(torch.int32)

    def _jittered(self, key: PerEnv, pixel: Tensor, fired: Tensor, on: PerEnv, off: PerEnv) -> tuple[Tensor, Tensor]:
        """Return the thresholds for the level after ``fired`` levels, int64."""
        a, b = normal2(key, pixel, int(Stream.JITTER), fired)
        up = on + torch.floor(a * self._jitter + 0.5).to(torch.int64)
        down = off + torch.floor(b * self._jitter + 0.5).to(torch.int64)
        return up.clamp(min=self._floor_on), down.clamp(min=self._floor_off)

    # -- a step --------------------------------------------------------------------------------------------------
    def _advance(self, flat: Tensor, interval: Interval) -> TensorEvents:
        extremes = self._look(flat)
        firing, counts, sizes = self._sized(flat, extremes)
        # Caps are only computed where some block could exceed its share: they cost a pass
        # over all pixels.
        cap = self._caps(interval, firing) if self._may_cut(interval, sizes.farthest) else None
        # From here on the state changes.
        self._log, self._now = self._now, self._log
        if self._jitter:
            events = self._walk(firing, interval, cap)
        else:
            events = self._at_once(firing, counts, sizes, interval, cap)
        for k in interval.fresh:
            self._first_levels(k)
        causes = torch.zeros_like(events.word) if self.config.causes else None
        return self._events(interval, events, causes, waves=self._jitter > 0)

    def _look(self, flat: Tensor) -> Tensor:
        """Compute log intensities and distances beyond the levels (the first half), and return the extremes of the
        frames' bits."""
        extremes = []
        for piece in self._chunks():
            now, beyond = self._now[piece], self._beyond[piece]
            # The least and the largest bit pattern tell whether an intensity is invalid, see _refuse.
            extremes.append(torch.stack(torch.aminmax(flat[piece].view(torch.int32))))
            light, first, second = self._scratch[:, : len(now)]
            log_q25_(torch.add(flat[piece], self.config.log_eps, out=light), now, first, second)
            # The reference lies between the two levels, so at most one of them has been reached.
            torch.sub(now, self._upper[piece], out=beyond)
            torch.maximum(beyond, torch.sub(self._lower[piece], now, out=first.view(torch.int32)), out=beyond)
        return torch.stack(extremes)

    def _sized(self, flat: Tensor, extremes: Tensor) -> tuple[Firing, Tensor, Sizes]:
        """Return the firing pixels, the number of levels that each passes, and the numbers for the host.

        The host waits here, once. Raises EventDataError: an invalid intensity."""
        # The host may read numbers freely, so only firing pixels are counted.
        if self._host_is_near:
            self._refuse(flat, int(extremes[:, 0].amin()), int(extremes[:, 1].amax()))
            firing = self._gathered(places(self._beyond))
            # The number of levels that a pixel passes is known only when they are drawn.
            if self._jitter:
                return firing, firing.gap, Sizes(0, 0, int(self._beyond.amax()))
            # Levels that fit between the first one passed and the signal, and the first one itself.
            counts = torch.div(firing.gap, firing.step, rounding_mode="trunc") + 1
            most = int(counts.amax()) if len(counts) else 0
            return firing, counts, Sizes(int(counts.sum()), most, int(self._beyond.amax()))
        # Otherwise every pixel is counted, so that all numbers come in one transfer.
        active = self._beyond >= 0
        step = self._on if self._same_steps else torch.where(self._now >= self._upper, self._on, self._off)
        levels = torch.where(active, torch.div(self._beyond, step, rounding_mode="trunc") + 1, 0)
        # All numbers in one transfer, for which the host waits.
        numbers = (extremes[:, 0].amin(), extremes[:, 1].amax(), active.sum(), levels.sum(), levels.amax())
        looked = torch.stack([one.to(torch.int64) for one in (*numbers, self._beyond.amax())]).tolist()
        self._refuse(flat, looked[0], looked[1])
        firing = self._gathered(_known(active, looked[2]))
        counts = levels.index_select(0, firing.flat).to(torch.int64)
        return firing, counts, Sizes(*looked[3:])

    # A block's worst case: every pixel as far beyond its level as the farthest one.
    def _may_cut(self, v: Interval, farthest: int) -> bool:
        """Return whether some block of pixels could have more events than its share."""
        return BLOCK * (int(max(farthest, 0) * self._inverse_threshold) + 2) > self._share

    def _caps(self, v: Interval, f: Firing) -> Tensor:
        """Return the largest number of events of each firing pixel, (M,) int64, shared as in the single emulator's
        kernel among the firing pixels of a block of 1024."""
        blocks = -(-self._pixels // BLOCK)
        # Padded to whole blocks; -1 is a pixel that does not fire.
        beyond = torch.full((self.envs, blocks * BLOCK), -1, dtype=torch.int32, device=self.device)
        beyond[:, : self._pixels] = self._beyond.view(self.envs, -1)
        beyond = beyond.view(-1, BLOCK)
        count, farthest = (beyond >= 0).sum(1), beyond.amax(1)
        cap = (farthest.to(torch.float64) * self._inverse_threshold).to(torch.int64) + 2
        # At most one event per refractory period, and one at either end.
        if self._refractory_ns:
            env = torch.arange(self.envs, device=self.device).repeat_interleave(blocks)
            dt_ns = torch.as_tensor(v.of(v.dt_ns, env), device=self.device)
            bound = torch.div(dt_ns, self._refractory_ns, rounding_mode="trunc") + 2
            cap = torch.minimum(cap, bound)
        # The share is split among the pixels of the block that fire.
        shared = torch.div(self._share, count.clamp(min=1), rounding_mode="trunc").clamp(min=1)
        cap = torch.where(count * cap > self._share, shared, cap)
        block = torch.div(f.flat - f.env * self._pixels, BLOCK, rounding_mode="trunc") + f.env * blocks
        return cap.index_select(0, block)

    def _count_cut(self, env: Tensor, cut: Tensor) -> None:
        self.saturated.index_add_(0, env, cut.to(torch.int64))

    @property
    def _same_steps(self) -> bool:
        return not self._spread and self._on == self._off

    def _gathered(self, index: Tensor) -> Firing:
        # Gathered as int64, in which products of two 31-bit numbers fit.
        take = lambda tensor: tensor.index_select(0, index).to(torch.int64)
        log, upper, lower = take(self._now), take(self._upper), take(self._lower)
        on, off = (take(self._on), take(self._off)) if self._spread else (self._on, self._off)
        above = log >= upper
        step = on if self._same_steps else torch.where(above, on, off)
        gap = torch.maximum(log - upper, lower - log)
        whole = (log - take(self._log)).abs()
        return Firing(
            flat=index,
            env=self._env_of(index),
            log=log,
            whole=whole,
            gap=gap,
            polarity=above.to(torch.int64),
            on=on,
            off=off,
            step=step,
        )

    def _at_once(self, f: Firing, counts: Tensor, sizes: Sizes, v: Interval, cap: Tensor | None) -> Found:
        """Return all events in raster order and move the levels."""
        # passed: the last level passed.
        passed = f.log - (2 * f.polarity - 1) * (f.gap - (counts - 1) * f.step)
        self._upper.index_copy_(0, f.flat, (passed + f.on).to(torch.int32))
        self._lower.index_copy_(0, f.flat, (passed - f.off).to(torch.int32))
        # word: pixel number and polarity, as Found has it.
        part, whole, word, env = f.whole - f.gap, f.whole, (f.flat << 1) | f.polarity, f.env
        first = owner = f.flat
        # With at most one event per pixel nothing has to be repeated.
        if sizes.most > 1:
            # Number of the first event of each pixel among all events; then every event's pixel and its
            # own number there.
            first = counts.cumsum(0) - counts
            owner = torch.repeat_interleave(counts, output_size=sizes.total)
            of_owner = lambda c: c.index_select(0, owner) if isinstance(c, Tensor) else c
            number = torch.arange(sizes.total, device=self.device) - of_owner(first)
            part = of_owner(part) + number * of_owner(f.step)
            whole, word = of_owner(whole), of_owner(word)
            env = of_owner(env) if self.envs > 1 else torch.zeros_like(word)
        after = crossing_ns(part, whole, v.of(v.dt_ns, env), v.longest_ns)
        after += v.of(v.t0_ns - 1000 * v.base_us, env)
        events = Found(word, torch.div(after, 1000, rounding_mode="trunc"))
        if not self._refractory_ns and cap is None:
            return events
        if sizes.most <= 1:
            first = owner = torch.arange(len(word), device=self.device)
        # Some events may be dropped from here on.
        keep = torch.ones(len(word), dtype=torch.bool, device=self.device)
        if self._refractory_ns:
            keep = self._awake(f, counts, first, sizes.most, after + 1000 * v.of(v.base_us, env))
        if cap is not None:
            let = keep.to(torch.int64)
            # rank: kept events of the same pixel before this one.
            before = let.cumsum(0) - let
            rank = before - before.index_select(0, first.index_select(0, owner))
            within = rank < cap.index_select(0, owner)
            self._count_cut(env, keep & ~within)
            keep = keep & within
        return Found(*(one[keep] for one in events))

    def _awake(self, f: Firing, counts: Tensor, first: Tensor, most: int, t_ns: Tensor) -> Tensor:
        """Return which events come after their pixel's refractory period, (N,) bool; the others are dropped.

        first : each pixel's first event.   t_ns : of all events, pixel by pixel. One iteration per level, over all
        pixels, so that no size depends on the dropped events."""
        # The j-th levels of all pixels are processed together.
        last = self._last_ns.index_select(0, f.flat)
        # The additional last element takes the writes of pixels without a j-th level.
        keep = torch.zeros(len(t_ns) + 1, dtype=torch.bool, device=self.device)
        for j in range(most):
            there = counts > j
            at = torch.where(there, first + j, len(t_ns))
            time = t_ns.index_select(0, at.clamp(max=len(t_ns) - 1))
            alive = there & (time - last >= self._refractory_ns)
            last = torch.where(alive, time, last)
            keep.index_copy_(0, at, alive)
        self._last_ns.index_copy_(0, f.flat, last)
        return keep[:-1]

    def _walk(self, f: Firing, v: Interval, cap: Tensor | None) -> Found:
        """Return the result of :meth:`_at_once` level by level, with new thresholds at each."""
        slots = torch.arange(len(f.flat), device=self.device)
        gap, fired = f.gap.clone(), self._fired.index_select(0, f.flat).to(torch.int64)
        up, down, emitted = torch.zeros_like(gap), torch.zeros_like(gap), torch.zeros_like(gap)
        last = self._last_ns.index_select(0, f.flat) if self._refractory_ns else gap
        rounds: list[Found] = []
        # One iteration per level; pixels without a further one drop out.
        while len(slots):
            flat, env, whole = (one.index_select(0, slots) for one in (f.flat, f.env, f.whole))
            here, polarity = gap.index_select(0, slots), f.polarity.index_select(0, slots)
            after = crossing_ns(whole - here, whole, v.of(v.dt_ns, env), v.longest_ns)
            after += v.of(v.t0_ns - 1000 * v.base_us, env)
            alive = torch.ones_like(slots, dtype=torch.bool)
            if self._refractory_ns:
                time, before = after + 1000 * v.of(v.base_us, env), last.index_select(0, slots)
                alive = time - before >= self._refractory_ns
                last.index_copy_(0, slots, torch.where(alive, time, before))
            if cap is not None:
                within = emitted.index_select(0, slots) < cap.index_select(0, slots)
                self._count_cut(env, alive & ~within)
                alive = alive & within
                emitted.index_add_(0, slots, alive.to(torch.int64))
            # Number of the pixel in the whole batch, and the polarity in bit 0.
            word = (flat << 1) | polarity
            rounds.append(Found(word[alive], torch.div(after[alive], 1000, rounding_mode="trunc")))
            # The next thresholds, drawn once per level and numbered by the levels passed.
            number = fired.index_select(0, slots) + 1
            on, off = (c.index_select(0, slots) if isinstance(c, Tensor) else c for c in (f.on, f.off))
            key = self._keys[env].unbind(1)
            new_up, new_down = self._jittered(key, flat - env * self._pixels, number, on, off)
            here = here - torch.where(polarity.bool(), new_up, new_down)
            for target, values in ((fired, number), (up, new_up), (down, new_down), (gap, here)):
                target.index_copy_(0, slots, values)
            slots = slots[here >= 0]
        # The last level passed, from what is left of the gap: the new reference.
        passed = f.log - (2 * f.polarity - 1) * (gap + torch.where(f.polarity.bool(), up, down))
        self._upper.index_copy_(0, f.flat, (passed + up).to(torch.int32))
        self._lower.index_copy_(0, f.flat, (passed - down).to(torch.int32))
        self._fired.index_copy_(0, f.flat, fired.to(torch.int32))
        if self._refractory_ns:
            self._last_ns.index_copy_(0, f.flat, last)
        return Found(*(torch.cat([f.flat[:0], *(one[c] for one in rounds)]) for c in range(2)))
