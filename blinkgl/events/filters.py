"""Filters on the camera, behind the read-out: events in, some of them out, none moved.

What each one passes stands in its configuration (:mod:`blinkgl.config.readout`). All are causal, keep one small state a
pixel or block, and know nothing of chunks: any split of a stream into steps passes the same events.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar

import numba
import numpy as np

from blinkgl.config.base import Config
from blinkgl.config.readout import FlickerFilter, RateFilter, TrailFilter
from blinkgl.errors import EventDataError
from blinkgl.events.packing import JIT
from blinkgl.types.events import Events

_LONG_AGO = -(2**62)


@numba.njit(**JIT)
def _trail(x, y, t, p, width, threshold, first, second, later, last_us, place, polarity, keep):
    for i in range(t.size):
        k = np.int64(y[i]) * width + x[i]
        # Its place in the burst; the third stands for all that follow.
        same = place[k] > 0 and polarity[k] == p[i] and t[i] - last_us[k] <= threshold
        here = min(place[k] + 1, 3) if same else 1
        place[k], polarity[k], last_us[k] = here, p[i], t[i]
        keep[i] = first if here == 1 else (second if here == 2 else later)


@numba.njit(**JIT)
def _rate(t, period, limit, state, keep):
    """``state``: the period, events that came in it, that passed, that came in the one before, and what has been added
    up since one passed."""
    number, came, passed, before, sum_ = state[0], state[1], state[2], state[3], state[4]
    for i in range(t.size):
        now = t[i] // period
        if now != number:
            before = came if now == number + 1 else 0
            number, came, passed = now, 0, 0
        came += 1
        # ``limit`` of ``before`` events, at even distances.
        sum_ += limit
        share = max(before, limit)
        keep[i] = sum_ >= share and passed < limit
        if sum_ >= share:
            sum_ = min(sum_ - share, share)
        passed += keep[i]
    state[0], state[1], state[2], state[3], state[4] = number, came, passed, before, sum_


@numba.njit(**JIT)
def _flicker(x, y, t, p, block, columns, shortest, longest, start, stop_below, passes, onset_us, last, count, on, keep):
    for i in range(t.size):
        b = (np.int64(y[i]) // block) * columns + x[i] // block
        if p[i] == 1 and last[b] == 0:  # a burst begins
            distance = t[i] - onset_us[b]
            if distance > longest:
                count[b] = 0
            elif distance < shortest:
                count[b] = max(count[b] - 1, 0)
            else:
                count[b] = min(count[b] + 1, start)
            onset_us[b] = t[i]
        elif t[i] - onset_us[b] > longest:  # the next burst is overdue
            count[b] = 0
        last[b] = p[i]
        if count[b] >= start:
            on[b] = 1
        elif count[b] < stop_below:
            on[b] = 0
        keep[i] = (on[b] == 1) == passes


class Filter(ABC):
    """One stage. ``step`` gives the events of a chunk that pass, in order; ``dropped`` counts the others."""

    Config: ClassVar[type[Config]]

    def __init__(self) -> None:
        self.dropped = 0
        self._arrays: dict[str, np.ndarray] = {}
        """All of its state."""

    @abstractmethod
    def _passes(self, events: Events, keep: np.ndarray) -> None:
        """Says of each event whether it passes."""

    def step(self, events: Events) -> Events:
        if not len(events):
            return events
        keep = np.zeros(len(events), np.bool_)
        self._passes(events, keep)
        passed = events.part(keep)
        self.dropped += len(events) - len(passed)
        return passed

    def state_dict(self) -> dict[str, np.ndarray]:
        return {"dropped": np.array([self.dropped], np.int64), **{k: v.copy() for k, v in self._arrays.items()}}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        same = set(state) == {"dropped", *self._arrays}
        if not (same and all(state[k].shape == v.shape for k, v in self._arrays.items())):
            raise EventDataError("saved state is of another filter", value=sorted(state))
        self.dropped = int(state["dropped"][0])
        for key, array in self._arrays.items():
            array[...] = state[key]


class Trail(Filter):
    """See :class:`~blinkgl.config.readout.TrailFilter`. 10 bytes a pixel."""

    Config = TrailFilter

    def __init__(self, config: TrailFilter, height: int, width: int):
        super().__init__()
        pixels = height * width
        self._width, self._threshold = width, int(config.threshold_us)
        self._places = (config.keep == "first", config.keep in ("second", "not_first"), config.keep == "not_first")
        self._arrays = {
            "last_us": np.full(pixels, _LONG_AGO, np.int64),
            "place": np.zeros(pixels, np.uint8),
            "polarity": np.zeros(pixels, np.uint8),
        }

    def _passes(self, events: Events, keep: np.ndarray) -> None:
        columns = events.x, events.y, events.t, events.p
        _trail(*columns, self._width, self._threshold, *self._places, *self._arrays.values(), keep)


class Rate(Filter):
    """See :class:`~blinkgl.config.readout.RateFilter`."""

    Config = RateFilter

    def __init__(self, config: RateFilter, height: int, width: int):
        super().__init__()
        self._period, self._limit = config.period_us, config.limit
        self._arrays = {"state": np.array([_LONG_AGO, 0, 0, 0, 0], np.int64)}

    def _passes(self, events: Events, keep: np.ndarray) -> None:
        _rate(events.t, self._period, self._limit, self._arrays["state"], keep)


class Flicker(Filter):
    """See :class:`~blinkgl.config.readout.FlickerFilter`."""

    Config = FlickerFilter

    def __init__(self, config: FlickerFilter, height: int, width: int):
        super().__init__()
        self._block, self._columns = config.block, -(-width // config.block)
        blocks = -(-height // config.block) * self._columns
        self._band = (int(1e6 / config.high_hz), int(np.ceil(1e6 / config.low_hz)))
        self._counts, self._pass = (config.start, config.stop_below), config.mode == "pass"
        self._arrays = {
            "onset_us": np.full(blocks, _LONG_AGO // 2, np.int64),
            "last": np.ones(blocks, np.uint8),
            "count": np.zeros(blocks, np.int64),
            "on": np.zeros(blocks, np.uint8),
        }

    def _passes(self, events: Events, keep: np.ndarray) -> None:
        columns = events.x, events.y, events.t, events.p
        _flicker(
            *columns, self._block, self._columns, *self._band, *self._counts, self._pass, *self._arrays.values(), keep
        )


FILTERS: dict[type[Config], type[Filter]] = {one.Config: one for one in (Trail, Rate, Flicker)}


def make_filter(config: Any, height: int, width: int) -> Filter:
    """The stage that a configuration asks for, of a sensor of this size."""
    return FILTERS[type(config)](config, height, width)
