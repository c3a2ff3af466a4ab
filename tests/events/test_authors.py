"""The emulators beside the recursions of their authors' programs, of which golden counts are kept.

``tests/golden/authors.npz`` was made at commit 348eebef, whose ``compat: authors`` computed both programs frame by
frame: that of V2E made the same events as v2e itself (commit cac6384 of its repository) given the same draws, 4.9
million of 4.9 million in twelve cases; that of the Voltmeter is the published recursion. Arrays are events per pixel
of :func:`clip`, (polarity, H, W): ``v2e`` and ``v2e_cutoff`` (a low-pass of 100 Hz) without noise, spread or dead time,
and ``voltmeter_mean``, the mean over seeds 0 to 7 of DVS346 with V = 0 at the start.
"""

from pathlib import Path

import numpy as np
import pytest

from blinkgl.config.events import V2eConfig, VoltmeterConfig
from blinkgl.events import make_emulator

GOLDEN = np.load(Path(__file__).parents[1] / "golden" / "authors.npz")
QUIET = {
    "preset": "clean",
    "threshold_sigma": 0.0,
    "leak_rate_hz": 0.0,
    "shot_noise_rate_hz": 0.0,
    "refractory_us": 0.0,
    "start": "zero",
}
FRAMES, FPS = 120, 500


def clip():
    """Frames (24, 32) float32 of a pattern that moves, and their times, ns."""
    y, x = np.mgrid[:24, :32].astype(np.float64)
    for k in range(FRAMES):
        t = k / FPS
        picture = 0.35 + 0.3 * np.sin((x + 60 * t) / 4) * np.cos((y - 35 * t) / 6)
        yield picture.astype(np.float32), k * 10**9 // FPS


def counts(config, seed):
    """Events per pixel, (polarity, H, W)."""
    emulator, found = make_emulator(config, 24, 32, seed), np.zeros((2, 24, 32), np.int64)
    for frame, t_ns in clip():
        events = emulator.step(frame, t_ns)
        np.add.at(found, (events.p.astype(int), events.y, events.x), 1)
    return found


def test_v2e_without_a_low_pass_makes_as_many_events_at_every_pixel():
    np.testing.assert_array_equal(counts(V2eConfig(**QUIET), 1), GOLDEN["v2e"])


def test_v2e_with_a_low_pass_differs_by_how_a_frame_is_integrated():
    """Theirs filters frame by frame, ours in continuous time."""
    found, theirs = counts(V2eConfig(**{**QUIET, "cutoff_hz": 100.0}), 1), GOLDEN["v2e_cutoff"]
    assert abs(found - theirs).max() <= 2
    assert found.sum() / theirs.sum() == pytest.approx(0.987, abs=0.002)


def test_the_voltmeters_mean_is_theirs():
    found = np.mean([counts(VoltmeterConfig(start="zero"), seed) for seed in range(8)], axis=0)
    theirs = GOLDEN["voltmeter_mean"]
    assert abs(found - theirs).mean() < 0.01
    assert found.sum() / theirs.sum() == pytest.approx(1, abs=0.002)
