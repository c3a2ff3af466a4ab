"""What makes one doubt a recording before a network is asked: clock ticks in place of µs, pixels that drown the rest.

Neither is an error: a network answers all the same, and the answer is worth nothing.
"""

from __future__ import annotations

import numpy as np

from blinkgl.types.events import Events

SLOWEST, FASTEST = 1e-3, 1e4
"""Events per second and pixel that cameras give: a dark still scene has 0.05; a dead time of 100 µs allows 10,000."""
FLOOD, FEW = 0.5, 0.005
"""Share of the events in that share of the pixels, from which on they are said to be hot."""
_ENOUGH = 1000


def doubts(events: Events, height: int, width: int) -> list[str]:
    """Lines about the first events of a recording of (height, width) px; empty where all is as it should be."""
    if len(events) < _ENOUGH:
        return []
    found = []
    seconds = max(int(events.t[-1]) - int(events.t[0]), 1) * 1e-6
    rate = len(events) / seconds / (height * width)
    if not SLOWEST <= rate <= FASTEST:
        other = "ns, or ticks of the camera's clock" if rate < SLOWEST else "ms, or ticks of a slower clock"
        found.append(
            f"{rate:.2g} events per second and pixel are not a camera's (0.05 to 1000): are its times {other}, "
            "instead of µs?"
        )
    counts = np.bincount(events.y.astype(np.int64) * width + events.x, minlength=height * width)
    few = max(round(FEW * counts.size), 1)
    share = np.partition(counts, -few)[-few:].sum() / len(events)
    if share > FLOOD:
        found.append(
            f"{few} pixels ({100 * FEW:g} %) have {100 * share:.0f} % of the events: hot pixels, or a light that "
            "flickers; flow there is not motion"
        )
    return found
