"""One timeline of several cameras: frames are drawn when the strictest of them asks."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any

from blinkgl.timeline.strategy import Timeline


class Shared(Timeline):
    """One of several timelines, with the times of all; it says what was achieved for its own camera."""

    def __init__(self, own: Timeline, times: Iterator[int]):
        self.own, self._times = own, times
        super().__init__(own.config, own.t0_ns, own.t1_ns, own.pictures, own.response, own.stops_ns)

    def __iter__(self) -> Iterator[int]:
        return self._times

    def info(self) -> dict[str, Any]:
        return self.own.info()


def together(timelines: Sequence[Timeline]) -> list[Timeline]:
    """As many timelines of the same times, at which no step is longer than any of ``timelines`` (of one configuration)
    allows. A time is decided when the first of them is asked for it; those that lag behind get it later. A single one
    stays as it is."""
    if len(timelines) < 2:
        return list(timelines)
    lead = timelines[0]
    # tee holds a time until every camera has taken it, so cameras may lag behind each other.
    lead.others = tuple(timelines[1:])
    return [Shared(own, times) for own, times in zip(timelines, itertools.tee(lead, len(timelines)), strict=True)]
