"""Voxel grids, counts and time surfaces of events that stay on the card, beside NumPy on the same events."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import CardEsim, Counts, Latest, Voxels
from blinkgl.card.sinks import ONE
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim
from tests.events.clips import random_clip, run

H, W = 37, 45
CONFIG = EsimConfig(threshold_sigma=0.03)


def voxels(events, t0: int, t1: int, bins: int) -> np.ndarray:
    """Whole numbers of 2^-16, in plain Python integers."""
    grid = np.zeros((bins, H, W), np.int64)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p):
        place = (int(t) - t0) * (bins - 1) * ONE // (t1 - t0)
        first, later = divmod(place, ONE)
        sign = 1 if p else -1
        grid[first, y, x] += sign * (ONE - later)
        if later:
            grid[first + 1, y, x] += sign * later
    return grid


@pytest.fixture(scope="module")
def clip():
    frames, times = random_clip(3, frames=6, height=H, width=W)
    return frames, times, run(Esim(H, W, CONFIG, 2), frames, times)


@pytest.mark.parametrize("bins", [1, 2, 5])
def test_tensors_are_those_of_the_events(gl, clip, bins):
    """A window that begins and ends between two frames; over several steps."""
    frames, times, events = clip
    t0, t1 = int(times[1]) // 1000 + 3001, int(times[4]) // 1000 + 777
    inside = events.window(t0, t1)
    card = CardEsim(H, W, CONFIG, 2, gl=gl)
    sinks = Voxels(card, bins), Counts(card), Latest(card)
    for _ in range(2):  # a sink is used again
        for sink in sinks:
            sink.begin(t0, t1)
    total = 0
    for frame, t in zip(frames, times):
        total += card.advance(frame, int(t))
        for sink in sinks:
            sink.add()
    assert total == len(events) > len(inside) > 1000
    wanted = voxels(inside, t0, t1, bins)
    np.testing.assert_array_equal(sinks[0].whole(), wanted)
    np.testing.assert_array_equal(sinks[0].read(), (wanted / ONE).astype(np.float32))
    counts, latest = np.zeros((2, H, W), np.int64), np.full((2, H, W), -1)
    np.add.at(counts, (inside.p, inside.y, inside.x), 1)
    np.maximum.at(latest, (inside.p, inside.y, inside.x), inside.t)
    np.testing.assert_array_equal(sinks[1].read(), counts)
    np.testing.assert_array_equal(sinks[2].read(), latest)
    for sink in sinks:
        sink.release()
        sink.release()
    card.release()


def test_steps_that_are_read_and_steps_that_stay_may_alternate(gl, clip):
    frames, times, events = clip
    card = CardEsim(H, W, CONFIG, 2, gl=gl)
    count, read = 0, []
    for k, (frame, t) in enumerate(zip(frames, times)):
        if k % 2:
            count += card.advance(frame, int(t))
        else:
            read.append(card.step(frame, int(t)))
    assert count and count + sum(map(len, read)) == len(events)
    card.release()


def test_what_cannot_be_a_window(gl):
    card = CardEsim(8, 8, CONFIG, gl=gl)
    with pytest.raises(EventDataError, match=r"^bins: number of bins out of range"):
        Voxels(card, 0)
    sink = Counts(card)
    for t0, t1 in ((5, 5), (6, 5), (0, 2**30 + 1)):
        with pytest.raises(EventDataError, match=r"^window: a window has an end after its start"):
            sink.begin(t0, t1)
    sink.begin(0, 10)
    sink.add()  # before the first frame there is nothing
    assert not sink.read().any()
    card.release()
