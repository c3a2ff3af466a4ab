"""The timeline's percentiles on the card: those of arrays, bit for bit, and so the same times of frames."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from blinkgl.card import reductions
from blinkgl.card.reductions import OfTextures, ranks_right, reductions_on
from blinkgl.errors import GLError
from blinkgl.events.table import EMULATORS
from blinkgl.sequence import simulate_sequence
from blinkgl.timeline.reductions import SLOWEST, STILL, OfArrays
from tests.card.test_choice import config_of

CURVES = [emulator.response(emulator.Config()) for emulator in EMULATORS.values()]


@pytest.fixture
def card(gl):
    made = OfTextures(gl)
    yield made
    made.release()
    made.release()


def drawn(gl, picture):
    picture = np.ascontiguousarray(picture, np.float32)
    texture = gl.ctx.texture(picture.shape[1::-1], picture.shape[2], picture.tobytes(), dtype="f4")
    return SimpleNamespace(read=lambda: picture[..., :2], texture=lambda: texture)


def spread(rng, shape):
    """Of all orders of magnitude, up to what luminances may be."""
    return np.exp(rng.uniform(-85.0, 60.0, shape))


PICTURES = {
    "plain": lambda rng, shape: rng.normal(0, 100, shape),
    "mostly still": lambda rng, shape: rng.normal(0, 100, shape) * (rng.random(shape[:2]) < 0.05)[..., None],
    "few values": lambda rng, shape: np.round(rng.normal(0, 1, shape)),
    "all alike": lambda rng, shape: np.full(shape, 7.3),
    "all orders": lambda rng, shape: spread(rng, shape) * rng.choice((-1.0, 1.0), shape),
    "at the limit": lambda rng, shape: rng.integers(-2, 3, shape).astype(np.int32) + np.full(shape, SLOWEST).view("i4"),
    "no numbers": lambda rng, shape: np.where(
        rng.random(shape) < 0.3, rng.choice((np.inf, -np.inf, np.nan), shape), rng.normal(0, 9, shape)
    ),
}


@pytest.mark.parametrize("kind", PICTURES)
def test_the_percentiles_of_arrays_bit_for_bit(gl, card, kind):
    rng = np.random.default_rng(len(kind))
    for height, width in ((1, 1), (1, 2), (7, 5), (60, 81)):
        picture = PICTURES[kind](rng, (height, width, 2))
        if kind == "at the limit":
            picture = picture.astype(np.int32).view(np.float32)
        picture = np.asarray(picture, np.float32)
        of_light = picture.copy()
        of_light[..., 0] = np.abs(of_light[..., 0])
        one, other = drawn(gl, picture), drawn(gl, of_light)
        with np.errstate(all="ignore"):
            for percent in (0.5, 50.0, 80.0, 99.9, 100.0):
                assert card.speeds(one, percent) == OfArrays().speeds(one, percent), (height, width, percent)
                for curve in CURVES:
                    wanted = OfArrays().changes(other, curve, percent)
                    assert card.changes(other, curve, percent) == wanted, (height, width, percent, curve)


def test_the_first_two_of_four_components_and_nothing_that_moves(gl, card):
    picture = np.random.default_rng(0).normal(0, 5, (9, 11, 4)).astype(np.float32)
    seen = drawn(gl, picture)
    assert card.speeds(seen, 95.0) == OfArrays().speeds(seen, 95.0) != STILL
    assert card.speeds(drawn(gl, np.zeros((9, 11, 2))), 95.0) == STILL


@pytest.mark.parametrize(
    "timeline",
    [
        {"kind": "displacement", "max_px": 0.5, "max_px_peak": 0.8, "sample_every": 2},
        {"kind": "brightness", "max_fraction_of_threshold": 0.5, "sample_every": 2},
    ],
)
def test_frames_come_at_the_same_times_and_no_small_picture_is_read_back(gl, tmp_path, monkeypatch, timeline):
    """A whole sequence: the same frames, the same events."""
    from blinkgl.render.canvas import Frame

    reads, read, found = [], Frame.read, {}
    monkeypatch.setattr(Frame, "read", lambda frame, *given: reads.append(frame) or read(frame, *given))
    for device in ("cpu", "gl"):
        config = config_of(tmp_path, events={"device": device}, timeline=timeline)
        with simulate_sequence(config, 0, gl, labels=False) as sequence:
            reads.clear()
            seen = [(chunk.t_ns, chunk.events.t.tobytes()) for chunk in sequence.chunks()]
            found[device] = seen, sequence.timeline.looks
            assert isinstance(sequence.timeline.reductions, OfTextures if device == "gl" else OfArrays)
            assert bool(reads) == (device == "cpu")
    assert found["cpu"] == found["gl"] and found["gl"][1] > 5


def test_auto_is_the_card_where_it_ranks_right(gl, monkeypatch):
    assert isinstance(reductions_on(gl, "auto"), OfTextures)
    monkeypatch.setattr(reductions, "_answers", {})
    monkeypatch.setattr(reductions, "between", lambda below, above, share: 0.0)
    assert not ranks_right(gl) and isinstance(reductions_on(gl, "auto"), OfArrays)
    with pytest.raises(GLError, match=r"^events\.device: the card's percentiles of a trial .*events\.device: cpu"):
        reductions_on(gl, "gl")
