"""One timeline of several cameras: the strictest asks, each is told its own frames."""

from __future__ import annotations

import numpy as np

from blinkgl.config.events import EsimConfig
from blinkgl.config.timeline import DisplacementTimeline
from blinkgl.events import emulator_of
from blinkgl.timeline import make_timeline, together

MS = 1_000_000


class Seen:
    """A camera that sees one speed, from ``until`` on another."""

    def __init__(self, before: float, after: float, until: int):
        self.before, self.after, self.until = before, after, until

    def velocity_of_movers(self, t_ns: int, every: int):
        speed = self.before if t_ns < self.until else self.after
        return type("Drawn", (), {"read": lambda self: np.full((2, 2, 2), speed / np.sqrt(2), np.float32)})()


def made(seen, config=None):
    config = config or DisplacementTimeline(max_px=1.0, max_step_us=1e5)
    events = EsimConfig()
    return make_timeline(config, 0, 100 * MS, seen, emulator_of(events).response(events))


def test_no_step_is_longer_than_any_camera_allows():
    slow_then_fast, steady = made(Seen(20, 1000, 50 * MS)), made(Seen(200, 200, 0))
    both = together([slow_then_fast, steady])
    times = [list(one) for one in both]
    assert times[0] == times[1] and times[0][0] == 0 and times[0][-1] == 100 * MS
    steps = np.diff(times[0])
    early = np.array(times[0][1:]) <= 50 * MS
    assert steps[early].max() <= 5 * MS + 1 and steps[~early].max() <= 1 * MS + 1
    assert len(times[0]) > len(list(made(Seen(200, 200, 0)))), "one alone would not ask for so many"


def test_whoever_asks_first_decides_and_the_other_gets_the_same():
    a, b = map(iter, together([made(Seen(100, 300, 30 * MS)), made(Seen(200, 200, 0))]))
    first = [next(b), next(b), next(a)]
    rest = [*first[2:], *a]
    assert [first[0], first[1], *b] == rest
