"""V2E on tensors: the events of :class:`blinkgl.events.v2e.V2e`, bit for bit, for many environments.

The model is that of :mod:`blinkgl.events.v2e` (Hu, Liu, Delbruck, CVPRW 2021): a lin-log photoreceptor of finite
bandwidth, thresholds spread over the pixels, leak, shot noise, photoreceptor noise, dead time. Its first half computes
the photoreceptors of all pixels in float32; :mod:`blinkgl.tensors.waves` makes the events of those that fire.

The state before a first frame (leak and noise after a long time in front of a scene) is drawn by the numba emulator on
the host, once for each environment that begins, and then copied to the device.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import v2e_model as model
from blinkgl.events.bands import BLOCK
from blinkgl.events.noise import TABLE_LOW, TABLE_SIZE, TABLE_STEP, noise_table
from blinkgl.events.packing import MAX_CAUSE_ROWS
from blinkgl.events.philox import Stream
from blinkgl.events.thresholds import pixel_thresholds
from blinkgl.events.v2e import V2e
from blinkgl.tensors.arith import PerEnv, exp_f32, horner, log_f32, log_f64, normal2, sqrt, uniform2
from blinkgl.tensors.batch import Batch, Found, Interval, TensorEvents, configured, places, stable_order
from blinkgl.tensors.waves import Parts, Rows, Shots, Step, add_curves, wake, waves

# Constants of the numba functions, so that there is one copy of each.
_SLOPE, _DARK, _SETTLED = (float(getattr(model, name)) for name in ("_SLOPE", "DARK", "SETTLED"))
_SMALLEST_K = float(vars(model)["_SMALLEST_K"])
# The coefficients of the highest power first, as horner takes them.
_GROWTH = list(map(float, model.GROWTH_32))
_TABLE_LOW, _TABLE_PER, _TABLE_LAST = float(np.float32(TABLE_LOW)), float(np.float32(1 / TABLE_STEP)), TABLE_SIZE - 2
_NOT_YET_NS = 2**62
_INF = float("inf")


def lin_log(intensity: Tensor) -> Tensor:
    """Return ln(I) above 20 DN, the chord from the origin below; float32. See ``v2e_model.lin_log``."""
    # torch.where computes both sides, so the logarithm's argument is clamped to its range.
    dim = torch.where(intensity < _DARK, 0.0, intensity * _SLOPE)
    return torch.where(intensity <= 20.0, dim, log_f32(intensity.clamp(min=20.0)))


def settled(lag: Tensor) -> Tensor:
    """Return a lag, 0 where it is over, which avoids subnormal numbers."""
    return torch.where(lag.abs() < _SETTLED, 0.0, lag)


def decay(k: Tensor) -> tuple[Tensor, Tensor]:
    """Return (e^-k, (1 - e^-k)/k), float32, k >= 0. See ``v2e_model.decay``."""
    small, large = k.clamp(max=0.5), k.clamp(min=0.5)
    # Taylor series below k = 1/2, the exponential above.
    p, e = horner(small, _GROWTH), exp_f32(-large)
    gentle = k < 0.5
    return torch.where(gentle, 1.0 - small * p, e), torch.where(gentle, p, (1.0 - e) / large)


class Numbers(NamedTuple):
    """Values of a step: one number where all environments have the same, else a tensor.

    step : (environments,) where it is a tensor.   kappa_32, since_32 : float32, columns (environments, 1) likewise.
    lengths_ns : of the intervals."""

    step: Step
    kappa_32: PerEnv
    since_32: PerEnv
    lengths_ns: list[int]


class TensorV2e(Batch):
    """V2E of ``envs`` environments of one size and configuration on ``device``; used as :class:`TensorEsim`.

    Environment k makes the events of ``blinkgl.V2e`` with the seed ``seed + k`` (modulo 2^64), bit for bit and in their
    order, noise included, with two limits: ``max_events_per_step`` cuts nothing, and the first frame of an environment
    is processed on the host (0.1 to 1 s at 640x480). A step synchronises with the host once for the checks, once per
    wave of events, and, with shot noise, once for each candidate of the busiest block of 1024 pixels.

    Raises EventDataError: a size that does not fit.   Source: Hu, Liu, Delbruck, CVPRW 2021."""

    # Of the state and the constants, those that are named below; see V2e and its Pixels.
    _intensity: Tensor
    _upper: Tensor
    _lower: Tensor
    _leak: Tensor
    _release: Tensor
    _since_ns: Tensor
    _noise_then: Tensor
    _hot: Tensor
    _clock_ns: Tensor
    _clock_index: Tensor
    _shot_table: Tensor

    def __init__(
        self,
        height: int,
        width: int,
        config: V2eConfig | None = None,
        *,
        envs: int = 1,
        device: str | torch.device = "cpu",
        seed: int = 0,
    ):
        super().__init__(height, width, envs, device, seed)
        self.config = config = configured(config, V2eConfig)
        if config.causes and height > MAX_CAUSE_ROWS:
            raise EventDataError("too many rows", where="causes", value=height, accepted=f"at most {MAX_CAUSE_ROWS}")
        self._has = Parts(
            low_pass=config.cutoff_hz > 0,
            refractory_ns=round(config.refractory_us * 1000),
            leak_jitter=config.leak_jitter,
            causes=config.causes,
        )
        self._leaky = config.leak_rate_hz > 0 or config.hot_pixel_fraction > 0
        self._noisy = config.photoreceptor_noise and config.shot_noise_rate_hz > 0
        self._shots = config.shot_noise_rate_hz > 0 and not config.photoreceptor_noise
        if not self._leaky:
            self._has = replace(self._has, leak_jitter=0.0)
        # Whole blocks of 1024 pixels, the last one padded.
        self._blocks = -(-self._pixels // BLOCK)
        self._shot_unit = 0.5 * config.shot_noise_rate_hz * model.DARKEST * 1e-9
        self._shots_per_ns, self._rebase_ns = np.zeros(self.envs), np.full(self.envs, 2**61)
        self._make_state(config)
        for k in range(self.envs):
            self._draw(k, config)
            self._forget(k)
        self._sizes: dict[int, Tensor] = {}

    def _make_state(self, config: V2eConfig) -> None:
        """Make flat tensors for the state, by the names of V2e's arrays, and for what is drawn once."""
        memory = self._has.low_pass or config.shot_noise_rate_hz > 0
        float32, int64, pixels, blocks = torch.float32, torch.int64, self._pixels, self._blocks
        # Name: type, elements per environment, whether the configuration needs it.
        wanted = {
            "_x": (float32, pixels, True),
            "_upper": (float32, pixels, True),
            "_lower": (float32, pixels, True),
            "_intensity": (float32, pixels, memory),
            "_lag": (float32, pixels, self._has.low_pass),
            "_noise": (float32, pixels, self._noisy),
            "_leak": (float32, pixels, self._leaky),
            "_release": (int64, pixels, self._has.refractory_ns > 0),
            "_since_ns": (int64, pixels, config.causes),
            "_noise_then": (float32, pixels, config.causes),
            "_clock_ns": (int64, blocks, self._shots),
            "_clock_index": (int64, blocks, self._shots),
        }
        drawn = {
            "_on": (float32, pixels, True),
            "_off": (float32, pixels, True),
            "_mean_leak": (float32, pixels, self._leaky),
            "_hot": (torch.uint8, pixels, config.causes),
            "_shot_table": (float32, blocks * 2 * BLOCK, self._shots),
        }
        for name, (dtype, size, there) in {**wanted, **drawn}.items():
            setattr(self, name, torch.zeros(self.envs * size if there else 0, dtype=dtype, device=self.device))
        self._state = tuple(name for name, (_, _, there) in wanted.items() if there)

    def _draw(self, k: int, c: V2eConfig) -> None:
        """Draw the constant properties of environment k's sensor."""
        seed, size = np.uint64(self.seeds[k]), (self.height, self.width)
        on, off = (one.astype(np.float32) for one in pixel_thresholds(*size, c, seed))
        leak = model.draw_leaks(*size, c, on, seed)
        drawn = {"_on": on, "_off": off, "_mean_leak": leak}
        if leak.size and leak.max() > 0:
            # The leak clock restarts when the median pixel has leaked REBASE.
            self._rebase_ns[k] = int(model.REBASE / float(np.median(leak[leak > 0])) * 1e9)
        if c.causes:
            drawn["_hot"] = model.draw_hot(*size, c, seed)
        if self._shots:
            table = drawn["_shot_table"] = model.shot_tables(on, off, *c.thresholds)
            self._shots_per_ns[k] = self._shot_unit * float(table[:, -1:].sum())  # if all pixels were dark
        self._take(k, drawn)

    def _take(self, k: int, arrays: dict[str, np.ndarray]) -> None:
        """Copy arrays to environment k's part of the tensors of their names."""
        for name, array in arrays.items():
            if array.size:
                getattr(self, name).view(self.envs, -1)[k] = torch.from_numpy(array.reshape(-1))

    def _forget(self, k: int) -> None:
        rows = lambda name: getattr(self, name).view(self.envs, -1)[k]
        # Levels that no signal reaches.
        rows("_upper").fill_(_INF)
        rows("_lower").fill_(-_INF)
        if self._shots:
            rows("_clock_ns").fill_(_NOT_YET_NS)
        self._clock[k, 3] = 0

    # -- a step --------------------------------------------------------------------------------------------------
    def _advance(self, flat: Tensor, interval: Interval) -> TensorEvents:
        self._refuse_noise(interval)
        # Extremes first: a frame that is refused must change nothing.
        bits = torch.aminmax(flat.view(torch.int32))
        lowest, highest = torch.stack(bits).tolist()
        self._refuse(flat, lowest, highest)
        each = self._numbers(interval)
        now, beyond = self._look(flat.view(self.envs, -1), each)
        shots = self._draw_shots(interval, now) if self._shots else None
        rows, step = self._rows(places(self._flagged(beyond, shots)), now, shots, each, interval)
        events = waves(rows, step, self._has, shots, self._put_back)
        # The second half is done: the photoreceptors' values become the state.
        for name, value in now.items():
            getattr(self, name).copy_(value.reshape(-1))
        self._rest_leaks(interval, each)
        for k in interval.fresh:
            self._begin(k, flat, int(interval.end_ns[k]))
        none = torch.empty(0, dtype=torch.int64, device=self.device)
        word, after, cause = (torch.cat([none, *(wave[c] for wave in events)]) for c in range(3))
        return self._events(interval, Found(word, after), cause if self.config.causes else None, waves=True)

    def _numbers(self, v: Interval) -> Numbers:
        """Return the step's numbers, computed in double precision on the host as V2e does, and rounded once where
        float32 is needed."""
        config, lengths = self.config, v.lengths_ns
        # A fresh environment's leak clock starts with its frame.
        epoch = np.where(self._clock[:, 0] == 1, self._clock[:, 3], v.start_ns)
        since_0, since_1 = ([one * 1e-9 for one in (times - epoch).tolist()] for times in (v.start_ns, v.end_ns))

        def given(values: list[float]) -> Any:
            if all(value == values[0] for value in values):
                return values[0]
            return torch.tensor(values, dtype=torch.float64, device=self.device)

        column = lambda v: v.to(torch.float32)[:, None] if isinstance(v, Tensor) else float(np.float32(v))
        # kappa = 2 pi f_c dt / 275, time constants per DN of (I + 20).
        kappa = given([2 * np.pi * config.cutoff_hz * dt * 1e-9 / 275.0 for dt in lengths])
        dt, since = given([dt * 1e-9 for dt in lengths]), given(since_1)
        step = Step(
            t0_ns=v.t0_ns,
            start_ns=v.t0_ns - 1000 * v.base_us,
            dt_ns=v.dt_ns,
            dt=dt,
            since_0=given(since_0),
            since_1=since,
            kappa=kappa,
            low=None,
            high=None,
        )
        return Numbers(step, column(kappa), column(since), lengths)

    def _refuse_noise(self, interval: Interval) -> None:
        """Raise EventDataError for more shot noise in an interval than a step may emit."""
        lengths = interval.end_ns - interval.start_ns
        for k in np.flatnonzero(self._shots_per_ns * lengths > self.config.max_events_per_step)[:1]:
            raise EventDataError(
                "more shot noise than max_events_per_step in one interval",
                where=f"environment {k}, frame {self._clock[k, 2]}",
                value=f"{lengths[k]} ns",
                accepted="a shorter interval or a lower shot_noise_rate_hz",
            )

    def _look(self, frames: Tensor, each: Numbers) -> tuple[dict[str, Tensor], Tensor]:
        """Compute the first half: what the photoreceptors hold at the interval's end, by the name of the state, and
        how far their signals lie beyond the levels; (environments, pixels) float32."""
        before: Callable[[str], Tensor] = lambda name: getattr(self, name).view(self.envs, -1)
        intensity = frames * self.config.full_scale
        x = lin_log(intensity)
        now = {"_intensity": intensity} if "_intensity" in self._state else {}
        now["_x"] = signal = x
        k = None
        if self._has.low_pass:
            # First low-pass, whose corner follows the mean intensity of the interval.
            k = ((before("_intensity") + intensity) * 0.5 + 20.0) * each.kappa_32
            a, g = decay(k)
            now["_lag"] = settled(before("_lag") * a - (x - before("_x")) * g)
            signal = x + now["_lag"]
        if self._leaky:
            signal = signal + before("_leak") * each.since_32
        if self._noisy and k is not None:
            now["_noise"] = self._next_noise(before("_noise"), k, each)
            signal = signal + now["_noise"]
        return now, torch.maximum(signal - before("_upper"), before("_lower") - signal)

    def _next_noise(self, noise: Tensor, k: Tensor, each: Numbers) -> Tensor:
        """Return the photoreceptor noise at the interval's end, by the exact step of an Ornstein-Uhlenbeck process."""
        pairs = torch.arange((self._pixels + 1) // 2, device=self.device)
        # Pixels 2j and 2j + 1 share a draw. One environment at a time: its draws take forty times their memory.
        drawn = [
            torch.stack(normal2(self._keys[e].unbind(0), pairs, int(Stream.NOISE), int(self._clock[e, 2])), 1).view(-1)
            for e in range(self.envs)
        ]
        normal = torch.stack(drawn)[:, : self._pixels].to(torch.float32)
        # The size is interpolated in ln k, as in v2e_model.noise_place.
        place = (log_f32(k.clamp(min=_SMALLEST_K)) - _TABLE_LOW) * _TABLE_PER
        below = place.clamp(min=0.0, max=float(_TABLE_LAST)).to(torch.int64)
        part = place.clamp(max=float(_TABLE_LAST)) - below.to(torch.float32)
        sizes = torch.stack([self._noise_sizes(dt) for dt in each.lengths_ns])
        low, high = sizes.gather(1, below), sizes.gather(1, below + 1)
        a, _ = decay(k)
        return noise * a + (low + part * (high - low)) * sqrt(1.0 - a * a) * normal

    def _noise_sizes(self, dt_ns: int) -> Tensor:
        """Return the table of the noise's size over ln k, (TABLE_SIZE,) float32, for this frame spacing."""
        if dt_ns not in self._sizes:
            c = self.config
            made = noise_table(c.shot_noise_rate_hz, dt_ns * 1e-9, model.noise_threshold(c), c.refractory_us * 1e-6)
            # Tables of a few spacings are kept; with varying spacings they would pile up.
            self._sizes = {**(self._sizes if len(self._sizes) < 2 * self.envs else {})}
            self._sizes[dt_ns] = torch.from_numpy(made).to(self.device)
        return self._sizes[dt_ns]

    def _draw_shots(self, interval: Interval, now: dict[str, Tensor]) -> Shots | None:
        """Draw the shot noise of the interval, None without any, and move the clocks. One Poisson clock per block of
        1024 pixels, at the rate of dark pixels, thinned to the rate at their intensities (Lewis and Shedler 1979)."""
        table = self._shot_table.view(-1, 2 * BLOCK)
        # Every block of every environment has a clock; all due ones advance together, one candidate per turn.
        env = torch.arange(self.envs, device=self.device).repeat_interleave(self._blocks)
        block = torch.arange(self._blocks, device=self.device).repeat(self.envs)
        end_ns = torch.from_numpy(interval.end_ns).to(self.device)[env]
        start_ns, dt_ns = (self._filled(v, env) for v in (interval.t0_ns, interval.dt_ns))
        whole = table[:, -1].to(torch.float64)
        rate = whole * self._shot_unit
        shots: list[tuple[Tensor, ...]] = []
        while len(due := torch.nonzero(self._clock_ns <= end_ns).view(-1)):
            key, number, b = self._keys[env[due]].unbind(1), self._clock_index[due], block[due]
            u, pick = uniform2(key, b, int(Stream.SHOT), number * 2)
            accept, _ = uniform2(key, b, int(Stream.SHOT), number * 2 + 1)
            # How many entries of the block's cumulative noise are at or below the draw; ON pixels come first.
            weight = (pick * whole[due]).to(torch.float32)
            place = torch.searchsorted(table[due], weight[:, None], right=True).view(-1).clamp(max=2 * BLOCK - 1)
            pixel, on = b * BLOCK + (place & (BLOCK - 1)), place < BLOCK
            inside = pixel < self._pixels
            flat = torch.where(inside, pixel, 0) + env[due] * self._pixels
            # Intensity at the candidate's time, on the straight line between the frames.
            after = (self._clock_ns[due] - start_ns[due]).clamp(min=0)
            before = self._intensity[flat]
            change = (now["_intensity"].view(-1)[flat] - before).to(torch.float64)
            light = before.to(torch.float64) + change * (after.to(torch.float64) / dt_ns[due])
            # Thinning from the rate in the dark, see v2e_model.shot_factor.
            factor = 1.0 - ((light + 20.0) / 275.0).clamp(0.0, 1.0) * 0.75
            let = inside & (accept * model.DARKEST < factor)
            shots.append((flat[let], after[let], on[let].to(torch.int64)))
            # Exponential waiting time; at least 1 ns, so that the clock moves on.
            gap = (-log_f64(u) / rate[due]).clamp(max=1e18).to(torch.int64) + 1
            self._clock_ns[due] += gap
            self._clock_index[due] += 1
        none = torch.empty(0, dtype=torch.int64, device=self.device)
        flat, after, on = (torch.cat([none, *(one[c] for one in shots)]) for c in range(3))
        # Bits of each key: pixel number, ns within an interval, polarity.
        order = stable_order([(flat, 31), (after, 41), (on, 1)])
        return Shots(flat[order], after[order], on[order]) if len(flat) else None

    def _filled(self, value: Any, env: Tensor) -> Tensor:
        return value[env] if isinstance(value, Tensor) else torch.full_like(env, value)

    def _flagged(self, beyond: Tensor, shots: Shots | None) -> Tensor:
        """Return ``beyond``, flat, with 0 where shot noise falls."""
        flags = beyond.reshape(-1)
        if shots is not None:
            flags[shots.flat] = 0.0
        return flags

    def _rows(
        self, flat: Tensor, now: dict[str, Tensor], shots: Shots | None, each: Numbers, v: Interval
    ) -> tuple[Rows, Step]:
        """Return the rows of the pixels to process, without those that stay in their dead time, and their times."""
        if self._has.refractory_ns:
            end_ns = torch.from_numpy(v.end_ns).to(self.device)[self._env_of(flat)]
            # A level of -inf marks the dead time; of those only the pixels that are released
            # now take part.
            asleep = self._upper[flat] == -_INF
            flat = flat[~asleep | (self._release[flat] <= end_ns)]
        env = self._env_of(flat)
        zero = torch.zeros(len(flat), dtype=torch.float64, device=self.device)
        # Features that are off have empty tensors and count as 0.
        old = lambda name: getattr(self, name)[flat].to(torch.float64) if getattr(self, name).numel() else zero
        new = lambda name: now[name].view(-1)[flat].to(torch.float64) if name in now else zero
        step = each.step.of(env)._replace(low=self._keys[env, 0], high=self._keys[env, 1])
        r = {"flat": flat, "pixel": flat - env * self._pixels, "on": old("_on"), "off": old("_off")}
        r |= {"mean_leak": old("_mean_leak"), "leak": old("_leak"), "up": old("_upper"), "down": old("_lower")}
        r |= {"x0": old("_x"), "x1": new("_x"), "lag0": old("_lag"), "lag1": new("_lag")}
        r |= {"i0": old("_intensity"), "i1": new("_intensity"), "noise": old("_noise")}
        r |= {"shift": new("_noise") - old("_noise"), "now": torch.zeros_like(flat)}
        if self.config.causes:
            r |= {"since": self._since_ns[flat] - step.t0_ns, "noise_then": old("_noise_then"), "hot": self._hot[flat]}
        if shots is not None:
            # Where the pixel's shot noise begins in the sorted list, or the list's end.
            first = torch.searchsorted(shots.flat, flat)
            mine = (first < len(shots.flat)) & (shots.flat[first.clamp(max=len(shots.flat) - 1)] == flat)
            r["shot"] = torch.where(mine, first, len(shots.flat))
        add_curves(r, step, self._has)
        if self._has.refractory_ns:
            waking = self._upper[flat] == -_INF
            r["now"] = torch.where(waking, (self._release[flat] - step.t0_ns).clamp(min=0), r["now"])
            wake(r, step, self._has, waking)
        return r, step

    def _put_back(self, r: Rows, v: Step) -> None:
        """Write levels and other state changed by a wave back. In a dead time both levels count as passed, so that the
        pixel is processed until its release."""
        flat, dead = r["flat"], r["dead"]
        self._upper[flat] = torch.where(dead, -_INF, r["up"].to(torch.float32))
        self._lower[flat] = torch.where(dead, _INF, r["down"].to(torch.float32))
        if self._has.leak_jitter > 0.0:
            self._leak[flat] = r["leak"].to(torch.float32)
        if self._has.refractory_ns:
            self._release[flat] = torch.where(dead, r["now"] + v.t0_ns, self._release[flat])
        if self._has.causes:
            self._since_ns[flat] = r["since"] + v.t0_ns
            self._noise_then[flat] = r["noise_then"].to(torch.float32)

    def _rest_leaks(self, interval: Interval, each: Numbers) -> None:
        """Move the leak into the levels where the leak clock has run for long, so that float32 stays accurate."""
        due = (self._clock[:, 0] == 1) & (interval.end_ns - self._clock[:, 3] >= self._rebase_ns)
        for k in np.flatnonzero(due):
            here = slice(int(k) * self._pixels, (int(k) + 1) * self._pixels)
            # In float32, as in V2e, so that the levels get the same bits.
            gone = self._leak[here] * float(np.float32((int(interval.end_ns[k]) - int(self._clock[k, 3])) * 1e-9))
            self._upper[here] -= gone
            self._lower[here] -= gone
            self._clock[k, 3] = interval.end_ns[k]

    def _begin(self, k: int, flat: Tensor, t_ns: int) -> None:
        """Set environment k's state at its first frame, drawn by the emulator on the host."""
        # The numba emulator on the host draws it: the same draws as everywhere.
        single = V2e(self.height, self.width, self.config, self.seeds[k])
        single.step(flat.view(self.envs, self.height, self.width)[k].cpu().numpy(), t_ns)
        state = single.state_dict()
        self._take(k, {name: state[name] for name in self._state})
        self._clock[k, 3] = t_ns
