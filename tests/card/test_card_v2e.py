"""V2E on the card: the events, and the state, of the numba kernel and of its slow twin, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import CardV2e, Counts
from blinkgl.card.kernels import Rounding
from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import V2e
from blinkgl.types.events import Events
from tests.card.test_frames_on_card import textures
from tests.events.clips import assert_same, random_clip, run
from tests.events.reference import ReferenceV2e

CLEAN = dict(preset="clean")
NOISE = dict(shot_noise_rate_hz=100.0, leak_rate_hz=20.0, hot_pixel_fraction=0.02, causes=True)
VARIANTS = {
    "clean": dict(preset="clean", threshold_sigma=0.05),
    "default": dict(),
    "noisy": dict(preset="noisy", **NOISE, refractory_us=300.0),
    "no_dead_time": dict(**NOISE, refractory_us=0.0),
    "hum": dict(photoreceptor_noise=True, shot_noise_rate_hz=20.0, second_cutoff_hz=200.0, causes=True),
}
MORE = {
    "low_pass": dict(**CLEAN, cutoff_hz=300.0),
    "dead_time": dict(**CLEAN, refractory_us=500.0),
    "dead_time_and_low_pass": dict(**CLEAN, cutoff_hz=100.0, refractory_us=300.0),
    "leak": dict(**CLEAN, leak_rate_hz=50.0, leak_jitter=0.0),
    "shots_alone": dict(**CLEAN, shot_noise_rate_hz=100.0),
    "fine": dict(contrast_threshold=0.01, threshold_sigma=0.001, refractory_us=0.0),
    "balanced": dict(start="balanced", contrast_threshold_off=0.3, full_scale=1000.0),
}


def assert_same_state(a, b) -> None:
    states = a.state_dict(), b.state_dict()
    assert set(states[0]) == set(states[1])
    for name, array in states[0].items():
        np.testing.assert_array_equal(states[1][name], array, err_msg=name)


def compare(gl, config, seed, clip, times, slow=False) -> Events:
    size = clip[0].shape
    fast, card = V2e(*size, config, seed), CardV2e(*size, config, seed, gl=gl)
    events = run(card, clip, times)
    assert_same(events, run(fast, clip, times))
    assert_same_state(fast, card)
    assert card.saturated == fast.saturated
    if slow:
        assert_same(events, run(ReferenceV2e(*size, config, seed), clip, times))
    card.release()
    return events


@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_numba_and_slow_twin(gl, variant):
    clip, times = random_clip(1, frames=6)
    config = V2eConfig(**VARIANTS[variant])
    assert len(compare(gl, config, 1, clip, times, slow=True)) > 1000
    clip, times = random_clip(2, frames=7)
    compare(gl, config, 2**63 + 9, clip, times)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2**63 + 9])
@pytest.mark.parametrize("variant", [*VARIANTS, *MORE])
def test_every_variant_and_seed(gl, variant, seed):
    clip, times = random_clip(seed % 7 + 3, frames=8)
    compare(gl, V2eConfig(**{**VARIANTS, **MORE}[variant]), seed, clip, times, slow=variant != "fine")


@pytest.mark.parametrize("density", [0.0, 0.02, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (3, 1111), (90, 128)])
def test_every_size_and_density(gl, size, density):
    rng = np.random.default_rng(7)
    log = np.cumsum(rng.normal(0, 1.2, (4, *size)) * (rng.random((4, *size)) < density), axis=0)
    clip = np.exp(np.clip(log, -8, 3)).astype(np.float32)
    compare(gl, V2eConfig(shot_noise_rate_hz=20.0), 3, clip, 1 + np.arange(4) * 1_000_003)


@pytest.mark.parametrize("variant", ["clean", "noisy"])
def test_intervals_of_any_length(gl, variant):
    """From one nanosecond to six seconds, in which a dead time ends long after, or thousands of noise events come."""
    clip, _ = random_clip(4, frames=7, height=12, width=20)
    times = -(10**15) + np.cumsum([0, 1, 999, 2**31 - 1, 10**6, 6 * 10**9, 5])
    compare(gl, V2eConfig(**VARIANTS[variant]), 5, clip, times)


def test_more_noise_than_was_likely(gl, monkeypatch):
    """Nothing fires, and the step is done again with more room; also where that is found one frame later."""
    monkeypatch.setattr("blinkgl.card.v2e.FEW_SHOTS", 1)
    clip, times = random_clip(3, frames=5)
    config = V2eConfig(shot_noise_rate_hz=300.0)
    values = CardV2e._values

    def unlikely(self, t_ns):
        room = self._room.shots
        made = {**values(self, t_ns), "candidates": 1}
        self._room.make_room_for_shots(room)  # as if it had not been asked for
        return made

    monkeypatch.setattr(CardV2e, "_values", unlikely)
    wanted = run(V2e(37, 45, config, 2), clip, times)
    for late in (False, True):
        card = CardV2e(37, 45, config, 2, gl=gl, late=late)
        room = card._room.shots
        assert_same(Events.concatenate([run(card, clip, times), card.flush()]), wanted)
        assert card._room.shots > 4 * room
        card.release()


def test_state_goes_from_one_device_to_the_other(gl):
    """Saved in the middle on either, restored on either: the rest of the clip is the same. Leaks begin anew in it."""
    clip, times = random_clip(3, frames=7)
    config = V2eConfig(**VARIANTS["noisy"])
    make = {"cpu": lambda: V2e(37, 45, config, 8), "gl": lambda: CardV2e(37, 45, config, 8, gl=gl)}
    whole = run(make["cpu"](), clip, times)
    assert V2e(37, 45, config, 8)._rebase_ns < times[2] - times[0]
    for first in make:
        begun = make[first]()
        head = run(begun, clip[:4], times[:4])
        state = begun.state_dict()
        for second in make:
            resumed, again = make[second](), make[second]()
            resumed.load_state_dict(state)
            assert_same(Events.concatenate([head, run(resumed, clip[4:], times[4:])]), whole)
            again.load_state_dict(state)
            for name, array in state.items():
                np.testing.assert_array_equal(again.state_dict()[name], array, err_msg=name)
    assert len(head) < len(whole)


@pytest.mark.parametrize("how", [{"late": True}, {"late": True, "sorts": True}])
def test_late_sorted_and_from_textures(gl, how):
    clip, times = random_clip(3, frames=8)
    clip[5:] = clip[5]  # nothing, after much
    config, frames = V2eConfig(**VARIANTS["noisy"]), textures(gl, clip)
    fast, card = V2e(37, 45, config, 2), CardV2e(37, 45, config, 2, gl=gl, **how)
    assert card.lags
    assert_same(Events.concatenate([run(card, frames, times), card.flush()]), run(fast, clip, times))
    assert_same_state(fast, card)
    for thing in (card, *frames):
        thing.release()


@pytest.mark.parametrize("late", [False, True])
def test_a_bad_frame_leaves_the_state_alone(gl, late):
    """Clocks of noise, photoreceptors and leaks that were to begin anew among it."""
    clip, times = random_clip(1, frames=6)
    bad = clip[2].copy()
    bad[3, 4] = np.nan
    good, (wrong,) = textures(gl, clip), textures(gl, [bad])
    config = V2eConfig(**VARIANTS["noisy"])
    fast, card = V2e(37, 45, config, 2), CardV2e(37, 45, config, 2, gl=gl, late=late)
    parts = [card.step(good[k], int(times[k])) for k in range(2)]
    with pytest.raises(EventDataError, match=r"^frame 2: intensity at pixel x=4, y=3"):
        parts.append(card.step(wrong, int(times[2])))
        card.step(good[3], int(times[3]))
    assert card.t_ns == times[1] and card.frames == 2
    parts += [card.step(good[k], int(times[k])) for k in range(3, 6)] + [card.flush()]
    kept = [0, 1, 3, 4, 5]
    assert_same(Events.concatenate(parts), run(fast, clip[kept], times[kept]))
    assert_same_state(fast, card)
    for thing in (card, wrong, *good):
        thing.release()


@pytest.mark.parametrize("values", [CLEAN, dict(), dict(refractory_us=0.0)])
def test_saturation_cuts_the_same_events(gl, values):
    config = V2eConfig(**values, contrast_threshold=0.02, threshold_sigma=0.002, max_events_per_step=1000)
    clip, times = random_clip(6, frames=5)
    fast, card = V2e(37, 45, config, 2), CardV2e(37, 45, config, 2, gl=gl)
    assert_same(run(card, clip, times), run(fast, clip, times))
    assert card.saturated == fast.saturated > 1000
    card.release()


def test_nothing_is_lost_where_the_buffer_is_too_small(gl):
    config = V2eConfig(contrast_threshold=0.05, refractory_us=0.0)
    clip = np.exp(np.array([0.0, 1.0, -1.0, 0.0])[:, None, None] * np.ones((4, 64, 64))).astype(np.float32)
    for late in (False, True):
        fast, card = V2e(64, 64, config, 1), CardV2e(64, 64, config, 1, gl=gl, late=late)
        room, times = card._room.capacity, np.arange(4) * 10**7
        assert_same(Events.concatenate([run(card, clip, times), card.flush()]), run(fast, clip, times))
        assert card._room.capacity > 8 * room
        assert_same_state(fast, card)
        card.release()


def test_codes(gl):
    clip, times = random_clip(2, frames=6, dtype=np.uint8)
    fast, card = V2e(37, 45, None, 4), CardV2e(37, 45, None, 4, gl=gl)
    for emulator in (fast, card):
        emulator.set_decode((np.arange(256) / 255.0) ** 2.2)
    assert_same(run(card, clip, times), run(fast, clip, times))
    assert_same_state(fast, card)
    card.release()


def test_a_sink_does_not_take_causes_for_rows(gl):
    clip, times = random_clip(3, frames=5)
    config = V2eConfig(**VARIANTS["noisy"])
    card, counts = CardV2e(37, 45, config, 2, gl=gl), np.zeros((2, 37, 45), np.int64)
    events, sink = run(V2e(37, 45, config, 2), clip, times), Counts(card)
    assert set(events.cause) == {0, 1, 2, 3}
    sink.begin(int(times[0]) // 1000, int(times[-1]) // 1000 + 1)
    for frame, t in zip(clip, times):
        card.advance(frame, int(t))
        sink.add()
    np.add.at(counts, (events.p, events.y, events.x), 1)
    np.testing.assert_array_equal(sink.read(), counts)
    sink.release()
    card.release()


def test_light_that_fades_to_nothing(gl):
    """Lags that run out and light below all numbers: nothing subnormal, which a card may take for zero, decides."""
    clip = np.full((40, 8, 8), 0.3, np.float32)
    clip[0] = np.float32(1e-44) * np.arange(64).reshape(8, 8)
    clip[20:] = np.exp2(-np.arange(64.0) * 2.5).reshape(8, 8)
    times = np.arange(40) * 5_000_000
    compare(gl, V2eConfig(**CLEAN, cutoff_hz=1000.0), 1, clip, times)
    compare(gl, V2eConfig(second_cutoff_hz=300.0, leak_rate_hz=0.0), 1, clip, times)


def test_too_much_noise_is_said_in_the_same_words(gl):
    frame, said = np.full((37, 45), 0.2, np.float32), []
    config = V2eConfig(shot_noise_rate_hz=1000.0, max_events_per_step=1000)
    for emulator in (V2e(37, 45, config), CardV2e(37, 45, config, gl=gl)):
        emulator.step(frame, 0)
        with pytest.raises(EventDataError, match=r"^frame 1: more shot noise than max_events_per_step") as caught:
            emulator.step(frame, 10**10)
        said.append(str(caught.value))
        emulator.step(frame, 10**5)
        emulator.release()
    assert said[0] == said[1]


@pytest.mark.slow
@pytest.mark.parametrize("rounding", [Rounding(True, True, False), Rounding(True, True, True)])
def test_in_whole_numbers(gl, rounding):
    """As on a card that rounds otherwise."""
    config = V2eConfig(**VARIANTS["noisy"])
    clip, times = random_clip(1, frames=5)
    fast, card = V2e(37, 45, config, 1), CardV2e(37, 45, config, 1, gl=gl, rounding=rounding)
    assert_same(run(card, clip, times), run(fast, clip, times))
    assert_same_state(fast, card)
    card.release()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("size", [(480, 640), (1080, 1920)])
@pytest.mark.parametrize("variant", VARIANTS)
def test_large_pictures(gl, size, seed, variant):
    rng, config = np.random.default_rng(seed), V2eConfig(**VARIANTS[variant])
    fast, card = V2e(*size, config, seed), CardV2e(*size, config, seed, gl=gl)
    for k, density in enumerate((0, 0.02, 0.3, 1.0, 0.0)):
        frame = np.exp(rng.normal(-1, 0.7, size) * (rng.random(size) < density)).astype(np.float32)
        assert_same(card.step(frame, k * 10**6), fast.step(frame, k * 10**6))
    card.release()


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["default", "noisy"])
def test_a_hundred_million_events(gl, variant):
    """Dense ones, with a restart on the other device among them: no step differs, nor does the state."""
    size, rng = (480, 640), np.random.default_rng(5)
    config = V2eConfig(**VARIANTS[variant], contrast_threshold=0.04, threshold_sigma=0.004)
    frames = [np.exp(rng.uniform(-3, 0, size)).astype(np.float32) for _ in range(3)]
    fast, card = V2e(*size, config, 4), CardV2e(*size, config, 4, gl=gl)
    count, k = 0, 0
    while count < 10**8:
        a, b = (one.step(frames[k % 3], k * 10**7) for one in (fast, card))
        assert_same(b, a)
        count, k = count + len(a), k + 1
        if k == 4:
            states = fast.state_dict(), card.state_dict()
            fast.load_state_dict(states[1])
            card.load_state_dict(states[0])
    assert k > 6
    assert_same_state(fast, card)
    card.release()
