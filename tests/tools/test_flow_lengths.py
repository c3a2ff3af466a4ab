"""The views of `flow_lengths --changed` are right about their own flow."""

import numpy as np
import pytest

pytest.importorskip("torch")

from blinkgl.tools import flow_lengths
from blinkgl.tools.flow_lengths import CHANGED, enlarged
from eflow.data.window import RawSample, Window


def sample_of(events: int = 300) -> RawSample:
    """Random events and flow on 12x9 pixels, valid everywhere."""
    rng = np.random.default_rng(0)
    x, y = rng.integers(0, 12, events).astype(np.uint16), rng.integers(0, 9, events).astype(np.uint16)
    part = lambda t0: Window(x, y, t0 + np.arange(events), np.ones(events, np.uint8), t0, t0 + events)
    flow, valid = rng.normal(size=(9, 12, 2)).astype(np.float32), np.ones((9, 12), bool)
    return RawSample(part(0), part(events), 9, 12, "s/0", "s", flow, valid, -flow, valid)


def test_enlarged_windows_have_the_events_and_the_flow_of_a_larger_sensor():
    sample = sample_of()
    three = enlarged(sample, 3)
    assert (three.height, three.width) == three.valid.shape == (27, 36)
    np.testing.assert_array_equal(three.new.x, 3 * sample.new.x)
    np.testing.assert_array_equal(three.flow[three.new.y, three.new.x], 3 * sample.flow[sample.new.y, sample.new.x])
    for name, view in CHANGED.items():
        seen = view(sample)
        assert seen.flow.shape == (seen.height, seen.width, 2) == (*seen.valid.shape, 2), name


def test_no_flow_is_as_wrong_as_zero_flow_in_every_table(monkeypatch):
    """And every window is in one row of each table."""
    windows = [sample_of(300), sample_of(20), sample_of(1)]
    monkeypatch.setattr(flow_lengths, "open_source", lambda _: windows)
    still = lambda model, height, width, **_: lambda window: (np.zeros((height, width, 2), np.float32), None)
    monkeypatch.setattr(flow_lengths, "Predictor", still)
    views, density, length = flow_lengths.of_changed(None, "pool", 3)
    assert [row[0] for row in views] == list(CHANGED)
    for _, error, zero, ratio, beside in views:
        assert error == zero and ratio == beside == 1.0
    assert views[-1][2] == pytest.approx(3 * views[0][2])  # tripled
    for column in (1, 3):
        assert sum(row[column] for row in density) == 3
    assert sum(row[1] for row in length) == 3
    assert [row[2] for row in density if row[1]] == [1.0, 1.0, 1.0]
