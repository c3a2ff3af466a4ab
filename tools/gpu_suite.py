"""What has to be known of a graphics card, in stages of a few minutes each, without a network.

    python -m blinkgl.tools.gpu_suite --pack out/card                        # before: makes what travels
    python -m blinkgl.tools.gpu_suite --stage A [--minutes 5] --out FOLDER   # there
    python -m blinkgl.tools.gpu_suite --small                                # all stages: does everything run?

A (5 minutes)  what works and how fast: pictures and labels beside the float64 reference, events on tensors beside
               numba's bit for bit, the way from OpenGL to CUDA, speed of the event kernel
B (3)          whole sequences, by one process and by several that share the card
C (8)          a network trains while its data are rendered; its weights come back in half precision
D (8)          the five networks, equal minutes each, on one set; ``--seed 1`` is another training

FOLDER then has ``gpu_suite.json`` and ``gpu_suite.md``, written after every row. Each piece of a stage runs in a
process of its own. A row that fails, hangs or ends its process says so in a line, and the next one goes on in another.
"""

from __future__ import annotations

import argparse
import contextlib
import importlib
import json
import math
import multiprocessing
import os
import shutil
import signal
import sys
import tempfile
import time
from argparse import Namespace
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.errors import BlinkGLError
from blinkgl.io.atomic import write_whole
from blinkgl.machine import bench
from blinkgl.machine.interrupts import interruptible
from blinkgl.types.trees import Tree

Row = Tree
"""A row of a table: title of a column -> text or number."""


MEASURED, TRAINED = "blinkgl.tools.gpu_pieces", "blinkgl.tools.gpu_learning"
PIECES = {
    "compiling": (MEASURED, "compiling kernels", 0.5, 240),
    "doctor": (MEASURED, "what the machine has", 0.2, 60),
    "transfer": (MEASURED, "from OpenGL to a tensor", 0.2, 20),
    "end_to_end": (MEASURED, "OpenGL draws, torch makes events and voxel grids", 0.2, 60),
    "kernel": (MEASURED, "speed and memory of the event kernel", 0.3, 45),
    "frames": (MEASURED, "pictures and labels beside the float64 reference", 0.3, 45),
    "events": (MEASURED, "events on tensors beside numba's, bit for bit", 0.25, 60),
    "fingerprint": (MEASURED, "pictures, labels and events beside those that travelled", 0.3, 30),
    "cold": (MEASURED, "a command's start", 0.4, 120),
    "sequences": (MEASURED, "whole sequences", 1.0, 90),
    "online": (TRAINED, "E-FlowFormer quick trains while its data are rendered", 1.0, 300),
    "networks": (TRAINED, "five networks, equal minutes, one set", 1.0, 300),
}
"""Where a piece's function is, its heading, the share of the stage's minutes that it may take, and the longest time of
a row, s."""
NEED_TORCH = ("transfer", "end_to_end", "kernel", "events", "online", "networks")
STAGES = {
    "A": (5.0, ("compiling", "doctor", "transfer", "end_to_end", "kernel", "frames", "events", "fingerprint")),
    "B": (3.0, ("compiling", "cold", "sequences")),
    "C": (8.0, ("compiling", "online")),
    "D": (8.0, ("compiling", "networks")),
}
"""Minutes and pieces."""
REHEARSAL_MINUTES = 20.0
"""Longest time of a stage with ``--small``, on any machine."""
RANKS = ("begun", "done", "absent", "failed", "cut")
"""States of a piece; that of its worst row counts."""


# --- the results ------------------------------------------------------------------------------------------------------


def table(rows: list[Row]) -> list[str]:
    """Lines of a Markdown table."""
    columns = list(dict.fromkeys(name for row in rows for name in row))
    show = lambda v: "" if v is None else f"{v:,.4g}" if isinstance(v, float) else str(v).replace("|", "/")
    return [
        "| " + " | ".join(columns) + " |",
        "|---" * len(columns) + "|",
        *("| " + " | ".join(show(row.get(name)) for name in columns) + " |" for row in rows),
    ]


def write(out: Path, report: Tree) -> None:
    """``gpu_suite.json`` and ``gpu_suite.md``, whole."""
    lines = [f"# {report['machine']}, {report['device']}"]
    for stage, pieces in report["stages"].items():
        for name, piece in pieces.items():
            summary = f"{piece['state']}, {piece['seconds']:.0f} s {piece['said']}".rstrip()
            lines += ["", f"## {stage}, {name}: {PIECES[name][1]}", "", summary, ""]
            lines += table(piece["rows"]) if piece["rows"] else []
    plain = lambda value: value.item() if isinstance(value, np.generic) else str(value)
    text = json.dumps(report, indent=1, default=plain)
    for name, content in (("gpu_suite.json", text), ("gpu_suite.md", "\n".join(lines))):
        write_whole(out / name, content + "\n")


# --- the process of a piece -------------------------------------------------------------------------------------------


def answer(pipe: Connection, name: str, module: str, first: int, options: Namespace) -> None:
    """Measure the rows of a piece from number ``first`` on, and send them: (what, value), what being device, begin
    (number and name of a row), rows or state."""
    os.setsid()  # so that what it begins can be ended with it
    try:
        pipe.send(("device", line := importlib.import_module(MEASURED).device_line(options)))
        if line == "no torch" and name in NEED_TORCH:
            raise ImportError(line)
        for number, (title, measure) in enumerate(getattr(importlib.import_module(module), name)(options)):
            if number >= first:
                pipe.send(("begin", (number, title)))
                rows, state = measured(title, measure)
                pipe.send(("rows", rows))
                pipe.send(("state", state))
    except Exception as error:  # noqa: BLE001 - the other pieces go on
        pipe.send(("state", outcome(error)))


def measured(title: str, measure: Callable[[], Row | list[Row]]) -> tuple[list[Row], tuple[str, str]]:
    """Return the rows that a function gives, or one that says why it gives none; and the state of the piece."""
    try:
        result = measure()
    except Exception as error:  # noqa: BLE001 - the other rows go on
        state, reason = outcome(error)
        return [{"": title, "said": f"{state}: {reason}"}], (state, f"'{title}' has no result")
    rows = result if isinstance(result, list) else [{"": title, **result}]
    wrong = any(row.get(name) is False for row in rows for name in ("passed", "same numbers"))
    return rows, ("failed", f"'{title}' is wrong") if wrong else ("done", "")


def outcome(error: Exception) -> tuple[str, str]:
    """Return "absent", where this machine cannot do something, or "failed"; and why, in a line."""
    reason = " ".join(str(error).split())[:300]
    cannot = isinstance(error, (BlinkGLError, ImportError)) or "out of memory" in reason
    return ("absent", reason) if cannot else ("failed", f"{type(error).__name__}: {reason}")


def stop(process: Any) -> None:
    """End a piece's process and all that it began and that is still there."""
    for number, seconds in ((signal.SIGTERM, 5), (signal.SIGKILL, 1)):
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        process.join(seconds)
    process.kill()


# --- the command ------------------------------------------------------------------------------------------------------


def run_stage(name: str, options: Namespace, report: Tree) -> None:
    """Every piece of a stage, as far as its minutes reach."""
    minutes, pieces = STAGES[name]
    seconds = 60 * (options.minutes or (REHEARSAL_MINUTES if options.small else minutes))
    deadline, done = time.monotonic() + seconds, report["stages"].setdefault(name, {})
    for piece in (piece for piece in pieces if piece in options.only):
        print(f"{name}, {piece} …", flush=True)
        outcomes = done[piece] = {"state": "begun", "said": "", "seconds": 0.0, "rows": []}
        began, first = time.monotonic(), 0
        until = min(deadline, began + seconds * PIECES[piece][2])
        while first is not None:
            first = run_process(piece, first, until, options, report, outcomes)
            outcomes["seconds"] = time.monotonic() - began
            write(options.out, report)
        print(f"{name}, {piece}: {outcomes['state']}, {outcomes['seconds']:.0f} s {outcomes['said']}", flush=True)


def run_process(
    name: str, first: int, deadline: float, options: Namespace, report: dict[str, object], outcomes: Tree
) -> int | None:
    """Run a piece from a row on until it ends, hangs or its time is over. Return the row that another process begins
    with, or None."""
    module, _, _, row_s = PIECES[name]
    row, spawn = (-1, "the start"), multiprocessing.get_context("spawn")
    options.seconds = deadline - time.monotonic()
    here, there = spawn.Pipe(duplex=False)
    process = spawn.Process(target=answer, args=(there, name, module, first, options))
    try:
        process.start()
        there.close()
        at_work = False  # starting a process takes as long as the machine is busy: only rows have a limit
        while here.poll(max(0.0, min(row_s if at_work else math.inf, deadline - time.monotonic()))):
            what, value = here.recv()
            at_work = what == "begin"
            if at_work:
                row = value
            elif what == "rows":
                outcomes["rows"] += value
                print(*(f"  {next(iter(one.values()))}" for one in value), sep="\n", flush=True)
                write(options.out, report)
            elif what == "device":
                report["device"] = value
            elif RANKS.index(value[0]) >= RANKS.index(outcomes["state"]):
                outcomes |= dict(zip(("state", "said"), value, strict=True))
        if time.monotonic() >= deadline:
            outcomes |= {"state": "cut", "said": f"the time was over during '{row[1]}'"}
            return None
        why = f"no result after {row_s:g} s"
    except EOFError:  # it has ended
        process.join()
        if process.exitcode == 0:
            return None
        why = f"the process ended with status {process.exitcode}"
    finally:
        stop(process)
    outcomes |= {"state": "failed", "said": f"'{row[1]}': {why}"}
    outcomes["rows"].append({"": row[1], "said": why})
    return None if row[0] < 0 else row[0] + 1


OPTIONS: dict[str, Tree] = {
    "--stage": {"default": "".join(STAGES), "help": "one or several: A, AB …; all of them"},
    "--minutes": {"type": float, "help": "of each stage, instead of its own"},
    "--out": {"type": Path, "default": Path("out/gpu_suite")},
    "--small": {"action": "store_true", "help": "small pictures: does everything run?"},
    "--only": {"default": ",".join(PIECES), "help": "pieces, with commas between"},
    "--device": {"help": "torch's; a card if there is one"},
    "--seed": {"type": int, "default": 0, "help": "of the trainings"},
    "--events": {"type": float, "help": "of the comparison, at least; 1e7, with --small 1e5"},
    "--backend": {"default": "auto", "help": "of OpenGL's context in stage A: auto, egl, osmesa"},
    "--egl-device": {"type": int, "default": 0, "help": "as blinkgl doctor numbers them"},
    "--packed": {"type": Path, "default": Path("out/card"), "help": "the folder that --pack made"},
    "--pack": {"type": Path, "metavar": "FOLDER", "help": "make what travels, and nothing else"},
}


def parsed(arguments: list[str] | None) -> Namespace:
    """Of the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, how in OPTIONS.items():
        parser.add_argument(name, **how)
    options = parser.parse_args(arguments)
    options.only = options.only.split(",")
    for option, names, known in (("--only", options.only, PIECES), ("--stage", options.stage, STAGES)):
        if unknown := set(names) - set(known):
            parser.error(f"{option}: unknown {', '.join(sorted(unknown))}; expected {', '.join(known)}")
    options.events = options.events or (1e5 if options.small else 1e7)
    return options


def main(arguments: list[str] | None = None) -> int:
    """See the module. 0: everything is measured, or cannot be here; 1: something failed."""
    options = parsed(arguments)
    if options.pack:
        importlib.import_module(TRAINED).pack(options.pack, options.small)
        return 0
    options.out.mkdir(parents=True, exist_ok=True)
    report: Tree = {"machine": bench.machine_line(), "device": options.device, "stages": {}}
    options.scratch = tempfile.mkdtemp(prefix="blinkgl-gpu-")
    try:
        with interruptible(signal.SIGTERM):
            for stage in options.stage:
                run_stage(stage, options, report)
    except KeyboardInterrupt:
        return 130
    finally:
        shutil.rmtree(options.scratch, ignore_errors=True)
    print((options.out / "gpu_suite.md").read_text(encoding="utf-8"))
    return int(any(piece["state"] == "failed" for stage in report["stages"].values() for piece in stage.values()))


if __name__ == "__main__":
    sys.exit(main())
