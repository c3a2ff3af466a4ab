"""Causes of events: which they are, that they follow their events to the file and back, that they cost nothing off."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from blinkgl.cli import run as command
from blinkgl.config.events import EsimConfig, V2eConfig, VoltmeterConfig
from blinkgl.errors import EventDataError, OutputError
from blinkgl.events import Events, make_emulator
from blinkgl.events.grids import voxel_grid
from blinkgl.events.truth import Surfaces, SurfaceTruth
from blinkgl.io.formats import convert, event_writer, open_events, write_events
from blinkgl.recordings.simulation import SimulationReport, frames_to_events
from blinkgl.types.events import count_causes, named_causes
from tests.events.clips import assert_same, random_clip, run

MS = 10**6
NOTHING = dict(preset="clean", threshold_sigma=0.0, leak_cov_decades=0.0, causes=True)
STILL = dict(k3=0.0, k4=0.0, k5=0.0, k6=0.0, causes=True)


def shares(config, seconds: float, slope: float = 0.0, side: int = 30) -> dict[str, float]:
    """Of the events of an even scene that gets brighter by ``slope`` ln units a second."""
    emulator = make_emulator(config, side, side, 1)
    times = np.arange(0, seconds, 2e-3)
    frames = (np.full((side, side), 0.2 * np.exp(slope * t), np.float32) for t in times)
    counts = named_causes(count_causes(run(emulator, frames, np.round(times * 1e9))))
    assert sum(counts.values()) > 500
    return {name: n / sum(counts.values()) for name, n in counts.items()}


@pytest.mark.parametrize(
    "config, slope, cause",
    [
        (EsimConfig(threshold_jitter=0.05, causes=True), 4.0, "signal"),
        (V2eConfig(**NOTHING), 4.0, "signal"),
        (V2eConfig(**{**NOTHING, "cutoff_hz": 100.0}), 4.0, "signal"),
        (V2eConfig(**{**NOTHING, "leak_rate_hz": 20.0}), 0.0, "leak"),
        (V2eConfig(**{**NOTHING, "shot_noise_rate_hz": 20.0}), 0.0, "shot"),
        (
            V2eConfig(**{**NOTHING, "shot_noise_rate_hz": 20.0, "photoreceptor_noise": True, "cutoff_hz": 50.0}),
            0,
            "shot",
        ),
        (V2eConfig(**{**NOTHING, "hot_pixel_fraction": 1.0, "hot_pixel_rate_hz": 30.0}), 0.0, "hot"),
        (VoltmeterConfig(**STILL), 4.0, "signal"),
        (VoltmeterConfig(**{**STILL, "k4": 2e-5}), 0.0, "leak"),
        (VoltmeterConfig(**{**STILL, "k5": 4e-7}), 0.0, "leak"),
        (VoltmeterConfig(**{**STILL, "k6": 6e-3}), 0.0, "shot"),
    ],
)
def test_one_term_alone_is_the_cause(config, slope, cause):
    found = shares(config, 0.4, slope)
    assert found[cause] == 1.0, found


@pytest.mark.parametrize("dead_us", [0.0, 900.0])
@pytest.mark.parametrize("leak_share, cause", [(0.4, "signal"), (0.6, "leak")])
def test_the_larger_part_of_the_way_is_the_cause(leak_share, cause, dead_us):
    """Both the light and the leak push up, all the time: the one that pushes more."""
    theta, whole = 0.2, 30.0  # thresholds per second
    v2e = V2eConfig(
        **{**NOTHING, "leak_rate_hz": whole * leak_share, "refractory_us": dead_us},
        contrast_threshold=theta,
        start="zero",
    )
    slope = whole * (1 - leak_share)
    assert shares(v2e, 0.4, slope * theta)[cause] == 1.0
    volt = VoltmeterConfig(
        **{**STILL, "k4": whole * leak_share * 1e-6, "refractory_us": dead_us}, k2=1e-3, start="zero"
    )
    assert shares(volt, 0.4, slope / volt.k1)[cause] > 0.99


@pytest.mark.parametrize(
    "config",
    [
        V2eConfig(shot_noise_rate_hz=50.0, leak_rate_hz=30.0, refractory_us=9_000.0, causes=True),
        V2eConfig(preset="noisy", photoreceptor_noise=True, hot_pixel_fraction=0.1, causes=True),
        VoltmeterConfig(k6=2e-3, k4=3e-5, refractory_us=2_000.0, causes=True),
        VoltmeterConfig(k3=0.01, refractory_us=9000.0),
        EsimConfig(causes=True),
        EsimConfig(threshold_jitter=0.05, refractory_us=400.0),
    ],
)
def test_a_run_that_is_saved_and_restored_is_the_same(config):
    clip, times = random_clip(2, frames=8)
    whole = run(make_emulator(config, 37, 45, 3), clip, times)
    first, second = (make_emulator(config, 37, 45, 3) for _ in range(2))
    head = run(first, clip[:3], times[:3])
    second.load_state_dict(first.state_dict())
    assert_same(whole, Events.concatenate([head, run(second, clip[3:], times[3:])]))
    assert (whole.cause is not None) == config.causes and second.frames == 8


def events_with_causes() -> Events:
    clip, times = random_clip(3, frames=6)
    return run(
        make_emulator(V2eConfig(shot_noise_rate_hz=100.0, leak_rate_hz=90.0, causes=True), 37, 45, 1), clip, times
    )


@pytest.mark.parametrize("name", ["a.h5", "a.npz", "a.npy"])
def test_files_keep_causes(tmp_path, name):
    events = events_with_causes()
    pieces = [events.part(slice(i, i + 700)) for i in range(0, len(events), 700)]
    write_events(tmp_path / name, [Events.empty(), *pieces, Events.empty()], 37, 45)
    with open_events(tmp_path / name) as file:
        assert file.causes
        assert_same(file.read(), events)
    write_events(tmp_path / f"plain-{name}", replace(events, cause=None), 37, 45)
    with open_events(tmp_path / f"plain-{name}") as file:
        assert not file.causes
        assert_same(file.read(), replace(events, cause=None))


@pytest.mark.parametrize("ending", ["raw", "txt", "csv"])
def test_other_formats_say_that_they_cannot(tmp_path, ending, capsys):
    events = events_with_causes()
    target = tmp_path / f"b.{ending}"
    with (
        pytest.raises(OutputError, match="cannot hold the causes of events"),
        event_writer(target, 37, 45) as out,
    ):
        out.append(events)
    assert not target.exists()
    write_events(tmp_path / "a.h5", events, 37, 45)
    _, count = convert(tmp_path / "a.h5", target)
    assert count == len(events)
    with open_events(target) as file:
        assert not file.causes
    assert command(["convert", str(tmp_path / "a.h5"), str(tmp_path / "c.csv")]) == 0
    assert "causes of the events are left out" in capsys.readouterr().out


def test_bad_causes_in_files_are_named(tmp_path):
    events = events_with_causes()
    with pytest.raises(EventDataError, match="some events have causes and some do not"):
        write_events(
            tmp_path / "a.h5",
            [
                events,
                replace(events.window(2**40, 2**41), cause=None),
                replace(events.part(slice(len(events) - 1, None)), cause=None),
            ],
            37,
            45,
        )
    write_events(tmp_path / "a.h5", events, 37, 45)
    with h5py.File(tmp_path / "a.h5", "r+") as file:
        file["events/cause"][17] = 9
    with open_events(tmp_path / "a.h5") as file, pytest.raises(EventDataError, match="cause of event 17.*9"):
        file.read()


def test_too_many_rows(tmp_path):
    emulator = make_emulator(EsimConfig(causes=True), 2**14 + 1, 2)
    with pytest.raises(EventDataError, match="events.causes.*16384"):
        emulator.step(np.ones((2**14 + 1, 2), np.float32), 0)
    assert len(make_emulator(EsimConfig(causes=True), 2**14, 2).step(np.ones((2**14, 2), np.float32), 0)) == 0


def test_simulate_counts_by_cause(tmp_path, capsys):
    frames = [np.full((20, 20), 0.4, np.float32)] * 30
    report, config = SimulationReport(), V2eConfig(shot_noise_rate_hz=100.0, leak_rate_hz=90.0, causes=True)
    events = Events.concatenate(list(frames_to_events(frames, fps=200, emulator=config, report=report)))
    assert report.causes == named_causes(count_causes(events)) and sum(report.causes.values()) == len(events)
    assert report.causes["shot"] > 100 < report.causes["leak"] and report.causes["hot"] == 0

    rng = np.random.default_rng(0)
    np.save(tmp_path / "clip.npy", rng.integers(0, 255, (6, 20, 24), np.uint8))
    options = ["--fps", "100", "--emulator", "v2e", "--set", "causes=true", "--preview", str(tmp_path / "p.mp4")]
    assert command(["simulate", str(tmp_path / "clip.npy"), "--out", str(tmp_path / "a.h5"), *options]) == 0
    assert "by cause: signal " in capsys.readouterr().out
    with open_events(tmp_path / "a.h5") as file:
        assert file.causes
    assert command(["simulate", str(tmp_path / "clip.npy"), "--out", str(tmp_path / "a.csv"), *options]) == 2
    assert "csv cannot hold the causes of events" in capsys.readouterr().err


# --- Which surface made an event, by hand: two frames of three pixels, and what an event between them is given.

MS_TRUTH = 1_000_000


def shown(*pixels):
    """(id, depth, speed) of a picture of one row."""
    ids, depth, speed = (np.array([part]) for part in zip(*pixels))
    return Surfaces(
        ids.astype(np.uint32), depth.astype(np.float32), np.stack([speed, 0 * speed], -1).astype(np.float32)
    )


def events(*rows):
    """(x, t µs)"""
    x, t = (np.array(part) for part in zip(*rows))
    return Events(x.astype(np.uint16), np.zeros(len(x), np.uint16), t.astype(np.int64), np.ones(len(x), np.uint8))


NOTHING_TRUTH, WALL, BOX = (0, np.inf, 0), (1, 5, 1), (2, 3, 20)


def test_the_nearer_in_time_where_nothing_passes_else_the_nearer_surface():
    truth = SurfaceTruth()
    truth.see(0, shown(WALL, WALL, BOX, NOTHING_TRUTH))
    truth.see(10 * MS_TRUTH, shown((1, 5.1, 2), BOX, WALL, (2, 3, 7)))
    given = truth.of(events((0, 4000), (0, 6000), (1, 1000), (1, 9000), (2, 1000), (2, 9000), (3, 100)), 10 * MS_TRUTH)
    assert given["instance"].tolist() == [1, 1, 2, 2, 2, 2, 2]
    assert given["velocity"][:, 0].tolist() == [1, 2, 20, 20, 20, 20, 7]
    assert np.allclose(given["depth"], [5, 5.1, 3, 3, 3, 3, 3])


def test_a_pixel_that_sees_its_neighbours_asks_them():
    frames = shown(WALL, BOX), shown(WALL, BOX)
    for reach, whose in ((0, 1), (1, 2)):
        truth = SurfaceTruth(reach)
        truth.see(0, frames[0])
        truth.see(10 * MS_TRUTH, frames[1])
        assert truth.of(events((0, 5000)), 10 * MS_TRUTH)["instance"][0] == whose


def test_what_a_pixel_remembers_is_still_that_of_what_left():
    truth, memory_s = SurfaceTruth(), np.full((1, 1), 0.015)
    for ms, pixel in ((0, BOX), (10, WALL), (20, WALL), (30, WALL)):
        truth.see(ms * MS_TRUTH, shown(pixel), memory_s)
        if ms == 20:
            assert truth.of(events((0, 15_000)), 20 * MS_TRUTH)["instance"][0] == 2
    assert truth.of(events((0, 24_000), (0, 26_000)), 30 * MS_TRUTH)["instance"].tolist() == [2, 1]


def test_a_voxel_grid_of_a_window_without_length_is_empty():
    events = Events(np.ones(1, np.uint16), np.ones(1, np.uint16), np.array([5]), np.ones(1, np.uint8))
    for t0, t1 in ((5, 5), (4, 4), (9, 9)):
        assert not voxel_grid(events, t0, t1, 2, 2, 3).any()
    assert voxel_grid(events, 5, 6, 2, 2, 3)[0, 1, 1] == 1
