"""The event rate controller of Prophesee's cameras, which thins events when there are too many.

The published driver of the IMX636 (OpenEB, ``gen41_erc``) counts events in reference periods of 200 µs, compares with a
target count, and drops events evenly in time. Here the count of a period sets the share of the events that the next one
keeps, evenly among its events, unless fewer come; no period keeps more than the target. The first period of a burst
keeps its first events, the others are thinned. So nothing waits, and the events kept do not depend on how they arrive
in chunks.
"""

from __future__ import annotations

import numpy as np

from blinkgl.machine.kernels import kernel
from blinkgl.types.events import Events

PERIOD_US = 200


@kernel(error_model="numpy")
def _thin(t_us, target, state, keep):
    """Write the indices of the events that are kept to ``keep`` and return their number. ``state``: number of the
    period, its events so far, those kept, the events of the period before."""
    kept = 0
    for i in range(t_us.size):
        period = t_us[i] // PERIOD_US
        if period != state[0]:
            # A period without events comes between them unless they follow each other.
            state[3] = state[1] if period == state[0] + 1 else 0
            state[0], state[1], state[2] = period, 0, 0
        state[1] += 1
        # As many as in the period before, unless the present one is going to have fewer.
        coming = state[1] * PERIOD_US // (t_us[i] - period * PERIOD_US + 1)
        expected = max(min(state[3], coming), target)
        # Evenly: the k-th event is kept where k target / expected passes a whole number.
        due = state[1] * target // expected
        if due > state[2] and state[2] < target:
            state[2] += 1
            keep[kept] = i
            kept += 1
    return kept


class RateController:
    """max_rate : events per second.   dropped : number of events so far that were not let through."""

    def __init__(self, max_rate: float):
        self.dropped = 0
        self._target = np.int64(max(1, round(max_rate * PERIOD_US * 1e-6)))
        self.state = np.array([-(2**62), 0, 0, 0], np.int64)

    def state_dict(self) -> np.ndarray:
        return np.array([*self.state, self.dropped], np.int64)

    def load_state_dict(self, state: np.ndarray) -> None:
        self.state[...], self.dropped = state[:4], int(state[4])

    def step(self, events: Events) -> Events:
        """Return the events that pass, in order; ``events`` come in order from step to step."""
        if not len(events):
            return events
        keep = np.empty(len(events), np.int64)
        kept = _thin(events.t, self._target, self.state, keep)
        self.dropped += len(events) - kept
        return events if kept == len(events) else events.part(keep[:kept])
