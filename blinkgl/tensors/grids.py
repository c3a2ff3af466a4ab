"""What is made of events where they lie: voxel grids, counts, times of last events, for each environment.

Nothing here is differentiable: grids are made of events, and whether there is an event does not depend smoothly on the
frames. None of these functions synchronises with the host.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from blinkgl.events.emulator import NEVER_NS
from blinkgl.tensors.batch import TensorEvents

NEVER_US = NEVER_NS // 1000
"""Time of the last event of a pixel that had none."""


def _cells(events: TensorEvents, channel: Tensor, channels: int) -> Tensor:
    """Return the events' places in a flat (environments, channels, H, W) array, (N,) int64."""
    _, height, width = events.shape
    return ((events.env.to(torch.int64) * channels + channel) * height + events.y) * width + events.x


def voxel_grid(events: TensorEvents, t0_us: Any, t1_us: Any, bins: int) -> Tensor:
    """(environments, bins, H, W) float32: polarities (+1, -1), each shared between the two bins beside
    (bins - 1) (t - t0) / (t1 - t0); events outside [t0, t1] count as nothing.

    t0_us, t1_us : microseconds, one for all environments or (environments,) int64 tensors on the events' device.
    On a processor the numbers are those of :func:`blinkgl.events.grids.voxel_grid`, bit for bit; on a card sums are
    made in any order, so they agree to float32's rounding. Source: Zhu et al., CVPR 2019, section 3.1."""
    # The kernel max(0, 1 - |place - bin|) of Zhu et al. touches two bins.
    envs, height, width = events.shape
    env = events.env.to(torch.int64)
    start, end = (value[env] if isinstance(value, Tensor) else int(value) for value in (t0_us, t1_us))
    last = bins - 1
    length: Any = end - start
    length = length.to(torch.float64) if isinstance(length, Tensor) else length
    place = (events.t - start).to(torch.float64) * (last / length)
    lower = place.to(torch.int64).clamp(0, last)
    weight = (place - lower).to(torch.float32)
    inside = (events.t >= start) & (events.t <= end)
    sign = torch.where(events.p > 0, 1.0, -1.0) * inside
    # Both shares of an event side by side: a cell then adds them up in the order of events, as the numba loop does.
    first, second = _cells(events, lower, bins), _cells(events, (lower + 1).clamp(max=last), bins)
    shares = torch.stack((sign * (1.0 - weight), torch.where(lower < last, sign * weight, 0.0)), 1)
    grid = torch.zeros(envs * bins * height * width, device=events.t.device)
    grid.index_add_(0, torch.stack((first, second), 1).view(-1), shares.view(-1))
    return grid.view(envs, bins, height, width)


def event_counts(events: TensorEvents) -> Tensor:
    """(environments, 2, H, W) int32: OFF events in channel 0, ON events in channel 1. The same on every device."""
    envs, height, width = events.shape
    counts = torch.zeros(envs * 2 * height * width, dtype=torch.int32, device=events.t.device)
    counts.index_add_(0, _cells(events, events.p.to(torch.int64), 2), torch.ones_like(events.x))
    return counts.view(envs, 2, height, width)


def latest_times(events: TensorEvents, before: Tensor | None = None) -> Tensor:
    """(environments, 2, H, W) int64 microseconds: when each pixel had its last OFF and ON event, :data:`NEVER_US` where
    it had none. The same on every device.   before : the result for the events so far."""
    envs, height, width = events.shape
    shape = (envs, 2, height, width)
    start = torch.full(shape, NEVER_US, dtype=torch.int64, device=events.t.device) if before is None else before
    cells = _cells(events, events.p.to(torch.int64), 2)
    # amax is the same in any order, so the result does not depend on the device.
    return start.reshape(-1).scatter_reduce(0, cells, events.t, "amax").view(shape)


def time_surface(latest: Tensor, t_us: Any, tau_us: float) -> Tensor:
    """exp(-(t - latest) / tau), float32 of the shape of ``latest``; 0 where a pixel had no event.

    latest : of :func:`latest_times`.   t_us : now, one or (environments,).   Source: Lagorce et al., TPAMI 2017."""
    now = t_us.view(-1, 1, 1, 1) if isinstance(t_us, Tensor) else t_us
    return torch.exp((latest - now).to(torch.float64) / tau_us).to(torch.float32)
