"""The table of `real_recordings --bursts --sets`: errors of known flow."""

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("torch")

from shared_data import shared

from blinkgl.errors import BlinkGLError
from blinkgl.tools import real_recordings as rr
from eflow.data.window import RawSample, Window


def sample(flow: np.ndarray) -> RawSample:
    """Four events, at the left edge, and a flow that is not valid in the last row."""
    height, width = flow.shape[:2]
    x, y = np.zeros(4, np.uint16), np.arange(4, dtype=np.uint16)
    part = lambda t0: Window(x, y, t0 + np.arange(4), np.ones(4, np.uint8), t0, t0 + 100)
    valid = np.ones((height, width), bool)
    valid[-1] = False
    return RawSample(part(0), part(100), height, width, "s/0", "s", flow, valid)


@pytest.fixture
def two(monkeypatch):
    """A set of an affine field and one that is four times as long, and an answer that is right about both but for a
    factor of two at the pixels without events."""
    v, u = np.mgrid[:6, :8].astype(np.float32)
    one = np.stack([1 + 0.5 * u, 2 - 0.25 * v], -1)
    samples = [sample(one), sample(4 * one)]
    monkeypatch.setattr(rr, "open_source", lambda path: samples)

    def answer(pair):
        flow = samples[answer.calls].flow.copy()
        flow[:, 1:] *= 2
        answer.calls += 1
        return flow

    answer.calls = 0
    monkeypatch.setattr(rr, "answer_of", lambda name, height, width: answer)
    return rr.of_set("anything", ["half"], 2)


def test_zero_flow_is_the_unit_and_an_affine_field_is_found(two):
    assert two["zero"]["of_zero_events"] == two["zero"]["of_zero_all"] == 1
    assert two["best affine"]["aee_all"] == pytest.approx(0, abs=1e-5)
    assert 0 < two["best constant"]["of_zero_all"] < 1


def test_pixels_with_events_are_judged_by_themselves(two):
    assert two["half"]["aee_events"] == 0 and two["half"]["length_events"] == 1
    assert 1 < two["half"]["length_all"] < 2 and two["half"]["cosine_all"] == pytest.approx(1)
    # Of the valid pixels seven columns of eight are twice as long as the truth.
    assert 0 < two["half"]["of_zero_all"] == pytest.approx(two["half"]["length_all"] - 1)


def test_a_set_without_labels_is_one_line(monkeypatch):
    monkeypatch.setattr(rr, "open_source", lambda path: [replace(sample(np.ones((6, 8, 2))), flow=None, valid=None)])
    with pytest.raises(BlinkGLError, match="nowhere: no labelled sample"):
        rr.of_set("nowhere", [], 2)


def test_the_office_moves_in_its_pictures_as_in_its_events():
    """Contrast maximisation, which sees no picture, finds the same shift in the windows between two of them."""
    pairs = list(rr.of_office(shared(f"data/events/{rr.OFFICE}"), 3))
    assert len(pairs) == 5
    shifts = rr.answer_of("contrast-translation", 180, 190)
    for pair, flow in pairs[::2]:
        seen, true = shifts(pair)[90, 90], np.nanmedian(flow, axis=(0, 1))
        assert np.hypot(*(seen - true)) < 0.15 * np.hypot(*true)
