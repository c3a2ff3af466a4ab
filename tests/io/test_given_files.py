"""Files that programs of others wrote, with what is right of each (skipped where the shared folder is absent)."""

from __future__ import annotations

import re
import shutil

import numpy as np
import pytest

from blinkgl import cli
from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.reading import NOTHING, Declared, EventReading
from blinkgl.types.events import Events
from tests.shared_data import shared

FOLDER = "field/next/files"


def given(name: str):
    return shared(f"{FOLDER}/{name}")


def truth() -> Events:
    with np.load(given("03_truth.npz")) as file:
        return Events(
            file["x"].astype(np.uint16), file["y"].astype(np.uint16), file["t"].astype(np.int64), file["p"].astype("u1")
        )


def same(found: Events, columns: str = "xytp", *, shift: bool = False) -> None:
    right = truth()
    assert len(found) == len(right)
    for name in columns:
        a, b = getattr(found, name), getattr(right, name)
        np.testing.assert_array_equal(a - a[0] if shift else a, b - b[0] if shift else b)


def events(name: str, **declared) -> tuple[Events, list[str], tuple]:
    with open_events(given(name), EventReading.of(**declared)) as file:
        return file.read(), file.notes, (file.height, file.width)


def frames(name: str, declared: Declared = NOTHING) -> tuple[list[np.ndarray], list[int], list[str]]:
    source = open_frames(given(name), declared)
    pictures, times = [], []
    for picture, t_ns, _ in source:
        pictures.append(picture)
        times.append(t_ns)
    return pictures, times, source.notes


def grey(picture: np.ndarray) -> np.ndarray:
    return picture if picture.ndim == 2 else picture.mean(-1)


def run(capsys, *arguments) -> tuple[int, str]:
    status = cli.run([str(a) for a in arguments])
    captured = capsys.readouterr()
    assert "Traceback" not in captured.err
    return status, captured.out + captured.err


def one_line(call, *words: str) -> str:
    with pytest.raises(BlinkGLError) as error:
        call()
    text = str(error.value)
    assert "\n" not in text
    for word in words:
        assert word in text, text
    return text


ROWS = {"time_unit": "us", "columns": "x,y,p,t"}


@pytest.mark.parametrize(
    ("name", "declared", "count", "size", "said"),
    [
        ("04_dvs128.aedat", {}, 200, (128, 128), ""),
        ("04_dvs128.aedat", {"size": "128x128"}, 200, (128, 128), ""),
        ("16_evimo.npz", {}, 200, None, "meta"),
        ("20_format_by_system_id.raw", {}, 150, (480, 640), ""),
        ("20_size_by_system_id.raw", {}, 150, (480, 640), ""),
        ("27_openeb_geometry.csv", ROWS, 200, (720, 1280), ""),
        ("28_size_in_attributes.h5", {}, 9, (480, 640), ""),
        ("30_triggers.raw", {}, 200, None, "2 triggers"),
        ("34_polarity_255.csv", {"time_unit": "us", "polarity": "0/255"}, 200, None, ""),
    ],
)
def test_events(name, declared, count, size, said):
    found, notes, sized = events(name, **declared)
    assert len(found) == count and size in (None, sized) and said in " ".join(notes)


@pytest.mark.parametrize("name", ["03_dat_version.dat", "18_lucid_padding.raw", "19_evt21_by_system_id.raw"])
def test_the_same_events(tmp_path, name):
    """Names of files say nothing: a copy under another name gives the same."""
    path = tmp_path / f"some recording{given(name).suffix}"
    shutil.copy(given(name), path)
    for one in (given(name), path):
        with open_events(one) as file:
            same(file.read())


@pytest.mark.parametrize(
    ("read", "words", "without"),
    [
        (lambda: events("11_other_array_first.npz"), ["--columns"], "--damaged"),
        (lambda: events("12_two_cameras.npz"), ["--stream", "0", "1"], "--damaged"),
        (lambda: events("13_stereo_frames.aedat4"), ["--stream"], "--damaged"),
        (lambda: frames("15_ycgco.mp4"), ["YCgCo"], "--"),
        (lambda: frames("24_lab", Declared(fps=100)), ["PhotometricInterpretation", "8"], "--damaged"),
        (lambda: events("34_polarity_255.csv", time_unit="us"), ["--polarity"], "--damaged keep"),
        (lambda: events("35_late_event.txt", columns="x,y,t,p", time_unit="us"), ["--sort"], "--columns"),
        (lambda: events("35_late_event.txt", sort=True), ["--columns x,y,t,p", "--time-unit us"], "--damaged"),
    ],
)
def test_what_is_refused_names_what_is_right(read, words, without):
    """(Of 24: TIFF says that a and b are signed; this file has them from 128 on, so no reading is right for both.)"""
    assert without not in one_line(read, *words)


EVERY = Declared(fps=30)


@pytest.mark.parametrize(
    ("name", "declared", "ticks", "said"),
    [
        ("01_trimmed.mp4", NOTHING, range(30), ""),
        ("02_null_frames.avi", NOTHING, [*range(10), *range(13, 20), *range(21, 26)], ""),
        ("08_imagej_ms.tif", NOTHING, [0, 0.3, 0.6, 0.9], "10 ms"),
        ("21_open_gop_cut.mkv", NOTHING, 30, "left out"),
        ("22_within_gop.ts", NOTHING, 14, "left out"),
        ("23_motion_photo", EVERY, range(3), ""),
        ("25_vp8_hidden.webm", NOTHING, 28, ""),
        ("32_grey_and_colour", EVERY, range(4), ""),
    ],
)
def test_frames(name, declared, ticks, said):
    """Their number, or times in thirtieths of a second."""
    pictures, times, notes = frames(name, declared)
    assert len(pictures) == (ticks if isinstance(ticks, int) else len(ticks)) and said in " ".join(notes)
    assert isinstance(ticks, int) or np.allclose(np.array(times) / 1e9 * 30, ticks, atol=1e-3)


def test_the_first_frame_is_the_first_that_decodes():
    _, times, notes = frames("21_open_gop_cut.mkv")
    stated = re.search(r"the first frame is at (\S+) s of the file", " ".join(notes))
    assert times[0] > 0 and float(stated[1]) == pytest.approx(times[0] / 1e9, rel=1e-5)


@pytest.mark.parametrize(
    ("name", "low", "high"),
    [("05_cmyk", (38, 42), (198, 202)), ("06_premultiplied", (19, 21), (0, 255)),
     ("07_pgm_maximum", (37.5, 40), (198.5, 200.5))],
)  # fmt: skip
def test_levels(name, low, high):
    """Colours of print; associated alpha, which is multiplied once; the maximum of PGM."""
    source = open_frames(given(name), Declared(fps=100))
    white = source.levels[1] if source.levels else 255
    for picture, *_ in source:
        for bounds, code in ((low, grey(picture).min()), (high, grey(picture).max())):
            assert bounds[0] <= float(code) * 255 / white <= bounds[1]


def test_09_alpha_of_webm():
    assert np.all(np.diff([float(grey(p).mean()) for p in frames("09_alpha.webm")[0]]) > 3)


def test_10_pixel_aspect():
    pictures, _, notes = frames("10_anamorphic.mp4")
    assert pictures[0].shape[:2] == (32, 70) and "16:11" in " ".join(notes)


def test_12_two_cameras():
    a, b = (events("12_two_cameras.npz", stream=k, columns="t,x,y,p", time_unit="us")[0] for k in ("0", "right"))
    assert len(a) and len(b) and not np.array_equal(a.x, b.x)


@pytest.mark.parametrize(("stream", "level"), [("0", 50), ("2", 180)])
def test_13_frames_of_the_camera_that_is_read(stream, level):
    with open_events(given("13_stereo_frames.aedat4"), EventReading.of(stream=stream)) as file:
        assert abs(np.mean([frame.image.mean() for frame in file.frames()]) - level) < 2


def test_13_two_frame_streams_are_listed():
    with open_events(given("13_two_frame_streams.aedat4")) as file:
        one_line(lambda: list(file.frames()), "frames", "--stream")


@pytest.mark.parametrize(("name", "first"), [("OUT.NPZ", 0), ("OUT.AEDAT4", 0), ("n.aedat4", -5000)])
def test_14_endings_in_capitals_and_negative_times(tmp_path, capsys, name, first):
    (tmp_path / "a.csv").write_text(f"t,x,y,p\n{first},1,2,1\n1000,3,4,0\n2000,5,6,1\n")
    out = tmp_path / name
    status, text = run(capsys, "convert", tmp_path / "a.csv", out, "--time-unit", "us", "--size", "16x16")
    if first < 0:
        assert (status, text.count("\n")) == (2, 1)
    else:
        assert status == 0 and out.read_bytes().startswith(b"PK" if name == "OUT.NPZ" else b"#!AER-DAT4.0")
        assert open_events(out).read().x.tolist() == [1, 3, 5]


def test_17_nanoseconds_since_1970():
    found, _, _ = events("17_ns_since_1970.csv", time_unit="ns")
    lines = given("17_ns_since_1970.csv").read_text().splitlines()[1:]
    assert found.t.tolist() == [(int(line.split(",")[0]) + 500) // 1000 for line in lines]


def test_30_triggers_are_written(tmp_path, capsys):
    words = ["convert", given("30_triggers.raw"), tmp_path / "o.h5", "--triggers", tmp_path / "triggers.csv"]
    assert run(capsys, *words)[0] == 0
    assert len((tmp_path / "triggers.csv").read_text().splitlines()) == 3


def test_35_a_late_event():
    found, _, _ = events("35_late_event.txt", columns="x,y,t,p", time_unit="us", sort=True)
    rows = np.loadtxt(given("35_late_event.txt")).astype(int)
    rows = rows[np.argsort(rows[:, 2], kind="stable")]
    np.testing.assert_array_equal(np.stack([found.x, found.y, found.t, found.p], 1), rows)
