"""Makes a whole data set with any executor. It survives interruptions and makes nothing twice and nothing half.

    outcome = run_dataset(load_run("configs/blinkflow_mini.yaml"), "out/mini", Local(workers=2), resume=True)

A sequence depends only on the recipe, its group and its number. So the order, the workers and the number of attempts do
not affect it, and a run may be interrupted at any point and continued.
"""

from __future__ import annotations

import contextlib
import signal
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

from blinkgl.config.run import RunTemplate
from blinkgl.dataset.assets import check_assets, digest
from blinkgl.dataset.executor import Executor, Inline, StartError
from blinkgl.dataset.messages import Message
from blinkgl.dataset.plan import Plan, check_output
from blinkgl.dataset.report import Totals
from blinkgl.dataset.run_folder import RunFolder
from blinkgl.dataset.work import Job, environment_differences, report_of
from blinkgl.errors import BlinkGLError, ConfigError, OutputError
from blinkgl.machine.interrupts import STOPS, interruptible, uninterrupted
from blinkgl.sequence_files.index import INDEX, write_index

ATTEMPTS = 3
"""A sequence is set aside after this many temporary failures, or one permanent failure
(:func:`blinkgl.errors.may_pass`)."""
_POLL_S = 0.5


@dataclass
class Outcome:
    """The result of a run. ``found``: sequences that were complete already; ``set_aside``: name -> reason of those
    given up."""

    planned: int
    found: int = 0
    made: Totals = field(default_factory=Totals)
    set_aside: dict[str, str] = field(default_factory=dict)
    elapsed_s: float = 0.0
    surprises: int = 0
    """Failures without a BlinkGLError: dead workers, time limits, bugs."""
    damaged: dict[str, str] = field(default_factory=dict)
    """Folders found damaged and moved to ``.run/damaged``: name -> the problem."""


class Listener:
    """The interface of a display, and one that shows nothing; see :mod:`blinkgl.show.generate`."""

    def begin(self, plan: Plan, outcome: Outcome) -> None:
        """Be told what is there and what will be made."""

    def message(self, name: str, message: Message) -> None:
        """Be told what a worker says of the sequence ``name``."""

    def end(self, outcome: Outcome) -> None:
        """Be told how the run ended, in every case."""


def run_dataset(
    template: RunTemplate,
    out: str | Path,
    executor: Executor | None = None,
    *,
    num: int | None = None,
    resume: bool = False,
    mixed: bool = False,
    time_limit_s: float = 0.0,
    listener: Listener | None = None,
) -> Outcome:
    """Make every sequence of ``template`` below ``out`` that is not complete yet.

    executor : default :class:`~blinkgl.dataset.executor.Inline`.
    resume : continue a run in ``out``; without it, an existing sequence folder is an error.
    mixed : continue although the recipe, the assets or the software have changed since the run began.
    time_limit_s : wall time of one attempt at one sequence; 0: none.

    Raises BlinkGLError when no sequence could be made; unless an earlier run began in ``out``, only logs are left then,
    and another recipe may start there. Raises, before any work: ConfigError and AssetError (recipe, assets), GLError,
    OutputError (folder of another recipe, in use by another run, cannot be written). Raises during work: OutputError
    when the disk is full, KeyboardInterrupt for Ctrl-C and SIGTERM; complete sequences stay, and ``resume`` continues.
    """
    executor, listener = executor or Inline(), listener or Listener()
    out = Path(out)
    check_output(out)
    plan = Plan.of(template, num)
    assets = check_assets(plan)
    folder = RunFolder(out)
    # Absolute: workers on other machines start in other folders, and a link may change during the run.
    job = Job(str(out.resolve()), str(template.base.resolve()), plan.recipe_text(), num)
    # Batch systems and `docker stop` end a run like Ctrl-C.
    with interruptible(*STOPS), folder.locked(plan.tasks.splits):
        folder.check(plan, assets, mixed)
        outcome = _found(plan, folder, resume)
        keep_logs = False
        try:
            if outcome.planned > outcome.found:
                environment = _agreed(executor.open(job), digest(assets))
                folder.check_environment(environment, mixed)
                folder.begin(plan, assets, environment, num)
            _make_missing(plan, executor, folder, outcome, time_limit_s, listener)
        except StartError:
            keep_logs = True
            raise
        finally:
            # A second signal would leave what the workers were writing.
            with uninterrupted(signal.SIGINT, *STOPS):
                executor.close()
                if not folder.begun and not keep_logs:
                    folder.take_back_logs()
                elif folder.begun and folder.in_place:
                    _leave(plan, folder, outcome, assets, num)
                listener.end(outcome)
        if outcome.set_aside and not (outcome.made or outcome.found):
            folder.forget(plan, keep_logs=outcome.surprises > 0)
            reason, others = next(iter(outcome.set_aside.values())), ""
            if outcome.planned > 1:
                others = f" (all {outcome.planned} sequences failed, this is the first's reason)"
            raise BlinkGLError(reason + others)
    return outcome


def _make_missing(
    plan: Plan,
    executor: Executor,
    folder: RunFolder,
    outcome: Outcome,
    time_limit_s: float,
    listener: Listener,
) -> None:
    """Make what is missing, in a folder without what was found damaged."""
    for name in outcome.damaged:
        folder.put_away(name)
    folder.sweep(plan)
    listener.begin(plan, outcome)
    started, missing = time.monotonic(), outcome.planned > outcome.found
    if missing:
        _loop(plan, executor, folder, outcome, time_limit_s, listener)
    outcome.elapsed_s = time.monotonic() - started
    if not missing and not (folder.out / INDEX).is_file():  # the run was killed after its last sequence
        write_index(folder.out)


def _leave(plan: Plan, folder: RunFolder, outcome: Outcome, assets: dict[str, str], num: int | None) -> None:
    """Leave a run's folder as another run can go on with it."""
    folder.sweep(plan)
    with contextlib.suppress(OutputError):  # on a full disk the first error is the one to report
        # Deleted during the run; without it the recipe of the run would be unknown.
        if folder.read("run.json") is None:
            folder.begin(plan, assets, folder.environment, num)
    folder.write_failures(outcome.set_aside)
    with contextlib.suppress(OutputError):
        write_index(folder.out)


def _found(plan: Plan, folder: RunFolder, resume: bool) -> Outcome:
    """Return what exists already. Raises OutputError for existing sequences without ``resume``."""
    dropped = folder.dropped
    outcome = Outcome(len(plan.tasks) - sum(plan.tasks.number(name) is not None for name in dropped))
    for _, task in plan.tasks.present(folder.out):
        if task.name in dropped:
            continue
        state = folder.state(task.name)
        if state is None:  # an empty folder
            continue
        if not resume:
            raise OutputError(
                "output folder exists",
                where=str(folder.out / task.name),
                accepted="a new folder name, or --resume to make only what is missing",
            )
        if state == "":
            outcome.found += 1
        else:
            outcome.damaged[task.name] = state
    return outcome


def _after_failure(message: Message, name: str, attempt: int, folder: RunFolder, outcome: Outcome) -> int | None:
    """Note that an attempt at a sequence failed, and return the number of the next one; None: there is none.

    Raises :class:`OutputError` if nothing else can be made either."""
    outcome.surprises += not message.get("expected", False)
    folder.log(name, f"attempt {attempt} failed: {message['error']}")
    if folder.state(name) == "":  # the worker died between the rename and the message
        outcome.found += 1
        return None
    if message["stop"]:
        raise OutputError(
            f"{message['error']}; the run has stopped with {outcome.found + len(outcome.made)} of {outcome.planned} "
            "sequences whole",
            accepted="run again with --resume when that is mended",
        )
    if message.get("lost"):  # not the sequence's fault: a whole machine was lost
        return attempt
    if attempt >= ATTEMPTS or message["final"]:
        outcome.set_aside[name] = message["error"]
        message["given_up"] = True
        return None
    return attempt + 1


def _loop(
    plan: Plan, executor: Executor, folder: RunFolder, outcome: Outcome, time_limit_s: float, listener: Listener
) -> None:
    running: dict[int, tuple[int, float]] = {}  # task -> attempt, since when
    # Existing entries were checked before; damaged ones have been moved away by now.
    tasks, dropped = enumerate(plan.tasks), folder.dropped
    fresh = ((n, 1) for n, task in tasks if task.name not in dropped and not folder.occupied(task.name))
    again: deque[tuple[int, int]] = deque()

    def tell(message: Message) -> None:
        listener.message(plan.tasks[message["task"]].name, message)

    executor.listener = tell
    environment = folder.environment
    upcoming = next(fresh, None)
    while upcoming or again or running:
        while (upcoming or again) and executor.free() > 0:
            if upcoming:
                (number, attempt), upcoming = upcoming, next(fresh, None)
            else:
                number, attempt = again.popleft()
            running[number] = (attempt, time.monotonic())
            executor.submit(number, attempt)
        for message in executor.poll(_POLL_S):
            if message["kind"] == "hello":  # replacement of a dead worker
                _agree(message, environment, None)
                continue
            number = message["task"]
            task = plan.tasks[number]
            if message["kind"] == "done":
                attempt, _ = running.pop(number)
                message["report"]["path"] = str(folder.out / task.name)  # as the user wrote it
                outcome.made.add(report_of(message))
                folder.add_cost(task, message, attempt)
            elif message["kind"] == "failed":
                attempt, _ = running.pop(number)
                next_attempt = _after_failure(message, task.name, attempt, folder, outcome)
                if next_attempt:
                    again.append((number, next_attempt))
            tell(message)
        folder.check_in_place()
        if time_limit_s > 0:
            now = time.monotonic()
            for number, (_, since) in running.items():
                if now - since > time_limit_s:
                    executor.kill(number, f"took longer than the limit of {time_limit_s:g} s")


def _agreed(hellos: list[Message], assets: str) -> dict[str, str]:
    """Return the workers' common environment. Raises as :func:`_agree`."""
    environment = hellos[0]["environment"]
    for hello in hellos:
        _agree(hello, environment, assets)
    return environment


def _agree(hello: Message, environment: dict[str, str], assets: str | None) -> None:
    """Raise an error for workers that differ in anything that affects the bytes."""
    if different := environment_differences(hello["environment"], environment):
        raise ConfigError(
            f"workers differ in version or hardware: {different}",
            where="--executor",
            accepted="the same installation on all of them",
        )
    if assets is not None and hello["assets"] != assets:
        raise ConfigError(
            "a worker finds other meshes or textures than the driver",
            where="--executor",
            accepted="the same files on all machines",
        )
