"""Shared code of the benchmarks: a description of the machine, and timing."""

from __future__ import annotations

import datetime
import os
import platform
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np


def machine_line(opengl: str | None = None) -> str:
    """Return one line for a report: CPU, cores, memory, versions, OpenGL renderer, date."""
    import numba

    parts = [
        _processor(),
        f"{len(os.sched_getaffinity(0))} cores",
        f"{_memory_gib():.0f} GiB",
        f"Python {platform.python_version()}",
        f"NumPy {np.__version__}",
        f"numba {numba.__version__}",
    ]
    if opengl:
        parts.append(opengl)
    return ", ".join([*parts, datetime.datetime.now().astimezone().date().isoformat()])


def seconds(run: Callable[[], object], repeat: int = 10, warm_up: int = 2) -> dict[str, float]:
    """Return the wall seconds of ``run()``: median, minimum and maximum of ``repeat`` after ``warm_up`` runs that do
    not count."""
    for _ in range(warm_up):
        run()
    times = []
    for _ in range(repeat):
        started = time.perf_counter()
        run()
        times.append(time.perf_counter() - started)
    return {"median": float(np.median(times)), "min": min(times), "max": max(times), "repeat": repeat}


def _processor() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _memory_gib() -> float:
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
