"""Every file format that BlinkGL reads, damaged: mutants are read in processes that may
die, under a clock and a memory limit.

    python -m blinkgl.tools.fuzz_files [--mutants 1000] [--formats "events*" "mesh*"] [--seed 0] [--out out/fuzz]
                                       [--json FILE]
    python -m blinkgl.tools.fuzz_files --formats "mesh ply" --only 317  # one mutant again, with its traceback

What may come of a mutant: it is read (and what was read is looked at, see :mod:`blinkgl.tools.fuzz_formats`), or
refused with the one line of the command line. Everything else is a defect: a traceback, a crash, more than --cpu
seconds, more than --memory, a message of several lines, or a wrong answer that a check could have known. Defects are
grouped by where they happen; the first mutants of each group are kept in OUT with the command that repeats them. The
same seed and version make the same mutants. Exit status 1 when there are defects.

The reading process is forked from one that has read the whole file before, and reads mutants one after the other until
one of them is the end of it, so that a mutant costs milliseconds; no OpenGL is in it.
"""

from __future__ import annotations

import argparse
import contextlib
import faulthandler
import fnmatch
import gc
import json
import os
import resource
import select
import shutil
import signal
import sys
import tempfile
import time
import traceback
import zlib
from collections import Counter
from collections.abc import Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

# A process with threads cannot be forked safely; where this is imported they are somebody else's.
if __name__ == "__main__":
    for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
        os.environ.setdefault(_name, "1")

from blinkgl.errors import BlinkGLError
from blinkgl.tools.fuzz_formats import FORMATS, MARK, Format

OK, REFUSED, WRONG, TRACEBACK, CRASH, HANG, MEMORY = (
    "ok",
    "refused",
    "wrong answer",
    "traceback",
    "crash",
    "hang",
    "memory",
)
DEFECTS = (WRONG, TRACEBACK, CRASH, HANG, MEMORY)
_LONGEST_LINE = 700
_KEPT = 2
_BATCH = 50
"""Mutants that one process reads one after the other, if it lives."""


@dataclass(frozen=True)
class Limits:
    """cpu_s : processor seconds a mutant may take. wall_s : against waiting without working. memory_mb : beyond what
    the whole file takes; at eight times that allocations fail, to protect the machine."""

    cpu_s: int = 10
    wall_s: float = 60.0
    memory_mb: int = 512


@dataclass(frozen=True)
class Outcome:
    """kind : one of the constants above. detail : the line, the last frame of the traceback, or what is wrong."""

    kind: str
    detail: str = ""
    trace: str = ""
    peak_mb: float = 0.0


@dataclass
class Report:
    """What came of a format's mutants. defects : (kind and place) -> how many, the first mutants, a message."""

    format: str
    mutants: int = 0
    outcomes: dict[str, int] = field(default_factory=dict)
    refusals: dict[str, int] = field(default_factory=dict)
    defects: dict[str, dict] = field(default_factory=dict)
    seconds: float = 0.0

    @property
    def defective(self) -> int:
        return sum(self.outcomes.get(k, 0) for k in DEFECTS)


def fuzz(
    fmt: Format,
    mutants: int,
    *,
    seed: int = 0,
    limits: Limits = Limits(),
    out: Path | None = None,
    only: int | None = None,
) -> Report:
    """Reads ``mutants`` mutants of a format. ``out``: folder for those that show a defect. Raises RuntimeError when the
    whole file is not read well, which is a fault of the table."""
    report = Report(fmt.name)
    start = time.perf_counter()
    with tempfile.TemporaryDirectory(prefix="blinkgl-fuzz-") as scratch:
        if fmt.needs == "torch":
            import torch

            torch.set_num_threads(1)
        task = _Task(fmt, Path(scratch), seed, limits)
        indices = list(range(mutants)) if only is None else [only]
        while indices:
            for index, outcome in task.outcomes(indices[:_BATCH]):
                indices.remove(index)
                report.mutants += 1
                report.outcomes[outcome.kind] = report.outcomes.get(outcome.kind, 0) + 1
                if outcome.kind == REFUSED:
                    kind = outcome.detail.split(" (got")[0].replace(scratch, "")[:100]
                    report.refusals[kind] = report.refusals.get(kind, 0) + 1
                elif outcome.kind in DEFECTS:
                    _note(report, task, index, outcome, out)
                if only is not None:
                    print(
                        f"{fmt.name} #{index}: {task.mutant(index)[2]} of {task.mutant(index)[0]}: {outcome.kind}: "
                        f"{outcome.detail}\n{outcome.trace}"
                    )
    report.seconds = time.perf_counter() - start
    return report


class _Task:
    """A format's seed files in ``folder``, and processes that read mutants of them."""

    def __init__(self, fmt: Format, folder: Path, seed: int, limits: Limits):
        self.format, self.folder, self.seed, self.limits = fmt, folder, seed, limits
        self.targets = fmt.make(folder)
        self.originals = {name: (folder / name).read_bytes() for name in self.targets}
        self.usual_mb = float("inf")
        if (outcome := self._judged(None)).kind != OK:  # also loads and compiles everything that the children will need
            raise RuntimeError(f"{fmt.name}: the whole file is not read well: {outcome}")
        gc.collect()
        gc.freeze()
        ((_, whole),) = self.outcomes([None])
        if whole.kind != OK:
            raise RuntimeError(f"{fmt.name}: the whole file, read in a child: {whole}")
        self.usual_mb = whole.peak_mb

    def mutant(self, index: int) -> tuple[str, bytes, str]:
        """(file, damaged bytes, mutator's name) number ``index``; the first target gets
        half of the mutants and more."""
        rng = np.random.default_rng([self.seed, zlib.crc32(self.format.name.encode()), index])
        target = self.targets[0] if rng.random() < 0.5 else self.targets[int(rng.integers(len(self.targets)))]
        data, name = self.originals[target], ""
        for _ in range(1 if rng.random() < 0.85 else 2):
            mutate = self.format.mutators[int(rng.integers(len(self.format.mutators)))]
            name = mutate.__qualname__.split(".")[0]
            try:
                data = mutate(rng, data)
            except Exception:  # noqa: BLE001 - the second of two may not understand what the first left
                break
        return target, data, name

    def outcomes(self, indices: list[int | None]) -> Iterator[tuple[int | None, Outcome]]:
        """One after the other from one process, as far as that gets; None is the whole file."""
        reader, writer = os.pipe()
        sys.stdout.flush()
        pid = os.fork()
        if pid == 0:
            os.close(reader)
            self._child(indices, writer)  # does not return
        os.close(writer)
        said, late, waiting = b"", False, list(indices)
        deadline = time.monotonic() + self.limits.wall_s
        while waiting:
            left = deadline - time.monotonic()
            if left <= 0 or not select.select([reader], [], [], left)[0]:
                late = True
                break
            if not (piece := os.read(reader, 1 << 16)):
                break
            said += piece
            while b"\n" in said:
                line, said = said.split(b"\n", 1)
                yield waiting.pop(0), Outcome(**json.loads(line))
                deadline = time.monotonic() + self.limits.wall_s
        os.close(reader)
        if late:
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        _, status, _ = os.wait4(pid, 0)
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(pid, signal.SIGKILL)  # what it may have started
        for name, data in self.originals.items():
            (self.folder / name).write_bytes(data)
        (self.folder / MARK).unlink(missing_ok=True)
        if not waiting or (len(waiting) < len(indices) and os.WIFEXITED(status)):
            return  # it went as far as it wanted
        if late or (os.WIFSIGNALED(status) and os.WTERMSIG(status) in (signal.SIGXCPU, signal.SIGKILL)):
            yield waiting[0], Outcome(HANG, f"more than {self.limits.wall_s if late else self.limits.cpu_s} s")
        elif os.WIFSIGNALED(status):
            yield waiting[0], Outcome(CRASH, signal.Signals(os.WTERMSIG(status)).name)
        else:
            yield (
                waiting[0],
                Outcome(CRASH, f"the process ended by itself with status {os.waitstatus_to_exitcode(status)}"),
            )

    def _child(self, indices: list[int | None], pipe: int) -> None:
        try:
            faulthandler.disable()
            os.setpgid(0, 0)
            null = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(null, stream)
            size = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
            resource.setrlimit(resource.RLIMIT_AS, (size + (8 * self.limits.memory_mb << 20),) * 2)
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            for index in indices:
                resource.setrlimit(
                    resource.RLIMIT_CPU, (int(time.process_time()) + 1 + self.limits.cpu_s, resource.RLIM_INFINITY)
                )
                outcome = self._judged(index)
                peak = (
                    max(resource.getrusage(who).ru_maxrss for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
                    / 1024
                )
                hog = peak > self.usual_mb + self.limits.memory_mb
                if hog and outcome.kind in (OK, REFUSED):
                    outcome = Outcome(
                        MEMORY,
                        f"more than {self.limits.memory_mb} MB beyond the usual: {peak - self.usual_mb:.0f} MB, then "
                        f"{outcome.kind} {outcome.detail[:200]}",
                    )
                _say(pipe, replace(outcome, peak_mb=peak))
                if hog:  # the peak stays: the next mutant gets a new process
                    break
        finally:
            os._exit(0)

    def _judged(self, index: int | None) -> Outcome:
        """Damages, reads, judges, mends."""
        try:
            if index is None:
                (self.folder / MARK).touch()
                return _judged(self.format, self.folder)
            target, data, _ = self.mutant(index)
            if data == self.originals[target]:
                (self.folder / MARK).touch()
            (self.folder / target).write_bytes(data)
            outcome = _judged(self.format, self.folder)
            (self.folder / target).write_bytes(self.originals[target])
            return outcome
        except BaseException as error:  # noqa: BLE001 - e.g. no memory left to say what happened
            return Outcome(TRACEBACK, f"{type(error).__name__}, and nothing more could be said")
        finally:
            (self.folder / MARK).unlink(missing_ok=True)


def _say(pipe: int, outcome: Outcome) -> None:
    text = json.dumps(asdict(outcome)).encode("utf-8", "replace") + b"\n"
    while text:
        text = text[os.write(pipe, text) :]


def _note(report: Report, task: _Task, index: int, outcome: Outcome, out: Path | None) -> None:
    fmt, seed, (target, data, mutator) = task.format, task.seed, task.mutant(index)
    place = outcome.detail if outcome.kind == TRACEBACK else outcome.detail.split(":")[0][:80]
    found = report.defects.setdefault(
        f"{outcome.kind}: {place}",
        {
            "count": 0,
            "mutants": [],
            "mutator": mutator,
            "message": outcome.trace or outcome.detail,
            "repeat": f'python -m blinkgl.tools.fuzz_files --formats "{fmt.name}" --seed {seed} --only {index}',
        },
    )
    found["count"] += 1
    if len(found["mutants"]) < _KEPT:
        found["mutants"].append(index)
        if out is not None:
            path = out / f"{fmt.name.replace(' ', '_')}-{index}" / target
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
            (out / f"{fmt.name.replace(' ', '_')}-{index}" / "what.txt").write_text(
                f"{found['repeat']}\n{outcome.kind}: {outcome.detail}\n{outcome.trace}\n"
            )


def _judged(fmt: Format, folder: Path) -> Outcome:
    from blinkgl.machine.command_line import user_line

    try:
        problem = fmt.judge(folder)
    except BaseException as error:  # noqa: BLE001 - a SystemExit would be a defect too
        line = user_line(error) if isinstance(error, Exception) else None
        if line is None:
            return Outcome(TRACEBACK, _place(error), "".join(traceback.format_exception(error))[-6000:])
        if "\n" in line or "\r" in line or len(line) > _LONGEST_LINE or not line.isprintable():
            return Outcome(WRONG, f"a message that is not one readable line: {line[:300]!r}")
        if isinstance(error, BlinkGLError) and not error.where:
            return Outcome(WRONG, f"a message that names no file: {line[:300]}")
        return Outcome(REFUSED, line)
    return Outcome(OK) if problem is None else Outcome(WRONG, problem)


def _place(error: BaseException) -> str:
    """Type of the exception and the innermost line of ours."""
    frames = [
        f
        for f in traceback.extract_tb(error.__traceback__)
        if "/tools/" not in f.filename and ("blinkgl" in f.filename or "eflow" in f.filename)
    ]
    where = f"{Path(frames[-1].filename).name}:{frames[-1].lineno} {frames[-1].name}" if frames else "?"
    return f"{type(error).__name__} at {where}"


def show(reports: list[Report]) -> None:
    from rich.console import Console
    from rich.table import Table

    console = Console(width=150 if not sys.stdout.isatty() else None)
    table = Table("format", "mutants", "ok", "refused", "defects", "s")
    for r in reports:
        table.add_row(
            r.format,
            str(r.mutants),
            str(r.outcomes.get(OK, 0)),
            str(r.outcomes.get(REFUSED, 0)),
            str(r.defective),
            f"{r.seconds:.0f}",
        )
    total = Counter()
    for r in reports:
        total.update(r.outcomes)
    table.add_row(
        "all",
        str(sum(r.mutants for r in reports)),
        str(total[OK]),
        str(total[REFUSED]),
        str(sum(r.defective for r in reports)),
        f"{sum(r.seconds for r in reports):.0f}",
    )
    console.print(table)
    for r in reports:
        for what, found in sorted(r.defects.items(), key=lambda item: -item[1]["count"]):
            console.print(
                f"{r.format}: {found['count']} x {what}\n    {found['message'].strip().splitlines()[-1][:200]}\n    "
                f"{found['repeat']}",
                highlight=False,
                markup=False,
                soft_wrap=True,
            )


def chosen(patterns: list[str]) -> list[Format]:
    """Formats by shell patterns; all without."""
    found = [f for f in FORMATS if not patterns or any(fnmatch.fnmatch(f.name, p) for p in patterns)]
    if not found:
        raise SystemExit(f"no format is called {patterns}; there are: {', '.join(f.name for f in FORMATS)}")
    return found


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument(
        "--formats", nargs="*", default=[], metavar="PATTERN", help="names of the table, with * and ?; default: all"
    )
    parser.add_argument("--mutants", type=int, default=1000, help="per format")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", type=int, help="this one mutant, with its traceback")
    parser.add_argument("--cpu", type=int, default=Limits.cpu_s, help="processor seconds a mutant may take")
    parser.add_argument(
        "--memory", type=int, default=Limits.memory_mb, help="MB a mutant may take beyond the whole file"
    )
    parser.add_argument("--out", type=Path, help="folder for mutants that show a defect (emptied first)")
    parser.add_argument("--json", type=Path, help="file for the report")
    options = parser.parse_args(arguments)
    if options.out is not None:
        shutil.rmtree(options.out, ignore_errors=True)
        options.out.mkdir(parents=True)
    quiet()
    reports = []
    for fmt in chosen(options.formats):
        if not fmt.available:
            print(f"{fmt.name}: left out, {fmt.needs} is not installed", file=sys.stderr)
            continue
        report = fuzz(
            fmt,
            options.mutants,
            seed=options.seed,
            limits=Limits(options.cpu, memory_mb=options.memory),
            out=options.out,
            only=options.only,
        )
        print(
            f"{fmt.name}: {report.mutants} mutants, {report.defective} defects, {report.seconds:.0f} s",
            file=sys.stderr,
            flush=True,
        )
        reports.append(report)
        if options.json is not None:
            options.json.write_text(
                json.dumps({"seed": options.seed, "reports": [asdict(r) for r in reports]}, indent=1) + "\n"
            )
    if options.only is None:
        show(reports)
    return 1 if any(r.defective for r in reports) else 0


def quiet() -> None:
    """One thread in this process, so that it can be forked, and no warnings."""
    import warnings

    import cv2

    warnings.simplefilter("ignore")
    cv2.setNumThreads(0)


if __name__ == "__main__":
    sys.exit(main())
