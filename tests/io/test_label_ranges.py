"""Labels of events and of intervals are checked for range as events are: nothing wraps."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from blinkgl.errors import AssetError, EventDataError
from blinkgl.io.event_labels import EventLabelsReader, EventLabelsWriter
from blinkgl.io.intervals import encode_intervals, intervals_in, read_intervals
from blinkgl.types.events import TRUTH
from tests.io.some_events import some_events

E = some_events(5, 0, 1000, 24, 32)


@pytest.fixture
def labels(tmp_path):
    truth = np.zeros(5, TRUTH)
    truth["depth"] = [1, 2, np.inf, 4, 5]
    writer = EventLabelsWriter(tmp_path / "event_labels.h5")
    writer.append(replace(E, truth=truth, cause=np.array([0, 1, 2, 3, 0], np.uint8)))
    writer.close()
    return tmp_path / "event_labels.h5"


@pytest.mark.parametrize(
    "name, values, message",
    [
        ("instance", [1, 70000, 3, 4, 5], r"instance of event 1 \(got 70000\); expected 0 to 65535"),
        ("instance", [1, 2, -1, 4, 5], r"instance of event 2 \(got -1\)"),
        ("cause", [0, 1, 2, 259, 0], r"cause of event 3 \(got 259\); expected 0 to 3"),
        ("depth", [1, 1e300, 3, 4, 5], r"depth of event 1 \(got 1e\+300\); expected float32"),
        ("depth", [1, 2, 3, np.nan, 5], r"depth of event 3 \(got nan\)"),
        ("velocity", [[0, 0]] * 4 + [[0, np.nan]], r"velocity of event 4 \(got \[0.0, nan\]\)"),
        ("velocity", [[np.inf, 0]] + [[0, 0]] * 4, r"velocity of event 0"),
    ],
)
def test_labels_of_events(labels, name, values, message):
    with EventLabelsReader(labels) as reader:
        truth, cause = reader.read()
        assert np.isinf(truth["depth"][2]) and cause.tolist() == [0, 1, 2, 3, 0]
    with h5py.File(labels, "r+") as file:
        del file[name]
        file[name] = np.asarray(values, "f8" if name in ("depth", "velocity") else "i8")
    with EventLabelsReader(labels) as reader, pytest.raises(EventDataError, match=message):
        reader.read()


def test_intervals(tmp_path):
    path = tmp_path / "i.h5"
    arrays = {"flow": np.zeros((1, 4, 4, 2), np.float32), "valid": np.ones((1, 4, 4), bool)}
    whole = encode_intervals(10**8, np.array([10**7]), arrays)
    for name, value, message in (
        ("interval_ns", np.array([2**64 - 10**7], "u8"), "'interval_ns' holds no times"),
        ("from_us", np.uint64(2**64 - 5), "'from_us' holds no times"),
        ("flow", np.full((1, 4, 4, 2), np.nan, "f4"), "valid flow that is no number"),
    ):
        path.write_bytes(whole)
        assert read_intervals(path, ("flow", "valid"))[1].tolist() == intervals_in(path).tolist() == [10**7]
        with h5py.File(path, "r+") as file:
            del file[name]
            file[name] = value
        with pytest.raises(AssetError, match=message):
            read_intervals(path, ("flow", "valid"))
