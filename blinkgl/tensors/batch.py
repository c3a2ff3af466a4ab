"""Base of the emulators on tensors: frames and times in, checks, the order of events, reset, saving.

A step has two halves. The first processes every pixel: it computes the signal and how far it lies beyond the pixel's
levels, into separate memory. Then the host reads a few numbers in one transfer: whether every intensity is valid, how
many pixels fire, how many events they have. Only then does the second half process the firing pixels and change the
state, so a refused frame leaves every environment unchanged.
"""

from __future__ import annotations

import numbers
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from blinkgl.errors import EventDataError
from blinkgl.events.arith import LOG_MAX_INPUT
from blinkgl.events.emulator import INTENSITY_LIMIT_BITS, MAX_SIDE, NEVER_NS
from blinkgl.events.packing import MAX_INTERVAL_NS
from blinkgl.tensors.arith import PerEnv, words_of
from blinkgl.types.events import Events

_RADIX_BITS = 16
_CHUNK = {"cpu": 2**18}
"""Pixels per piece of the first half: on a CPU they fit the second-level cache; elsewhere 2^24 keep the scratch memory
small compared with the state of many environments."""


@dataclass(frozen=True, eq=False)
class TensorEvents:
    """Events of one step of all environments, on their device, sorted by environment, then time, then raster order.

    env, x, y : (N,) int32, environment, pixel column, pixel row.
    t : (N,) int64 microseconds.   p : (N,) uint8, 1 brighter (ON), 0 darker (OFF).
    cause : (N,) uint8 of :class:`~blinkgl.types.events.Cause`, or None without ``config.causes``.
    starts : (environments + 1,) int64, where each environment's events begin, and the end.
    shape : (environments, H, W)."""

    env: Tensor
    x: Tensor
    y: Tensor
    t: Tensor
    p: Tensor
    cause: Tensor | None
    starts: Tensor
    shape: tuple[int, int, int]

    def __len__(self) -> int:
        return len(self.t)

    def numpy(self) -> list[Events]:
        """Return the events of each environment in this process's memory (one transfer)."""
        starts = self.starts.tolist()
        x, y = (one.cpu().numpy().astype(np.uint16) for one in (self.x, self.y))
        t, p = self.t.cpu().numpy(), self.p.cpu().numpy()
        cause = None if self.cause is None else self.cause.cpu().numpy()
        parts = [slice(a, b) for a, b in pairwise(starts)]
        return [Events(x[s], y[s], t[s], p[s], None if cause is None else cause[s]) for s in parts]


@dataclass(frozen=True, eq=False)
class Interval:
    """One step's times. An integer where all environments have the same, else (environments,) int64 on the device.

    t0_ns, dt_ns : start and length.   base_us : the start's microsecond.   fresh : environments whose first frame this
    is; their intervals have a length of 1 and no events.   start_ns, end_ns : (environments,) int64 on the host."""

    t0_ns: PerEnv
    dt_ns: PerEnv
    base_us: PerEnv
    fresh: tuple[int, ...]
    start_ns: np.ndarray
    end_ns: np.ndarray

    @property
    def longest_ns(self) -> int:
        """Return the longest interval."""
        return max(int((self.end_ns - self.start_ns).max()), 1)

    @property
    def lengths_ns(self) -> list[int]:
        """Return the length for each environment."""
        return np.maximum(self.end_ns - self.start_ns, 1).tolist()

    def of(self, value: object, env: Tensor) -> Any:
        """Return ``value``, one of the times, for elements of these environments."""
        return value[env] if isinstance(value, Tensor) else value


class Found(NamedTuple):
    """Events that are not in order yet, (N,) int64.

    word : pixel number over all environments, and the polarity in the lowest bit.
    after_us : microseconds after the environment's base."""

    word: Tensor
    after_us: Tensor


def stable_order(keys: Sequence[tuple[Tensor, int]]) -> Tensor:
    """Return indices that sort by the keys, the first one first; equal elements keep their order.

    keys : (N,) int64 >= 0, with their numbers of bits."""
    order: Any = None
    for key, bits in reversed(keys):
        # On a GPU torch's own sort is fast and stable.
        if key.device.type != "cpu":
            fresh = torch.sort(key if order is None else key[order], stable=True).indices
            order = fresh if order is None else order[fresh]
            continue
        # NumPy sorts 16-bit keys by counting, which takes a tenth of a comparison sort's time. From the lowest digit
        # up, every pass keeps the order of equal digits.
        whole = key.numpy()
        for low in range(0, bits, _RADIX_BITS):
            digit = (whole >> low).astype(np.uint16)
            fresh = np.argsort(digit if order is None else digit[order], kind="stable")
            order = fresh if order is None else order[fresh]
    if order is None:
        return torch.arange(len(keys[0][0]), device=keys[0][0].device)
    return order if isinstance(order, Tensor) else torch.from_numpy(order)


def places(flags: Tensor) -> Tensor:
    """Return indices of the elements >= 0 of a flat int32 or float32 tensor, ascending; this synchronises with the
    host."""
    # NumPy's comparison and search take a quarter of torch's time.
    if flags.device.type == "cpu":
        return torch.from_numpy(np.flatnonzero(flags.numpy() >= 0))
    return torch.nonzero(flags >= 0).view(-1)


def _there(device: Any) -> torch.device:
    """Return a torch device with its number, as tensors have it ("cuda" becomes "cuda:0"), so that frames' devices
    compare equal. Raises EventDataError: this machine, or this torch, has none such."""
    try:
        return torch.empty(0, device=device).device
    except (RuntimeError, AssertionError, TypeError, NotImplementedError):
        cards = [f"cuda:{k}" for k in range(torch.cuda.device_count())]
        raise EventDataError(
            "there is no such device", where="device", value=str(device), accepted=" or ".join(["cpu", *cards])
        ) from None


Made = TypeVar("Made")


def configured(config: object, kind: type[Made]) -> Made:
    """Return the configuration of an emulator, None for its defaults. Raises EventDataError: it is another's."""
    if config is not None and not isinstance(config, kind):
        raise EventDataError("not its configuration", where="config", value=config, accepted=kind.__name__)
    return kind() if config is None else config


class Batch(ABC):
    """Emulators of ``envs`` environments of one size and configuration; environment k draws from ``seed + k``.

    device : torch's.   Raises EventDataError: a size or a number of environments that does not fit, no such device."""

    _state: tuple[str, ...] = ()
    """Names of the tensors that make up the state, besides times."""

    @property
    def _host_is_near(self) -> bool:
        """Return whether reading a number costs nothing, because the host is the device."""
        return self.device.type == "cpu"

    def __init__(self, height: int, width: int, envs: int, device: object, seed: int):
        for where, value in (("height", height), ("width", width), ("envs", envs), ("seed", seed)):
            if not isinstance(value, numbers.Integral) or isinstance(value, bool):
                raise EventDataError("not a whole number", where=where, value=value, accepted="a whole number")
        if not (1 <= height < MAX_SIDE and 1 <= width < MAX_SIDE and envs >= 1 and envs * height * width < 2**31):
            raise EventDataError(
                "frame size or number of environments out of range",
                value=(envs, height, width),
                accepted=f"sides of 1 to {MAX_SIDE - 1}, fewer than 2^31 pixels in all",
            )
        self.height, self.width, self.envs = int(height), int(width), int(envs)
        self.device = _there(device)
        self.seed = int(seed) & (2**64 - 1)
        self.seeds = tuple((self.seed + k) & (2**64 - 1) for k in range(self.envs))
        """Seed of each environment: that of the single emulator that it equals."""
        self._pixels = self.height * self.width
        self._keys = torch.tensor([words_of(s) for s in self.seeds], dtype=torch.int64, device=self.device)
        self._clock = np.zeros((self.envs, 4), np.int64)  # started, t_ns, frames, start of the leak clock (V2E)
        self.saturated = torch.zeros(self.envs, dtype=torch.int64, device=self.device)
        """Events cut by ``max_events_per_step`` so far, (environments,)."""

    # -- for users -----------------------------------------------------------------------------------------------
    @torch.no_grad()
    def step(self, frames: Tensor, t_ns: int | Sequence[int] | np.ndarray | Tensor) -> TensorEvents:
        """Return the events of every environment since its last frame; none for an environment's first frame.

        frames : (environments, H, W) float32 linear luminance on :attr:`device`, finite, 0 to 2^30.
        t_ns : of these frames, an integer for all environments or (environments,) of them on the host, increasing in
        each environment by at most 17 minutes.
        Raises EventDataError that names the environment, and the pixel of an invalid intensity; no environment has then
        changed. Gradients do not flow through events: frames are detached."""
        flat = self._checked(frames)
        interval = self._interval(t_ns)
        events = self._advance(flat, interval)
        # Only after the step succeeded.
        self._clock[:, 0], self._clock[:, 1] = 1, interval.end_ns
        self._clock[:, 2] += 1
        return events

    def reset(self, mask: object = None) -> None:
        """Reset the environments of ``mask`` ((environments,) bool; None: all), which restart with their next frame, at
        any time.

        Constant properties of a sensor (thresholds, leaks, seeds) stay. A mask on a GPU is copied to the host."""
        mask = np.ones(self.envs, bool) if mask is None else torch.as_tensor(mask).cpu().numpy()
        if mask.shape != (self.envs,) or mask.dtype != bool:
            raise EventDataError(
                "not a mask of environments",
                where="mask",
                value=(mask.dtype, mask.shape),
                accepted=f"({self.envs},) bool",
            )
        # 0 in the first column: not started.
        self._clock[mask] = 0
        for k in np.flatnonzero(mask):
            self._forget(int(k))

    def state_dict(self) -> dict[str, Tensor]:
        """Return all state besides configuration and seed: copies of tensors."""
        state = {name: getattr(self, name).clone() for name in (*self._state, "saturated")}
        return {"clock": torch.from_numpy(self._clock.copy()), **state}

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore the result of :meth:`state_dict` in a batch of the same size, configuration, seed and environments.

        Raises EventDataError: it belongs to another; nothing has then changed."""
        mine = {"clock": torch.from_numpy(self._clock), **{k: getattr(self, k) for k in (*self._state, "saturated")}}
        fits = set(state) == set(mine) and all(
            state[k].shape == v.shape and state[k].dtype == v.dtype for k, v in mine.items()
        )
        if not fits:
            raise EventDataError(
                "the saved state belongs to other emulators", value=sorted(state), accepted=", ".join(mine)
            )
        for name, tensor in mine.items():
            tensor.copy_(state[name])

    # -- checks --------------------------------------------------------------------------------------------------
    def _checked(self, frames: Tensor) -> Tensor:
        """Return the frames, (environments * H * W,). Checks of values are part of the first half."""
        wanted = (self.envs, self.height, self.width)
        if not isinstance(frames, Tensor) or tuple(frames.shape) != wanted or frames.dtype != torch.float32:
            value = (str(frames.dtype), tuple(frames.shape)) if hasattr(frames, "dtype") else type(frames).__name__
            raise EventDataError("not frames of luminance", where="frames", value=value, accepted=f"float32 {wanted}")
        if frames.device != self.device:
            raise EventDataError(
                "frames on another device", where="frames", value=str(frames.device), accepted=str(self.device)
            )
        # One flat array of all environments, whose gradient is not followed.
        return frames.detach().reshape(-1)

    def _interval(self, t_ns: object) -> Interval:
        """Return the interval of the step to ``t_ns``. Raises EventDataError naming the first environment with an
        invalid time."""
        try:
            # An integer, or one per environment; a tensor on a GPU is copied to the host.
            times = np.asarray(t_ns.cpu() if isinstance(t_ns, Tensor) else t_ns)
            if times.dtype.kind not in "iu" or times.shape not in ((), (self.envs,)):
                raise ValueError
            times = np.broadcast_to(times.astype(np.int64), (self.envs,)).copy()
        except (TypeError, ValueError, OverflowError):
            accepted = f"whole nanoseconds, one or {self.envs}"
            raise EventDataError("not time stamps", where="t_ns", value=t_ns, accepted=accepted) from None
        # A fresh environment has no interval: its time before is its own.
        started, before = self._clock[:, 0] == 1, np.where(self._clock[:, 0] == 1, self._clock[:, 1], times)
        late = np.where(started, times <= before, False) | (np.abs(times) >= 2**61)
        wrong = np.flatnonzero(late | (times - before > MAX_INTERVAL_NS))
        if len(wrong):
            k = int(wrong[0])
            raise EventDataError(
                "time stamps must increase, by at most 17 minutes",
                where=f"environment {k}, frame {self._clock[k, 2]}",
                value=f"{times[k]} ns",
                accepted=f"{before[k] + 1} to {before[k] + MAX_INTERVAL_NS} ns" if started[k] else "less than 2^61 ns",
            )
        # Avoids a division by an interval that does not exist.
        length = np.where(started, times - before, 1)

        def given(values: np.ndarray) -> Any:
            # One number where all environments agree, which spares a value for each pixel.
            alike = (values == values[0]).all()
            return int(values[0]) if alike else torch.from_numpy(values.copy()).to(self.device, non_blocking=True)

        fresh = tuple(int(k) for k in np.flatnonzero(~started))
        return Interval(given(before), given(length), given(before // 1000), fresh, before, times)

    def _refuse(self, flat: Tensor, lowest: int, highest: int) -> None:
        """Raise EventDataError for intensities whose bits, read as integers, range from ``lowest`` to ``highest``.

        Negative numbers have negative bits; infinities and NaN are above the largest number, so two extremes of a frame
        check all of it. Only -0.0 seems wrong and is valid."""
        if lowest >= 0 and highest <= int(INTENSITY_LIMIT_BITS):
            return
        # The pixel is searched only for the error.
        bad = torch.nonzero(~((flat >= 0) & (flat <= LOG_MAX_INPUT))).view(-1)
        if len(bad):
            k, pixel = divmod(int(bad[0]), self._pixels)
            y, x = divmod(pixel, self.width)
            error = EventDataError(
                f"intensity at pixel x={x}, y={y} cannot be used",
                where=f"environment {k}, frame {self._clock[k, 2]}",
                value=float(flat[bad[0]]),
                accepted=f"a finite value from 0 to {LOG_MAX_INPUT:.3g}",
            )
            error.pixel = (x, y)
            raise error

    def _chunks(self) -> list[slice]:
        """Return slices that cut the flat pixels into pieces."""
        # Without an entry for the device a piece has 2^24 pixels.
        size, total = _CHUNK.get(self.device.type, 2**24), self.envs * self._pixels
        return [slice(a, min(a + size, total)) for a in range(0, total, size)]

    # -- events --------------------------------------------------------------------------------------------------
    def _env_of(self, flat: Tensor) -> Tensor:
        """Return the environments of flat pixel numbers."""
        return torch.div(flat, self._pixels, rounding_mode="trunc") if self.envs > 1 else torch.zeros_like(flat)

    def _events(self, interval: Interval, found: Found, cause: Tensor | None, waves: bool) -> TensorEvents:
        """Return the sorted columns of events given pixel by pixel, or wave by wave with each wave in raster order.

        waves : events of one pixel are not adjacent yet."""
        # Sorted by environment, then time; with one environment that key is left out.
        env = self._env_of(found.word >> 1) if self.envs > 1 else None
        keys = [(found.after_us, (interval.longest_ns // 1000 + 1).bit_length())]
        if env is not None:
            keys.insert(0, (env, (self.envs - 1).bit_length()))
        # Raster order among equal times; the sort itself keeps a pixel's events in the order they came.
        if waves:
            keys.append((found.word >> 1, (self.envs * self._pixels - 1).bit_length()))
        order = stable_order(keys)
        # Columns from the word: polarity in the lowest bit, the pixel above it.
        word, after = found.word.index_select(0, order), found.after_us.index_select(0, order)
        env, pixel = torch.zeros_like(word) if env is None else env.index_select(0, order), word >> 1
        if self.envs > 1:
            pixel -= env * self._pixels
        y = torch.div(pixel, self.width, rounding_mode="trunc")
        return TensorEvents(
            env=env.to(torch.int32),
            x=(pixel - y * self.width).to(torch.int32),
            y=y.to(torch.int32),
            t=after + interval.of(interval.base_us, env),
            p=(word & 1).to(torch.uint8),
            cause=None if cause is None else cause.index_select(0, order).to(torch.uint8),
            starts=torch.searchsorted(env, torch.arange(self.envs + 1, device=self.device)),
            shape=(self.envs, self.height, self.width),
        )

    @abstractmethod
    def _advance(self, flat: Tensor, interval: Interval) -> TensorEvents:
        """Return the events of a step; nothing changes where it raises."""

    @abstractmethod
    def _forget(self, k: int) -> None:
        """Reset environment k, which then waits for its first frame."""


# ---------------------------------------------------------------------------------------------------------------------
# Grids of events, computed on their device for each environment: voxel grids, counts, times of last events.
#
# Nothing here is differentiable: whether there is an event does not depend smoothly on the frames. None of these
# functions synchronises with the host.

NEVER_US = NEVER_NS // 1000
"""Time of the last event of a pixel without events."""


def _cells(events: TensorEvents, channel: Tensor, channels: int) -> Tensor:
    """Return the events' places in a flat (environments, channels, H, W) array, (N,) int64."""
    _, height, width = events.shape
    return ((events.env.to(torch.int64) * channels + channel) * height + events.y) * width + events.x


def voxel_grid(events: TensorEvents, t0_us: PerEnv, t1_us: PerEnv, bins: int) -> Tensor:
    """Return (environments, bins, H, W) float32: polarities (+1, -1), each divided between the two bins next to (bins -
    1) (t - t0) / (t1 - t0); events outside [t0, t1] are ignored.

    t0_us, t1_us : microseconds, one for all environments or (environments,) int64 tensors on the events' device. On a
    CPU the numbers are those of :func:`blinkgl.events.grids.voxel_grid`, bit for bit; on a GPU sums are in any order,
    so they agree to float32's rounding. Source: Zhu et al., CVPR 2019, section 3.1."""
    # The kernel max(0, 1 - |place - bin|) of Zhu et al. touches two bins.
    envs, height, width = events.shape
    env = events.env.to(torch.int64)
    start, end = (value[env] if isinstance(value, Tensor) else int(value) for value in (t0_us, t1_us))
    last = bins - 1
    length: PerEnv = end - start
    # A window without length has no bins: nothing of it counts, as below.
    length = length.clamp(min=1).to(torch.float64) if isinstance(length, Tensor) else max(length, 1)
    place = (events.t - start).to(torch.float64) * (last / length)
    lower = place.to(torch.int64).clamp(0, last)
    weight = (place - lower).to(torch.float32)
    inside = (events.t >= start) & (events.t <= end) & torch.as_tensor(end > start, device=events.t.device)
    # Events outside the span add 0.
    sign = torch.where(events.p > 0, 1.0, -1.0) * inside
    # Both shares of an event are adjacent: a cell then adds them in the order of events, as the numba loop does.
    first, second = _cells(events, lower, bins), _cells(events, (lower + 1).clamp(max=last), bins)
    # In the last bin the second share is 0, so its clamped cell does not matter.
    shares = torch.stack((sign * (1.0 - weight), torch.where(lower < last, sign * weight, 0.0)), 1)
    grid = torch.zeros(envs * bins * height * width, device=events.t.device)
    grid.index_add_(0, torch.stack((first, second), 1).view(-1), shares.view(-1))
    return grid.view(envs, bins, height, width)


def event_counts(events: TensorEvents) -> Tensor:
    """Return (environments, 2, H, W) int32: OFF events in channel 0, ON events in channel 1. The same on every
    device."""
    envs, height, width = events.shape
    counts = torch.zeros(envs * 2 * height * width, dtype=torch.int32, device=events.t.device)
    counts.index_add_(0, _cells(events, events.p.to(torch.int64), 2), torch.ones_like(events.x))
    return counts.view(envs, 2, height, width)


def latest_times(events: TensorEvents, before: Tensor | None = None) -> Tensor:
    """Return the time of each pixel's last OFF and ON event, (environments, 2, H, W) int64 microseconds,
    :data:`NEVER_US` where it had none. The same on every device.   before : the result for the events so far."""
    envs, height, width = events.shape
    shape = (envs, 2, height, width)
    start = torch.full(shape, NEVER_US, dtype=torch.int64, device=events.t.device) if before is None else before
    cells = _cells(events, events.p.to(torch.int64), 2)
    # amax is the same in any order, so the result does not depend on the device.
    return start.reshape(-1).scatter_reduce(0, cells, events.t, "amax").view(shape)


def time_surface(latest: Tensor, t_us: PerEnv, tau_us: float) -> Tensor:
    """Return exp(-(t - latest) / tau), float32 of the shape of ``latest``; 0 where a pixel had no event.

    latest : of :func:`latest_times`.   t_us : now, one or (environments,).   Source: Lagorce et al., TPAMI 2017."""
    now = t_us.view(-1, 1, 1, 1) if isinstance(t_us, Tensor) else t_us
    # NEVER_US is so long ago that the exponential is 0.
    return torch.exp((latest - now).to(torch.float64) / tau_us).to(torch.float32)
