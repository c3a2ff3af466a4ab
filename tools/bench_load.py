"""What a busy machine does to the event kernels on one and two threads.

    python -m blinkgl.tools.bench_load [--load 8] [--rounds 5] [--against FOLDER] [--json FILE]

``--load`` processes spin while it measures (0: none; on a quiet machine that is the other half of the picture). For
each emulator a clip of 640x480 at 1000 fps is passed through once per thread count and round, thread counts taking
turns; wall and processor milliseconds a frame, median over the rounds after one that does not count. ``--against``: a
checkout of another version, measured in the same turns, each in a process of its own. ``digest`` is
of all events: equal whatever the threads.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numba
import numpy as np
from rich.console import Console
from rich.table import Table

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator
from blinkgl.machine import bench
from blinkgl.tools.bench_events import FPS, HEIGHT, WIDTH, clip

EMULATORS = {
    "ESIM": EsimConfig(contrast_threshold=0.2, threshold_sigma=0.0),
    "V2E": V2eConfig(),
    "Voltmeter": VoltmeterConfig(),
}
THREADS = (1, 2)


@contextlib.contextmanager
def spinning(count: int) -> Iterator[None]:
    """``count`` processes that keep a core busy each, for as long as the block lasts."""
    # None outlives this process.
    program = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100_000))"
    children = [subprocess.Popen([sys.executable, "-c", program]) for _ in range(count)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def one_pass(config, frames: np.ndarray) -> dict[str, float | str]:
    emulator, digest = make_emulator(config, HEIGHT, WIDTH, 0), hashlib.sha256()
    emulator.step(frames[0], 0)
    events = []
    wall, cpu = time.perf_counter(), time.process_time()
    for k in range(1, len(frames)):
        events.append(emulator.step(frames[k], k * 1_000_000_000 // FPS))
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    for chunk in events:
        for name in "xytp":
            digest.update(getattr(chunk, name).tobytes())
    steps = len(frames) - 1
    return {"wall_ms": wall / steps * 1e3, "cpu_ms": cpu / steps * 1e3, "digest": digest.hexdigest()[:12]}


def answer() -> None:
    """The measured process: a line "EMULATOR THREADS" in, a line of JSON out."""
    frames, _ = clip("mid", 30)
    for line in sys.stdin:
        name, threads = line.split()
        numba.set_num_threads(int(threads))
        print(json.dumps(one_pass(EMULATORS[name], frames)), flush=True)


def measure(versions: dict[str, subprocess.Popen], rounds: int) -> list[dict]:
    seen: dict[tuple, list[dict]] = {}
    for number in range(rounds + 1):
        for name in EMULATORS:
            for threads in THREADS:
                for version, process in versions.items():
                    process.stdin.write(f"{name} {threads}\n")
                    process.stdin.flush()
                    reply = json.loads(process.stdout.readline())
                    if number:
                        seen.setdefault((name, version, threads), []).append(reply)
    return [
        {
            "emulator": name,
            "version": version,
            "threads": threads,
            "digest": replies[0]["digest"],
            **{k: float(np.median([r[k] for r in replies])) for k in ("wall_ms", "cpu_ms")},
            "wall_ms_min": min(r["wall_ms"] for r in replies),
        }
        for (name, version, threads), replies in seen.items()
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--load", type=int, default=8, help="spinning processes (default: 8)")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--against", metavar="FOLDER", help="checkout of another version to measure in the same turns")
    parser.add_argument("--json", metavar="FILE", help="write the figures there too")
    parser.add_argument("--answer", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.answer:
        answer()
        return
    program = (
        "import sys; sys.path.insert(0, sys.argv.pop(1)); name = sys.argv.pop(1); exec(compile(open(name).read(), "
        "name, 'exec'))"
    )
    folders = {
        "this": Path(__file__).resolve().parents[1],
        **({"against": Path(options.against).resolve()} if options.against else {}),
    }
    versions = {
        version: subprocess.Popen(
            [sys.executable, "-c", program, str(folder), __file__, "--answer"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, "NUMBA_NUM_THREADS": str(max(THREADS))},
        )
        for version, folder in folders.items()
    }
    try:
        with spinning(options.load):
            rows = measure(versions, options.rounds)
    finally:
        for process in versions.values():
            process.stdin.close()
            process.wait()
    report = {
        "machine": bench.machine_line(),
        "load": options.load,
        "load_average": os.getloadavg()[0],
        "rounds": options.rounds,
        "rows": rows,
    }
    console = Console(width=120)
    console.print(report["machine"], highlight=False, soft_wrap=True)
    table = Table(
        title=f"{options.load} spinning processes beside it (load average {report['load_average']:.1f}); ms a frame, "
        f"median of {options.rounds}"
    )
    for column in ("emulator", "version", "threads", "wall", "fastest", "processor", "wall x1 thread", "digest"):
        table.add_column(column)
    alone = {(r["emulator"], r["version"]): r["wall_ms"] for r in rows if r["threads"] == 1}
    for r in rows:
        table.add_row(
            r["emulator"],
            r["version"],
            str(r["threads"]),
            f"{r['wall_ms']:.2f}",
            f"{r['wall_ms_min']:.2f}",
            f"{r['cpu_ms']:.2f}",
            f"{r['wall_ms'] / alone[r['emulator'], r['version']]:.2f}",
            r["digest"],
        )
    console.print(table)
    if options.json:
        Path(options.json).write_text(json.dumps(report, indent=2) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
