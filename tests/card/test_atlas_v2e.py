"""Batches of V2E: sequences that share one event kernel have the events and the states that each has alone."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import AtlasV2e, CardV2e, Counts, TileSinks
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Events, V2e
from blinkgl.sequence import simulate_sequence
from blinkgl.sequence.items import EventChunk
from blinkgl.sequence.side_by_side import side_by_side
from tests.card.test_atlas import SIZE, clips, in_turn
from tests.card.test_card_v2e import CLEAN, MORE, VARIANTS, assert_same_state
from tests.card.test_choice import config_of
from tests.card.test_frames_on_card import textures
from tests.events.clips import assert_same, random_clip, run

OTHERS = (
    {},
    dict(contrast_threshold=0.15, contrast_threshold_off=0.3, full_scale=700.0),
    dict(contrast_threshold=0.3, threshold_sigma=0.05),
)
"""What sequences of a batch need not share."""


def configs_of(variant) -> list[V2eConfig]:
    return [V2eConfig(**{**{**VARIANTS, **MORE}[variant], **other}) for other in OTHERS]


def compare(gl, variant, late) -> list[V2e]:
    configs, sequences = configs_of(variant), list(clips(3))
    with AtlasV2e(gl, *SIZE, 4, configs[0], late=late) as atlas:
        emulators = [atlas.emulator(config, 2**63 + k) for k, config in enumerate(configs)]
        frames = [(textures(gl, clip) if late else clip, times) for clip, times in sequences]
        found, every = in_turn(emulators, frames), []
        assert atlas.rounds == max(len(times) for _, times in sequences) - 1, "together, not one by one"
        for k, (emulator, (clip, times)) in enumerate(zip(emulators, sequences, strict=True)):
            alone = V2e(*SIZE, configs[k], 2**63 + k)
            assert_same(found[k], run(alone, clip, times))
            assert len(found[k]) > 500 and emulator.saturated == alone.saturated
            assert_same_state(alone, emulator)
            every.append(alone)
    return every


@pytest.mark.parametrize("variant", VARIANTS)
def test_each_has_the_events_that_it_has_alone(gl, variant):
    """Causes among them, and leaks that begin anew in the middle; textures, and read back by memory that both see."""
    alone = compare(gl, variant, late=True)
    if variant == "noisy":
        assert alone[2]._epoch_ns[0] > 1_000_003 * 2


@pytest.mark.slow
@pytest.mark.parametrize("late", [False, True])
@pytest.mark.parametrize("variant", [*VARIANTS, *MORE])
def test_every_variant(gl, variant, late):
    compare(gl, variant, late)


def test_nobody_has_to_keep_step(gl):
    """One is three frames ahead, one comes late into the tile of another that left, whose clocks, noise and dead times
    it finds there; an interval of five seconds."""
    config, sequences = V2eConfig(**VARIANTS["noisy"]), list(clips(3, 7, 0))
    wanted = [run(V2e(*SIZE, config, k), *one) for k, one in enumerate(sequences)]
    with AtlasV2e(gl, *SIZE, 2, config) as atlas:
        a, b = atlas.emulator(config, 0), atlas.emulator(config, 1)
        with pytest.raises(EventDataError, match=r"^tiles: every tile is in use \(got 2\); expected release one"):
            atlas.emulator(config, 2)
        parts = [[], [], []]
        step = lambda emulator, k, n: parts[k].append(emulator.step(sequences[k][0][n], int(sequences[k][1][n])))
        for n in range(3):
            step(a, 0, n)
        for n in range(7):
            step(b, 1, n)
        parts[1].append(b.flush())
        b.release()
        c = atlas.emulator(config, 2)
        assert c.tile == b.tile
        for n in range(7):
            step(c, 2, n)
            if n >= 3:
                step(a, 0, n)
        parts[0].append(a.flush())
        parts[2].append(c.flush())
        for k in range(3):
            assert_same(Events.concatenate(parts[k]), wanted[k])
        a.release()
        d, alone = atlas.emulator(config, 9), V2e(*SIZE, config, 9)
        c.step(sequences[2][0][0], int(sequences[2][1][-1]) + 1)
        for n in range(2):
            d.step(sequences[0][0][n], n * 5 * 10**9)
        assert_same(d.flush(), run(alone, sequences[0][0][:2], [0, 5 * 10**9]))
        assert_same_state(alone, d)


@pytest.mark.parametrize("late", [False, True])
def test_a_frame_that_cannot_be_used_is_its_own_sequences_trouble(gl, late):
    """Clocks of noise and dead times of all are as without it."""
    config, good = V2eConfig(**VARIANTS["noisy"]), list(clips(3, 5, 0))
    bad = good[1][0][2].copy()
    bad[3, 4] = np.inf
    with AtlasV2e(gl, *SIZE, 3, config, late=late) as atlas:
        emulators = [atlas.emulator(config, k) for k in range(3)]
        shown, (wrong,) = [textures(gl, clip) for clip, _ in good], textures(gl, [bad])
        parts = [[], [], []]
        for n in range(5):
            for k in range(3):
                t_ns = int(good[k][1][n])
                if (k, n) == (1, 2):
                    parts[k].append(emulators[k].step(wrong, t_ns))
                    continue
                if (k, n) == (1, 3):
                    with pytest.raises(EventDataError, match=r"^frame 2: intensity at pixel x=4, y=3 cannot"):
                        emulators[k].step(shown[k][n], t_ns)
                parts[k].append(emulators[k].step(shown[k][n], t_ns))
        for k in range(3):
            parts[k].append(emulators[k].flush())
            kept = [n for n in range(5) if (k, n) != (1, 2)]
            alone = V2e(*SIZE, config, k)
            assert_same(Events.concatenate(parts[k]), run(alone, good[k][0][kept], good[k][1][kept]))
            assert_same_state(alone, emulators[k])


def test_more_noise_than_was_likely(gl, monkeypatch):
    """In one of them, so that nothing fires in any; the round is done again with more room."""
    config, sequences = V2eConfig(shot_noise_rate_hz=300.0), list(clips(2, 5, 0))
    with AtlasV2e(gl, *SIZE, 2, config) as atlas:
        emulators = [atlas.emulator(config, k) for k in range(2)]
        room = atlas.room.shots
        monkeypatch.setattr(emulators[0], "_likely_shots", lambda t_ns: 1)
        monkeypatch.setattr(emulators[1], "_likely_shots", lambda t_ns: 1)
        found = in_turn(emulators, sequences)
        assert atlas.room.shots > 2 * room
        for k, (clip, times) in enumerate(sequences):
            assert_same(found[k], run(V2e(*SIZE, config, k), clip, times))


def test_saturation_cuts_the_same_events_of_the_same_sequence(gl):
    config = dict(**CLEAN, contrast_threshold=0.02, threshold_sigma=0.002)
    configs, sequences = [V2eConfig(**config, max_events_per_step=n) for n in (1000, 10**6)], list(clips(2, 5, 0))
    with AtlasV2e(gl, *SIZE, 2, configs[0]) as atlas:
        emulators = [atlas.emulator(one, 2) for one in configs]
        found = in_turn(emulators, sequences)
        for k, (clip, times) in enumerate(sequences):
            alone = V2e(*SIZE, configs[k], 2)
            assert_same(found[k], run(alone, clip, times))
            assert emulators[k].saturated == alone.saturated and (alone.saturated > 1000) == (k == 0)


def test_events_that_find_no_room(gl):
    config = V2eConfig(contrast_threshold=0.05, refractory_us=0.0)
    clip = np.exp(np.array([0.0, 1.0, -1.0, 0.0])[:, None, None] * np.ones((4, 64, 64))).astype(np.float32)
    times = np.arange(4) * 10**7
    with AtlasV2e(gl, 64, 64, 2, config) as atlas:
        emulators, room = [atlas.emulator(config, k) for k in range(2)], atlas.room.capacity
        found = in_turn(emulators, [(clip, times)] * 2)
        assert atlas.room.capacity > 4 * room
        for k in range(2):
            assert_same(found[k], run(V2e(64, 64, config, k), clip, times))


def test_tensors_of_tiles_do_not_take_causes_for_rows(gl):
    config = V2eConfig(**VARIANTS["noisy"])
    given = [random_clip(seed, frames=5, height=SIZE[0], width=SIZE[1]) for seed in range(3)]
    with AtlasV2e(gl, *SIZE, 3, config) as atlas:
        tiles, sink = [atlas.emulator(config, k) for k in range(3)], TileSinks(atlas, Counts)
        for tile, (_, times) in zip(tiles, given, strict=True):
            sink.begin(tile, int(times[0]) // 1000, int(times[-1]) // 1000 + 1)
        for n in range(5):
            for tile, (clip, times) in zip(tiles, given, strict=True):
                tile.advance(clip[n], int(times[n]))
            sink.add()
        for k, (clip, times) in enumerate(given):
            events, counts = run(V2e(*SIZE, config, k), clip, times), np.zeros((2, *SIZE), np.int64)
            assert set(events.cause) == {0, 1, 2, 3}
            np.add.at(counts, (events.p, events.y, events.x), 1)
            np.testing.assert_array_equal(sink.read(tiles[k]), counts)
        sink.release()


def test_what_a_batch_does_not_do(gl):
    with AtlasV2e(gl, 8, 8, 2) as atlas:
        for key, value in (("cutoff_hz", 0.0), ("second_cutoff_hz", 50.0), ("leak_jitter", 0.0), ("causes", True)):
            with pytest.raises(
                EventDataError, match=rf"^events\.{key}: sequences of a batch ask for the same parts .*got {value}\)"
            ):
                atlas.emulator(V2eConfig(**{key: value}))
        assert atlas._in_use == [None, None], "who was refused takes no tile"
        for arguments, said in (
            ((EsimConfig(),), r"^events\.emulator: the batch is of another emulator \(got 'esim'\); expected v2e"),
            ((V2eConfig(), 0, "pchip"), r"^timeline\.reconstruction: the card follows straight lines"),
            ((V2eConfig(), 0, "linear", (8, 9)), r"^camera: sequences of a batch are of one size .*8, 9"),
        ):
            with pytest.raises(EventDataError, match=said):
                atlas.emulator(*arguments)
        one = atlas.emulator(V2eConfig(shot_noise_rate_hz=1000.0, max_events_per_step=1000))
        one.step(np.full((8, 8), 0.2, np.float32), 0)
        with pytest.raises(EventDataError, match=r"^frame 1: more shot noise than max_events_per_step"):
            one.step(np.full((8, 8), 0.2, np.float32), 10**12)
    with pytest.raises(EventDataError, match=r"^tiles: so many sequences of 8x4096 .*got 5\); expected 1 to 4"):
        AtlasV2e(gl, 4096, 8, 5, V2eConfig(causes=True))


def test_a_batch_compiles_what_one_alone_does(gl):
    """The same parts and planes, whatever a sequence draws: hot pixels among them."""
    for variant in (*VARIANTS, *MORE):
        config = {**VARIANTS, **MORE}[variant]
        card = CardV2e(9, 11, V2eConfig(**config), gl=gl)
        with AtlasV2e(gl, 9, 11, 2, V2eConfig(**config)) as atlas:
            assert card._layout() == atlas.layout
        card.release()


@pytest.mark.slow
def test_whole_sequences_side_by_side(gl, tmp_path):
    """Three scenes in two tiles."""
    config = config_of(tmp_path, timeline={"kind": "displacement", "max_px": 2.0}, events={"emulator": "v2e"})
    alone, together = {}, {}
    keep = lambda table, n, item: table.setdefault(n, []).append(item.events) if isinstance(item, EventChunk) else None
    for number in range(3):
        with simulate_sequence(config, number, gl) as sequence:
            for item in sequence:
                keep(alone, number, item)
    camera = config.camera
    with AtlasV2e(gl, camera.height, camera.width, 2, config.events) as atlas:
        made = (simulate_sequence(config, number, gl, atlas=atlas) for number in range(3))
        for number, item in side_by_side(made, 2):
            keep(together, number, item)
    for number in range(3):
        assert_same(Events.concatenate(together[number]), Events.concatenate(alone[number]))
        assert len(Events.concatenate(alone[number])) > 100
