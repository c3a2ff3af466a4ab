"""The judge: guesses where there is nothing to tell, is sure where there is."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from blinkgl.config.events import V2eConfig
from blinkgl.errors import EventDataError
from blinkgl.recordings.patches import LEAST_PATCHES, WINDOWS
from blinkgl.recordings.simulation import frames_to_events
from blinkgl.tools.judge import area, boosted, judge, judge_halves, judge_unlike
from blinkgl.types.events import Events

H, W = 96, 128


def poisson(rate_hz: float, on_share: float = 0.5, seed: int = 0, size=(H, W), seconds: float = 1.0) -> Events:
    rng = np.random.default_rng(seed)
    n = rng.poisson(rate_hz * seconds * size[0] * size[1])
    return Events(
        rng.integers(0, size[1], n).astype(np.uint16),
        rng.integers(0, size[0], n).astype(np.uint16),
        np.sort(rng.integers(0, round(seconds * 1e6), n)),
        (rng.random(n) < on_share).astype(np.uint8),
    )


def test_area_under_the_curve_counts_pairs():
    rng = np.random.default_rng(0)
    score, label = rng.integers(0, 6, 60).astype(float), rng.random(60) < 0.4
    pairs = [(a > b) + 0.5 * (a == b) for a in score[label] for b in score[~label]]
    assert area(score, label.astype(float)) == pytest.approx(np.mean(pairs))


def test_stumps_learn_what_one_feature_says_and_nothing_of_chance():
    rng = np.random.default_rng(1)
    x = rng.normal(size=(1500, 4)).astype(np.float32)
    label = (x[:, 2] + 0.5 * rng.normal(size=1500) > 0.3).astype(float)
    assert area(boosted(x[:1000], label[:1000], x[1000:])[0], label[1000:]) > 0.9
    shuffled = rng.permutation(label)
    assert abs(area(boosted(x[:1000], shuffled[:1000], x[1000:])[0], shuffled[1000:]) - 0.5) < 0.08


def test_the_same_law_cannot_be_told_apart_and_another_can():
    span, a = (0, 1_000_000), poisson(8)
    assert abs(judge(a, poisson(8, seed=1), (H, W), span).auc - 0.5) < 0.08
    assert judge(a, poisson(8, 0.65, seed=2), (H, W), span).auc > 0.8
    small = poisson(8, 0.9, seed=3, size=(64, 80))
    assert judge_unlike(a, small, (H, W), (64, 80), span).auc > 0.95
    assert abs(judge_halves(a, (H, W), span).auc - 0.5) < 0.12


@pytest.fixture(scope="module")
def moving() -> Events:
    """Of a texture that slides to the lower right before a camera with noise."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).random((H + 80, W + 80)).astype(np.float32), (0, 0), 3)
    texture = cv2.normalize(texture, None, 0.05, 0.9, cv2.NORM_MINMAX)
    frames = [texture[80 - 2 * k :, 80 - 2 * k :][:H, :W] for k in range(40)]
    camera = V2eConfig(contrast_threshold=0.15, cutoff_hz=60, shot_noise_rate_hz=3, leak_rate_hz=0.5)
    return Events.concatenate(list(frames_to_events(frames, fps=200, emulator=camera, seed=1)))


def spoilt(events: Events, how: str) -> Events:
    x, y, t, p = (events.x.astype(int), events.y.astype(int), events.t.copy(), events.p)
    rng, window = np.random.default_rng(0), (t[-1] + 1) / WINDOWS
    keep = np.ones(len(t), bool)
    if how == "reversed":
        t = np.clip((2 * (t // window) + 1) * window - t, 0, t[-1]).astype(np.int64)
    elif how == "mirrored":
        x = x // 16 * 16 + 15 - x % 16
    elif how == "dealt anew":
        dealt = rng.permutation((H // 16) * (W // 16))[y // 16 * (W // 16) + x // 16]
        x, y = dealt % (W // 16) * 16 + x % 16, dealt // (W // 16) * 16 + y % 16
    elif how == "a tenth dropped":
        keep = rng.random(len(t)) >= 0.1
    elif how == "bursts":
        early = rng.random(len(t)) < 0.15
        t[early] = t[early] // 20_000 * 20_000 + rng.integers(0, 500, early.sum())
    elif how == "steps of a clock":
        t = t // 1000 * 1000
    order = np.argsort(t[keep], kind="stable")
    return Events(
        x[keep][order].astype(np.uint16), y[keep][order].astype(np.uint16), t[keep][order], p[keep][order]
    )  # fmt: skip


@pytest.mark.parametrize(
    ("how", "by"),
    [
        ("reversed", "motion along"),
        ("mirrored", "border|motion along x"),
        ("dealt anew", "unlike beside|border"),
        ("a tenth dropped", None),
        ("bursts", "bursts|time|intervals"),
        ("steps of a clock", "at one time"),
    ],
)
def test_what_no_pixel_shows_by_itself_is_seen_and_named(moving, how, by):
    """Time backwards, patches turned over or dealt anew, events missing, bursts, a coarse clock."""
    found = judge(moving, spoilt(moving, how), (H, W), (0, int(moving.t[-1]) + 1))
    assert found.paired > 0.75
    assert by is None or (found.auc > 0.75 and re.search(by, found.telling[0][0]))


def test_two_halves_of_one_stream_are_not_told_apart(moving):
    heads = np.random.default_rng(2).random(len(moving)) < 0.5
    found = judge(moving.part(heads), moving.part(~heads), (H, W), (0, int(moving.t[-1]) + 1))
    assert abs(found.auc - 0.5) < 0.06 and abs(found.paired - 0.5) < 0.06


def test_too_few_events_are_refused():
    with pytest.raises(EventDataError, match=str(LEAST_PATCHES)):
        judge_halves(poisson(0.05), (H, W), (0, 1_000_000))
