"""The cost of a run, from sequences of it that are made, or begun, in a temporary folder."""

from __future__ import annotations

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.report import SequenceReport
from blinkgl.gl import GLContext
from blinkgl.machine.compiling import compiled_s

_MOST, _LONG_S, _PART = 12, 8.0, 0.4
"""As many sequences are made to learn the cost, or as take this time; a long one at least for this time and part."""


@dataclass(frozen=True)
class Cost:
    """Of a sequence: wall and processor time without compiling, s, bytes, event frames of all cameras, events, wall
    seconds by stage, and what was noted of it."""

    seconds: float
    processor_s: float
    bytes: int
    frames: int
    events: int
    stages: dict[str, float]
    notes: tuple[str, ...] = ()

    @classmethod
    def of(cls, report: SequenceReport, began: np.ndarray, folder: str, fraction: float) -> Cost:
        """Return the cost of a sequence of which a fraction was made; its scene is built once. began : of :func:`_now`
        at its beginning."""
        once = report.seconds.get("scene", 0.0)
        size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
        whole = lambda count: round(count / fraction)
        seconds, processor_s = (float(once + (spent - once) / fraction) for spent in _now() - began)
        counts = whole(size), whole(report.frames), whole(report.events)
        return cls(seconds, processor_s, *counts, dict(report.seconds), report.notes)


def _now() -> np.ndarray:
    """Return the wall and the processor clock of this process, s, without compiling, which one thread does."""
    return np.array([time.perf_counter(), time.process_time()]) - compiled_s()


def rehearsals(template: RunTemplate, index: int, count: int, gl: GLContext | None) -> list[Cost]:
    """Return the costs of sequence ``index`` and, of a run of ``count``, of the next ones, which differ, until it took
    a while. The first one of a process fills its caches. Raises the errors of generating them."""
    costs = [_rehearsal(template, index, gl)]
    while len(costs) < min(count, _MOST) and sum(cost.seconds for cost in costs) < _LONG_S:
        costs.append(_rehearsal(template, index + len(costs), gl))
    return costs


def mean_cost(costs: list[Cost]) -> tuple[float, float, int]:
    """Return mean wall and processor seconds, without the first sequence if there are more, and mean bytes."""
    seconds, processor_s = np.mean([(c.seconds, c.processor_s) for c in costs[1:] or costs], axis=0)
    return float(seconds), float(processor_s), int(np.mean([c.bytes for c in costs]))


class _Enough(Exception):
    """Enough of a sequence was made to know its cost, the argument."""


def _rehearsal(template: RunTemplate, index: int, gl: GLContext | None) -> Cost:
    began = _now()

    def progress(report: SequenceReport, fraction: float) -> None:
        if (_now() - began)[0] > _LONG_S and fraction > _PART:
            raise _Enough(Cost.of(report, began, scratch, fraction))

    with tempfile.TemporaryDirectory(prefix="blinkgl-explain-") as scratch:
        try:
            config = template.sequence(index)
            made = generate_sequence(config, index, scratch, gl, base=template.base, progress=progress)
            return Cost.of(made, began, scratch, 1.0)
        except _Enough as enough:
            return enough.args[0]
