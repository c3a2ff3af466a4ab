"""Length of the flow by density of events."""

import numpy as np
import pytest

from eflow.density import EDGES, LengthByDensity


def test_lengths_lie_in_the_bin_of_their_density_with_their_ratio():
    """Constant flow of 4 px on 10x10: n events are a density of n / 100 / 4."""
    truth, valid = np.tile(np.float32([0, 4]), (10, 10, 1)), np.ones((10, 10), bool)
    hit = np.zeros((10, 10), bool)
    hit[0] = True
    lengths = LengthByDensity()
    for events, factor in ((12, 0.5), (12, 0.7), (12, 0.6), (100, 1.1), (8000, 1.0)):
        flow = truth * factor
        flow[0] *= 2  # where the events are it is twice as long
        lengths.add(flow, truth, valid, events, hit)
    sparse, middle, dense = lengths.rows()
    assert (sparse["from"], sparse["to"], sparse["samples"]) == (0.02, 0.05, 3)
    assert sparse["all"] == pytest.approx(0.6 * 1.1) and sparse["events"] == pytest.approx(1.2)
    assert sparse["quartiles"] == pytest.approx([1.1, 1.3])
    assert (middle["from"], middle["samples"], dense["from"], dense["to"]) == (0.2, 1, 1.0, None)


def test_what_does_not_move_has_no_length():
    truth, valid = np.full((10, 10, 2), 0.3, np.float32), np.ones((10, 10), bool)
    lengths = LengthByDensity()
    lengths.add(truth, truth, valid, 50, valid)  # shorter than half a px
    lengths.add(truth, truth, ~valid, 50, valid)
    assert lengths.rows() == []
    truth[:2] = 3  # a fifth of the pixels moves: those count, the density is of all
    lengths.add(2 * truth, truth, valid, 100, ~valid)
    (row,) = lengths.rows()
    mean = 0.2 * 3 * 2**0.5 + 0.8 * 0.3 * 2**0.5
    assert (
        row["all"] == pytest.approx(2) and row["from"] <= 1 / mean < (row["to"] or np.inf) and np.isnan(row["events"])
    )
    assert list(EDGES) == sorted(EDGES) and {0.02, 1.0} < set(EDGES)
