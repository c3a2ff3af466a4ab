"""Events that ``max_events_per_step`` cuts are counted, and no others: nothing is lost, nothing is reported as lost."""

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator
from blinkgl.events.v2e_blocks import flag_block
from tests.events.clips import random_clip, run

KINDS = {
    "esim": EsimConfig(threshold_sigma=0.0),
    "esim, dead time": EsimConfig(refractory_us=2000.0),
    "v2e": V2eConfig(preset="clean"),
    "v2e, noisy": V2eConfig(preset="noisy"),
    "voltmeter": VoltmeterConfig(),
    "voltmeter, dead time": VoltmeterConfig(refractory_us=2000.0),
}


@pytest.mark.parametrize("kind", KINDS)
def test_nothing_is_reported_as_lost_that_is_not(kind):
    clip, times = random_clip(4, frames=5)
    emulator = make_emulator(KINDS[kind], 37, 45, 3)
    made = run(emulator, clip, times)
    assert len(made) > 500 and emulator.saturated == 0


@pytest.mark.parametrize("kind", [k for k in KINDS if "noisy" not in k and "dead" not in k])
def test_what_is_cut_is_counted(kind):
    """One step of 30 events a pixel into room for four: as many are given as fit, and with those that are counted as
    cut there are as many as without a limit, to an event of each pixel."""
    frames = [np.full((24, 30), v, np.float32) for v in (0.01, 1.0)]
    counts = []
    for limit in (3000, 10**6):
        emulator = make_emulator(KINDS[kind].model_copy(update={"max_events_per_step": limit}), 24, 30, 3)
        emulator.step(frames[0], 0)
        made = len(emulator.step(frames[1], 10**8))
        assert made <= limit and (emulator.saturated > 0) == (limit == 3000)
        counts.append(made + emulator.saturated)
        if limit == 3000:
            assert made > 2000
    assert abs(counts[0] - counts[1]) <= (0.1 if kind == "voltmeter" else 0.05) * counts[1]


def test_at_a_level_exactly_an_event_is_due():
    """Not one unit in the last place before it."""
    before = np.nextafter(np.float32(1), np.float32(0))
    z = np.array([1, before, -1, -before, 0, 1.5], np.float32)
    flags = np.full(6, 7, np.uint8)
    farthest = flag_block(z, np.ones(6, np.float32), -np.ones(6, np.float32), flags)
    assert flags.tolist() == [1, 0, 1, 0, 0, 1] and farthest == 0.5
    assert flag_block(z[:1], np.ones(1, np.float32), -np.ones(1, np.float32), flags[:1]) == 0
    assert flag_block(z[1:2], np.ones(1, np.float32), -np.ones(1, np.float32), flags[:1]) < 0
