"""Small clips for the emulator tests."""

from __future__ import annotations

import numpy as np

from blinkgl.types.events import Events


def random_clip(seed: int, frames: int = 8, height: int = 37, width: int = 45, contrast: float = 0.5, dtype=np.float32):
    """Random-walk luminance with still pixels, exact returns and irregular frame times.

    Returns ((N, H, W) frames, (N,) int64 ns). The size is odd so that bands and blocks end raggedly.
    """
    rng = np.random.default_rng(seed)
    steps = rng.normal(0, contrast, (frames, height, width)) * (rng.random((frames, height, width)) < 0.5)
    log = np.cumsum(steps, axis=0) - 2.0
    log[2] = log[0]  # an exact return
    clip = np.exp(np.clip(log, -9, 3))
    clip[:, 3, :5] = 0.0
    times = 7_123 + np.cumsum(rng.integers(1_000, 40_000_000, frames))
    if dtype == np.uint8:
        return np.clip(clip * 255, 0, 255).astype(np.uint8), times
    return clip.astype(np.float32), times


def run(emulator, clip, times) -> Events:
    return Events.concatenate([emulator.step(f, int(t)) for f, t in zip(clip, times)])


def assert_same(a: Events, b: Events) -> None:
    assert len(a) == len(b)
    assert a.columns == b.columns
    for name in a.columns:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


def by_pixel(events: Events, width: int) -> tuple[np.ndarray, Events]:
    """(pixels, events): pixel after pixel, in order of time."""
    pixel = events.y.astype(np.int64) * width + events.x
    order = np.lexsort((events.t, pixel))
    return pixel[order], events.part(order)
