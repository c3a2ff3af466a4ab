"""How far a training is, by steps or by the clock, and the learning rate there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.distributed as dist

from eflow.config import OptimConfig


def learning_rate(done: float, peak: float, warmup: float, cooldown: float) -> float:
    """The rate when a share ``done`` (0 … 1) of the training is over: linear from peak / 25 up to ``peak`` over its
    first ``warmup``, then ``peak``, and linear down to peak / 25e4 over its last ``cooldown``."""
    start, end = peak / 25, peak / 25e4
    if done < warmup:
        return start + (peak - start) * done / warmup
    if done < 1 - cooldown:
        return peak
    return peak + (end - peak) * min((done - (1 - cooldown)) / max(cooldown, 1e-9), 1)


@dataclass
class Course:
    """How far a training is, by steps and, where ``optim.minutes`` says so, by the clock of all its parts together.

    before : seconds of the parts before this one."""

    optim: OptimConfig
    began: float
    before: float
    clock: Callable[[], float]

    @property
    def seconds(self) -> float:
        return self.before + self.clock() - self.began

    def done(self, step: int, device: torch.device, world: int) -> float:
        """Share of the training that is over after ``step`` steps; the same on all ranks."""
        share = step / self.optim.steps
        if self.optim.minutes is None:
            return share
        if world == 1:
            return max(share, self.seconds / (60 * self.optim.minutes))
        seconds = torch.tensor(self.seconds, dtype=torch.float64, device=device)
        dist.broadcast(seconds, 0)
        return max(share, float(seconds) / (60 * self.optim.minutes))

    def minutes_left(self, time_limit: float | None) -> float | None:
        """Until the end or this call's ``time_limit``; None where there is no clock."""
        ends = [] if time_limit is None else [time_limit]
        ends += [] if self.optim.minutes is None else [self.optim.minutes - self.before / 60]
        return min(ends, default=None)
