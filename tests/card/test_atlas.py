"""Batches: sequences that share one event kernel have the events and the states that each has alone."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import Atlas
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim, Events
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.items import EventChunk, GroundTruth
from blinkgl.sequence.side_by_side import side_by_side
from tests.card.test_choice import config_of
from tests.card.test_frames_on_card import textures
from tests.events.clips import assert_same, random_clip, run

SIZE = 37, 45
CONFIGS = (
    EsimConfig(threshold_sigma=0.03),
    EsimConfig(contrast_threshold=0.1, contrast_threshold_off=0.3, threshold_sigma=0.0, log_eps=0.02),
    EsimConfig(threshold_sigma=0.0, refractory_us=700.0),
    EsimConfig(threshold_jitter=0.02),
    EsimConfig(contrast_threshold=0.02, threshold_sigma=0.0, max_events_per_step=1000),
)


def clips(count, frames=6, shorter=1):
    """Sequences of times and lengths of their own."""
    for k in range(count):
        clip, times = random_clip(k, frames=frames - shorter * (k % 2), height=SIZE[0], width=SIZE[1])
        yield clip, times * (1 + 3 * k) + 1_000_003 * k


def in_turn(emulators, given):
    """The events of each, frame by frame in turn; who is at the end is flushed."""
    found = [[] for _ in emulators]
    for n in range(max(len(times) for _, times in given) + 1):
        for emulator, (frames, times), events in zip(emulators, given, found):
            if n < len(times):
                events.append(emulator.step(frames[n], int(times[n])))
            elif n == len(times):
                events.append(emulator.flush())
    return [Events.concatenate(events) for events in found]


@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("given", ["arrays", "textures"])
def test_each_has_the_events_that_it_has_alone(gl, given, late):
    with Atlas(gl, *SIZE, 6, jitter=True, refractory=True, late=late) as atlas:
        emulators = [atlas.emulator(config, 3 + k) for k, config in enumerate(CONFIGS)]
        sequences = list(clips(len(CONFIGS)))
        frames = [(textures(gl, clip) if given == "textures" else clip, times) for clip, times in sequences]
        found = in_turn(emulators, frames)
        assert atlas.rounds == max(len(times) for _, times in sequences) - 1, "together, not one by one"
        for k, (emulator, (clip, times)) in enumerate(zip(emulators, sequences)):
            alone = Esim(*SIZE, CONFIGS[k], 3 + k)
            assert_same(found[k], run(alone, clip, times))
            assert len(found[k]) > 500 and emulator.saturated == alone.saturated
            assert (emulator.saturated > 0) == (k == 4)
            for name, array in emulator.state_dict().items():
                np.testing.assert_array_equal(array, alone.state_dict()[name], err_msg=f"{k}: {name}")


def test_nobody_has_to_keep_step(gl):
    """One is three frames ahead, one comes late into the tile of another that left; long intervals; more events than
    there is room for."""
    sequences = list(clips(3, 8, 0))
    wanted = [run(Esim(*SIZE, CONFIGS[1], k), *one) for k, one in enumerate(sequences)]
    with Atlas(gl, *SIZE, 2, spread=False) as atlas:
        a, b = atlas.emulator(CONFIGS[1], 0), atlas.emulator(CONFIGS[1], 1)
        with pytest.raises(EventDataError, match=r"^tiles: every tile is in use \(got 2\); expected release one"):
            atlas.emulator(CONFIGS[1], 2)
        capacity, parts = atlas.room.capacity, [[], [], []]
        step = lambda emulator, k, n: parts[k].append(emulator.step(sequences[k][0][n], int(sequences[k][1][n])))
        for n in range(3):
            step(a, 0, n)
        for n in range(8):
            step(b, 1, n)
        parts[1].append(b.flush())
        b.release()
        b.release()
        c = atlas.emulator(CONFIGS[1], 2)
        assert c.tile == b.tile
        for n in range(8):
            step(c, 2, n)
            if n >= 3:
                step(a, 0, n)
        parts[0].append(a.flush())
        parts[2].append(c.flush())
        for k in range(3):
            assert_same(Events.concatenate(parts[k]), wanted[k])
        wild = np.exp(np.random.default_rng(0).normal(0, 3, (2, *SIZE))).astype(np.float32)
        long = [0, 5_000_000_000]
        a.release()
        d = atlas.emulator(CONFIGS[4], 9)
        for n in range(2):
            c.step(wild[n], int(sequences[2][1][-1]) + 1 + n)
            d.step(wild[n], long[n])
        assert_same(d.flush(), run(Esim(*SIZE, CONFIGS[4], 9), wild, long))
        assert atlas.room.capacity > capacity


@pytest.mark.parametrize("late", [False, True])
def test_a_frame_that_cannot_be_used_is_its_own_sequences_trouble(gl, late):
    good = list(clips(3, 5, 0))
    bad = good[1][0][2].copy()
    bad[3, 4] = np.inf
    with Atlas(gl, *SIZE, 3, late=late) as atlas:
        emulators = [atlas.emulator(CONFIGS[0], k) for k in range(3)]
        shown = [textures(gl, clip) for clip, _ in good]
        (wrong,) = textures(gl, [bad])
        parts = [[], [], []]
        for n in range(5):
            for k in range(3):
                t_ns = int(good[k][1][n])
                if (k, n) == (1, 2):
                    parts[k].append(emulators[k].step(wrong, t_ns))
                    continue
                if (k, n) == (1, 3):
                    with pytest.raises(EventDataError, match=r"^frame 2: intensity at pixel x=4, y=3 cannot") as caught:
                        emulators[k].step(shown[k][n], t_ns)
                    assert caught.value.pixel == (4, 3) and caught.value.t_ns == int(good[1][1][2])
                parts[k].append(emulators[k].step(shown[k][n], t_ns))
        for k in range(3):
            parts[k].append(emulators[k].flush())
            kept = [n for n in range(5) if (k, n) != (1, 2)]
            assert_same(
                Events.concatenate(parts[k]), run(Esim(*SIZE, CONFIGS[0], k), good[k][0][kept], good[k][1][kept])
            )


def test_what_a_batch_does_not_do(gl):
    with Atlas(gl, 8, 8, 2, spread=False) as atlas:
        for key, value in (("threshold_sigma", 0.03), ("threshold_jitter", 0.1), ("refractory_us", 5.0)):
            with pytest.raises(EventDataError, match=rf"^events\.{key}: the batch was made without it"):
                atlas.emulator(EsimConfig(**{"threshold_sigma": 0.0, key: value}))
        one = atlas.emulator(EsimConfig(threshold_sigma=0.0))
        one.step(np.ones((8, 8), np.float32), 0)
        one.step(np.full((8, 8), 3, np.float32), 10)
        for wrong in (one.state_dict, lambda: one.load_state_dict({}), lambda: one.advance(np.ones((8, 8)), 20)):
            with pytest.raises(EventDataError):
                wrong()
        for arguments, said in (
            ((V2eConfig(),), r"^events\.emulator: the batch is of another emulator \(got 'v2e'\); expected esim"),
            ((EsimConfig(), 0, "pchip"), r"^timeline\.reconstruction: the card follows straight lines"),
            ((EsimConfig(), 0, "linear", (8, 9)), r"^camera: sequences of a batch are of one size .*8, 9"),
        ):
            with pytest.raises(EventDataError, match=said):
                atlas.emulator(*arguments)
    with pytest.raises(EventDataError, match=r"^tiles: so many sequences of 8x4096 .*got 17\); expected 1 to 16"):
        Atlas(gl, 4096, 8, 17)


def test_whole_sequences_side_by_side(gl, tmp_path):
    """Three scenes in two tiles: the events and the flow of each are those that it has alone."""
    config = config_of(tmp_path, timeline={"kind": "displacement", "max_px": 2.0}, labels={"flow": ["forward"]})
    alone, together = {}, {}

    def kept(table, number, item):
        events, flow = table.setdefault(number, ([], []))
        if isinstance(item, EventChunk):
            events.append(item.events)
        elif isinstance(item, GroundTruth) and item.frame.forward is not None:
            flow.append((item.t_ns, item.frame.forward.flow.tobytes()))

    for number in range(3):
        with simulate_sequence(config, number, gl) as sequence:
            for item in sequence:
                kept(alone, number, item)
    camera = config.camera
    with Atlas(gl, camera.height, camera.width, 2) as atlas:
        made = (simulate_sequence(config, number, gl, atlas=atlas) for number in range(3))
        for number, item in side_by_side(made, 2):
            kept(together, number, item)
        frames = atlas.rounds
        made = side_by_side((simulate_sequence(config, n, gl, atlas=atlas) for n in range(2)), 2)
        next(made)
        made.close()
        assert atlas.emulator(config.events).tile == 0, "closed, so that its tile is free again"
    for number in range(3):
        assert_same(Events.concatenate(together[number][0]), Events.concatenate(alone[number][0]))
        assert together[number][1] == alone[number][1] and len(alone[number][1]) == 3
    assert frames < sum(len(events) for events, _ in alone.values())
