"""The cost of one sequence, and the configuration that reproduces it."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from blinkgl.config.reader import to_yaml
from blinkgl.config.sequence import SequenceConfig
from blinkgl.version import __version__

if TYPE_CHECKING:
    from blinkgl.sequence import Simulation

STAGES = ("scene", "render", "read-back", "events", "images", "write", "preview")
"""The stages of a sequence's time; the rest is "other"."""
Progress = Callable[["SequenceReport", float], None]
"""Called regularly with the running report and the fraction done, 0 … 1."""


@dataclass
class SequenceReport:
    """The cost and content of one sequence. Times in wall seconds; they are displayed, never written into the data
    set."""

    index: int
    path: Path
    simulated_s: float = 0.0
    frames: int = 0
    events: int = 0
    triangles: int = 0
    labels: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    total_s: float = 0.0
    """without ``compile_s``"""
    compile_s: float = 0.0
    """time to compile kernels; 0 except for a machine's first sequence of a kind"""
    causes: dict[str, int] = field(default_factory=dict)
    """events by cause; empty unless ``events.causes`` is on"""
    notes: tuple[str, ...] = ()
    """what was guessed, left out or not drawn of the files, a line each"""

    def count(self, sequence: Simulation) -> None:
        """Count the items so far."""
        for key in ("frames", "events", "labels", "seconds", "causes", "notes"):
            setattr(self, key, getattr(sequence, key))

    def finish(self, sequence: Simulation, flushed_s: float) -> None:
        """Complete the report when the files exist. flushed_s : time to close them."""
        self.count(sequence)
        self.seconds["write"] += flushed_s
        self.simulated_s = (sequence.t1_ns - sequence.t0_ns) * 1e-9
        self.triangles = sequence.triangles
        self.total_s, self.compile_s = sequence.clock.total, sequence.clock.compile_s


@dataclass
class Totals:
    """The total cost of many sequences, in constant memory. ``first`` is the first that was added."""

    count: int = 0
    first: SequenceReport | None = None
    simulated_s: float = 0.0
    frames: int = 0
    events: int = 0
    labels: int = 0
    causes: Counter[str] = field(default_factory=Counter)
    seconds: Counter[str] = field(default_factory=Counter)
    total_s: float = 0.0
    compile_s: float = 0.0

    def __len__(self) -> int:
        return self.count

    def add(self, report: SequenceReport) -> Totals:
        self.count += 1
        self.first = self.first or report
        for key in ("simulated_s", "frames", "events", "labels", "total_s"):
            setattr(self, key, getattr(self, key) + getattr(report, key))
        self.compile_s = max(self.compile_s, report.compile_s)  # workers compile at the same time
        self.causes.update(report.causes)
        self.seconds.update(report.seconds)
        return self

    def summary(self) -> dict[str, float]:
        """Return totals of a run: counts, wall seconds per stage, and the rates of the table."""
        stages = {name: self.seconds.get(name, 0.0) for name in STAGES}
        stages["other"] = max(0.0, self.total_s - sum(stages.values()))
        return {
            "sequences": self.count,
            "frames": self.frames,
            "events": self.events,
            "labels": self.labels,
            "simulated_s": self.simulated_s,
            "total_s": self.total_s,
            "seconds_per_simulated_second": self.total_s / self.simulated_s,
            "events_per_second": self.events / self.total_s,
            **{f"{name}_s": seconds for name, seconds in stages.items()},
        }


def shares(seconds: dict[str, float]) -> str:
    """Return "render 63 %, events 12 %": the stages that took most of the time so far."""
    total = sum(seconds.values()) or 1.0
    largest = sorted(STAGES, key=lambda name: -seconds.get(name, 0.0))[:2]
    return ", ".join(f"{name} {100 * seconds.get(name, 0.0) / total:.0f} %" for name in largest)


_NOT_SAID_AS_NULL = ("frames", "physics", "deform", "images", "fog", "rig", "sensors")
"""Keys added after the first data sets: without them a sequence keeps its bytes."""


def config_yaml(config: SequenceConfig, index: int) -> str:
    """Return the resolved configuration as YAML; ``blinkgl generate`` reproduces this one sequence from it."""
    tree = json.loads(config.model_dump_json())
    tree["output"].update(first_index=index, sequences=1)
    scene = tree.get("scene") or {}
    objects = scene.get("objects")
    for table in (tree, scene, *(objects if isinstance(objects, list) else ())):
        for key in _NOT_SAID_AS_NULL:
            if table.get(key, ...) is None:
                del table[key]
    return (
        f"# BlinkGL {__version__}, sequence {index}: every value as drawn.\n"
        "# Relative paths start from the folder of the run's own configuration file.\n" + to_yaml(tree)
    )
