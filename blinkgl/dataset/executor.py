"""Executors: this process, or a pool of processes on this machine. (Many machines: :mod:`blinkgl.dataset.cluster`.)

All have the same interface, so that the loop in :mod:`blinkgl.dataset.run` works with any of them.
"""

from __future__ import annotations

import contextlib
import json
import os
import selectors
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Protocol

from blinkgl.dataset.messages import RUN_FOLDER, Message
from blinkgl.dataset.work import Job, Maker, maker_of, thread_environment
from blinkgl.errors import BlinkGLError, ConfigError
from blinkgl.gl.context import egl_devices
from blinkgl.machine.posix import fcntl

_START_S = 600.0  # compiling every kernel for the first time on a slow machine
_STOP_S = 2.0  # then SIGKILL: what a writer leaves is removed as that of any dead one
_BAD_STARTS = 3


class StartError(BlinkGLError):
    """Workers ended before they could report the reason. Their output, which the message names, is kept.

    log : its path."""

    def __init__(self, problem: str, log: Path):
        super().__init__(problem, where="--workers", accepted=f"see {log}")
        self.log = log


class Executor(Protocol):
    """Runs the tasks of a run: :class:`Inline`, :class:`Local`, and Ray's in :mod:`blinkgl.dataset.cluster`."""

    listener: Callable[[Message], None]
    """Called with progress that ``poll`` does not return (:class:`Inline`); a run sets it before it polls."""

    def open(self, job: Job) -> list[Message]:
        """Prepare for work; return the workers' hellos. Raises BlinkGLError."""

    def free(self) -> int:
        """Return the number of further tasks that it would start at once."""

    def submit(self, task: int, attempt: int) -> None:
        """Start a task."""

    def poll(self, timeout_s: float) -> list[Message]:
        """Return the messages received meanwhile; a dead worker is a "failed" of its task."""

    def kill(self, task: int, reason: str) -> None:
        """End a task that took too long."""

    def close(self) -> None:
        """Stop everything and wait; leave no half sequence and no process."""


class Inline(Executor):
    """Runs tasks in this process, without a time limit."""

    def __init__(self) -> None:
        self.listener = lambda message: None
        self._maker: Maker | None = None
        self._next: tuple[int, int] | None = None

    def open(self, job: Job) -> list[Message]:
        self._maker = maker_of(job.maker, job.to_dict(), None)
        return [self._maker.open()]

    def free(self) -> int:
        return int(self._next is None)

    def submit(self, task: int, attempt: int) -> None:
        self._next = (task, attempt)

    def poll(self, timeout_s: float) -> list[Message]:
        if self._next is None:
            return []
        assert self._maker is not None, "a task is submitted after open"
        (task, attempt), self._next = self._next, None
        return [self._maker.make(task, attempt, self.listener)]

    def kill(self, task: int, reason: str) -> None:
        raise AssertionError("a task of this process is over when poll returns")

    def close(self) -> None:
        if self._maker is not None:
            self._maker.__exit__()


class Local(Executor):
    """``workers`` processes, each with its own OpenGL context and its share of the cores.

    devices : EGL devices, distributed over the workers. Default: all graphics cards, if there are several and the
        configuration does not select another than the first; else the configuration's.
    cores : that they share. Default: all that this process may use.

    A worker that dies is replaced. Workers have their own sessions, so that Ctrl-C reaches only the driver, and end
    when the driver's end of their standard input closes for any reason.
    """

    def __init__(self, workers: int, devices: list[int] | None = None, cores: int | None = None):
        if workers < 1:
            raise ConfigError("too few", where="--workers", value=workers, accepted="1 or more")
        if fcntl is None:
            raise ConfigError(
                "worker processes need a POSIX system",
                where="--workers",
                value=workers,
                accepted="none: this process alone",
            )
        self._wanted, self._devices, self._cores = workers, devices, cores
        self._processes: list[_Process] = []
        self._selector = selectors.DefaultSelector()

    def open(self, job: Job) -> list[Message]:
        self._job, self._bad_starts = job, 0
        self._selector.close()  # an earlier run has closed it, too
        self._selector = selectors.DefaultSelector()
        self._dealt = several_cards(job) if self._devices is None else self._devices
        cores = self._cores or len(os.sched_getaffinity(0))
        # numba and OpenGL read these once, when they are loaded, so they must be in a worker's environment
        # from its start.
        self._environment = {**os.environ, "PYTHONSAFEPATH": "1", **thread_environment(self._wanted, cores)}
        for slot in range(self._wanted):
            self._start(slot)
        # A run begins when every worker has said hello: their machines and assets are compared before any work.
        hellos, deadline = [], time.monotonic() + _START_S
        while len(hellos) < self._wanted:
            hellos += [m for m in self.poll(1.0) if m["kind"] == "hello"]
            if time.monotonic() > deadline:
                raise StartError(f"workers did not start within {_START_S:.0f} s", self._log(0))
        return hellos

    def free(self) -> int:
        return sum(p.ready and p.task is None for p in self._processes)

    def submit(self, task: int, attempt: int) -> None:
        # There is one: the driver submits only when ``free`` allows it.
        process = next(p for p in self._processes if p.ready and p.task is None)
        process.task = task
        process.send({"task": task, "attempt": attempt})

    def poll(self, timeout_s: float) -> list[Message]:
        messages: list[Message] = []
        for key, _ in self._selector.select(timeout_s):
            process: _Process = key.data
            lines, ended = process.read()
            for message in lines:
                # The job itself is impossible (assets, OpenGL): another worker would be refused likewise.
                if message["kind"] == "refused":
                    raise BlinkGLError(message["error"])
                if message["kind"] == "hello":
                    # Only consecutive failed starts mean that no worker can start.
                    process.ready, self._bad_starts = True, 0
                if message["kind"] in ("done", "failed"):
                    process.task = None
                messages.append(message)
            if ended:
                messages += self._bury(process)
        return messages

    def kill(self, task: int, reason: str) -> None:
        for process in self._processes:
            if process.task == task:
                process.reason = reason
                # SIGKILL: a worker that hangs in a driver does not react to SIGTERM. ``poll`` reports its task.
                process.kill()

    def close(self) -> None:
        for process in self._processes:
            process.stop()
        # One deadline for all of them: they stop at the same time.
        deadline = time.monotonic() + _STOP_S
        for process in self._processes:
            try:
                process.popen.wait(max(0.1, deadline - time.monotonic()))
            except subprocess.TimeoutExpired:
                process.kill()
                process.popen.wait()
            process.close()
        self._processes.clear()
        self._selector.close()

    def _start(self, slot: int) -> None:
        device = self._dealt[slot % len(self._dealt)] if self._dealt else None
        process = _Process(slot, self._log(slot), self._environment)
        self._processes.append(process)
        self._selector.register(process.channel, selectors.EVENT_READ, process)
        process.send({"job": self._job.to_dict(), "maker": self._job.maker, "device": device})

    def _bury(self, process: _Process) -> list[Message]:
        """Handle a process that ended by itself: its task failed, and another replaces it."""
        # A closed pipe is always readable: the selector would spin on it.
        self._selector.unregister(process.channel)
        self._processes.remove(process)
        status = process.popen.wait()
        process.kill()  # what it had started
        process.close()
        how = process.reason or (
            f"the worker was ended by {signal.Signals(-status).name}"
            if status < 0
            else f"the worker ended with status {status}"
        )
        if not process.ready:
            self._bad_starts += 1
            if self._bad_starts >= _BAD_STARTS:
                raise StartError(f"workers cannot start: {how}", process.log)
        self._start(process.slot)
        return (
            []
            if process.task is None
            else [{"kind": "failed", "task": process.task, "error": how, "final": False, "stop": False}]
        )

    def _log(self, slot: int) -> Path:
        return Path(self._job.out) / RUN_FOLDER / "logs" / f"worker-{slot}.log"


class _Process:
    """One worker process and the two pipes to it."""

    def __init__(self, slot: int, log: Path, environment: dict[str, str]):
        self.slot, self.log = slot, log
        self.ready, self.reason = False, ""
        self.task: int | None = None
        # Bytes after the last newline: a message may arrive in two reads.
        self._rest = b""
        # Messages have their own pipe: libraries and drivers print to standard output, which is the log.
        self.channel, write_end = os.pipe()
        try:
            log.parent.mkdir(parents=True, exist_ok=True)
            output = open(log, "ab")  # noqa: SIM115 - either of the two is closed below
        except OSError:
            output = open(os.devnull, "ab")  # noqa: SIM115
        with output:
            # -P: modules of the folder that the user stands in are not imported, whatever their names.
            self.popen = subprocess.Popen(
                [sys.executable, "-P", "-m", "blinkgl.dataset.worker", str(write_end)],
                stdin=subprocess.PIPE,
                stdout=output,
                stderr=output,
                pass_fds=(write_end,),
                env=environment,
                start_new_session=True,
            )
        assert self.popen.stdin is not None
        self._orders = self.popen.stdin
        # The child has its copy. With ours open the channel would never end.
        os.close(write_end)

    def send(self, order: dict) -> None:
        try:
            self._orders.write(json.dumps(order).encode() + b"\n")
            self._orders.flush()
        except OSError:  # it died just now; the end of its channel will be seen
            pass

    def read(self) -> tuple[list[Message], bool]:
        """Return complete messages received, and whether the channel has ended."""
        data = os.read(self.channel, 1 << 16)
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines if line], not data

    def stop(self) -> None:
        if self.popen.poll() is None:
            # The signal interrupts a sequence in progress; the closed input ends a waiting worker.
            self.popen.terminate()
        try:
            self._orders.close()
        except OSError:
            pass

    def kill(self) -> None:
        """Kill the process and those that it started: it leads a group of its own."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.popen.pid, signal.SIGKILL)

    def close(self) -> None:
        try:
            self._orders.close()
        except OSError:
            pass
        os.close(self.channel)


def several_cards(job: Job) -> list[int] | None:
    """Return the machine's graphics cards as EGL devices, when there are several and the configuration does not choose
    one."""
    wanted = [group.template.check().gl for group in job.plan().used]
    if any(gl.backend == "osmesa" or gl.device != 0 for gl in wanted) or os.environ.get("GLCONTEXT_DEVICE_INDEX"):
        return None
    cards = [number for number, text in enumerate(egl_devices()) if "software" not in text.lower()]
    return cards if len(cards) > 1 else None
