"""Times parts of BlinkGL, alone or in turns with another checkout.

    python -m blinkgl.tools.bench                                    # what can be timed
    python -m blinkgl.tools.bench WHAT [--config FILE] [--set a.b=c …] [--rounds 9] [--load N] [--json FILE]
    python -m blinkgl.tools.bench WHAT --against CHECKOUT …          # ratios of the two versions
    python -m blinkgl.tools.bench --page [--rounds 5]                # docs/benchmarks.md: all of them

Every row is run once per round after ``--warm-up`` rounds that do not count, the rows and the checkouts in turns, each
checkout in a process of its own. Printed are medians of wall and of processor milliseconds, children's included, and
the fastest wall time. On a shared machine processor time and ratios of one run are what to trust. ``--load`` keeps so
many processes spinning meanwhile. What runs in the checkouts is bench_rows.py of this one.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import math
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import MappingProxyType

import numpy as np

from blinkgl.machine.bench import machine_line
from blinkgl.tools.bench_rows import WHATS

HERE = Path(__file__).resolve().parents[1]
Table = dict[str, dict[str, np.ndarray]]
"""Row -> name of a command -> (rounds, n) numbers."""


@contextlib.contextmanager
def checkout(folder: Path) -> Iterator[str]:
    """A folder for ``sys.path`` with that checkout's packages where a wheel has them."""
    with tempfile.TemporaryDirectory(prefix="blinkgl-bench-") as name:
        (package := Path(name) / "blinkgl").mkdir()
        for path in [*(folder / "blinkgl").iterdir(), *(folder / room for room in ("shaders", "configs", "tools"))]:
            if path.name != "__pycache__":
                (package / path.name).symlink_to(path)
        (Path(name) / "eflow").symlink_to(folder / "eflow")
        yield name


PROGRAM = "import runpy, sys; sys.path.insert(0, sys.argv.pop(1)); runpy.run_path(sys.argv.pop(1), run_name='__main__')"
ROWS = Path(__file__).with_name("bench_rows.py")


def in_checkout(stack: contextlib.ExitStack, folder: Path, arguments: list[str]) -> list[str]:
    """The command of a process that times the rows of ``arguments`` in a checkout, which lasts as long as the stack."""
    return [sys.executable, "-c", PROGRAM, stack.enter_context(checkout(folder)), str(ROWS), *arguments]


def started(stack: contextlib.ExitStack, command: list[str], variables: Mapping[str, str]) -> subprocess.Popen[str]:
    """A measured process, which ends with the stack. variables : of its environment."""
    environment = {**os.environ, **variables}
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)

    def stop() -> None:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # it has ended by an error of its own, which is reported
            process.stdin.close()
        process.wait()

    stack.callback(stop)
    return process


def one_round(process: subprocess.Popen[str]) -> dict[str, list[float]]:
    """Every row once. Raises SystemExit where the process has ended."""
    assert process.stdin is not None and process.stdout is not None
    process.stdin.write("\n")
    process.stdin.flush()
    if not (line := process.stdout.readline()):
        raise SystemExit(f"the measured process ended with status {process.wait()}")
    return json.loads(line)


def spin(stack: contextlib.ExitStack, count: int) -> None:
    """Keeps ``count`` processes busy until the stack ends, or this process does."""
    program = "import os\nparent = os.getppid()\nwhile os.getppid() == parent:\n    sum(range(100_000))"
    for _ in range(count):
        child = subprocess.Popen([sys.executable, "-c", program])
        stack.callback(child.wait)
        stack.callback(child.kill)


def measure(
    commands: Mapping[str, list[str]],
    rounds: int,
    warm_up: int = 2,
    load: int = 0,
    variables: Mapping[str, str] = MappingProxyType({}),
) -> Table:
    """Row -> name of a command -> its numbers, (rounds, n): those of the rounds that count, commands in turns.

    load : processes that spin meanwhile.   variables : of the environment of the measured processes."""
    seen: dict[str, dict[str, list[list[float]]]] = {}
    with contextlib.ExitStack() as stack:
        processes = {name: started(stack, command, variables) for name, command in commands.items()}
        spin(stack, load)
        for k in range(warm_up + rounds):
            for name, process in processes.items():
                for row, numbers in one_round(process).items():
                    if k >= warm_up:
                        seen.setdefault(row, {}).setdefault(name, []).append(numbers)
    return {row: {name: np.array(numbers) for name, numbers in of.items()} for row, of in seen.items()}


def figures(numbers: np.ndarray) -> dict[str, float]:
    """Medians of [wall, processor] milliseconds of the rounds, (rounds, 2), and the fastest wall time."""
    wall, processor = np.median(numbers, axis=0).tolist()
    return {"wall_ms": wall, "cpu_ms": processor, "fastest_ms": float(numbers[:, 0].min())}


def show(table: dict[str, dict[str, dict[str, float]]]) -> None:
    """A line a row and checkout; behind the second its share of the first, wall and processor time."""
    print(f"{'':34} {'':9} {'wall, ms':>10} {'fastest':>10} {'processor':>10}")
    for row, of in table.items():
        first = next(iter(of.values()))
        for name, r in of.items():
            line = f"{row:34} {name:9} {r['wall_ms']:10.2f} {r['fastest_ms']:10.2f} {r['cpu_ms']:10.2f}"
            if r is not first:
                line += f"   this / {name}: {first['wall_ms'] / r['wall_ms']:.2f}, {first['cpu_ms'] / r['cpu_ms']:.2f}"
            print(line)


def _ms(value: float) -> str:
    """Three digits, or none where a part of a row has no processor time of its own."""
    return "" if math.isnan(value) else f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


PAGE = Path("docs/benchmarks.md")
PEERS = "\n## Beside the authors' programs\n"
"""Heading of the section that tools/peers.py makes."""
PEERS_ANCHOR = "#beside-the-authors-programs"


def page(machine: str, rounds: int) -> str:
    """docs/benchmarks.md: every row of every part, on this machine."""
    about = (
        "# Benchmarks\n\nMade by `python -m blinkgl.tools.bench --page` on an otherwise idle machine; do not edit. "
        f"{machine}. Medians of {rounds} rounds (networks: one), milliseconds. Processor time is that of all threads. "
        f"Accuracy is in [what was measured](results.md), speed beside other programs is [below]({PEERS_ANCHOR}).\n"
    )
    parts = [about]
    for what, rows in WHATS.items():
        once = what == "networks"  # minutes each
        with contextlib.ExitStack() as stack:
            table = measure({"this": in_checkout(stack, HERE, [what])}, 1 if once else rounds, int(not once))
        medians = {row: figures(of["this"]) for row, of in table.items()}
        lines = [f"|{row}|{_ms(m['cpu_ms'])}|{_ms(m['wall_ms'])}|\n" for row, m in medians.items()]
        about = " ".join((rows.__doc__ or "").split())
        parts.append(
            f"\n## {what}\n\n{about} `python -m blinkgl.tools.bench {what}`\n\n|row|processor|wall|\n|---|---|---|\n"
            + "".join(lines)
        )
        print(parts[-1], flush=True)
    return "".join(parts)


def main(arguments: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__ + "\n" + "\n".join(f"{name:9} {what.__doc__}" for name, what in WHATS.items()),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("what", choices=WHATS, metavar="WHAT", nargs="?")
    parser.add_argument("--config", metavar="FILE", help="instead of configs/demo.yaml")
    parser.add_argument("--set", dest="overrides", action="append", default=[], metavar="a.b=c")
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--warm-up", type=int, default=2)
    parser.add_argument("--load", type=int, default=0, metavar="N", help="processes that spin meanwhile")
    parser.add_argument("--against", type=Path, metavar="CHECKOUT")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    parser.add_argument("--page", action="store_true", help=f"write {PAGE}")
    words = sys.argv[1:] if arguments is None else arguments
    options = parser.parse_args(words)
    if options.page:
        peers = PAGE.read_text(encoding="utf-8").partition(PEERS)  # tools/peers.py makes that section
        PAGE.write_text(page(machine_line(), options.rounds) + "".join(peers[1:]), encoding="utf-8")
        return
    if options.what is None:
        parser.print_help()
        return
    folders = {"this": HERE}
    if options.against is not None:
        folders["against"] = options.against.resolve()
    changes = [word for change in options.overrides for word in ("--set", change)]
    row_words = [options.what, *(["--config", options.config] if options.config else []), *changes]
    machine = machine_line()
    print(machine)
    with contextlib.ExitStack() as stack:
        commands = {name: in_checkout(stack, folder, row_words) for name, folder in folders.items()}
        measured = measure(commands, options.rounds, options.warm_up, options.load)
    table = {row: {name: figures(numbers) for name, numbers in of.items()} for row, of in measured.items()}
    show(table)
    if options.json is not None:
        report = {"machine": machine, "what": options.what, "rounds": options.rounds, "load": options.load}
        options.json.write_text(json.dumps({**report, "rows": table}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
