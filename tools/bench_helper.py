"""What a second process that draws frames is worth to one sequence, and what two cores could give at most.

    python -m blinkgl.tools.bench_helper [CONFIG…] [--seconds 0.6] [--rounds 3]

Turns of: one process; the same with its helper, which is there already; two processes that make the sequence each, half
their time (the bound). Wall seconds of whole sequences: for a machine that has nothing else to do. Processor seconds
stand beside them.
"""

from __future__ import annotations

import argparse
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from importlib import resources
from pathlib import Path

from rich.console import Console
from rich.table import Table

from blinkgl.config.sequence import load_run
from blinkgl.dataset.generate import generate_sequence
from blinkgl.dataset.plan import Plan
from blinkgl.gl import create_context
from blinkgl.machine.bench import machine_line
from blinkgl.sequence.helper import Helper

ARMS = ("one process", "with a helper", "two processes, a sequence each")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("configs", nargs="*")
    parser.add_argument("--seconds", type=float, default=0.6)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        _work(arguments.configs[0], arguments.seconds)
        return
    shipped = resources.files("blinkgl.configs")
    configs = arguments.configs or [str(shipped / "demo.yaml"), str(shipped / "flying_objects.yaml")]
    console = Console()
    console.print(machine_line(), highlight=False)
    table = Table("clip", "who", "wall s", "processor s", "times as fast")
    for config in configs:
        found = measure(config, arguments.seconds, arguments.rounds)
        alone = found[ARMS[0]][0]
        for arm, (wall, cpu) in found.items():
            table.add_row(Path(config).name, arm, f"{wall:.2f}", f"{cpu:.2f}", f"{alone / wall:.2f}")
    console.print(table)


def measure(config: str, seconds: float, rounds: int) -> dict[str, tuple[float, float]]:
    """Medians of (wall seconds, processor seconds) per sequence, by arm."""
    first, *pair = (_Worker(config, seconds, threads) for threads in (None, "0", "0"))
    workers = (first, *pair)
    try:
        for worker in workers:  # compiles, and the helper starts
            worker.asked("alone")
        for _ in range(2):
            first.asked("helped")
        found: dict[str, list[tuple[float, float]]] = {arm: [] for arm in ARMS}
        for _ in range(rounds):
            found[ARMS[0]].append(first.asked("alone"))
            found[ARMS[1]].append(first.asked("helped"))
            for worker in pair:
                worker.ask("alone")
            walls, cpus = zip(*(worker.answer() for worker in pair), strict=True)
            found[ARMS[2]].append((max(walls) / 2, sum(cpus) / 2))
    finally:
        for worker in workers:
            worker.close()
    return {arm: tuple(statistics.median(column) for column in zip(*rows, strict=True)) for arm, rows in found.items()}


class _Worker:
    """A process that makes the sequence when it is asked. threads : of llvmpipe; None: as many as it takes."""

    def __init__(self, config: str, seconds: float, threads: str | None):
        command = [sys.executable, "-m", "blinkgl.tools.bench_helper", "--worker", config, "--seconds", str(seconds)]
        environment = {**os.environ, **({} if threads is None else {"LP_NUM_THREADS": threads})}
        self._popen = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment
        )

    def ask(self, how: str) -> None:
        self._popen.stdin.write(how + "\n")
        self._popen.stdin.flush()

    def answer(self) -> tuple[float, float]:
        wall, cpu = map(float, self._popen.stdout.readline().split())
        return wall, cpu

    def asked(self, how: str) -> tuple[float, float]:
        self.ask(how)
        return self.answer()

    def close(self) -> None:
        self._popen.stdin.close()
        self._popen.wait()


def _work(path: str, seconds: float) -> None:
    template = load_run(path, [f"time.duration={seconds}"])
    plan = Plan.of(template, 1)
    task = plan.tasks[0]
    config = plan.config(task)
    with create_context(config.gl.backend, config.gl.device) as gl, Helper(patience_s=0.0) as helper:
        for line in sys.stdin:
            out = tempfile.mkdtemp(prefix="blinkgl-bench-")
            wall, cpu = time.perf_counter(), time.process_time() + helper.cpu_s
            wanted = helper if line.strip() == "helped" else None
            generate_sequence(config, task.index, out, gl, base=template.base, helper=wanted)
            wall, cpu = time.perf_counter() - wall, time.process_time() + helper.cpu_s - cpu
            shutil.rmtree(out)
            print(f"{wall:.4f} {cpu:.4f}", flush=True)


if __name__ == "__main__":
    main()
