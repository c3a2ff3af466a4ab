"""The noise of given frames: found, kept from becoming events, and never found where there is none."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest
import skimage.data

from blinkgl.cli import run
from blinkgl.config.events import EsimConfig
from blinkgl.errors import EventDataError
from blinkgl.events import Events
from blinkgl.io.frames import open_frames
from blinkgl.recordings.clip import FrameReading, clip_of_frames, read_recording, timed_frames
from blinkgl.recordings.decoding import Decoder
from blinkgl.recordings.frame_noise import BAND, MOST_CODES, DenoisedLight, estimated, looked_at
from blinkgl.recordings.simulation import SimulationReport, frames_to_events
from tests.shared_data import shared

H, W, CODE = 96, 128, 1 / 255
ESIM = EsimConfig(contrast_threshold=0.15, threshold_sigma=0.0, log_eps=5 / 255)


def scene(count: int, step_px: float = 0.0) -> np.ndarray:
    """(count, H, W) luminance: a ramp over a fine pattern that stands still, before it a bar that moves."""
    y, x = np.mgrid[:H, :W]
    still = 0.06 + 0.6 * x / W + 0.03 * ((x // 3 + y // 3) % 2)
    frames = np.repeat(still[None], count, axis=0)
    for k in range(count):
        left = 20 + step_px * k
        frames[k][:, (x[0] >= left) & (x[0] < left + 10)] = 0.8
    return frames


def frame_noise(frames):
    """Return the noise that pairs of neighbouring frames show."""
    looks = [look for look in map(looked_at, frames[:-1], frames[1:]) if look is not None and not look.bound]
    return estimated(looks, lambda light: CODE)[0]


def noisy(frames: np.ndarray, constant: float, slope: float, seed: int = 0) -> np.ndarray:
    """As 8-bit codes of light, with noise of this variance."""
    spread = np.sqrt(constant + slope * frames)
    light = frames + spread * np.random.default_rng(seed).standard_normal(frames.shape)
    return np.clip(np.round(light * 255), 0, 255).astype(np.uint8)


def events_of(frames, **options) -> tuple[Events, SimulationReport]:
    report = SimulationReport()
    options = {"fps": 100, "emulator": ESIM, "gamma": "linear", **options}
    return Events.concatenate(list(frames_to_events(frames, report=report, **options))), report


def test_where_nearly_all_blocks_change_smoothly_no_noise_is_told():
    """Light that moves is in nearly every block of these frames, and white noise in one of twenty."""
    y, x = np.mgrid[:480, :640]
    rng = np.random.default_rng(0)
    frames = []
    for k in range(4):
        frame = 0.4 + 0.2 * np.sin(2 * np.pi * (x + 2 * k) / 24) * np.cos(2 * np.pi * (y - k) / 32)
        frame[:24] = 0.4 + 0.02 * rng.standard_normal((24, 640))
        frames.append(frame.astype(np.float32))
    assert frame_noise(frames) is None
    assert frame_noise([frame[:24] for frame in frames]) is not None, "which is noise by itself"


def moving(photograph: str, step_px: float) -> list[np.ndarray]:
    """Five frames of a photograph that moves, as 8-bit codes of sRGB say its light."""
    image = getattr(skimage.data, photograph)().astype(np.float32)
    frames = []
    for k in range(5):
        # At twice the size, so that every frame is as sharp as the others.
        shift = np.float32([[1, 0, -20 - 2 * step_px * k], [0, 1, -20 - 1.2 * step_px * k]])
        large = cv2.warpAffine(image, shift, (480, 360), flags=cv2.INTER_CUBIC, borderMode=cv2.BORDER_REFLECT)
        moved = cv2.resize(large, (240, 180), interpolation=cv2.INTER_AREA).clip(0, 255)
        frames.append(((np.round(moved) / 255) ** 2.2).astype(np.float32))
    return frames


@pytest.mark.parametrize("photograph", ["grass", "gravel", "coins"])
@pytest.mark.parametrize("step_px", [0.5, 2.0, 7.0])
def test_a_fine_texture_that_moves_is_no_noise(photograph, step_px):
    frames = moving(photograph, step_px)
    assert frame_noise(frames) is None


@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_noise_is_found_where_nothing_else_is(sigma):
    frames = 0.4 + sigma * np.random.default_rng(0).standard_normal((5, 180, 240))
    assert frame_noise(list(frames.astype(np.float32))).typical[1] == pytest.approx(sigma, rel=0.1)


@pytest.mark.parametrize("step_px", [0.0, 2.0])
@pytest.mark.parametrize(("constant", "slope"), [((2 * CODE) ** 2, 0.0), (CODE**2, 2e-4), (1e-7, 5e-4)])
def test_noise_is_found_at_every_brightness(constant, slope, step_px):
    frames = noisy(scene(5, step_px), constant, slope).astype(np.float32) / 255
    found = frame_noise(list(frames))
    assert found is not None
    light = np.array([0.1, 0.3, 0.6])
    rounding = CODE**2 / 12
    np.testing.assert_allclose(found.sigma(light), np.sqrt(constant + slope * light + rounding), rtol=0.15)


def test_a_still_camera_makes_no_events_of_noise_and_a_moving_bar_its_own():
    exact, _ = events_of(scene(12, 2.0).astype(np.float32))
    noise, _ = events_of(noisy(scene(12), 4 * CODE**2, 2e-4), keep_noise=True)
    still, report = events_of(noisy(scene(12), 4 * CODE**2, 2e-4))
    assert report.noise is not None and "noise is" in str(report.noise)
    assert len(noise) > 2000 and len(still) < len(noise) / 200
    moving, _ = events_of(noisy(scene(12, 2.0), 4 * CODE**2, 2e-4))
    where = lambda events: np.bincount(events.x, minlength=W)
    assert len(moving) == pytest.approx(len(exact), rel=0.15)
    assert np.corrcoef(where(moving), where(exact))[0, 1] > 0.97


def test_a_texture_that_moves_is_no_noise():
    """All over the picture, so that no block stands still: fine texture that jumps by pixels."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).random((H, 2 * W)).astype(np.float32), (0, 0), 1.2)
    texture = cv2.normalize(texture, None, 0.1, 0.9, cv2.NORM_MINMAX)
    exact = [np.round(texture[:, 3 * k : 3 * k + W] * 255) / 255 for k in range(5)]
    assert frame_noise([frame.astype(np.float32) for frame in exact]) is None


@pytest.mark.parametrize(
    "frames",
    [
        np.round(scene(8, 2.0) * 255).astype(np.uint8),
        np.repeat(np.round(scene(8, 1.3) * 255).astype(np.uint8)[..., None], 3, axis=3),
        noisy(scene(8), 4 * CODE**2, 0.0).astype(np.float32) / 255,
    ],
    ids=["rendered", "rendered in colour", "floats"],
)
def test_exact_frames_are_taken_as_they_are(frames):
    kept, _ = events_of(frames, keep_noise=True)
    ours, report = events_of(frames)
    assert report.noise is None
    assert all(np.array_equal(getattr(ours, k), getattr(kept, k)) for k in "xytp")


def test_a_pixel_moves_no_further_than_noise_leaves_it():
    """A band round where a pixel stands: inside nothing changes, a ramp is followed at the band's distance."""
    light = lambda codes: codes.astype(np.float32) / 255
    steady = DenoisedLight(light, lambda light: CODE)
    still = noisy(scene(200), 4 * CODE**2, 0.0)
    for frame in still[:100]:
        shown = steady(frame)
    band = BAND * steady.noise.sigma(np.float32(0.3))
    ramp = [light(frame) + np.float32(0.1 * band * k) for k, frame in enumerate(still[100:])]
    assert np.abs(shown - light(still[99])).max() <= 1.02 * np.sqrt(1 + 1 / 99) * band
    for value in ramp:
        shown = steady(value, value)
    behind = np.median(ramp[-1] - shown)
    assert behind == pytest.approx(band, rel=0.25), "the ramp pushes with its highest values, noise included"


RNG = np.random.default_rng(5)
TEXTURE = np.kron(RNG.integers(60, 160, (H // 8, W // 8)), np.ones((8, 8)))
SMOOTH = cv2.GaussianBlur(np.kron(RNG.integers(40, 200, (H // 8, 60)), np.ones((8, 8))), (0, 0), 1.5)


def grain(picture: np.ndarray, sigma: float) -> np.ndarray:
    """8-bit codes with noise of ``sigma`` codes."""
    return np.clip(np.rint(picture + RNG.normal(0, sigma, picture.shape)), 0, 255).astype(np.uint8)


def pan(count: int, sigma: float = 0.0) -> list[np.ndarray]:
    return [grain(SMOOTH[:, 2 * k : 2 * k + W], sigma) for k in range(count)]


def dots(low: int, high: int, flips: float, count: int = 30) -> list[np.ndarray]:
    """A stimulus of random dots, of which a part flips every frame."""
    lit, frames = RNG.integers(0, 2, (H, W)), []
    for _ in range(count):
        frames.append(np.where(lit, high, low).astype(np.uint8))
        lit = np.where(RNG.random((H, W)) < flips, 1 - lit, lit)
    return frames


def share(frames, after: int = 0) -> float:
    """Events from frame ``after`` on, as a share of those that are made with the noise."""
    counts = [
        sum(int((e.t > 10_000 * after).sum()) for e in frames_to_events(frames, fps=100, keep_noise=keep, seed=3))
        for keep in (False, True)
    ]
    return counts[0] / counts[1]


@pytest.mark.parametrize(
    ("frames", "after", "most"),
    [
        ([grain(TEXTURE, 4) for _ in range(40)], 1, 0.01),
        ([np.zeros((H, W), np.uint8)] * 10 + [grain(TEXTURE, 4) for _ in range(40)], 11, 0.02),  # a black leader
        ([np.full((H, W), 30, np.uint8)] * 10 + [grain(TEXTURE, 4) for _ in range(40)], 11, 0.02),  # a grey one
        ([TEXTURE.astype(np.uint8)] * 20 + [grain(TEXTURE, 4) for _ in range(40)], 21, 0.02),  # a clean title
        ([grain(TEXTURE * (1 + 0.05 * (-1) ** k), 2) for k in range(40)], 1, 0.02),  # flicker
        ([grain(p, 4) for p in (TEXTURE, SMOOTH[:, :W], TEXTURE[::-1]) for _ in range(20)], 41, 0.2),  # cuts
        ([np.stack([grain(TEXTURE, 4)] * 3, -1) for _ in range(30)], 1, 0.01),
        ([grain(TEXTURE, 4).astype(np.uint16) * 257 for _ in range(30)], 1, 0.01),
    ],
    ids=["grain", "black leader", "grey leader", "title", "flicker", "cuts", "colour", "16 bits"],
)
def test_noise_is_kept_out_whatever_came_before(frames, after, most):
    assert share(frames, after) < most


@pytest.mark.parametrize(
    ("frames", "after"),
    [
        (dots(80, 180, 0.1), 0), (dots(118, 136, 0.1), 0), (dots(110, 140, 0.02), 0), (dots(100, 150, 0.5), 0),
        ([grain(np.full((H, W), 128.0), 2.5 * MOST_CODES) for _ in range(20)], 0),
        (pan(30), 0), ([grain(TEXTURE, 4) for _ in range(8)] + pan(40), 14),
        ([grain(TEXTURE, 4) for _ in range(8)] + [TEXTURE.astype(np.uint8)] * 20 + pan(30), 28),
    ],
    ids=["a tenth flips", "weak dots", "few flip", "half flips", "white noise", "pan", "noise, then a pan",
         "noise, stillness, a pan"],
)  # fmt: skip
def test_what_a_clip_shows_makes_its_events(frames, after):
    assert share(frames, after) > 0.97


def flickering(count: int, more: float = 0.1, dark: float = 0.8) -> np.ndarray:
    """Frames whose light is ``dark`` and ``dark + more`` of the scene's in turn."""
    return np.round(scene(count) * (dark + more * (np.arange(count) % 2))[:, None, None] * 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("frames", "said"),
    [
        (flickering(9), "warning: the whole picture flickers, by a factor of 1.13 from frame to frame"),
        (np.clip(np.round(scene(6, 2.0) * 500), 0, 255).astype(np.uint8), "% of the codes are at an end"),
        (np.round(scene(6, 2.0) * 15).astype(np.uint8) * 17, "warning: frames of 11 different codes"),
        (noisy(scene(2), 4 * CODE**2, 0.0), "own noise is"),
        (np.round(scene(6) * 255).astype(np.uint8), "0 events"),
    ],
    ids=["flicker", "clipped", "four bits", "two frames", "in a static scene"],
)
def test_frames_with_a_caveat(tmp_path, capsys, frames, said):
    np.save(tmp_path / "v.npy", frames)
    assert run(["simulate", str(tmp_path / "v.npy"), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 0
    out = capsys.readouterr().out
    assert said in out
    assert ("warning:" in out) == ("warning:" in said or "at an end" in said)


@pytest.mark.parametrize("levels", [np.arange(20, 200, 16), np.array([0, 13, 25, 38, 51, 64, 76, 89, 102]), [7] * 5])
def test_a_fade_and_a_blank_picture_have_no_caveat(tmp_path, capsys, levels):
    """Brightness that only rises is no flicker; one code has no step to another."""
    np.save(tmp_path / "v.npy", np.ones((1, 24, 32), np.uint8) * np.asarray(levels, np.uint8)[:, None, None])
    assert run(["simulate", str(tmp_path / "v.npy"), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 0
    assert "flickers" not in (out := capsys.readouterr().out) and "of 1 different codes" not in out


@pytest.mark.parametrize(("more", "dark"), [(0.1, 0.8), (0.5, 0.5), (0.84, 0.15), (0.9, 0.02), (0.02, 0.8)])
def test_how_much_the_picture_flickers(tmp_path, capsys, more, dark):
    """The brighter frames over the darker ones, for small factors and for large ones."""
    np.save(tmp_path / "v.npy", flickering(9, more, dark))
    assert run(["simulate", str(tmp_path / "v.npy"), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 0
    said = re.search(
        r"the whole picture flickers, by a factor of (\S+) from frame to frame, and", capsys.readouterr().out
    )
    assert said and float(said[1]) == pytest.approx((dark + more) / dark, rel=0.03)


def test_one_light_in_files_of_8_and_16_bits_does_not_flicker(tmp_path, capsys):
    codes = np.random.default_rng(1).integers(40, 200, (48, 64)).astype(np.uint8)
    for k in range(9):
        cv2.imwrite(str(tmp_path / f"{k:03d}.png"), codes if k % 2 else codes.astype(np.uint16) * 257)
    assert run(["simulate", str(tmp_path), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 0
    out = capsys.readouterr().out
    assert "0 events" in out and "flicker" not in out


def test_still_pixels_of_a_recording():
    """cuke_davis346, a still camera: of the pixels where nothing changes no more events are left than the camera's
    own, where there were many times as many."""
    path = shared("data/events/cuke_davis346/demo-01.aedat4")
    events, size, _ = read_recording(path)
    frames, exposures = timed_frames(path)
    clip = clip_of_frames(events, frames, size, FrameReading(exposures=exposures, delay_ms=5.0))
    rate = lambda stream: np.count_nonzero(clip.still[stream.y, stream.x])
    recorded, made = rate(clip.events), rate(clip.simulate(EsimConfig(contrast_threshold=0.25, log_eps=5 / 255)))
    assert 0 < made < recorded


# ---------------------------------------------------------------------------------------------------------------------
# Few rows, mosaics of colour filters, and frames that say what they are.


def counted(frames, **use):
    report = SimulationReport()
    events = frames_to_events(frames, fps=1000, report=report, gamma="linear", **use)
    return sum(map(len, events)), report


@pytest.mark.parametrize("shape", [(8, 96), (96, 8), (9, 96), (16, 96), (4, 200)])
def test_grain_of_few_rows_makes_few_events(shape):
    """As of a large picture: each pixel of grain of 4 codes has 4 to 5 events in 60 frames if nothing is done."""
    rng = np.random.default_rng(0)
    light = np.linspace(60, 160, shape[1])[None] * np.ones((shape[0], 1))
    film = [np.clip(np.rint(light + rng.normal(0, 4, shape)), 0, 255).astype(np.uint8) for _ in range(60)]
    few = sum(map(len, frames_to_events(film, fps=100, gamma="srgb")))
    many = sum(map(len, frames_to_events(film, fps=100, gamma="srgb", keep_noise=True)))
    assert many > 3 * film[0].size and few < 0.05 * film[0].size


def mosaic_of(k: int, speed: float, height: int = 96, width: int = 128) -> np.ndarray:
    """A smooth scene behind RGGB filters, 16 bits, without noise."""
    y, x = np.mgrid[0:height, 0:width].astype(float)
    x = x - k * speed
    red = 0.5 + 0.35 * np.sin(x / 9) * np.cos(y / 13)
    green = 0.7 * (0.4 + 0.3 * np.cos(x / 7 + 1) * np.sin(y / 11))
    blue = 0.4 * (0.3 + 0.25 * np.sin(x / 12 + y / 8))
    out = green.copy()
    out[::2, ::2], out[1::2, 1::2] = red[::2, ::2], blue[1::2, 1::2]
    return (out * 60000).astype(np.uint16)


@pytest.mark.parametrize("speed", [0.09, 1.5])
def test_a_mosaic_without_noise_is_exact(speed):
    film = [mosaic_of(k, speed) for k in range(60)]
    count, report = counted(film)
    assert report.noise is None and count == counted(film, keep_noise=True)[0]
    assert report.guessed_over_px == pytest.approx(speed, rel=0.3)


def test_the_noise_of_a_mosaic_is_found():
    rng = np.random.default_rng(0)
    film = [np.clip(mosaic_of(0, 0) + rng.normal(0, 900, (96, 128)), 0, 65535).astype(np.uint16) for _ in range(30)]
    count, report = counted(film)
    assert report.noise is not None and count < 0.02 * counted(film, keep_noise=True)[0]
    assert report.noise.typical[1] == pytest.approx(900 / 65535, rel=0.25)


@pytest.mark.parametrize("noise", ["photon_noise: false", "photon_noise: true"])
def test_the_frame_camera_of_a_sequence_says_what_it_is(tmp_path, noise):
    folder = tmp_path / "frame_camera" / "images"
    folder.mkdir(parents=True)
    (tmp_path / "config.yaml").write_text(
        f"images: {{bits: 12, response: linear, black: 0.0625, bayer: rggb, {noise}}}\n"
    )
    (tmp_path / "frame_camera" / "exposures.csv").write_text("start_us\n")
    (folder / "timestamps.txt").write_text("".join(f"{1000 * k}\n" for k in range(4)))
    for k in range(4):
        cv2.imwrite(str(folder / f"{k:06d}.png"), np.full((16, 24), 256 + 100 * k, np.uint16))
    source = open_frames(folder)
    assert source.levels == (0.0625 * 4095, 4095.0) and source.transfer == "linear"
    assert source.exact == ("false" in noise) and [t for _, t, _ in source] == [0, 10**6, 2 * 10**6, 3 * 10**6]
    assert any("linear, 12 bits, rggb filters" in note for note in source.notes)


@pytest.mark.parametrize(
    ("levels", "dtype"), [(None, "u1"), (None, "u2"), ((16, 235), "u1"), ((64, 940), "u2"), ((0, 4095), "u2")]
)
def test_the_distance_of_codes_is_that_of_256(levels, dtype):
    """Of linear codes it is 1/255 everywhere, however many of them lie between black and white."""
    assert Decoder("linear", levels).code_distance(dtype)(0.5) * 255 == pytest.approx(1, rel=1e-3)


@pytest.mark.parametrize(("dtype", "white"), [(np.uint8, 255), (np.uint16, 1023), (np.uint16, 65535)])
def test_codes_at_the_declared_white_are_at_an_end(tmp_path, capsys, dtype, white):
    """Half of the pixels are clipped, whatever code is white; a tenth below it none is."""
    for top, said in ((white, True), (round(0.9 * white), False)):
        frames = np.random.default_rng(0).integers(white // 4, white // 2, (6, 48, 64)).astype(dtype)
        frames[:, :24] = top
        np.save(tmp_path / "v.npy", frames)
        words = ["--white-level", str(white)] if white == 1023 else ["--range", "full"]
        line = ["simulate", str(tmp_path / "v.npy"), "--fps", "100", *words, "--out", str(tmp_path / "e.h5")]
        assert run([*line, "--overwrite"]) == 0
        assert ("50 % of the codes are at an end" in capsys.readouterr().out) == said


@pytest.mark.parametrize("dtype", [np.uint32, np.uint64, np.int32])
def test_other_integers_are_refused_before_anything_is_made_of_them(dtype):
    with pytest.raises(EventDataError, match=r"unsupported pixel type .*expected uint8, uint16 or float"):
        events_of(np.zeros((3, 8, 8), dtype))


@pytest.mark.parametrize(
    "options",
    [["--fps", "10"], ["--gamma", "2.2"], ["--white-level", "9"], ["--range", "full"], ["--timestamps", "nothing.txt"],
     ["--background", "black"], ["--frames-time-unit", "us"], ["--frame-delay-ms", "3"]],
    ids=lambda words: words[0],
)  # fmt: skip
def test_what_is_declared_of_frames_needs_frames(tmp_path, capsys, options):
    np.savez(
        tmp_path / "e.npz", t_us=np.arange(2000) * 10, x=np.ones(2000, int), y=np.ones(2000, int), p=np.ones(2000, int)
    )
    for command in (
        ["compare", str(tmp_path / "e.npz")],
        ["calibrate", str(tmp_path / "e.npz"), "--still", "--out", str(tmp_path / "o.yaml")],
    ):
        assert run([*command, *options]) == 2
        said = capsys.readouterr().err
        assert f"{options[0]}: there are no frames; expected --frames, or nothing of frames" in said
    np.save(tmp_path / "v.npy", scene(6, 2.0).astype(np.float32)[:, :4, :4])
    assert run(["compare", str(tmp_path / "e.npz")]) == 0
    assert (
        run(["compare", str(tmp_path / "e.npz"), "--size", "4x4", "--frames", str(tmp_path / "v.npy"), "--fps", "300"])
        == 0
    )
