"""What rendering while training costs: samples a second, and how long a training of a given pace would wait.

    python -m blinkgl.tools.bench_online [RECIPE] [--workers 1 2] [--step-ms 0 10 25 50] [--samples 400] [--json FILE]
    python -m blinkgl.tools.bench_online [RECIPE] --leaks 10000 --workers 2       # memory after each tenth of them

RECIPE: configs/eflow/real_data.yaml by default, windows of 5 to 100 ms, ten of a sequence. A training is stood for by a
loop that keeps this process busy for ``--step-ms`` per sample; 0 takes samples as fast as they come. The first 160
samples do not count. ``waited``: share of the wall time in which the loop had to wait for a sample.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from pathlib import Path

from rich.console import Console
from rich.table import Table

from blinkgl import OnlineSequences
from blinkgl.machine import bench

RECIPE = "configs/eflow/real_data.yaml"
HOW = {"window_ms": (5, 100), "per_sequence": 10, "min_events": 40, "max_flow": 16, "min_density": 0.008}
WARM_UP = 160


def busy(milliseconds: float) -> None:
    """Keeps a core for so much processor time."""
    until = time.process_time() + milliseconds / 1000
    while time.process_time() < until:
        sum(range(2000))


def pace(recipe: str, workers: int, step_ms: float, samples: int) -> dict[str, float]:
    """Samples taken by a loop that is busy between them."""
    with OnlineSequences(recipe, workers=workers, **HOW) as sequences:
        stream = iter(sequences)
        for _ in range(WARM_UP):
            next(stream)
        before, began = sequences.stats.waited_s, time.perf_counter()
        for _ in range(samples):
            next(stream)
            busy(step_ms)
        seconds = time.perf_counter() - began
        stats = sequences.stats
        return {
            "workers": workers,
            "step_ms": step_ms,
            "samples_per_s": samples / seconds,
            "waited": (stats.waited_s - before) / seconds,
            "render_ms": 1000 * stats.cpu_s / stats.samples,
            "failures": stats.failures,
        }


def leaks(recipe: str, workers: int, samples: int) -> list[dict[str, float]]:
    """Memory of this process, of the workers, and what the spool holds, after each tenth of ``samples``."""
    rows = []
    with OnlineSequences(recipe, workers=workers, **HOW) as sequences:
        for n, _ in zip(range(1, samples + 1), sequences, strict=False):
            if n % (samples // 10) == 0:
                mine, theirs = resident(os.getpid()), [resident(pid) for pid in descendants(os.getpid())]
                spool = [size for f in sequences.stream.spool.iterdir() if (size := size_of(f)) is not None]
                rows.append(
                    {
                        "samples": n,
                        "MiB": mine,
                        "worker_MiB": max(theirs),
                        "spool_files": len(spool),
                        "spool_MiB": sum(spool) / 2**20,
                        "replaced": sequences.stats.replaced,
                    }
                )
                print(rows[-1], flush=True)  # it takes long, and may be ended
    return rows


def size_of(file: Path) -> int | None:
    """Bytes of a file of the spool; None: the stream has just thrown it away."""
    try:
        return file.stat().st_size
    except FileNotFoundError:
        return None


def resident(pid: int) -> float:
    """MiB that a process holds."""
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 2**20


def descendants(pid: int) -> list[int]:
    children = [
        int(child) for task in Path(f"/proc/{pid}/task").iterdir() for child in (task / "children").read_text().split()
    ]
    return children + [below for child in children for below in descendants(child)]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("recipe", nargs="?", default=RECIPE)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--step-ms", type=float, nargs="+", default=[0.0, 10.0, 25.0, 50.0])
    parser.add_argument("--samples", type=int, default=400)
    parser.add_argument("--leaks", type=int, metavar="SAMPLES", help="so many samples, and what they leave behind")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    options = parser.parse_args()
    rows = (
        leaks(options.recipe, options.workers[0], max(options.leaks, 10))
        if options.leaks
        else [
            pace(options.recipe, workers, step_ms, options.samples)
            for workers in options.workers
            for step_ms in options.step_ms
        ]
    )
    report = {
        "machine": bench.machine_line(),
        "load_average": os.getloadavg()[0],
        "recipe": options.recipe,
        "rows": rows,
    }
    console = Console(width=120)
    console.print(report["machine"], highlight=False, soft_wrap=True)
    table = Table(*rows[0])
    for row in rows:
        table.add_row(*(f"{value:.4g}" for value in row.values()))
    console.print(table)
    if options.json:
        Path(options.json).write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
