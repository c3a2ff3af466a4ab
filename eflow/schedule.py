"""Progress of a training, by steps or by time, and its learning rate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
import torch.distributed as dist

from eflow.config import OptimConfig


def learning_rate(done: float, peak: float, warmup: float, cooldown: float) -> float:
    """Return the learning rate after a share ``done`` (0 … 1) of the training.

    It rises linearly from peak / 25 to ``peak`` over the first share ``warmup``, stays, and falls linearly to
    peak / 25e4 over the last share ``cooldown``."""
    start, end = peak / 25, peak / 25e4
    if done < warmup:
        return start + (peak - start) * done / warmup
    if done < 1 - cooldown:
        return peak
    return peak + (end - peak) * min((done - (1 - cooldown)) / max(cooldown, 1e-9), 1)


@dataclass
class Course:
    """Progress of a training, by steps and, if ``optim.minutes`` is set, by the time of all its parts.

    before : seconds of the parts before this one."""

    optim: OptimConfig
    began: float
    before: float
    clock: Callable[[], float]

    @property
    def seconds(self) -> float:
        return self.before + self.clock() - self.began

    def done(self, step: int, device: torch.device, world: int) -> float:
        """Return the share of the training that is done after ``step`` steps; the same on all ranks."""
        share = step / self.optim.steps
        if self.optim.minutes is None:
            return share
        if world == 1:
            return max(share, self.seconds / (60 * self.optim.minutes))
        seconds = torch.tensor(self.seconds, dtype=torch.float64, device=device)
        dist.broadcast(seconds, 0)
        return max(share, float(seconds) / (60 * self.optim.minutes))

    def minutes_left(self, time_limit: float | None) -> float | None:
        """Return the minutes until the end or the ``time_limit`` of this call; None if there is no limit."""
        ends = [] if time_limit is None else [time_limit]
        ends += [] if self.optim.minutes is None else [self.optim.minutes - self.before / 60]
        return min(ends, default=None)
