"""``blinkgl generate``: one display of all workers, and a table at the end."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TimeElapsedColumn
from rich.table import Table

from blinkgl.config.run import load_run
from blinkgl.dataset.executor import Executor, Inline, Local
from blinkgl.dataset.messages import Message
from blinkgl.dataset.plan import Plan
from blinkgl.dataset.report import STAGES, SequenceReport, Totals, shares
from blinkgl.dataset.run import Listener, Outcome, run_dataset
from blinkgl.dataset.work import report_of
from blinkgl.errors import ConfigError
from blinkgl.io.records import named
from blinkgl.layouts.export import refuse_plan
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.machine.terminal import causes_line, clock, plain_column, plain_console, say, size
from blinkgl.sequence_files.index import made_folders
from blinkgl.show import export
from blinkgl.show.view import check_extra

if TYPE_CHECKING:
    from blinkgl.viewer.page import Page

MAX_NOTES = 20
"""Number of files whose undrawn features are listed."""
SET_ASIDE = 3
"""Exit status of a finished run with missing sequences."""


def run(
    config: str,
    out: str,
    *,
    num: int | None = None,
    seed: int | None = None,
    overrides: Sequence[str] = (),
    quiet: bool = False,
    executor: Executor | None = None,
    view: bool = False,
    layout: str | None = None,
    **options: Any,
) -> int:
    """Run :func:`~blinkgl.dataset.run.run_dataset` behind a display; status :data:`SET_ASIDE` when sequences are
    missing, whose names and reasons are printed even when ``quiet``. view : show each sequence in a browser when it is
    complete, and all until Ctrl-C. layout : when no sequence is missing, also write them as ``OUT-LAYOUT`` (`blinkgl
    export`). options : resume, mixed and time_limit_s, of the run. Raises their errors, and ConfigError without the
    extra [view]."""
    exported = f"{named(Path(out))}-{layout}"
    if layout is not None:
        export.refuse_early(exported, layout)
    template = load_run(config, overrides, seed=seed)
    if layout not in (None, export.SHARDS):
        refuse_plan(template, num, layout)
    console = plain_console(quiet=quiet)
    display = Listener() if quiet else Display(console, Path(out))
    with _shown(view, Path(out), display) as listener:
        outcome = run_dataset(template, out, executor, num=num, listener=listener, **options)
        show_outcome(console, outcome, Path(out))
        if quiet:
            for name, reason in sorted(outcome.set_aside.items()):
                say(plain_console(stderr=True), f"set aside: {name}: {reason}")
    if layout is not None and not outcome.set_aside:
        export.run(out, exported, layout=layout, quiet=quiet)
    return SET_ASIDE if outcome.set_aside else 0


@contextmanager
def _shown(view: bool, out: Path, display: Listener) -> Iterator[Listener]:
    """Show the run's progress, if requested also on a page in the browser, which stays until Ctrl-C. Raises ConfigError
    without viser."""
    if not view:
        yield display
        return
    check_extra("--view")
    from blinkgl.viewer.page import Page
    from blinkgl.viewer.server import LocalServer

    server, console = LocalServer(), plain_console()
    page = Page(server)
    drawing = threading.Thread(target=page.run, daemon=True)
    try:
        say(console, f"{server.url}  (each sequence appears there when it is complete)")
        drawing.start()
        yield Watched(page, out, display)
        if page.folders:
            say(console, f"{server.url}  (Ctrl-C ends it)")
            heartbeat.rest()
            try:
                drawing.join()
            except KeyboardInterrupt:
                say(console, "")
    finally:
        page.end()
        server.stop()


class Watched(Listener):
    """A run's listener that forwards everything and adds each finished sequence to a page."""

    def __init__(self, page: Page, out: Path, display: Listener):
        self._page, self._out, self._display = page, out, display

    def begin(self, plan: Plan, outcome: Outcome) -> None:
        self._display.begin(plan, outcome)
        if self._out.is_dir():
            for folder in made_folders(self._out):  # sequences of the resumed run
                self._page.add(folder)

    def message(self, name: str, message: Message) -> None:
        self._display.message(name, message)
        if message["kind"] == "done":
            self._page.add(self._out / name)

    def end(self, outcome: Outcome) -> None:
        self._display.end(outcome)


class Display(Listener):
    """Shows sequences, events, frames/s, remaining time, disk space used and expected: on a terminal a bar per sequence
    in progress, elsewhere a line per finished sequence."""

    def __init__(self, console: Console, out: Path):
        self._console, self._out = console, out
        self._bars = Progress(
            plain_column("{task.description}"),
            BarColumn(bar_width=30),
            plain_column("{task.percentage:>3.0f}%"),
            plain_column("{task.fields[detail]}"),
            TimeElapsedColumn(),
            console=console,
            transient=True,
            disable=not console.is_terminal,
        )
        self._tasks: dict[str, TaskID] = {}
        self._at_work: dict[str, tuple[float, int, int]] = {}  # fraction, frames and events of sequences in progress
        self._done = self._frames = self._events = self._bytes = self._given_up = 0
        self._notes: set[str] = set()
        self._foretold = False
        # Pace counts from the end of the last sequence that was the first of its process, which filled the caches.
        self._warm_since, self._warm_from = 0.0, 0.0

    def begin(self, plan: Plan, outcome: Outcome) -> None:
        self._todo = outcome.planned - outcome.found
        self._started = self._warm_since = time.monotonic()
        if outcome.found:
            self._say(f"{outcome.found} of {outcome.planned} sequences are complete already")
        for name, problem in outcome.damaged.items():
            self._say(f"{name} was damaged ({problem}); moved to .run/damaged, will be made again")
        self._bars.start()
        self._total = self._bars.add_task("all", total=max(self._todo, 1), detail="", visible=self._todo > 1)

    def message(self, name: str, message: Message) -> None:
        kind = message["kind"]
        if kind == "said":
            if message["text"] not in self._notes:  # several workers report the same
                self._notes.add(message["text"])
                self._say(message["text"])
            return
        self._note(message.get("notes") or message.get("report", {}).get("notes") or ())
        if kind == "progress":
            self._at_work[name] = (message["fraction"], message["frames"], message["events"])
            if name not in self._tasks:
                self._tasks[name] = self._bars.add_task(name, total=1.0, detail="")
            detail = (
                f"{message['frames']} frames, {message['events'] / 1e6:.2f} M events, {shares(message['seconds'])}"
                if message["fraction"] < 1
                else "labels, files"
            )
            self._bars.update(self._tasks[name], completed=message["fraction"], detail=detail)
        else:
            self._at_work.pop(name, None)
            if name in self._tasks:
                self._bars.remove_task(self._tasks.pop(name))
        if kind == "done":
            report = report_of(message)
            self._done, self._frames, self._events = (
                self._done + 1,
                self._frames + report.frames,
                self._events + report.events,
            )
            self._bytes += message["bytes"]
            if message.get("first"):
                self._warm_since, self._warm_from = time.monotonic(), self._made()
            elif not self._foretold:
                self._foretold = True
                whole = time.monotonic() - self._started + self._left()
                self._say(f"expected: about {clock(whole)} and {size(self._bytes / self._done * self._todo)}")
            if not self._console.is_terminal or self._todo > 1:
                self._say(_line(report) + (f"; {self.summary()}" if self._todo > 1 else ""))
        elif kind == "failed":
            self._given_up += bool(message.get("given_up"))
            self._say(
                f"{name} failed, {'set aside' if message.get('given_up') else 'will be tried again'}: "
                f"{message['error']}"
            )
        self._bars.update(self._total, completed=self._made(), detail=self.summary())

    def end(self, outcome: Outcome) -> None:
        self._bars.stop()

    def summary(self) -> str:
        """Return "12/20, 85 frames/s, 1.2 M events/s, 0:03:10 left, 0.21 GB of about 0.35 GB"."""
        elapsed = max(time.monotonic() - self._started, 1e-3)
        frames = self._frames + sum(f for _, f, _ in self._at_work.values())
        events = self._events + sum(e for _, _, e in self._at_work.values())
        parts = [
            f"{self._done}/{self._todo}",
            f"{frames / elapsed:.0f} frames/s",
            f"{events / elapsed / 1e6:.2f} M events/s",
        ]
        if self._made():
            parts.append(f"{clock(self._left())} left")
        if self._done:
            expected = self._bytes / self._done * self._todo
            room = shutil.disk_usage(self._out).free
            parts.append(f"{size(self._bytes)} of about {size(expected)}")
            if expected - self._bytes > room:
                parts.append(f"DISK: only {size(room)} free")
        return ", ".join(parts)

    def _left(self) -> float:
        """Return the wall time of what is left, s, by the pace of warm sequences, where there are some."""
        now, made = time.monotonic(), self._made()
        since, before = (self._warm_since, self._warm_from) if made > self._warm_from + 0.5 else (self._started, 0.0)
        return (self._todo - self._given_up - made) * (now - since) / (made - before)

    def _made(self) -> float:
        """Return the sequences made so far, those in progress by their part."""
        return self._done + sum(fraction for fraction, _, _ in self._at_work.values())

    def _note(self, lines: Iterable[str]) -> None:
        """Print what was guessed or is not drawn, once per file, for all sequences and workers."""
        for line in lines:
            if line in self._notes:
                continue
            self._notes.add(line)
            if len(self._notes) <= MAX_NOTES:
                self._say(f"note: {line}")
            elif len(self._notes) == MAX_NOTES + 1:
                self._say("note: there are more; the manifests have them under not_drawn and scene_log")

    def _say(self, text: str) -> None:
        say(self._console, text)


def show_outcome(console: Console, outcome: Outcome, out: Path) -> None:
    """Print the final table and the failed sequences."""
    if outcome.made:
        show_table(console, outcome.made, outcome.elapsed_s)
    else:
        say(
            console,
            f"nothing to make: all {outcome.found} sequences are complete"
            if not outcome.set_aside
            else "no sequence was made",
        )
    if outcome.set_aside:
        say(
            console,
            f"{len(outcome.set_aside)} of {outcome.planned} sequences are set aside; run again with --resume to try "
            f"them again (logs: {out}/.run/logs)",
        )
        for name, reason in sorted(outcome.set_aside.items()):
            say(console, f"  {name}: {reason}")


def _line(report: SequenceReport) -> str:
    return (
        f"{report.path}: {report.frames} frames, {report.events / 1e6:.2f} M events, {report.labels} labels, "
        f"{report.total_s:.1f} s ({report.total_s / report.simulated_s:.1f} s per simulated second)"
    )


def show_table(console: Console, made: Totals, elapsed_s: float | None = None) -> None:
    """Print the final table: counts, speed and time per stage. ``elapsed_s``: of the run, where several workers ran at
    once."""
    s, first = made.summary(), made.first
    assert first is not None, "there are no sequences to show"
    table = Table(
        title=f"{s['sequences']} sequence{'s' if s['sequences'] != 1 else ''}, {s['simulated_s']:g} simulated seconds",
        title_justify="left",
        show_header=False,
    )
    several = len(made) > 1
    counts = {
        "event frames": f"{s['frames']:,}",
        "events": f"{s['events'] / 1e6:.2f} M",
        "by cause": causes_line(made.causes, made.simulated_s).removeprefix("by cause: ") if made.causes else None,
        "labels": f"{s['labels']:,}",
        "elapsed": f"{elapsed_s:.1f} s  ({s['total_s'] / elapsed_s:.2f} sequences at a time)"
        if elapsed_s is not None and several
        else None,
        "wall time of all sequences" if several else "wall time": f"{s['total_s']:.1f} s",
        "per simulated second": f"{s['seconds_per_simulated_second']:.2f} s",
        "rate": f"{s['events_per_second'] / 1e6:.2f} M events/s",
    }
    stages = {
        name: f"{s[f'{name}_s']:.2f} s  {100 * s[f'{name}_s'] / s['total_s']:4.0f} %"
        for name in (*STAGES, "other")
        if name != "images" or s["images_s"]  # else no images were requested
    }
    for part in (counts, stages):
        for name, text in part.items():
            if text is not None:
                table.add_row(name, text)
        table.add_section()
    console.print(table)
    folder = first.path
    say(console, f"look at {folder / 'preview.mp4'}" if (folder / "preview.mp4").exists() else f"written to {folder}")


# ---------------------------------------------------------------------------------------------------------------------
# Choose an executor from the options of ``blinkgl generate``.


def choose_executor(
    name: str, workers: int | None, *, address: str | None = None, gpus: float = 0.0, devices: str | None = None
) -> Executor:
    """Return the executor; ``local`` without ``workers`` is this process itself. Raises ConfigError: unknown name,
    options of another executor, no Ray."""
    if name not in ("local", "ray"):
        raise ConfigError("unknown executor", where="--executor", value=name, accepted="local or ray")
    if name == "local":
        for option, value in (("--address", address), ("--gpus", gpus)):
            if value:
                raise ConfigError("belongs to --executor ray", where=option, value=value)
        numbers = _devices(devices)
        return Inline() if workers is None and numbers is None else Local(workers or 1, numbers)
    if devices is not None:
        raise ConfigError("belongs to --executor local; Ray deals out GPUs itself", where="--devices", value=devices)
    from blinkgl.dataset.cluster import RayCluster

    return RayCluster(workers, address=address, gpus=gpus)


def _devices(text: str | None) -> list[int] | None:
    if text is None:
        return None
    parts = [part.strip() for part in text.split(",")]
    if not all(part.isdecimal() for part in parts):
        raise ConfigError(
            "not a list of device numbers",
            where="--devices",
            value=text,
            accepted="numbers as `blinkgl doctor` lists them, e.g. 0,1",
        )
    return [int(part) for part in parts]
