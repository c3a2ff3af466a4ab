"""Where the wall time of a sequence goes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from blinkgl.machine.compiling import compiled_s, working_clock


class StageClock:
    """Wall seconds per named stage, without the compilation of kernels, which happens once per machine and is told
    apart (``compile_s``). ``with clock("events"): …`` adds to a stage; stages do not nest."""

    def __init__(self) -> None:
        self.started = working_clock()
        self._compiled = compiled_s()
        self.seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begin = working_clock()
        try:
            yield
        finally:
            self.add(stage, working_clock() - begin)

    def add(self, stage: str, seconds: float) -> None:
        self.seconds[stage] = self.seconds.get(stage, 0.0) + seconds

    @property
    def total(self) -> float:
        return working_clock() - self.started

    @property
    def compile_s(self) -> float:
        return compiled_s() - self._compiled
