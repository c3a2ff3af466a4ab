"""Events that ``max_events_per_step`` cuts are counted, and no others: nothing is lost, nothing is reported as lost."""

import numpy as np
import pytest

from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator

KINDS = {
    "esim": EsimConfig(threshold_sigma=0.0),
    "v2e": V2eConfig(preset="clean"),
    "voltmeter": VoltmeterConfig(),
}


@pytest.mark.parametrize("kind", KINDS)
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
