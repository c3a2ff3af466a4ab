"""Emulators on tensors beside the single ones: environments with times, seeds, resets and restarts of their own."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from blinkgl.types.events import Events


def assert_same(ours: Events, theirs: Events, what: object) -> None:
    assert len(ours) == len(theirs), (what, len(ours), len(theirs))
    if len(theirs):  # an empty chunk has no column of causes
        assert ours.columns == theirs.columns, what
    for name in theirs.columns:
        assert np.array_equal(getattr(ours, name), getattr(theirs, name)), (what, name)


def compare(
    batch_kind: Any,
    single_kind: Any,
    config: Any,
    height: int,
    width: int,
    envs: int,
    *,
    steps: int = 7,
    seed: int = 5,
    density: float = 0.6,
    frames_seed: int = 0,
    device: str = "cpu",
) -> int:
    """Steps both and compares all events; returns how many there were. Raises AssertionError.

    Environments have intervals of their own, one of 5 s among them; the last begins anew in the middle, and the whole
    batch is saved and restored."""
    rng = np.random.default_rng((frames_seed, height, width, envs))
    make = lambda: batch_kind(height, width, config, envs=envs, seed=seed, device=device)
    batch = make()
    singles = [single_kind(height, width, config, s) for s in batch.seeds]
    t_ns, total = np.arange(envs) * 12_345 + 7, 0
    for n in range(steps):
        frames = np.exp(rng.normal(-1, density, (envs, height, width))).astype(np.float32)
        t_ns = t_ns + (
            5_000_000_123 if n == steps - 2 and config.emulator == "esim" else rng.integers(1, 3_000_000, envs)
        )
        if n == steps // 2:
            mask = np.arange(envs) == envs - 1
            batch.reset(mask)
            singles[-1] = single_kind(height, width, config, batch.seeds[-1])
            t_ns[-1] -= 2_000_000_000  # an environment that begins anew may begin at any time
        if n == steps // 2 + 1:
            state = batch.state_dict()
            batch = make()
            batch.load_state_dict(state)
        chunks = batch.step(torch.from_numpy(frames).to(device), t_ns if n % 2 else t_ns.tolist()).numpy()
        for k, single in enumerate(singles):
            events = single.step(frames[k], int(t_ns[k]))
            assert_same(chunks[k], events, (config, n, k))
            total += len(events)
        assert batch.saturated[:-1].tolist() == [single.saturated for single in singles[:-1]]
    return total
