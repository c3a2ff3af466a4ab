"""Where the wall time of a sequence goes."""

from __future__ import annotations

import time
from contextlib import contextmanager


class StageClock:
    """Wall seconds per named stage. ``with clock("events"): …`` adds to a stage; stages do not nest."""

    def __init__(self) -> None:
        self.started = time.perf_counter()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str):
        begin = time.perf_counter()
        try:
            yield
        finally:
            self.add(stage, time.perf_counter() - begin)

    def add(self, stage: str, seconds: float) -> None:
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    @property
    def total(self) -> float:
        return time.perf_counter() - self.started
