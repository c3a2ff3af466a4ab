"""Times BlinkGL's emulators in turns with the programs that their authors published, on the same frames.

    python -m blinkgl.tools.peers --v2e CHECKOUT --voltmeter CHECKOUT [--rounds 5] [--frames 24] [--page]

``--v2e`` is a checkout of SensorsINI/v2e, ``--voltmeter`` of Lynn0306/DVS-Voltmeter; either may be left out. Each
program runs in a process of its own with one thread, on a clip of 640x480 at 1000 frames/s. The first
frame, which only sets the state, is not timed. ``--page`` writes a section of docs/benchmarks.md.
"""

from __future__ import annotations

import argparse
import importlib
import sys
import time
from collections.abc import Callable, Sized
from types import ModuleType
from unittest.mock import MagicMock

import numpy as np

from blinkgl.machine.bench import machine_line
from blinkgl.tools.bench import PAGE, PEERS as SECTION, measure
from blinkgl.tools.bench_rows import FPS, HEIGHT, WIDTH, answer, clip

NOT_USED = ("screeninfo", "easygui", "tkinter", "engineering_notation", "dv_processing", "easydict")
"""Modules that the programs import for windows, output files and options, and that need not be installed here."""
PARAMETERS = {
    "v2e": "its command line's defaults",
    "voltmeter": "the authors' values for a DVS346",
}
K = (0.00018 * 29250, 20, 0.0001, 1e-7, 5e-9, 0.00001)
"""k1 to k6 of the authors' DVS346."""
Step = Callable[[np.ndarray, float], int]
"""Takes an 8-bit frame and its time in seconds; returns the number of events."""


def ours(kind: str) -> Step:
    """A step of our emulator with :data:`PARAMETERS`."""
    from blinkgl.events.table import make_emulator
    from blinkgl.recordings.simulation import emulator_config

    values = {"v2e": {"start": "zero"}, "voltmeter": dict(zip(("k1", "k2", "k3", "k4", "k5", "k6"), K, strict=True))}
    emulator = make_emulator(emulator_config({"emulator": kind, **values[kind]}), HEIGHT, WIDTH, seed=0)
    # Linear light, as the authors' programs take codes.
    return lambda frame, t: len(emulator.step(frame.astype(np.float32) / 255, round(t * 1e9)))


def imported(checkout: str, module: str) -> ModuleType:
    """A module of a checkout, with one thread."""
    import torch

    torch.set_num_threads(1)
    sys.path.insert(0, checkout)
    sys.modules.update({name: MagicMock() for name in NOT_USED if name not in sys.modules})
    return importlib.import_module(module)


def counted(events: Sized | None) -> int:
    """The number of events that an authors' program returns."""
    return 0 if events is None else len(events)


def v2e(checkout: str) -> Step:
    """A step of v2e's own emulator."""
    emulator = imported(checkout, "v2ecore.emulator").EventEmulator(
        pos_thres=0.2,
        neg_thres=0.2,
        sigma_thres=0.03,
        cutoff_hz=300,
        leak_rate_hz=0.01,
        shot_noise_rate_hz=0.001,
        refractory_period_s=0.0005,
        device="cpu",
    )
    return lambda frame, t: counted(emulator.generate_events(frame.astype(np.float32), t))


def voltmeter(checkout: str) -> Step:
    """A step of the DVS-Voltmeter authors' own simulator."""
    config = MagicMock()
    config.SENSOR.K = K
    simulator = imported(checkout, "src.simulator").EventSim(config, "", "")
    return lambda frame, t: counted(simulator.generate_events(frame, round(t * 1e6)))


def timed(program: str, checkout: str, frames: int) -> dict[str, list[float]]:
    """Density -> [processor ms a frame, events a pixel and frame] of a program, or of ours without a checkout."""
    row = {}
    for density in DENSITIES:
        pictures = clip(density, frames + 1)
        step = PEERS[program](checkout) if checkout else ours(program)
        for warm in (0, 1):  # compiling and first allocations
            step(pictures[warm], warm / FPS)
        began, events = time.process_time(), 0
        for number in range(2, frames + 1):
            events += step(pictures[number], number / FPS)
        spent = time.process_time() - began
        row[density] = [1000 * spent / (frames - 1), events / (frames - 1) / (HEIGHT * WIDTH)]
    return row


PEERS, DENSITIES = {"v2e": v2e, "voltmeter": voltmeter}, ("mid", "dense")


def table(checkouts: dict[str, str], rounds: int, frames: int) -> str:
    """The figures as Markdown: medians of the rounds, programs in turns."""
    lines = [
        "|model|events per pixel, frame: theirs, ours|authors' program, ms|BlinkGL, ms|ratio|\n|---|---|---|---|---|\n"
    ]
    one = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    answers = [sys.executable, "-P", "-m", "blinkgl.tools.peers", "--answer"]
    for model, checkout in checkouts.items():
        commands = {"theirs": [*answers, model, checkout, str(frames)], "ours": [*answers, model, "", str(frames)]}
        for of in measure(commands, rounds, warm_up=0, variables=one).values():
            (theirs, its_rate), (own, rate) = (np.median(of[name], axis=0) for name in commands)
            lines.append(
                f"|{model}: {PARAMETERS[model]}|{its_rate:.3f}, {rate:.3f}|{theirs:.1f}|{own:.1f}|{theirs / own:.1f}|\n"
            )
            print(lines[-1], end="", flush=True)
    return "".join(lines)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in PEERS:
        parser.add_argument(f"--{name}", metavar="CHECKOUT")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--frames", type=int, default=24)
    parser.add_argument("--page", action="store_true", help=f"write {PAGE}")
    parser.add_argument("--answer", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.answer:
        program, checkout, frames = options.answer
        answer(lambda: timed(program, checkout, int(frames)))
        return
    checkouts = {name: path for name in PEERS if (path := getattr(options, name))}
    if not checkouts:
        raise SystemExit("error: --v2e or --voltmeter: a checkout is needed")
    made = table(checkouts, options.rounds, options.frames)
    if options.page:
        PAGE.write_text(
            PAGE.read_text(encoding="utf-8").partition(SECTION)[0] + SECTION + "\n"
            "Made by `python -m blinkgl.tools.peers --v2e CHECKOUT --voltmeter CHECKOUT --page`; do not edit.\n\n"
            f"{machine_line()}. 640x480, 1000 frames/s, one thread each, in turns; medians of {options.rounds} rounds, "
            "processor milliseconds a frame. ESIM's authors publish C++ and CUDA, which it does not build.\n\n"
            f"{made}",
            encoding="utf-8",
        )


if __name__ == "__main__":
    main()
