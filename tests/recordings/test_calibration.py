"""calibrate: parameters that are known come back, what the data cannot tell is named, and nobody is led astray."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
import yaml

from blinkgl.cli import run
from blinkgl.errors import BlinkGLError, ConfigError, EventDataError
from blinkgl.io.formats import write_events
from blinkgl.io.reading import Declared
from blinkgl.recordings.calibration import calibrate, calibrate_events
from blinkgl.recordings.clip import TILE_PX, Clip, FrameReading, clip_of_frames, clip_of_still, clock_offset
from blinkgl.recordings.simulation import emulator_config
from blinkgl.recordings.statistics import sums, target
from blinkgl.report.calibration import mosaic
from blinkgl.types.events import Events
from tests.shared_data import shared

H, W, GAP_US = 64, 80, 20_000
TRUE = dict(contrast_threshold=0.25, contrast_threshold_off=0.32, threshold_sigma=0.03, log_eps=0.03,
            refractory_us=3000.0)  # fmt: skip


def moving(count: int = 7, px: float = 6.0, seed: int = 0, most: float = 0.95) -> list[tuple[np.ndarray, int, str]]:
    """Frames of a texture of three scales that moves; (codes, t_ns, name)."""
    rng = np.random.default_rng(seed)
    grown = lambda s: cv2.resize(
        rng.normal(size=(H // s + 8, W // s + 40)).astype(np.float32), (W + 200, H + 40), interpolation=cv2.INTER_CUBIC
    )
    light = np.clip(np.exp(0.25 * grown(4) + 0.4 * grown(8) + 0.7 * grown(24) - 1.5), 0.01, most)
    look = lambda k: cv2.warpAffine(light, np.float32([[1, 0, -px * k], [0, 1, -px * k / 4]]), (W, H))
    return [(np.round(look(k) * 255).astype(np.uint8), (k + 1) * GAP_US * 1000, f"#{k}") for k in range(count)]


def scene(frames=None) -> Clip:
    """A clip of the frames, without a camera's events."""
    frames = frames or moving()
    first, last = frames[0][1] // 1000, frames[-1][1] // 1000
    ends = Events(*(np.zeros(2, t) for t in (np.uint16, np.uint16)), np.array([first, last - 1]), np.zeros(2, np.uint8))
    return clip_of_frames(ends, frames, (H, W), FrameReading(delay_ms=0))


def files(folder, frames=None, emulator=None, shift_us: int = 0, seed: int = 9):
    """A recording, made by an emulator of the frames, and the frames, as a person has them."""
    frames = frames or moving()
    events = scene(frames).simulate(emulator_config({"emulator": "esim", **TRUE, **(emulator or {})}), seed)
    write_events(folder / "camera.npz", Events(events.x, events.y, events.t + shift_us, events.p), H, W)
    np.savez(
        folder / "frames.npz",
        frames=np.stack([f for f, _, _ in frames]),
        t_us=np.array([t // 1000 for _, t, _ in frames]),
    )
    return folder / "camera.npz", folder / "frames.npz"


# --- what is compared -------------------------------------------------------------------------------------------------


def test_the_clock_is_found():
    """Up to the emulator's own lag: levels are passed after the light has begun to change."""
    clip = scene()
    events = clip.simulate(emulator_config({"emulator": "esim", **TRUE}), 1)
    lag, correlation = clock_offset(events, clip.change, clip.clock_us, (H, W))
    assert 0 < lag < 4000 and correlation > 0.8
    for shift in (4_300, -7_000):
        found, _ = clock_offset(events, clip.change, clip.clock_us - shift, (H, W))
        assert found - lag == pytest.approx(shift, abs=700)


def test_another_exposure_of_a_frame_is_no_light():
    """The camera's first frame was exposed longer (evbench_davis240): a picture that becomes darker without events. A
    lamp that is dimmed makes events, and stays."""
    frames = moving(most=0.6)
    events = scene(frames).simulate(emulator_config({"emulator": "esim", **TRUE}), 1)
    longer = [(np.round(frames[0][0] * 1.4).astype(np.uint8), *frames[0][1:]), *frames[1:]]
    cut = clip_of_frames(events, longer, (H, W), FrameReading(delay_ms=0))
    whole = clip_of_frames(events, frames, (H, W), FrameReading(delay_ms=0))
    assert cut.facts["left_out"] == 1 and np.array_equal(cut.clock_us, whole.clock_us[1:])
    assert not {"left_out", "gain"} & set(whole.facts)
    dimmed = scene(longer).simulate(emulator_config({"emulator": "esim", **TRUE}), 1)
    assert not {"left_out", "gain"} & set(clip_of_frames(dimmed, longer, (H, W), FrameReading(delay_ms=0)).facts)


def test_a_gain_that_drifts_is_no_light():
    """Frames that become brighter by 3 % each, where the pixels of a still background say nothing."""
    bar = lambda k: np.s_[:, 5 + 8 * k : 11 + 8 * k]
    still = moving(1, most=0.6)[0][0]
    frames = []
    for k in range(7):
        codes = still.copy()
        codes[bar(k)] = 200
        frames.append((codes, (k + 1) * GAP_US * 1000, f"#{k}"))
    events = scene(frames).simulate(emulator_config({"emulator": "esim", **TRUE}), 1)
    drifting = [(np.round(f * 1.03**k).astype(np.uint8), *rest) for k, (f, *rest) in enumerate(frames)]
    told, whole = (clip_of_frames(events, given, (H, W), FrameReading(delay_ms=0)) for given in (drifting, frames))
    assert told.facts["gain"] == pytest.approx(1.03**6, rel=0.01) and "gain" not in whole.facts
    assert abs(np.median(told.change)) < 1e-3 and np.median(np.abs(told.change - whole.change)) < 0.01


def test_a_model_of_one_threshold_is_asked_for_on_and_off_together():
    """With half of the OFF events gone the Voltmeter, which cannot follow, has the total to follow and no more."""
    clip = scene()
    events = clip.simulate(emulator_config("voltmeter"), 1)
    off = np.flatnonzero(events.p == 0)
    fewer = np.ones(len(events), bool)
    fewer[off[::2]] = False
    recorded = sums(events.part(fewer), clip, 0, 3)
    spoilt = clip.with_events(events.part(fewer))
    asked = lambda kind: target(sums(spoilt.events, spoilt, 0, 3), together=emulator_config(kind).one_threshold)
    apart, together = asked("esim"), asked("voltmeter")
    assert together.together and not apart.together
    assert np.count_nonzero(together.block == "rate") == np.count_nonzero(apart.block == "rate") / 2
    on = np.exp(together.values[together.block == "rate"][-1]) * recorded.pixels[:, 0].sum() * recorded.seconds.sum()
    assert on == pytest.approx(recorded.rates.sum() + 1)


def test_tiles_of_a_large_sensor_have_the_same_events(monkeypatch):
    """Half of the pixels: what they see, and their recorded events, stay together."""
    frames = moving()
    events = scene(frames).simulate(emulator_config({"emulator": "esim", **TRUE, "threshold_sigma": 0.0}), 1)
    whole = clip_of_frames(events, frames, (H, W), FrameReading(delay_ms=0))
    part = clip_of_frames(events, frames, (H, W), FrameReading(delay_ms=0), most=2 * 32 * 32 * len(whole.frames))
    assert part.size == (64, 32) and part.share == pytest.approx(2 * 32 * 32 / (H * W))
    again = part.simulate(emulator_config({"emulator": "esim", **TRUE, "threshold_sigma": 0.0}), 5)
    assert len(again) == len(part.events) > 1000
    a, b = (sums(e, part, 0, part.intervals).polarity for e in (again, part.events))
    assert np.array_equal(a, b)


# --- the fit ----------------------------------------------------------------------------------------------------------


def test_from_files_to_a_sensor_file_and_a_page(tmp_path, capsys):
    camera, frames = files(tmp_path, shift_us=3000)
    out = tmp_path / "mine.yaml"
    fixed = [part for key in ("log_eps=0.03", "threshold_sigma=0.03") for part in ("--set", key)]
    assert run(["calibrate", str(camera), "--frames", str(frames), "--out", str(out), "--starts", "1", *fixed]) == 0
    said, warned = capsys.readouterr()
    assert "Clock: the polarity sums follow the frames best when +" in said and "dense flow" in said
    assert warned.startswith(f"note: {frames}: frames without exposure times: the offset of ")
    assert warned.count("\n") == 1 and " ms found from the events has whatever lies between " in warned
    table = yaml.safe_load(out.read_text())
    assert (table["width"], table["height"]) == (W, H)
    found = table["emulators"]["esim"]
    for key, within in (("contrast_threshold", 0.03), ("contrast_threshold_off", 0.03), ("refractory_us", 0.05)):
        assert found[key] == pytest.approx(TRUE[key], rel=within), key
        assert 0 < table["uncertainty"][f"emulators.esim.{key}"] < 0.1 * found[key]
    assert found["log_eps"] == 0.03
    emulator_config({"emulator": "esim", **found})
    page = (tmp_path / "mine.html").read_text()
    assert "data:image/png" in page and "kept fixed by request" in page
    assert run(["calibrate", str(camera), "--frames", str(frames), "--out", str(out)]) == 2
    assert "output file exists" in capsys.readouterr().err


@pytest.mark.parametrize("given", [FrameReading(exposures=True), FrameReading(delay_ms=3.0)])
def test_no_note_where_exposures_or_the_offset_are_known(given):
    events = scene().simulate(emulator_config("esim"), 1)
    fixed = [key for key in emulator_config("esim").fitted if key != "contrast_threshold"]
    result = calibrate_events(events, (H, W), moving(), given, fixed=fixed, starts=1)
    assert result.warnings == []


def still_recording(folder, seconds: float = 2.0, size=(48, 60), seed: int = 3, **noise):
    ends = Events(*(np.zeros(2, np.uint16) for _ in "xy"), np.array([0, round(seconds * 1e6)]), np.zeros(2, np.uint8))
    events = clip_of_still(ends, size).simulate(emulator_config({"emulator": "v2e", **noise}), seed)
    write_events(folder / "dark.npz", events, *size)
    return folder / "dark.npz"


def test_what_makes_no_difference_is_named(tmp_path):
    """ESIM has no noise: a scene that stands still says nothing of any of its parameters."""
    result = calibrate(still_recording(tmp_path, shot_noise_rate_hz=3.0), still=True, starts=1)
    assert (
        not result.values and set(result.undetermined) == set(result.config.fitted) and result.config == result.before
    )
    assert set(result.undetermined.values()) == {"makes no difference to this scene, left as it was"}


def test_noise_of_a_still_scene_comes_back(tmp_path):
    path = still_recording(tmp_path, leak_rate_hz=1.0, shot_noise_rate_hz=4.0)
    told = ("leak_rate_hz", "shot_noise_rate_hz")
    fixed = [key for key in emulator_config("v2e").fitted if key not in told]
    result = calibrate(path, still=True, emulator="v2e", fixed=fixed, starts=1)
    assert result.values == {
        "leak_rate_hz": pytest.approx(1.0, rel=0.1),
        "shot_noise_rate_hz": pytest.approx(4.0, rel=0.1),
    }


FIVE = range(5)


def recovered(folder, seed: int) -> dict[str, float]:
    """Relative errors of a fit to a simulation with known values, whose texture and chance are of this seed."""
    camera, frames = files(folder, moving(seed=seed), seed=seed + 20)
    fixed = {"log_eps": TRUE["log_eps"], "threshold_sigma": TRUE["threshold_sigma"]}
    result = calibrate(camera, frames, emulator={"emulator": "esim", **fixed}, fixed=fixed, starts=2)
    return {key: value / TRUE[key] - 1 for key, value in result.values.items()}


@pytest.mark.slow
@pytest.mark.parametrize("seed", FIVE)
def test_known_values_come_back(tmp_path, seed):
    """Thresholds within 2 %, the dead time within 5."""
    errors = recovered(tmp_path, seed)
    assert set(errors) == {"contrast_threshold", "contrast_threshold_off", "refractory_us"}
    assert all(abs(e) <= (0.05 if key == "refractory_us" else 0.02) for key, e in errors.items()), errors


# --- what is refused --------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "what, said",
    [
        ("no frames", "the recording has no frames"),
        ("other size", "frames and recording have different sizes .*got '64x80'.*80x64"),
        ("no times", "frames without times"),
        ("other scene", "events and frames do not match"),
        ("other clock", "events and frames do not match"),
        ("saturated", "too many pixels of the frames are saturated"),
        ("few events", "too few events"),
        ("two frames", r"fewer than two intervals .*got \[\(\d"),
        ("no motion", "events and frames do not match"),
        ("unknown key", "speed"),
        ("ratio", "fitted separately"),
        ("interpolation", "interpolate: unknown interpolation"),
        ("still and frames", "a still scene needs no frames"),
    ],
)
def test_one_line_and_nothing_written(tmp_path, capsys, what, said):
    camera, file = files(tmp_path)
    extra = {"no frames": [], "unknown key": ["--set", "speed=3"],
             "ratio": ["--set", "threshold_ratio=1.1"], "interpolation": ["--interpolate", "cubic"],
             "still and frames": ["--still"]}.get(what, [])  # fmt: skip
    stored = dict(np.load(file))
    if what == "other size":
        stored["frames"] = np.ascontiguousarray(stored["frames"].transpose(0, 2, 1))
    elif what == "no times":
        del stored["t_us"]
    elif what == "other scene":
        stored["frames"] = np.stack([f for f, _, _ in moving(seed=5, px=-2.0)])
    elif what == "other clock":
        stored["t_us"] = stored["t_us"] + 10_000_000
    elif what == "saturated":
        stored["frames"] = np.where(stored["frames"] > 60, 255, stored["frames"]).astype(np.uint8)
    elif what == "no motion":
        stored["frames"][...] = stored["frames"][0]
    elif what == "two frames":
        stored = {k: v[:2] for k, v in stored.items()}
    np.savez(file, **stored)
    if what == "few events":
        write_events(camera, scene().simulate(emulator_config("esim"), 1).part(slice(100)), H, W)
    before = sorted(tmp_path.iterdir())
    given = [] if what == "no frames" else ["--frames", str(file)]
    assert run(["calibrate", str(camera), *given, "--out", str(tmp_path / "out.yaml"), *extra]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and error.startswith("error: ")
    assert re.search(said, error), error
    assert sorted(tmp_path.iterdir()) == before


def test_an_emulator_that_says_nothing_and_a_file_of_another_kind(tmp_path, capsys):
    camera, frames = files(tmp_path)
    with pytest.raises(ConfigError, match="no parameter is left to fit"):
        calibrate(camera, frames, fixed=emulator_config("esim").fitted)
    with pytest.raises(BlinkGLError, match="no such file"):
        calibrate(tmp_path / "none.npz", frames)
    assert run(["calibrate", str(camera), "--frames", str(frames), "--out", str(tmp_path / "out.txt")]) == 2
    assert "ends in .yaml" in capsys.readouterr().err
    with pytest.raises(EventDataError, match="no frames"):
        calibrate(camera)


# --- a real camera ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_slider_depth_is_fitted_on_its_first_half_and_judged_on_its_second():
    root = shared("data/events/slider_depth")
    times = Declared(timestamps=root / "images.txt")
    result = calibrate(root / "events_chunk.txt", root / "images", declared=times, emulator="esim", starts=2)
    before, after = result.judged_before[1], result.judged[1]
    assert before.rate_ratio > 5 and 0.85 <= after.rate_ratio <= 1.15
    assert before.interval_distance > 0.5 and after.interval_distance <= 0.1
    assert after.polarity_correlation > before.polarity_correlation


def test_tiles_of_a_clip_are_shown_in_rows():
    strip = np.repeat(np.arange(5.0), TILE_PX)[:, None] * np.ones(TILE_PX)
    shown = mosaic(strip)
    assert shown.shape == (2 * TILE_PX, 3 * TILE_PX)
    assert shown[::TILE_PX, ::TILE_PX].tolist() == [[0, 1, 2], [3, 4, 0]]
    whole = np.ones((3 * TILE_PX, 2 * TILE_PX))
    assert mosaic(whole) is whole


@pytest.mark.parametrize("each", [40_000, 75_000])
def test_events_of_a_hot_pixel_are_counted_whole(each):
    """In every eighth of a recording more of one polarity than 16 bits hold."""
    n = 8 * each
    events = Events(*(np.full(n, k, np.uint16) for k in (5, 6)), np.arange(n) * 10, np.ones(n, np.uint8))
    got = sums(events, clip_of_still(events, (16, 16)), 0, 8)
    assert got.both.sum() == got.both[6 * 16 + 5] == n and got.still.sum() == n


def test_a_parameter_that_is_not_there_cannot_be_kept(tmp_path):
    recording = still_recording(tmp_path, shot_noise_rate_hz=3.0)
    with pytest.raises(ConfigError, match=r"--set: no such parameter \(got 'contrast_treshold'\)"):
        calibrate(recording, still=True, starts=1, fixed=["contrast_treshold"])
