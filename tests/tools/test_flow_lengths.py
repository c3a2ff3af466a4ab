"""The views of `flow_lengths --views` are right about their own flow."""

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.tools.flow_lengths import VIEWS, enlarged
from eflow.data.window import RawSample, Window


def test_enlarged_windows_have_the_events_and_the_flow_of_a_larger_sensor():
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 12, 300).astype(np.uint16), rng.integers(0, 9, 300).astype(np.uint16)
    part = lambda t0: Window(x, y, t0 + np.arange(300), np.ones(300, np.uint8), t0, t0 + 300)
    flow = rng.normal(size=(9, 12, 2)).astype(np.float32)
    sample = RawSample(
        part(0), part(300), 9, 12, "s/0", "s", flow, np.ones((9, 12), bool), -flow, np.ones((9, 12), bool)
    )
    three = enlarged(sample, 3)
    assert (three.height, three.width) == three.valid.shape == (27, 36)
    np.testing.assert_array_equal(three.new.x, 3 * x)
    np.testing.assert_array_equal(three.flow[three.new.y, three.new.x], 3 * flow[y, x])
    for name, view in VIEWS.items():
        seen = view(sample)
        assert seen.flow.shape == (seen.height, seen.width, 2) == (*seen.valid.shape, 2), name
