"""Voxel grids, counts and time surfaces of events that stay on the card, beside NumPy on the same events."""

from __future__ import annotations

import numpy as np
import pytest

from blinkgl.card import Atlas, CardEsim, Counts, Latest, TileSinks, Voxels
from blinkgl.card.sinks import ONE
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Esim
from blinkgl.types.events import Events
from tests.card.test_frames_on_card import textures
from tests.events.clips import assert_same, random_clip, run

H, W = 37, 45
CONFIG = EsimConfig(threshold_sigma=0.03)


def voxels(events, t0: int, t1: int, bins: int) -> np.ndarray:
    """Whole numbers of 2^-16, in plain Python integers."""
    grid = np.zeros((bins, H, W), np.int64)
    for x, y, t, p in zip(events.x, events.y, events.t, events.p):
        place = (int(t) - t0) * (bins - 1) * ONE // (t1 - t0)
        first, later = divmod(place, ONE)
        sign = 1 if p else -1
        grid[first, y, x] += sign * (ONE - later)
        if later:
            grid[first + 1, y, x] += sign * later
    return grid


@pytest.fixture(scope="module")
def clip():
    frames, times = random_clip(3, frames=6, height=H, width=W)
    return frames, times, run(Esim(H, W, CONFIG, 2), frames, times)


@pytest.mark.parametrize("bins", [1, 2, 5])
def test_tensors_are_those_of_the_events(gl, clip, bins):
    """A window that begins and ends between two frames; over several steps."""
    frames, times, events = clip
    t0, t1 = int(times[1]) // 1000 + 3001, int(times[4]) // 1000 + 777
    inside = events.window(t0, t1)
    card = CardEsim(H, W, CONFIG, 2, gl=gl)
    sinks = Voxels(card, bins), Counts(card), Latest(card)
    for _ in range(2):  # a sink is used again
        for sink in sinks:
            sink.begin(t0, t1)
    total = 0
    for frame, t in zip(frames, times):
        total += card.advance(frame, int(t))
        for sink in sinks:
            sink.add()
    assert total == len(events) > len(inside) > 1000
    wanted = voxels(inside, t0, t1, bins)
    np.testing.assert_array_equal(sinks[0].whole(), wanted)
    np.testing.assert_array_equal(sinks[0].read(), (wanted / ONE).astype(np.float32))
    counts, latest = np.zeros((2, H, W), np.int64), np.full((2, H, W), -1)
    np.add.at(counts, (inside.p, inside.y, inside.x), 1)
    np.maximum.at(latest, (inside.p, inside.y, inside.x), inside.t)
    np.testing.assert_array_equal(sinks[1].read(), counts)
    np.testing.assert_array_equal(sinks[2].read(), latest)
    for sink in sinks:
        sink.release()
        sink.release()
    card.release()


def test_steps_that_are_read_and_steps_that_stay_may_alternate(gl, clip):
    frames, times, events = clip
    card = CardEsim(H, W, CONFIG, 2, gl=gl)
    count, read = 0, []
    for k, (frame, t) in enumerate(zip(frames, times)):
        if k % 2:
            count += card.advance(frame, int(t))
        else:
            read.append(card.step(frame, int(t)))
    assert count and count + sum(map(len, read)) == len(events)
    card.release()


def test_what_cannot_be_a_window(gl):
    card = CardEsim(8, 8, CONFIG, gl=gl)
    with pytest.raises(EventDataError, match=r"^bins: number of bins out of range"):
        Voxels(card, 0)
    sink = Counts(card)
    for t0, t1 in ((5, 5), (6, 5), (0, 2**30 + 1)):
        with pytest.raises(EventDataError, match=r"^window: a window has an end after its start"):
            sink.begin(t0, t1)
    sink.begin(0, 10)
    sink.add()  # before the first frame there is nothing
    assert not sink.read().any()
    card.release()


@pytest.mark.parametrize("late", [False, True])
def test_tiles_have_what_each_has_alone(gl, late):
    """Four sequences of other times, thresholds and windows side by side; one ends early, one reads its events."""
    kinds = {"voxels": (Voxels, 5), "counts": (Counts, 5), "latest": (Latest, 5)}
    clips = [random_clip(seed, frames=6 - (seed == 3), height=H, width=W) for seed in range(4)]
    configs = [EsimConfig(threshold_sigma=0.03, contrast_threshold=0.1 + 0.05 * k) for k in range(4)]
    windows = [(int(t[1]) // 1000 + 301 * k, int(t[4]) // 1000 + 77) for k, (_, t) in enumerate(clips)]
    with Atlas(gl, H, W, tiles=5, late=late) as atlas:
        sinks = {name: TileSinks(atlas, kind, bins) for name, (kind, bins) in kinds.items()}
        tiles = [atlas.emulator(config, 7 + k) for k, config in enumerate(configs)]
        for sink in sinks.values():
            for tile, window in zip(tiles, windows, strict=True):
                sink.begin(tile, *window)
        read = []
        for k in range(6):
            for j, (tile, (frames, times)) in enumerate(zip(tiles, clips, strict=True)):
                if k == len(frames):
                    read += [tile.flush()]
                elif j == 2 and k % 2:
                    read.append(tile.step(frames[k], int(times[k])))
                elif k < len(frames):
                    tile.advance(frames[k], int(times[k]))
            for sink in sinks.values():
                sink.add()
        read.append(tiles[2].flush())
        for k, (tile, config, (frames, times)) in enumerate(zip(tiles, configs, clips, strict=True)):
            for name, (kind, bins) in kinds.items():
                single = CardEsim(H, W, config, 7 + k, gl=gl)
                one = kind(single, bins) if kind is Voxels else kind(single)
                one.begin(*windows[k])
                for frame, t in zip(frames, times, strict=True):
                    single.advance(frame, int(t))
                    one.add()
                assert one.read().any()
                np.testing.assert_array_equal(sinks[name].read(tile), one.read(), err_msg=f"{name} of {k}")
                one.release()
                single.release()
        frames, times = clips[2]
        every = Esim(H, W, configs[2], 9)
        wanted = [every.step(f, int(t)) for f, t in zip(frames, times, strict=True)]
        got = Events.concatenate([part for part in read if len(part)])
        assert_same(got, Events.concatenate([wanted[k] for k in (1, 3, 5)]))
        with pytest.raises(EventDataError, match=r"^bins: "):
            TileSinks(atlas, Voxels, 0)
        with Atlas(gl, H, W, tiles=1) as other, pytest.raises(EventDataError, match=r"^emulator: not a tile of this"):
            sinks["counts"].begin(other.emulator(CONFIG), 0, 1)
        for sink in sinks.values():
            sink.release()
            sink.release()


def test_a_tile_without_a_window_and_a_frame_that_is_none(gl):
    """Neither leaves anything in a sink; the others of the round do."""
    frames, times = random_clip(5, frames=4, height=H, width=W)
    bad = frames[2].copy()
    bad[3, 4] = np.nan
    (wrong,) = textures(gl, [bad])
    with Atlas(gl, H, W, tiles=3) as atlas:
        sink, tiles = TileSinks(atlas, Counts), [atlas.emulator(CONFIG, seed) for seed in range(3)]
        for tile in tiles[:2]:
            sink.begin(tile, int(times[1]) // 1000 + 1, 2**30)
        for k in range(3):
            for j, tile in enumerate(tiles):
                tile.advance(wrong if (j, k) == (1, 2) else frames[k], int(times[k]))
            sink.add()
        assert sink.read(tiles[0]).any() and not sink.read(tiles[1]).any() and not sink.read(tiles[2]).any()
        with pytest.raises(EventDataError, match=r"pixel x=4, y=3"):
            tiles[1].flush()
        sink.release()
    wrong.release()
