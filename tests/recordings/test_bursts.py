"""Bursts that a camera's own frames make: found where they are, and nowhere else."""

from __future__ import annotations

import numpy as np

from blinkgl.recordings.bursts import frame_bursts, inside_any
from blinkgl.recordings.clip import read_recording
from blinkgl.types.events import Events
from tests.recordings.test_calibration import H, W
from tests.shared_data import shared

FRAME_US = 40_000


def stream(at_us, polarity: float = 0.97, seed: int = 0, seconds: float = 0.3) -> Events:
    """40 events/ms of both polarities, and bursts of 300 within 0.6 ms."""
    rng = np.random.default_rng(seed)
    count = int(40_000 * seconds)
    t = [rng.integers(0, int(seconds * 1e6), count), *(rng.integers(a, a + 600, 300) for a in at_us)]
    p = [rng.random(count) < 0.5, *(rng.random(300) < polarity for _ in at_us)]
    order = np.argsort(np.concatenate(t), kind="stable")
    x, y = rng.integers(0, W, order.size), rng.integers(0, H, order.size)
    return Events(x.astype(np.uint16), y.astype(np.uint16), np.concatenate(t)[order],
                  np.concatenate(p)[order].astype(np.uint8))  # fmt: skip


def test_bursts_at_the_frames_interval():
    at = [12_300 + FRAME_US * k for k in range(7)]
    events = stream(at)
    spans = frame_bursts(events, FRAME_US * 1.01)
    assert len(spans) == 7 and (np.diff(spans) <= 1500).all()
    for (begin, end), a in zip(spans, at):
        assert begin <= a + 60 and end >= a + 540
    within = inside_any(events.t, spans)
    assert 1900 <= within.sum() - 40 * np.diff(spans).sum() / 1000 <= 2150
    assert np.array_equal(within, np.any([(events.t >= begin) & (events.t < end) for begin, end in spans], axis=0))
    assert not inside_any(events.t, spans[:0]).any()


def test_of_a_davis():
    """slider_depth: four intervals of 38.8 ms, ON at each, OFF a ms after two of them; 12 % of all events."""
    events, _, _ = read_recording(shared("data/events/slider_depth/events_chunk.txt"))
    spans = frame_bursts(events, 38_770)
    assert len(spans) == 6
    assert 0.10 < inside_any(events.t, spans).mean() < 0.13
