"""ESIM on the card: the events of the numba kernel and of its slow twin, bit for bit."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import CardEsim
from blinkgl.card.kernels import Rounding
from blinkgl.card.room import Room
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError, GLError
from blinkgl.events import Esim
from tests.events.clips import assert_same, random_clip, run
from tests.events.reference import ReferenceEsim

VARIANTS = {
    "plain": dict(threshold_sigma=0.0),
    "spread": dict(contrast_threshold=0.15, contrast_threshold_off=0.3, threshold_sigma=0.05),
    "refractory": dict(threshold_sigma=0.0, refractory_us=2500.0),
    "jitter": dict(threshold_sigma=0.02, threshold_jitter=0.05, refractory_us=100.5),
    "fine": dict(contrast_threshold=0.004, threshold_sigma=0.001),
}


@pytest.mark.parametrize("seed", [0, 1, 2**63 + 9])
@pytest.mark.parametrize("variant", VARIANTS)
def test_equals_numba_and_slow_twin(gl, variant, seed):
    clip, times = random_clip(seed % 7, frames=5 if variant in ("fine", "jitter") else 8)
    config = EsimConfig(**VARIANTS[variant])
    card = CardEsim(37, 45, config, seed, gl=gl)
    events = run(card, clip, times)
    assert len(events) > 2000
    assert_same(events, run(Esim(37, 45, config, seed), clip, times))
    if seed == 1 and variant != "fine":
        assert_same(events, run(ReferenceEsim(37, 45, config, seed), clip, times))
    card.release()


@pytest.mark.parametrize("density", [0.0, 0.02, 0.5, 1.0])
@pytest.mark.parametrize("size", [(1, 1), (16, 16), (3, 1111), (90, 128)])
def test_every_size_and_density(gl, size, density):
    """Sizes that fill no word, no block and no group; frames in which nothing, little or everything fires."""
    rng = np.random.default_rng(7)
    log = np.cumsum(rng.normal(0, 1.2, (4, *size)) * (rng.random((4, *size)) < density), axis=0)
    clip = np.exp(np.clip(log, -8, 3)).astype(np.float32)
    config = EsimConfig(threshold_sigma=0.03)
    fast, card = Esim(*size, config, 3), CardEsim(*size, config, 3, gl=gl)
    for k, frame in enumerate(clip):
        assert_same(card.step(frame, 1 + k * 1_000_003), fast.step(frame, 1 + k * 1_000_003))
    card.release()


@pytest.mark.parametrize("variant", ["spread", "refractory"])
def test_intervals_of_any_length(gl, variant):
    """From one nanosecond to 17 minutes; from 2^31 ns on the division has two digits."""
    clip, _ = random_clip(4, frames=8)
    times = -(10**15) + np.cumsum([0, 1, 999, 2**31 - 1, 2**31, 10**11, (2**30 - 1) * 1000, 5])
    config = EsimConfig(**VARIANTS[variant])
    card = CardEsim(37, 45, config, 5, gl=gl)
    assert_same(run(card, clip, times), run(Esim(37, 45, config, 5), clip, times))
    card.release()


@pytest.mark.parametrize("soft_float", [False, True])
def test_codes_and_causes(gl, soft_float):
    clip, times = random_clip(2, frames=6, dtype=np.uint8)
    config, table = EsimConfig(causes=True), (np.arange(256) / 255.0) ** 2.2
    fast, card = Esim(37, 45, config, 4), CardEsim(37, 45, config, 4, gl=gl, rounding=Rounding(soft_float))
    for emulator in (fast, card):
        emulator.set_decode(table)
    events = run(card, clip, times)
    assert events.cause is not None and len(events) > 1000
    assert_same(events, run(fast, clip, times))
    card.release()


@pytest.mark.parametrize("variant", ["spread", "jitter"])
def test_state_goes_from_one_device_to_the_other(gl, variant):
    """Saved in the middle on either, restored on either: the rest of the clip is the same."""
    clip, times = random_clip(3, frames=7)
    config = EsimConfig(**VARIANTS[variant])
    make = {"cpu": lambda: Esim(37, 45, config, 8), "gl": lambda: CardEsim(37, 45, config, 8, gl=gl)}
    whole = run(make["cpu"](), clip, times)
    for first in make:
        begun = make[first]()
        head = run(begun, clip[:4], times[:4])
        state = begun.state_dict()
        for second in make:
            resumed = make[second]()
            resumed.load_state_dict(state)
            assert_same(type(head).concatenate([head, run(resumed, clip[4:], times[4:])]), whole)
            again = make[second]()
            again.load_state_dict(state)
            for name, array in state.items():  # a state that is only passed on stays what it is
                np.testing.assert_array_equal(again.state_dict()[name], array, err_msg=name)
    assert len(head) < len(whole)


def test_nothing_is_lost_where_the_buffer_is_too_small(gl):
    """10 events a pixel where there is room for a quarter of one: emitted again from the records, into a larger one."""
    config = EsimConfig(contrast_threshold=0.1, threshold_sigma=0.02, threshold_jitter=0.01)
    clip = np.exp(np.array([0.0, 1.0, -1.0, 0.0])[:, None, None] * np.ones((4, 64, 64))).astype(np.float32)
    fast, card = Esim(64, 64, config, 1), CardEsim(64, 64, config, 1, gl=gl)
    room = card._room.capacity
    for k, frame in enumerate(clip):
        events = card.step(frame, k * 10**6)
        assert_same(events, fast.step(frame, k * 10**6))
    assert card._room.capacity > 8 * room
    card.release()


@pytest.mark.parametrize("variant", ["spread", "refractory"])
def test_saturation_cuts_the_same_events(gl, variant):
    config = EsimConfig(**{**VARIANTS[variant], "contrast_threshold": 0.02}, max_events_per_step=1000)
    clip, times = random_clip(6, frames=5)
    fast, card = Esim(37, 45, config, 2), CardEsim(37, 45, config, 2, gl=gl)
    assert_same(run(card, clip, times), run(fast, clip, times))
    assert card.saturated == fast.saturated > 1000
    card.release()


def test_a_bad_frame_leaves_the_state_alone(gl):
    clip, times = random_clip(1, frames=4)
    fast, card = Esim(37, 45, None, 2), CardEsim(37, 45, None, 2, gl=gl)
    bad = clip[2].copy()
    bad[3, 4] = np.nan
    for emulator in (fast, card):
        emulator.step(clip[0], int(times[0]))
        with pytest.raises(EventDataError, match=r"pixel x=4, y=3"):
            emulator.step(bad, int(times[1]))
    assert_same(run(card, clip[1:], times[1:]), run(fast, clip[1:], times[1:]))
    card.release()


def test_another_context_in_between(gl):
    """The renderer's or somebody else's: a step makes its own current."""
    from blinkgl.gl import create_context

    clip, times = random_clip(1, frames=4)
    card = CardEsim(37, 45, None, 2, gl=gl)
    with create_context() as other:
        events = []
        for frame, t in zip(clip, times):
            events.append(card.step(frame, int(t)))
            other.make_current()
        assert_same(type(events[0]).concatenate(events), run(Esim(37, 45, None, 2), clip, times))
    gl.make_current()
    card.release()


def test_what_it_does_not_do_is_said_in_one_line(gl, monkeypatch):
    with pytest.raises(
        EventDataError, match=r"^timeline\.reconstruction: .*straight lines.*'pchip'.*events\.device: cpu"
    ):
        CardEsim(8, 8, None, 0, "pchip", gl=gl)
    with pytest.raises(EventDataError, match=r"^events\.threshold_jitter: .*at most 1\.4"):
        CardEsim(8, 8, EsimConfig(threshold_jitter=3.0), gl=gl)
    CardEsim(8, 8, EsimConfig(threshold_jitter=1.3), gl=gl).release()
    with pytest.raises(GLError, match=r"^events\.device: 30000x30000 pixels are too many .*MiB.*events\.device: cpu"):
        Room(gl, 30000**2, "30000x30000 pixels", (30000, 30000), spread=False, more=False)

    class Old:
        version, renderer = "4.2", "an old card"
        ctx = type("ctx", (), {"version_code": 420})

    with pytest.raises(GLError, match=r"^events\.device: no compute shaders .*4\.2.*OpenGL 4\.3"):
        CardEsim(8, 8, gl=Old())


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("size", [(480, 640), (1080, 1920)])
@pytest.mark.parametrize("variant", ["spread", "refractory", "jitter"])
def test_large_pictures(gl, size, seed, variant):
    rng, config = np.random.default_rng(seed), EsimConfig(**VARIANTS[variant])
    fast, card = Esim(*size, config, seed), CardEsim(*size, config, seed, gl=gl)
    for k, density in enumerate((0, 0.02, 0.3, 0.0) if variant == "jitter" else (0, 0.02, 0.3, 1.0, 1.0, 0.0)):
        frame = np.exp(rng.normal(0, 0.7, size) * (rng.random(size) < density)).astype(np.float32)
        assert_same(card.step(frame, k * 10**6), fast.step(frame, k * 10**6))
    card.release()


@pytest.mark.slow
def test_a_hundred_million_events(gl):
    rng, config = np.random.default_rng(1), EsimConfig(contrast_threshold=0.1)
    clip = np.exp(rng.normal(0, 0.6, (5, 480, 640))).astype(np.float32)
    fast, card, count, k = Esim(480, 640, config, 1), CardEsim(480, 640, config, 1, gl=gl), 0, 0
    while count < 10**8:
        events = card.step(clip[k % 5], k * 777_777)
        assert_same(events, fast.step(clip[k % 5], k * 777_777))
        count, k = count + len(events), k + 1
    card.release()
