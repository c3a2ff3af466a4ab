"""What a training says of itself while it goes on: readings of its steps, log.jsonl, and what makes it stop."""

from __future__ import annotations

import contextlib
import json
import signal
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from blinkgl.errors import BlinkGLError
from blinkgl.io.atomic import output_errors


class TrainingError(BlinkGLError):
    """Training cannot go on (loss not finite)."""


class Readings:
    """Loss, end-point error and gradient norm of the steps, which stay on the device until they are asked for: to read
    a number is to wait for all that was computed before it. The latest ones that were read are ``loss``, ``epe`` and
    ``norm``."""

    def __init__(self, out: Path):
        self._out, self._pending = out, []
        self.loss = self.epe = self.norm = float("nan")

    def add(self, step: int, names: list[str], loss: Tensor, epe: Tensor, norm: Tensor) -> None:
        """After ``step`` steps, on the samples of these names."""
        self._pending.append((step, names, torch.stack([v.detach().float() for v in (loss, epe, norm)])))

    def values(self) -> list[tuple[float, float]]:
        """(loss, end-point error) of each step since the last call, in one copy.

        Raises TrainingError at the first that is not finite, having named its samples in ``nan_batch.json``. Steps
        after it were made with what it left, so whoever saves asks before."""
        read = torch.stack([v for _, _, v in self._pending]).tolist() if self._pending else []
        for (step, names, _), (loss, _, norm) in zip(self._pending, read, strict=True):
            if not np.isfinite([loss, norm]).all():
                _stop_on_nan(self._out, step, names, loss, norm)
        if read:
            self.loss, self.epe, self.norm = read[-1]
        self._pending.clear()
        return [(loss, epe) for loss, epe, _ in read]


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
    """SIGINT and SIGTERM become a flag that the loop reads between steps; a second SIGINT interrupts at once."""

    reason: str | None = None

    def __enter__(self) -> Signals:
        self._old = {}
        with contextlib.suppress(ValueError):  # not the main thread: the caller's business
            for s in (signal.SIGINT, signal.SIGTERM):
                self._old[s] = signal.signal(s, self._note)
        return self

    def _note(self, number: int, _) -> None:
        if self.reason and number == signal.SIGINT:
            raise KeyboardInterrupt
        self.reason = "signal"

    def __exit__(self, *_) -> None:
        for s, handler in self._old.items():
            signal.signal(s, handler)


class Log:
    """log.jsonl, one object per line, and tensorboard. On resuming, lines past the checkpoint
    are dropped: those steps run again."""

    def __init__(self, out: Path, start: int, enabled: bool):
        self.path, self.start, self.enabled = out / "log.jsonl", start, enabled

    def __enter__(self) -> Log:
        if self.enabled:
            with output_errors(self.path):
                lines = self.path.read_text(encoding="utf-8").splitlines() if self.path.is_file() else []
                kept = [
                    line
                    for line in lines
                    if line.startswith("{") and line.endswith("}") and json.loads(line)["step"] <= self.start
                ]
                self.path.write_text("".join(line + "\n" for line in kept), encoding="utf-8")
                self._file = open(self.path, "a", encoding="utf-8")
            from torch.utils.tensorboard import SummaryWriter

            self._board = SummaryWriter(str(self.path.parent / "tb"), purge_step=self.start + 1 if self.start else None)
        return self

    def write(self, step: int, kind: str, **values: float) -> None:
        with output_errors(self.path):
            self._file.write(json.dumps({"step": step, "kind": kind, **values}) + "\n")
            self._file.flush()
        for k, v in values.items():
            self._board.add_scalar(f"{kind}/{k}", v, step)

    def __exit__(self, *_) -> None:
        if self.enabled:
            self._file.close()
            self._board.close()
