"""Progress of a training: a live line on a terminal or a line every ten seconds, and log files."""

from __future__ import annotations

import contextlib
import json
import signal
import sys
import time
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
import torch
import torch.distributed as dist
from rich.progress import BarColumn, Progress
from torch import Tensor

from blinkgl.errors import BlinkGLError
from blinkgl.io.atomic import output_errors, write_whole
from blinkgl.machine.heartbeat import heartbeat
from blinkgl.machine.interrupts import STOPS, Stop
from blinkgl.machine.terminal import plain_column, plain_console
from eflow.types import Picture

T = TypeVar("T")
_QUIET_S = 10.0
"""Seconds between lines if the output is not a terminal."""


class TrainProgress:
    """Shows step, smoothed loss and EPE, samples/s and the time left until the last step or the time limit.

    The first line appears before the first step, the second after it.
    where : device and precision, as text.   minutes : time limit, counted from now on.
    rate : samples/s over the last steps."""

    def __init__(
        self,
        steps: int,
        start: int,
        batch: int,
        enabled: bool,
        where: str = "",
        minutes: float | None = None,
    ):
        self.steps, self.batch, self.enabled = steps, batch, enabled
        self.rate = 0.0
        self._loss: float | None = None
        self._epe: float | None = None
        self._step, self._time, self._printed = start, time.monotonic(), -float("inf")
        self._deadline = None if minutes is None else self._time + 60 * minutes
        self._where = where
        self._console = plain_console(file=sys.stderr)

    def __enter__(self) -> TrainProgress:
        self._live = None
        if self.enabled:
            limit = "" if self._deadline is None else f", {_hms(self._deadline - time.monotonic())} at most"
            self._print(f"training: {self.steps - self._step} steps of {self.batch} samples on {self._where}{limit}")
        if self.enabled and self._console.is_terminal:
            self._live = Progress(
                plain_column("step {task.completed}/{task.total}"),
                BarColumn(),
                plain_column("{task.fields[text]}"),
                console=self._console,
            )
            self._task = self._live.add_task("train", total=self.steps, completed=self._step, text="")
            self._live.start()
        return self

    def update(self, step: int, values: Iterable[tuple[float, float]] = ()) -> None:
        """Show the state after ``step`` steps. values : (loss, end-point error) of the steps read since the last
        call."""
        now = time.monotonic()
        speed = (step - self._step) * self.batch / max(now - self._time, 1e-9)
        # Exponential means: single steps differ by what is logged or validated between them.
        self.rate = speed if self.rate == 0 else 0.9 * self.rate + 0.1 * speed
        for loss, epe in values:
            self._loss = loss if self._loss is None else 0.95 * self._loss + 0.05 * loss
            self._epe = epe if self._epe is None else 0.95 * self._epe + 0.05 * epe
        self._step, self._time = step, now
        if not self.enabled or self._loss is None or self._epe is None:
            return
        text = f"loss {self._loss:.2f}  EPE {self._epe:.2f} px  {self.rate:.2f} samples/s  {self._left(now)}"
        if self._live is not None:
            self._live.update(self._task, completed=step, text=text)
        # Without a terminal, a line every so often instead of a bar.
        elif now - self._printed >= _QUIET_S or step == self.steps:
            self._printed = now
            self._print(f"step {step}/{self.steps}  {text}")

    def _left(self, now: float) -> str:
        left = (self.steps - self._step) * self.batch / max(self.rate, 1e-9)
        if self._deadline is None or now + left <= self._deadline:
            return f"{_hms(left)} left"
        left = max(self._deadline - now, 0.0)
        return (
            f"{_hms(left)} left until the time limit, at about step {self._step + int(left * self.rate / self.batch)}"
        )

    def _print(self, line: str) -> None:
        heartbeat.heard()
        print(line, file=sys.stderr, flush=True)  # noqa: T201

    def say(self, line: str) -> None:
        """Print a separate line."""
        if self.enabled:
            self._live.console.print(line) if self._live is not None else self._print(line)

    def note(self, step: int, scores: dict[str, float]) -> None:
        """Print the scores of a validation."""
        self._time = time.monotonic()  # validation does not count as training time
        self.say(f"step {step}  " + "  ".join(f"{k} {v:.3f}" for k, v in scores.items()))

    def __exit__(self, *_) -> None:
        if self._live is not None:
            self._live.stop()


class Waiting(Generic[T]):
    """Iterates over items; ``share`` is the share of the wall time spent waiting for the next one."""

    def __init__(self, items: Iterable[T]):
        self._items, self._waited, self._began = items, 0.0, time.monotonic()

    def __iter__(self) -> Iterator[T]:
        items = iter(self._items)
        while True:
            since = time.monotonic()
            try:
                item = next(items)
            except StopIteration:
                return
            finally:
                self._waited += time.monotonic() - since
            yield item

    @property
    def share(self) -> float:
        return self._waited / max(time.monotonic() - self._began, 1e-9)


class Counting:
    """Prints a count and the time left: at the start, every ten seconds, and at the end."""

    def __init__(self, total: int, what: str, enabled: bool):
        self.total, self.what, self.enabled = total, what, enabled
        self._began, self._printed = time.monotonic(), -float("inf")

    def __call__(self, done: int) -> None:
        now = time.monotonic()
        if not self.enabled or (now - self._printed < _QUIET_S and done < self.total):
            return
        self._printed, spent = now, now - self._began
        left = spent * (self.total - done) / done
        print(  # noqa: T201
            f"{done}/{self.total} {self.what}  {done / max(spent, 1e-9):.1f}/s  {_hms(left)} left",
            file=sys.stderr,
            flush=True,
        )


def cost_of(rendering: dict[str, float], waited: float) -> str:
    """Return a line about the cost of online rendering."""
    line = (
        f"{rendering['rendered']} samples rendered, {rendering['render_ms']:.1f} processor ms each; training waited "
        f"for them {100 * waited:.0f} % of the time"
    )
    if rendering["failed_sequences"]:
        line += f"; {rendering['failed_sequences']} sequences failed and were replaced"
    if rendering["replaced_workers"]:
        line += f"; {rendering['replaced_workers']} workers died and were replaced"
    return line


def _hms(seconds: float) -> str:
    seconds = int(min(seconds, 10**7))
    return f"{seconds // 3600}:{seconds // 60 % 60:02d}:{seconds % 60:02d}"


# ---------------------------------------------------------------------------------------------------------------------
# State of a running training: loss of its steps, signals, log files.


class TrainingError(BlinkGLError):
    """Training cannot continue (loss not finite)."""


class Readings:
    """Loss, end-point error and gradient norm of the steps, kept on the device until they are read, then averaged over
    the processes.

    Reading a number from a GPU waits for everything computed before it. ``loss``, ``epe`` and ``norm`` are the last
    values read."""

    def __init__(self, out: Path):
        self._out, self._pending = out, []
        self.loss = self.epe = self.norm = float("nan")

    def add(self, step: int, names: list[str], loss: Tensor, epe: Tensor, norm: Tensor) -> None:
        """Add the values of step ``step``.   names : of its samples."""
        self._pending.append((step, names, torch.stack([v.detach().float() for v in (loss, epe, norm)])))

    def values(self) -> list[tuple[float, float]]:
        """Return (loss, end-point error) of each step since the last call, in one copy.

        Raises TrainingError at the first value that is not finite, after writing the names of its samples to
        ``nan_batch.json``. Call this before saving a checkpoint: later steps are spoilt, too."""
        read = _of_all(torch.stack([v for _, _, v in self._pending])).tolist() if self._pending else []
        for (step, names, _), (loss, _, norm) in zip(self._pending, read, strict=True):
            if not np.isfinite([loss, norm]).all():
                _stop_on_nan(self._out, step, names, loss, norm)
        if read:
            self.loss, self.epe, self.norm = read[-1]
        self._pending.clear()
        return [(loss, epe) for loss, epe, _ in read]


def _of_all(values: Tensor) -> Tensor:
    """Return the mean of the values of all processes, which read at the same steps."""
    if dist.is_initialized():
        dist.all_reduce(values)
        values = values / dist.get_world_size()
    return values


def _stop_on_nan(out: Path, step: int, names: list[str], loss: float, norm: float) -> None:
    path = out / "nan_batch.json"
    with output_errors(path):
        path.write_text(
            json.dumps({"step": step, "loss": str(loss), "grad_norm": str(norm), "samples": names}, indent=1) + "\n"
        )
    raise TrainingError(
        f"loss or gradient is not finite at step {step}",
        where=str(path),
        value=(loss, norm),
        accepted="see the samples named there; the last checkpoint is unharmed",
    )


class Signals:
    """Turns SIGINT and SIGTERM into a flag that the loop reads between steps; a second SIGINT interrupts at once."""

    reason: str | None = None

    def __enter__(self) -> Signals:
        self._old = {}
        with contextlib.suppress(ValueError):  # not in the main thread: the caller handles signals
            for s in (signal.SIGINT, *STOPS):
                if signal.getsignal(s) is not signal.SIG_IGN:
                    self._old[s] = signal.signal(s, self._note)
        return self

    def _note(self, number: int, _) -> None:
        Stop.number = number
        if self.reason and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.reason = "signal"

    def __exit__(self, *_) -> None:
        for s, handler in self._old.items():
            signal.signal(s, handler)


class Log:
    """Writes log.jsonl (one object per line) and tensorboard files.

    A resumed run drops the lines after its checkpoint, since those steps run again; seconds continue from the last
    line. batch : samples per step."""

    SECONDS = ("processor_s", "wall_s")

    def __init__(self, out: Path, start: int, batch: int, enabled: bool):
        self.path, self.start, self.batch, self.enabled = out / "log.jsonl", start, batch, enabled

    def __enter__(self) -> Log:
        if self.enabled:
            with output_errors(self.path):
                lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else []
                # A power cut can leave half a line.
                whole = [json.loads(line) for line in lines if line.startswith("{") and line.endswith("}")]
                kept = [row for row in whole if row["step"] <= self.start]
                write_whole(self.path, "".join(json.dumps(row) + "\n" for row in kept))
                self._file = open(self.path, "a", encoding="utf-8")
            before = [kept[-1].get(key, 0.0) if kept else 0.0 for key in self.SECONDS]
            self._began = before[0] - time.process_time(), before[1] - time.monotonic()
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(self.path.parent / "tb"), purge_step=self.start + 1 if self.start else None)
        return self

    def write(self, step: int, kind: str, **values: float) -> None:
        """Write a line of values, with the samples and seconds of the whole training. Raises OutputError."""
        clocks = (time.process_time(), time.monotonic())
        spent = {k: round(b + t, 3) for k, b, t in zip(self.SECONDS, self._began, clocks, strict=True)}
        row = {"step": step, "kind": kind, "samples": step * self.batch, **spent, **values}
        with output_errors(self.path):
            self._file.write(json.dumps(row) + "\n")
            self._file.flush()
        for k, v in {**spent, **values}.items():
            self._board.add_scalar(f"{kind}/{k}", v, step)

    def describe(self, text: str, values: dict[str, object]) -> None:
        """Show the configuration in tensorboard, as text and as hyper-parameters by their keys."""
        from torch.utils.tensorboard.summary import hparams

        self._board.add_text("configuration", f"```\n{text}\n```", self.start)
        plain = {k: v if isinstance(v, bool | int | float | str) else str(v) for k, v in values.items()}
        writer = self._board.file_writer
        assert writer is not None
        for summary in hparams(plain, {"train/loss": 0.0, "train/epe": 0.0}):
            writer.add_summary(summary)

    def picture(self, step: int, strip: Picture) -> None:
        """Show a picture in tensorboard."""
        self._board.add_image("sample", strip, step, dataformats="HWC")

    def __exit__(self, *_) -> None:
        if self.enabled:
            self._file.close()
            self._board.close()
