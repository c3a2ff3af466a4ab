"""The read-out bus: what becomes of events when a sensor makes more than it can send.

One bus, first come first served. An event that finds ``queue_events`` others waiting is lost; the others are stamped
when they leave the bus, ``1 / events_per_second`` (and ``row_ns`` more where the row changes or the bus was idle) after
the one before. Below the limit events are late by less than a microsecond; above it time stamps lag by up to
``queue_events / events_per_second`` and the output rate is the bus's. Events of one microsecond are served in raster
order, as a row arbiter would, so in overload the upper rows of that microsecond come first.

Behind it stands the clock: a time stamp is the last tick of ``clock_us`` that has passed.

An event exists for the outside when it has left the bus. A recording that ends at time T therefore ends with the last
event that left by T; those still on the bus then are no part of it, and are counted (``late``).
"""

from __future__ import annotations

from dataclasses import replace

import numba
import numpy as np

from blinkgl.config.readout import ReadoutConfig
from blinkgl.errors import EventDataError
from blinkgl.events.packing import JIT
from blinkgl.types.events import OPTIONAL, Events

# Time on the bus is counted in ps, so that the rounding of 1 / events_per_second does not add up; from the first event
# on, because a clock that counts from 1970 leaves no room for them in 64 bits.
_PS_PER_US = 1_000_000
_NO_EVENT_YET = -(2**62)


@numba.njit(**JIT)
def _serve(t_us, y, event_ps, row_ps, waiting, state, keep, out_us):
    """``waiting``: ring of the times (ps) at which the last accepted events left.
    ``state``: accepted, bus free (ps), row."""
    kept, size = 0, waiting.size
    accepted, free_ps, row = state[0], state[1], state[2]
    for i in range(t_us.size):
        arrival = t_us[i] * _PS_PER_US
        # The place in the ring of the event ``size`` places ahead.
        slot = accepted % size
        if accepted >= size and waiting[slot] > arrival:
            # The event ``size`` places ahead has not left: the queue is full.
            continue
        start = max(arrival, free_ps)
        # The row's address is sent when the row changes or the bus was idle.
        if row_ps and (np.int64(y[i]) != row or start > free_ps):
            start += row_ps
        row, free_ps = np.int64(y[i]), start + event_ps
        waiting[slot] = free_ps
        accepted += 1
        keep[kept] = i
        out_us[kept] = free_ps // _PS_PER_US
        kept += 1
    state[0], state[1], state[2] = accepted, free_ps, row
    return kept


class Readout:
    """Events of an emulator, in order, chunk by chunk -> the events the sensor sends.

    ``dropped`` counts the events that found the queue full; ``late`` those that had not left
    the bus by the end of the last step.
    """

    def __init__(self, config: ReadoutConfig):
        self.config = config
        self.dropped = 0
        rate = config.events_per_second
        self._event_ps = 0 if rate is None else max(1, round(1e12 / rate))
        self._row_ps = round(config.row_ns * 1000)
        self._waiting = np.zeros(config.queue_events, np.int64)
        # Events accepted; time from which the bus is free (always has been); its row (none); µs of the first event.
        self._state = np.array([0, -(2**62), -1, _NO_EVENT_YET], np.int64)
        self._on_bus = Events.empty()

    @property
    def late(self) -> int:
        """Accepted events that no step has given out yet."""
        return len(self._on_bus)

    def step(self, events: Events, until_us: int | None = None) -> Events:
        """The events that leave the bus until ``until_us`` (that microsecond included), stamped when they do and in
        order from step to step; later ones wait for the next step. None: all of them, however late.

        ``until_us`` : the time up to which the emulator has given its events, int µs.
        Raises EventDataError 100 days after the first event, which picoseconds in int64 cannot hold."""
        sent = self._serve(events) if len(events) and self._event_ps else events
        # Events that have been served are already in order and later than those still on the bus.
        if self.late:
            sent = Events.concatenate([self._on_bus, sent])
        count = len(sent) if until_us is None else int(np.searchsorted(sent.t, until_us, side="right"))
        self._on_bus = sent.part(slice(count, None)).copy()
        return self._stamped(sent.part(slice(count)))

    def _stamped(self, events: Events) -> Events:
        """Return the events stamped with the last tick of the clock."""
        tick = self.config.clock_us
        return events if tick == 1 else replace(events, t=events.t - events.t % tick)

    def _serve(self, events: Events) -> Events:
        """Return the events that find a place in the queue, with the times at which they leave the bus."""
        if self._state[3] == _NO_EVENT_YET:
            self._state[3] = events.t[0]
        origin_us = int(self._state[3])
        # 2^43 us are 8.8e18 ps, just below 2^63.
        if int(events.t[-1]) - origin_us > 2**43:
            raise EventDataError(
                "the read-out counts from the first event",
                value=f"{(int(events.t[-1]) - origin_us) / 8.64e10:.4g} days",
                accepted="at most 100 days",
            )
        keep, out_us = np.empty(len(events), np.int64), np.empty(len(events), np.int64)
        after_us = events.t - origin_us
        kept = _serve(after_us, events.y, self._event_ps, self._row_ps, self._waiting, self._state, keep, out_us)
        self.dropped += len(events) - kept
        keep = keep[:kept]
        return replace(events.part(keep), t=out_us[:kept] + origin_us)

    def state_dict(self) -> dict[str, np.ndarray]:
        return {
            "waiting": self._waiting.copy(),
            "state": self._state.copy(),
            "dropped": np.array([self.dropped], np.int64),
            **{f"on_bus_{k}": getattr(self._on_bus, k).copy() for k in self._on_bus.columns},
        }

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        columns = ("x", "y", "t", "p", *(k for k in OPTIONAL if f"on_bus_{k}" in state))
        known = {"waiting", "state", "dropped", *(f"on_bus_{k}" for k in columns)}
        mine = {"waiting": self._waiting, "state": self._state}
        if set(state) != known or any(state[name].shape != array.shape for name, array in mine.items()):
            raise EventDataError("saved state is of another read-out", value=sorted(state))
        self._waiting[...], self._state[...], self.dropped = state["waiting"], state["state"], int(state["dropped"][0])
        self._on_bus = Events(**{k: state[f"on_bus_{k}"].copy() for k in columns})
