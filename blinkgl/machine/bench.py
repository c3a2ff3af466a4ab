"""A description of the machine, for benchmarks."""

from __future__ import annotations

import datetime
import os
import platform

import numpy as np

from blinkgl.machine.cpu import cpu_field


def machine_line(opengl: str | None = None) -> str:
    """Return one line for a report: CPU, cores, memory, versions, OpenGL renderer, date."""
    import numba

    parts = [
        cpu_field("model name") or platform.processor() or platform.machine(),
        f"{len(os.sched_getaffinity(0))} cores",
        f"{os.sysconf('SC_PAGE_SIZE') * os.sysconf('SC_PHYS_PAGES') / 2**30:.0f} GiB",
        f"Python {platform.python_version()}",
        f"NumPy {np.__version__}",
        f"numba {numba.__version__}",
    ]
    if opengl:
        parts.append(opengl)
    return ", ".join([*parts, datetime.datetime.now().astimezone().date().isoformat()])
