"""Events sorted on the card and read back one frame late: the same events, in the same order."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import CardEsim, Counts
from blinkgl.card.late import Slot
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError, GLError
from blinkgl.events import Esim
from blinkgl.types.events import Events
from tests.card.test_frames_on_card import textures
from tests.events.clips import assert_same, random_clip, run

HOW = [{"late": True}, {"sorts": True}, {"late": True, "sorts": True}]


def run_late(emulator, clip, times) -> Events:
    return Events.concatenate([run(emulator, clip, times), emulator.flush()])


@pytest.mark.parametrize("how", HOW)
@pytest.mark.parametrize("config", [EsimConfig(threshold_sigma=0.03, causes=True), EsimConfig(refractory_us=300.0)])
def test_the_same_events_in_the_same_order(gl, how, config):
    clip, times = random_clip(3, frames=7)
    card = CardEsim(37, 45, config, 2, gl=gl, **how)
    assert card.lags == ("late" in how)
    assert_same(run_late(card, clip, times), run(Esim(37, 45, config, 2), clip, times))
    card.release()
    card.release()


def test_events_come_one_frame_late(gl):
    clip, times = random_clip(3, frames=5)
    fast, card = Esim(37, 45), CardEsim(37, 45, gl=gl, late=True)
    wanted = [fast.step(f, int(t)) for f, t in zip(clip, times)]
    for k, frame in enumerate(clip):
        made = card.step(frame, int(times[k]))
        assert_same(made, wanted[k - 1] if k > 1 else Events.empty())
        assert card.done_ns == times[max(0, k - 1)]
    with pytest.raises(EventDataError, match=r"^state_dict: events are on their way.*flush\(\) before it"):
        card.state_dict()
    assert_same(card.flush(), wanted[-1])
    assert card.done_ns == times[-1] and not len(card.flush())
    for name, array in fast.state_dict().items():
        np.testing.assert_array_equal(card.state_dict()[name], array, err_msg=name)
    card.release()


@pytest.mark.parametrize("how", HOW)
def test_bursts_that_nobody_expected(gl, how):
    """From nothing to ten events a pixel: more than was sent off, and more than there was room for; causes an
    interval of many digits."""
    rng = np.random.default_rng(4)
    steps = np.array([0.0, 0.0, 2.5, 2.5, 0.3, 2.9, 2.9, 2.8])[:, None, None]
    clip = np.exp(steps * rng.uniform(0.3, 1.0, (8, 40, 52))).astype(np.float32)
    times = np.cumsum([0, 1000, 10**6, 10**9, 5 * 10**10, 10**5, 10**7, 10**8])
    config = EsimConfig(contrast_threshold=0.2, threshold_sigma=0.01)
    fast, card = Esim(40, 52, config, 1), CardEsim(40, 52, config, 1, gl=gl, **how)
    room = card._room.capacity
    assert_same(run_late(card, clip, times), run(fast, clip, times))
    assert card._room.capacity > 4 * room
    card.release()


@pytest.mark.parametrize("count", [0, 1, 63, 64, 129, 5000])
def test_the_sort_is_stable(gl, count):
    """Of words made by hand: equal times stay in their order, whatever the number of events, parts and digits."""
    from blinkgl.card.kernels import HEAD_BYTES, Kernels, SortRoom

    rng = np.random.default_rng(count)
    t, rest = rng.integers(0, 40, count) * rng.integers(1, 2**24, count), np.arange(count)
    words = (t << 33 | rest).astype(np.int64)
    parts = 2 * -(-count // 128)
    head = np.zeros(HEAD_BYTES // 4, np.uint32)
    head[7], head[11], head[12:18] = count, parts, (-(-parts // 64), 1, 1, -(-parts // 128), 1, 1)
    head[18] = parts // 2
    buffers = gl.ctx.buffer(head.tobytes()), gl.ctx.buffer(np.resize(words, 5001).tobytes() if count else bytes(8))
    room = SortRoom(gl, max(1, buffers[1].size // 8))
    sorted_ = Kernels(gl).sort(*buffers, room, int(t.max(initial=0)).bit_length())
    got = np.frombuffer(sorted_.read(8 * count), np.int64) if count else words
    np.testing.assert_array_equal(got, words[np.argsort(t, kind="stable")])
    for thing in (*buffers, room):
        thing.release()


def test_a_bad_frame_is_told_late_and_forgotten(gl):
    clip, times = random_clip(1, frames=5)
    bad = clip[2].copy()
    bad[3, 4] = np.nan
    good, (wrong,) = textures(gl, clip), textures(gl, [bad])
    card, fast = CardEsim(37, 45, None, 2, gl=gl, late=True), Esim(37, 45, None, 2)
    parts = [card.step(good[0], int(times[0])), card.step(good[1], int(times[1])), card.step(wrong, int(times[2]))]
    with pytest.raises(EventDataError, match=r"^frame 2: intensity at pixel x=4, y=3") as caught:
        card.step(good[3], int(times[3]))
    assert caught.value.t_ns == times[2] and card.t_ns == times[1] and card.frames == 2
    parts += [card.step(f, int(t)) for f, t in zip(good[3:], times[3:])] + [card.flush()]
    kept = [0, 1, 3, 4]
    assert_same(Events.concatenate(parts), run(fast, clip[kept], times[kept]))
    for thing in (card, wrong, *good):
        thing.release()


def test_steps_that_stay_and_steps_that_come(gl):
    """Neither loses what the other has under way; sinks see a step's events whatever became of their order."""
    clip, times = random_clip(3, frames=7)
    fast, card = Esim(37, 45), CardEsim(37, 45, gl=gl, late=True, sorts=True)
    wanted = [fast.step(f, int(t)) for f, t in zip(clip, times)]
    sink, read = Counts(card), []
    sink.begin(int(times[0]) // 1000, int(times[-1]) // 1000 + 1)
    for k, (frame, t) in enumerate(zip(clip, times)):
        if k in (3, 5):
            assert card.advance(frame, int(t)) == len(wanted[k])
            sink.add()
        else:
            read.append(card.step(frame, int(t)))
    read.append(card.flush())
    assert_same(Events.concatenate(read), Events.concatenate([e for k, e in enumerate(wanted) if k not in (3, 5)]))
    assert sink.read().sum() == len(wanted[3]) + len(wanted[5])
    sink.release()
    card.release()


def test_a_card_that_does_not_answer(gl, monkeypatch):
    slot = Slot(gl, 64)
    slot.seal()
    slot._wait_for = lambda *_: 0x911B  # timed out
    with pytest.raises(GLError, match=r"^events\.device: the card does not answer any more .*events\.device: cpu"):
        slot.wait()
    slot.release()


def test_an_old_driver_reads_back_at_once(gl, monkeypatch):
    monkeypatch.setattr("blinkgl.card.emulator.maps_persistently", lambda gl: False)
    clip, times = random_clip(3, frames=3)
    card = CardEsim(37, 45, gl=gl, late=True)
    assert not card.lags
    assert_same(run(card, clip, times), run(Esim(37, 45), clip, times))
    card.release()
