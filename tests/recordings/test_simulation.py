"""Video to events: the generator, the files, the command; and everything that can be wrong with the input."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

import blinkgl
from blinkgl.cli import run
from blinkgl.config.events import EsimConfig, V2eConfig
from blinkgl.errors import ConfigError, EventDataError
from blinkgl.events import Events, make_emulator
from blinkgl.io.formats import open_events
from blinkgl.io.reading import Declared
from blinkgl.io.video import VideoReader, VideoWriter
from blinkgl.recordings.decoding import Codes, Decoder
from blinkgl.recordings.fitting import Fitting
from blinkgl.recordings.simulation import FrameUse, SimulationReport, file_to_events, frames_to_events
from blinkgl.srgb import DECODE_8BIT
from tests.shared_data import shared

H, W = 30, 40
AT_100 = Declared(fps=100)


def frames8(count=8, height=H, width=W, channels=()) -> np.ndarray:
    """A bright bar wandering over a gradient, uint8."""
    out = np.empty((count, height, width, *channels), np.uint8)
    ramp = np.linspace(30, 120, width)
    for i in range(count):
        row = ramp.copy()
        row[3 * i : 3 * i + 6] = 230
        out[i] = row.reshape(1, width, *(1,) * len(channels))
    return out


def same(a: Events, b: Events) -> bool:
    return all(np.array_equal(getattr(a, k), getattr(b, k)) for k in "xytp")


def all_of(*args, **kw) -> Events:
    return Events.concatenate(list(frames_to_events(*args, **kw)))


def test_generator_equals_the_emulator_by_hand():
    frames = frames8()
    config = EsimConfig(contrast_threshold=0.3)
    emulator = make_emulator(config, H, W, 5)
    by_hand = Events.concatenate([emulator.step(DECODE_8BIT[f], i * 10_000_000) for i, f in enumerate(frames)])
    assert len(by_hand) > 1000
    report = SimulationReport()
    ours = all_of((f for f in frames), fps=100, emulator=config, seed=5, report=report)
    assert same(ours, by_hand)
    assert (report.frames, report.steps, report.events, report.on) == (
        8,
        8,
        len(ours),
        int(ours.p.sum()),
    ) and report.duration_s == pytest.approx(0.07)
    assert same(all_of([(f, i * 10_000_000) for i, f in enumerate(frames)], emulator=config, seed=5), by_hand)
    assert same(all_of(frames[..., None], fps=100, emulator=config, seed=5), by_hand)
    assert same(Events.concatenate(list(blinkgl.simulate(frames, fps=100, emulator=config, seed=5))), by_hand)


def test_luminance_of_colour_and_gamma():
    codes = np.random.default_rng(0).integers(0, 256, (5, 6, 3)).astype(np.uint8)
    exact = lambda curve: curve(codes / 255.0) @ np.array([0.2126, 0.7152, 0.0722])
    srgb = lambda x: np.where(x <= 0.04045, x / 12.92, ((x + 0.055) / 1.055) ** 2.4)
    assert np.allclose(Decoder("srgb")(codes, ""), exact(srgb), atol=1e-6)
    assert np.allclose(Decoder("linear")(codes, ""), exact(lambda x: x), atol=1e-6)
    assert np.allclose(Decoder(2.2)(codes, ""), exact(lambda x: x**2.2), atol=1e-6)
    real = np.random.default_rng(0).random((5, 6, 3)) * 10
    assert np.allclose(Decoder("linear")(real, ""), real @ np.array([0.2126, 0.7152, 0.0722]), rtol=1e-6)


@pytest.mark.parametrize("emulator", ["esim", "v2e", "voltmeter"])
@pytest.mark.parametrize("interpolate", ["linear", "motion"])
def test_interpolations_run_and_order_events(emulator, interpolate):
    report = SimulationReport()
    texture = cv2.GaussianBlur(np.random.default_rng(0).random((80, 160)) * 255, (0, 0), 3)
    frames = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    frames = np.stack([frames[:, 4 * i : 4 * i + 100] for i in range(5)])
    events = all_of(frames, fps=100, emulator=emulator, interpolate=interpolate, report=report)
    assert len(events) and np.all(np.diff(events.t) >= 0) and events.t[-1] <= 40_000
    assert report.frames == 5 and (report.steps == 5 if interpolate == "linear" else report.steps > 5)
    assert (report.displacement is not None) == (interpolate == "motion")


@pytest.mark.parametrize("step_px, said", [(9, True), (1, False)])
def test_slow_video_is_said(tmp_path, capsys, step_px, said):
    """Events between frames that things jump over are guessed: one line says how far, and what to do."""
    texture = cv2.GaussianBlur(np.random.default_rng(0).random((80, 160)) * 255, (0, 0), 3)
    frames = cv2.normalize(texture, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)
    np.save(tmp_path / "v.npy", np.stack([frames[:, step_px * i : step_px * i + 100] for i in range(4)]))
    command = ["simulate", str(tmp_path / "v.npy"), "--fps", "30", "--out"]
    assert run([*command, str(tmp_path / "e.h5")]) == 0
    warned = re.search(r"warning: things move up to (\d+) px between frames", capsys.readouterr().out)
    assert (warned is not None) == said and (not said or abs(int(warned[1]) - step_px) <= 1)
    assert run([*command, str(tmp_path / "m.h5"), "--interpolate", "motion"]) == 0
    assert "things move" not in capsys.readouterr().out


@pytest.mark.parametrize("gamma", [None, "srgb", "linear"])
def test_what_integer_codes_were_taken_for_is_said(tmp_path, gamma):
    """A recording's own frames are linear; codes of images are taken as sRGB, and the report says where nobody did."""
    np.save(tmp_path / "v.npy", frames8())
    report = file_to_events(tmp_path / "v.npy", tmp_path / "e.h5", declared=AT_100, use=FrameUse(Codes(gamma)))
    assert report.assumed_gamma == ("srgb" if gamma is None else None)
    sized = file_to_events(
        tmp_path / "v.npy", tmp_path / "e.h5", declared=AT_100, use=FrameUse(Codes(gamma)), size=(15, 20)
    )
    assert sized.assumed_gamma == ("srgb" if gamma is None else None)
    own = shared("data/events/aedat4/davis346_events_frames_imu.aedat4")
    file_to_events(own, tmp_path / "own.h5", use=FrameUse(Codes(gamma)))
    file_to_events(own, tmp_path / "linear.h5", use=FrameUse(Codes("linear")))
    alike = same(open_events(tmp_path / "own.h5").read(), open_events(tmp_path / "linear.h5").read())
    assert alike == (gamma != "srgb")


@pytest.mark.parametrize(
    ("size", "channels", "option", "taken"),
    [
        ((H, W), (), [], "linear"),
        ((H, W + 8), (), [], "srgb"),
        ((H, W), (3,), [], "srgb"),
        ((H, W), (), ["--gamma", "srgb"], None),
    ],
)
def test_grey_images_of_the_sensors_size_are_its_own(tmp_path, capsys, size, channels, option, taken):
    """What `calibrate` took the frames for stands in the sensor file, and `simulate` takes such frames for the same."""
    sensor = tmp_path / "mine.yaml"
    sensor.write_text(f"name: mine\nwidth: {W}\nheight: {H}\nframe_gamma: linear\n")
    np.save(tmp_path / "v.npy", frames8(8, *size, channels))
    command = ["simulate", str(tmp_path / "v.npy"), "--fps", "100", "--sensor", str(sensor), "--out"]
    assert run([*command, str(tmp_path / "e.h5"), *option]) == 0
    said = capsys.readouterr().out
    assert ("taken as sRGB" in said) == (taken == "srgb")
    assert ("taken for its own: --gamma linear" in said) == (taken == "linear")
    if not option and channels == ():
        events = Events.concatenate(list(blinkgl.simulate(frames8(8, *size), fps=100, sensor=str(sensor))))
        by_hand = all_of(frames8(8, *size), fps=100, gamma=taken)
        assert same(events, by_hand)


@pytest.mark.parametrize(
    "frame, message",
    [
        (np.full((H, W), np.nan, np.float32), r"frame 2: intensity at pixel x=0, y=0 cannot be used \(got nan\)"),
        (np.full((H, W), -1, np.float32), "frame 2: intensity.*got -1"),
        (np.full((H, W), np.inf, np.float32), "frame 2: intensity.*inf"),
        (np.ones((H, W + 1), np.float32), "frame 2: frame size changed"),
        (np.ones((H, W, 4), np.float32), "frame 2: not a frame"),
        (np.ones((H, W), np.int32), "unsupported pixel type|unsupported frame type"),
    ],
)
@pytest.mark.parametrize("interpolate", ["linear", "motion"])
def test_bad_frames_are_named(frame, message, interpolate):
    with pytest.raises(EventDataError, match=message):
        all_of([GOOD, GOOD * 2, frame, GOOD], fps=10, interpolate=interpolate)


GOOD = np.ones((H, W), np.float32)


@pytest.mark.parametrize(
    "frames, options, message",
    [
        ([], {"fps": 10}, "at least two frames.*0 frames"),
        ([GOOD], {"fps": 10}, "at least two frames.*1 frame"),
        ([(GOOD, 0), (GOOD, 10), (GOOD, 10)], {}, "frame 2: time stamps must increase"),
        ([GOOD, GOOD], {}, "frames without times"),
        ([GOOD], {"fps": 1, "emulator": "iebcs"}, "unknown emulator.*esim, v2e, voltmeter"),
        ([GOOD], {"fps": 1, "interpolate": "spline"}, "unknown interpolation"),
        ([GOOD], {"fps": 1, "gamma": "rec709"}, "unknown transfer curve"),
        ([GOOD], {"fps": 1, "emulator": {"emulator": "esim", "contrast_threshold": 0}}, "esim.contrast_threshold"),
    ],
)
def test_bad_streams(frames, options, message):
    with pytest.raises((EventDataError, ConfigError), match=message):
        all_of(frames, **options)


def write_video(path, frames, fps=100):
    with VideoWriter(path, *frames.shape[1:3], fps) as video:
        for f in frames:
            video.write(np.repeat(f[..., None], 3, axis=-1))


@pytest.mark.parametrize("ending", [".h5", ".raw", ".txt", ".csv", ".npz", ".npy"])
def test_video_to_every_format(tmp_path, ending):
    write_video(tmp_path / "v.mp4", frames8(10))
    expected = Events.concatenate(list(frames_to_events(VideoReader(tmp_path / "v.mp4"), fps=100)))
    report = file_to_events(tmp_path / "v.mp4", tmp_path / f"e{ending}", preview=tmp_path / "p.mp4")
    assert report.events == len(expected) > 1000 and report.frames == 10
    assert same(open_events(tmp_path / f"e{ending}").read(), expected)
    assert len(list(VideoReader(tmp_path / "p.mp4"))) >= 9
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted(["v.mp4", f"e{ending}", "p.mp4"])


def test_commands(tmp_path, capsys):
    write_video(tmp_path / "v.mp4", frames8(10))
    out = str(tmp_path / "e.h5")
    assert (
        run(
            [
                "simulate",
                str(tmp_path / "v.mp4"),
                "--out",
                out,
                "-e",
                "v2e",
                "--set",
                "preset=clean",
                "--interpolate",
                "motion",
            ]
        )
        == 0
    )
    said = capsys.readouterr().out
    assert "from 10 frames" in said and "interpolated by dense-flow warp, not recorded" in said
    assert run(["simulate", str(tmp_path / "v.mp4"), "--out", out]) == 2
    assert "output file exists; expected a new name, or --overwrite" in capsys.readouterr().err
    (tmp_path / "c.yaml").write_text("emulator: v2e\ncontrast_threshold: 1e-1\n")
    assert (
        run(
            [
                "simulate",
                str(tmp_path / "v.mp4"),
                "--out",
                out,
                "--config",
                str(tmp_path / "c.yaml"),
                "--overwrite",
                "-q",
            ]
        )
        == 0
    )
    expected = Events.concatenate(
        list(frames_to_events(VideoReader(tmp_path / "v.mp4"), fps=100, emulator=V2eConfig(contrast_threshold=0.1)))
    )
    assert capsys.readouterr().out == "" and same(open_events(out).read(), expected)
    assert run(["convert", out, str(tmp_path / "e.raw")]) == 0
    assert "40x30, from dsec" in capsys.readouterr().out
    assert run(["compare", out, str(tmp_path / "e.raw"), "--interval-ms", "10", "-o", str(tmp_path / "c")]) == 0
    said = capsys.readouterr().out
    assert "event counts per pixel" in said and (tmp_path / "c" / "compare.png").stat().st_size > 10_000
    for arguments in (
        ["--set", "contrast"],
        ["--config", str(tmp_path / "none.yaml")],
        ["--set", "contrast_treshold=1"],
        ["--gamma", "x"],
    ):
        assert run(["simulate", str(tmp_path / "v.mp4"), "--out", str(tmp_path / "n.h5"), *arguments]) == 2
        error = capsys.readouterr().err
        assert error.startswith("error: ") and error.count("\n") == 1
    assert run(["convert", out, str(tmp_path / "n.raw"), "--size", "3by4"]) == 2
    assert not (tmp_path / "n.h5").exists() and not (tmp_path / "n.raw").exists()


@pytest.mark.parametrize(
    "gamma, fine", [(10, True), ("2.2", True), (10.01, False), (0, False), (-1, False), ([], False)]
)
def test_exponents_of_frames(gamma, fine):
    good = np.ones((2, 2), np.float32)
    if fine:
        assert sum(map(len, frames_to_events([good, good / 8], fps=1, gamma=gamma))) > 0
    else:
        with pytest.raises(ConfigError, match="unknown transfer curve"):
            frames_to_events([good, good], fps=1, gamma=gamma)


def test_real_frames_against_the_real_recording():
    """The signs and places of the simulated events are the recording's: correlation of
    polarity sums, per frame interval."""
    from blinkgl.recordings.comparison import compare

    root = shared("data/events/slider_depth")
    import tempfile

    with tempfile.TemporaryDirectory() as folder:
        file_to_events(
            root,
            f"{folder}/e.h5",
            use=FrameUse(Codes("linear"), "motion"),
            emulator=EsimConfig(contrast_threshold=0.5, log_eps=10 / 255),
        )
        result = compare(root / "events_chunk.txt", f"{folder}/e.h5", frames=root)
    assert len(result.edges_us) == 5 and result.polarity_correlation.min() > 0.8
    assert 0.7 < np.nanmean(result.rate_ratio) < 1.1 and result.pixel_correlation > 0.75


def test_a_sensor_brings_its_parameters_and_its_read_out(tmp_path, capsys):
    """The DAVIS346's bus carries 12 M events/s: a strobing clip makes more, and what does
    not fit is lost and counted."""
    from blinkgl.config.sensor import load_sensor
    from blinkgl.show.simulate import emulator_options

    emulator, camera = emulator_options("v2e", None, ["contrast_threshold=0.3"], "davis346")
    assert emulator == load_sensor("davis346").emulator("v2e", contrast_threshold=0.3)
    assert camera == load_sensor("davis346")
    strobe = [np.full((120, 160), 0.1 if k % 2 else 1.0, np.float32) for k in range(20)]
    report = SimulationReport()
    kept = all_of(strobe, fps=2000, emulator=EsimConfig(), readout=camera.readout, report=report)
    free = all_of(strobe, fps=2000, emulator=EsimConfig())
    assert report.lost > 0 < report.late and len(kept) + report.lost + report.late == len(free)
    assert len(kept) <= 12e6 * 19 / 2000 + 1 and kept.t[-1] <= report.last_ns // 1000
    np.save(tmp_path / "strobe.npy", np.stack(strobe))
    command = [
        "simulate",
        str(tmp_path / "strobe.npy"),
        "--fps",
        "2000",
        "--sensor",
        "DAVIS 346",
        "--set",
        "refractory_us=0",
        "--out",
        str(tmp_path / "e.h5"),
    ]
    assert run(command) == 0 and "lost in the sensor's read-out" in capsys.readouterr().out
    assert run([*command[:-1], str(tmp_path / "f.h5"), "--sensor", "kodak"]) == 2
    assert "unknown sensor" in capsys.readouterr().err


@pytest.mark.parametrize(("given", "part"), [((480, 640), (480, 639)), ((40, 120), (40, 53)), ((260, 346), (260, 346))])
def test_frames_become_the_sensors_size_by_their_middle(given, part):
    """A brightness that rises evenly in x keeps its slope per part of the picture, its middle and its mean."""
    fit = Fitting(given, (260, 346))
    assert fit.part == part
    ramp = np.tile(np.linspace(0, 1, given[1], dtype=np.float32), (given[0], 1))
    fitted = fit(ramp)
    assert fitted.shape == (260, 346) and fitted.mean() == pytest.approx(0.5, abs=0.51 / given[1])
    step = part[1] / given[1] / 346
    np.testing.assert_allclose(np.diff(fitted[:, 4:-4], axis=1), step, rtol=0.05)


def test_a_sensors_size_is_taken_and_said(tmp_path, capsys):
    frames, out = tmp_path / "frames.npy", tmp_path / "e.npz"
    y, x = np.mgrid[:48, :64]
    np.save(frames, np.stack([(40 + 2 * ((x + 3 * k) % 64) + y).astype(np.uint8) for k in range(4)]))
    command = ["simulate", str(frames), "--fps", "50", "--out", str(out), "--overwrite", "--sensor", "davis346"]
    for more, size in (([], (260, 346)), (["--size", "20x10"], (10, 20)), (["--size", "64x48"], (48, 64))):
        assert run([*command, *more]) == 0
        with open_events(out) as file:
            assert (file.height, file.width) == size
        said = capsys.readouterr().out
        assert (f"scaled to {size[1]}x{size[0]} (--size WIDTH" in said) == (size != (48, 64))
    report = blinkgl.simulate_file(frames, out, fps=50, sensor="davis346", size=(48, 64))
    assert report.fitting is None
    assert run([*command, "--size", "64"]) == 2
    assert "--size: not a size (got '64'); expected WIDTHxHEIGHT" in capsys.readouterr().err


@pytest.mark.parametrize(
    "text, overrides, message",
    [
        ("{1: 2}", [], "esim: a key is not text"),
        ("emulator: [esim]", [], "emulator: unknown emulator"),
        ("emulator: {a: 1}", [], "emulator: unknown emulator"),
        ("- 1", [], "not a table of keys .got .1..; expected emulator parameters"),
        ("contrast_threshold: [", [], "not valid YAML"),
        ("", ["preset=[]"], "esim.preset: unknown key"),
        ("", ["emulator=v2e", "preset=[]"], "v2e.preset: unknown choice"),
        ("", ["contrast_threshold={"], "--set contrast_threshold.*not valid YAML"),
        ("", ["emulator=v2e", "contrast_threshold=many"], "not a number"),
    ],
)
@pytest.mark.parametrize("sensor", [None, "davis346"])
def test_emulator_parameters_that_cannot_be_used(tmp_path, text, overrides, message, sensor):
    from blinkgl.show.simulate import emulator_options

    (tmp_path / "e.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        emulator_options("esim", str(tmp_path / "e.yaml"), overrides, sensor)
