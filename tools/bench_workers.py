"""How much faster N workers make a data set than one, and whether their memory grows with the sequences' length.

    python -m blinkgl.tools.bench_workers [--workers 2] [--rounds 3] [--sequences 12] [--memory] [--json FILE]

Rounds of 1 and N workers alternate; the time is that of making sequences, worker start-up left out. Processor seconds
stand beside it: on a machine that others use, too, wall times mean little, but processor seconds per sequence over N
cores say what an idle one would do. --memory also makes one sequence of 1 s and one of 60 s and
shows the largest resident size of each.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
from importlib import resources
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.sequence import RunTemplate, load_run
from blinkgl.dataset.executor import Local
from blinkgl.dataset.run import run_dataset
from blinkgl.dataset.work import RUN_FOLDER
from blinkgl.machine.bench import machine_line

SIZE = ["camera.width=346", "camera.height=260"]
ONE_GROUP = ["groups.flying_test.enabled=false", "groups.falling_dice.enabled=false"]


def measure(template: RunTemplate, workers: int, sequences: int) -> dict[str, float]:
    """One run into a folder that is thrown away."""
    with tempfile.TemporaryDirectory(prefix="blinkgl-bench-") as folder:
        before = os.getloadavg()[0]
        outcome = run_dataset(template, f"{folder}/out", Local(workers), num=sequences)
        costs = [
            json.loads(line) for line in (Path(folder) / "out" / RUN_FOLDER / "costs.jsonl").read_text().splitlines()
        ]
    return {
        "workers": workers,
        "elapsed_s": outcome.elapsed_s,
        "cpu_s": sum(c["cpu_s"] for c in costs),
        "load_before": before,
        "peak_rss_mb": max(c["peak_rss_kib"] for c in costs) / 1024,
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--sequences", type=int, default=12)
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--json")
    arguments = parser.parse_args()
    console = Console()
    console.print(machine_line(), highlight=False)
    recipe = str(resources.files("blinkgl.configs").joinpath("blinkflow_mini.yaml"))
    template = load_run(recipe, SIZE + ONE_GROUP)
    measure(template, 1, 1)  # kernels and file caches
    runs = [
        measure(template, workers, arguments.sequences)
        for _ in range(arguments.rounds)
        for workers in (1, arguments.workers)
    ]
    median = {
        w: {k: float(np.median([r[k] for r in runs if r["workers"] == w])) for k in runs[0]}
        for w in {1, arguments.workers}
    }
    table = Table("workers", "elapsed s", "processor s", "cores used", "load before", "largest process MB")
    for w, m in sorted(median.items()):
        table.add_row(
            str(w),
            f"{m['elapsed_s']:.1f}",
            f"{m['cpu_s']:.1f}",
            f"{m['cpu_s'] / m['elapsed_s']:.2f}",
            f"{m['load_before']:.1f}",
            f"{m['peak_rss_mb']:.0f}",
        )
    console.print(table)
    ratio = median[1]["elapsed_s"] / median[arguments.workers]["elapsed_s"]
    console.print(
        f"{arguments.workers} workers against 1: {ratio:.2f}x, medians of {arguments.rounds} rounds of "
        f"{arguments.sequences} sequences",
        highlight=False,
    )
    memory = {}
    if arguments.memory:
        for seconds in (1, 60):
            memory[seconds] = measure(
                load_run(recipe, [*SIZE, *ONE_GROUP, f"time.duration={seconds}", "timeline={kind: uniform, fps: 40}"]),
                1,
                1,
            )["peak_rss_mb"]
        console.print(
            f"largest resident size of a worker: {memory[1]:.0f} MB after 1 s, {memory[60]:.0f} MB after 60 s",
            highlight=False,
        )
    if arguments.json:
        Path(arguments.json).write_text(
            json.dumps({"machine": machine_line(), "runs": runs, "ratio": ratio, "peak_rss_mb": memory}, indent=1)
            + "\n"
        )


if __name__ == "__main__":
    main()
