"""Rows that the caller knows to be unchanged may be skipped: same events, same state."""

import itertools

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.errors import EventDataError
from blinkgl.events import make_emulator

H, W = 53, 70


def clip():
    """A bright bar wandering up and down over a still background, and the rows that differ from frame to frame."""
    rng = np.random.default_rng(3)
    background = rng.uniform(0.1, 1.0, (H, W)).astype(np.float32)
    frames, places = [background], [(0, 0)]
    for k in range(12):
        y0 = 5 * k % 40
        frame = background.copy()
        frame[y0 : y0 + 6, 10:40] *= np.float32(2.5)
        frames.append(frame)
        places.append((y0, y0 + 6))
    rows = [None] + [(min(a[0], b[0]), max(a[1], b[1])) for a, b in itertools.pairwise(places)]
    rows[1] = places[1]
    frames += [frames[-1], frames[-1]]
    rows += [(0, 0), (0, 0)]  # nothing changed at all
    return frames, rows


@pytest.mark.parametrize(
    "config",
    [
        EsimConfig(),
        EsimConfig(threshold_sigma=0.0),
        EsimConfig(threshold_jitter=0.05, refractory_us=300.0),
        V2eConfig(preset="noisy"),
        VoltmeterConfig(),
    ],
)
def test_same_events_and_state(config):
    frames, rows = clip()
    told, untold = (make_emulator(config, H, W, seed=9) for _ in range(2))
    count = 0
    for k, (frame, changed) in enumerate(zip(frames, rows)):
        a, b = told.step(frame, k * 1_000_000, changed), untold.step(frame, k * 1_000_000)
        for name in "xytp":
            np.testing.assert_array_equal(getattr(a, name), getattr(b, name))
        count += len(a)
    assert count > 500
    for name, value in untold.state_dict().items():
        np.testing.assert_array_equal(told.state_dict()[name], value)


def test_bad_values_in_the_changed_rows_are_still_found():
    emulator = make_emulator(EsimConfig(), H, W, seed=1)
    frame = np.ones((H, W), np.float32)
    emulator.step(frame, 0)
    frame[20, 7] = np.nan
    with pytest.raises(EventDataError, match="x=7, y=20"):
        emulator.step(frame, 1000, rows=(18, 24))
