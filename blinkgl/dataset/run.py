"""Makes a whole data set and does not give up: any executor, any interruption, nothing made twice, nothing half made.

    outcome = run_dataset(load_run("configs/blinkflow_mini.yaml"), "out/mini", Local(workers=2), resume=True)

What a sequence holds depends on the recipe, its group and its number alone. So the order, the workers and the number of
attempts leave no trace in it, and a run may be cut anywhere and continued.
"""

from __future__ import annotations

import contextlib
import signal
import threading
import time
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

from blinkgl.config.sequence import RunTemplate
from blinkgl.dataset.executor import Executor, Inline
from blinkgl.io.index import write_index
from blinkgl.dataset.plan import Plan, check_output, digest
from blinkgl.dataset.report import SequenceReport
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.work import Job, Message, environment_differences, report_of
from blinkgl.errors import BlinkGLError, ConfigError, OutputError
from blinkgl.io.sequence_dir import refuse_existing

ATTEMPTS = 3
"""A sequence that fails so often is set aside."""
_POLL_S = 0.5


@dataclass
class Outcome:
    """What a run did. ``found``: sequences that were whole already; ``set_aside``: name -> reason of those given up."""

    planned: int
    found: int = 0
    made: list[SequenceReport] = field(default_factory=list)
    set_aside: dict[str, str] = field(default_factory=dict)
    elapsed_s: float = 0.0
    surprises: int = 0
    """Failures that were no BlinkGLError: dead workers, time limits, bugs."""
    damaged: dict[str, str] = field(default_factory=dict)
    """Folders found damaged and moved to ``.run/damaged``: name -> what was wrong."""


class Listener(Protocol):
    """What a display has to offer; see :mod:`blinkgl.dataset.show`."""

    def begin(self, plan: Plan, outcome: Outcome) -> None: ...
    def message(self, name: str, message: Message) -> None: ...
    def end(self, outcome: Outcome) -> None: ...


def run_dataset(template: RunTemplate, out: str | Path, executor: Executor | None = None, *, num: int | None = None, resume: bool = False,
                mixed: bool = False, time_limit_s: float = 0.0, listener: Listener | None = None) -> Outcome:
    """Makes every sequence of ``template`` below ``out`` that is not whole yet.

    executor : default :class:`~blinkgl.dataset.executor.Inline`.
    resume : go on with a run in ``out``; without it, a sequence folder that exists is an error.
    mixed : go on although the recipe, the assets or the software are not those the run began with.
    time_limit_s : wall time of one attempt at one sequence; 0: none.

    Raises BlinkGLError when no sequence at all could be made; nothing but logs is left then, and another recipe may start in ``out``.
    Raises, before any work: ConfigError and AssetError (recipe, assets), GLError, OutputError (folder of another recipe, another
    run at work in it, cannot be written). Raises during work: OutputError when the disk is full, KeyboardInterrupt for Ctrl-C and
    SIGTERM; whole sequences stay, and ``resume`` goes on.
    """
    executor = executor or Inline()
    out = Path(out)
    check_output(out)
    plan = Plan.of(template, num)
    assets = plan.check_assets()
    folder = RunFolder(out)
    folder.check(plan, assets, mixed)
    if not resume:
        for task in plan.tasks:
            _refuse(out / task.name)
    job = Job(str(out), str(template.base), plan.recipe_text(), num)
    with _terminable(), folder.locked():
        outcome = Outcome(len(plan.tasks))
        todo = deque()
        for number, task in enumerate(plan.tasks):
            state = folder.state(task.name)
            if state == "":
                outcome.found += 1
                continue
            if state is not None:
                outcome.damaged[task.name] = state
            todo.append((number, 1))
        try:
            if todo:
                hellos = executor.open(job)
                for hello in hellos:
                    _agree(hello, hellos[0]["environment"], digest(assets))
                folder.check_environment(hellos[0]["environment"], mixed)
                folder.begin(plan, assets, hellos[0]["environment"], num)
            for name in outcome.damaged:
                folder.put_away(name)
            folder.sweep(plan)
            if listener:
                listener.begin(plan, outcome)
            started = time.monotonic()
            if todo:
                _loop(plan, executor, todo, folder, outcome, time_limit_s, listener)
            outcome.elapsed_s = time.monotonic() - started
        finally:
            executor.close()
            if folder.begun:
                folder.sweep(plan)
                folder.write_failures(outcome.set_aside, plan)
                with contextlib.suppress(OutputError):  # on a full disk the first error is the one to hear of
                    write_index(out)
            if listener:
                listener.end(outcome)
        if outcome.set_aside and not (outcome.made or outcome.found):
            folder.forget(keep_logs=outcome.surprises > 0)
            reason = next(iter(outcome.set_aside.values()))
            raise BlinkGLError(reason if outcome.planned == 1 else f"{reason} (all {outcome.planned} sequences failed, this is the first's reason)")
    return outcome


def _loop(plan: Plan, executor: Executor, todo: deque, folder: RunFolder, outcome: Outcome, time_limit_s: float,
          listener: Listener | None) -> None:
    running: dict[int, tuple[int, float]] = {}  # task -> attempt, since when

    def tell(message: Message) -> None:
        if listener:
            listener.message(plan.tasks[message["task"]].name, message)

    executor.listener = tell
    environment = folder.environment
    while todo or running:
        while todo and executor.free() > 0:
            number, attempt = todo.popleft()
            running[number] = (attempt, time.monotonic())
            executor.submit(number, attempt)
        for message in executor.poll(_POLL_S):
            if message["kind"] == "hello":  # a worker in place of a dead one
                _agree(message, environment, None)
                continue
            number = message["task"]
            task = plan.tasks[number]
            if message["kind"] == "done":
                attempt, _ = running.pop(number)
                outcome.made.append(report_of(message))
                folder.add_cost(task, message, attempt)
            elif message["kind"] == "failed":
                attempt, _ = running.pop(number)
                outcome.surprises += not message.get("expected", False)
                folder.log(task.name, f"attempt {attempt} failed: {message['error']}")
                if folder.state(task.name) == "":  # the worker died between the rename and the message
                    outcome.found += 1
                elif message["stop"]:
                    raise OutputError(f"{message['error']}; the run has stopped with {outcome.found + len(outcome.made)} of "
                                      f"{outcome.planned} sequences whole", accepted="run again with --resume when that is mended")
                elif message.get("lost"):  # no fault of the sequence's: a whole machine went
                    todo.append((number, attempt))
                elif attempt >= ATTEMPTS or message["final"]:
                    outcome.set_aside[task.name] = message["error"]
                    message["given_up"] = True
                else:
                    todo.append((number, attempt + 1))
            tell(message)
        if time_limit_s > 0:
            now = time.monotonic()
            for number, (_, since) in running.items():
                if now - since > time_limit_s:
                    executor.kill(number, f"took longer than the limit of {time_limit_s:g} s")


def _agree(hello: Message, environment: dict[str, str], assets: str | None) -> None:
    """Workers that differ in anything that decides the bytes must not work on one data set."""
    if different := environment_differences(hello["environment"], environment):
        raise ConfigError(f"workers differ in version or hardware: {different}", where="--executor",
                          accepted="the same installation on all of them")
    if assets is not None and hello["assets"] != assets:
        raise ConfigError("a worker sees other meshes or textures than the driver", where="--executor", accepted="the same files on all machines")


def _refuse(path: Path) -> None:
    try:
        refuse_existing(path)
    except OutputError as error:
        raise OutputError(error.problem, where=error.where, accepted="a new folder name, or --resume to make only what is missing") from None


@contextlib.contextmanager
def _terminable() -> Iterator[None]:
    """SIGTERM (batch systems, ``docker stop``) ends a run as Ctrl-C does. Only a main thread can see to that."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_):
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
