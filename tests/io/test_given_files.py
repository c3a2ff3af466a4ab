"""Files that programs of others wrote, with what is right of each (skipped where the shared folder is absent)."""

from __future__ import annotations

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


def test_01_a_trimmed_clip_is_whole():
    pictures, times, _ = frames("01_trimmed.mp4")
    assert len(pictures) == 30
    assert np.allclose(np.array(times) / 1e9, np.arange(30) / 30, atol=1e-4)


def test_02_null_frames_of_avi_are_gaps():
    pictures, times, _ = frames("02_null_frames.avi")
    right = [*range(10), *range(13, 20), *range(21, 26)]
    assert len(pictures) == 22
    assert np.allclose(np.array(times) / 1e9 * 30, right, atol=1e-3)


def test_03_dat_without_a_version():
    same(events("03_dat_version.dat")[0])


def test_04_dvs128_or_a_refusal_without_size():
    try:
        found, _, size = events("04_dvs128.aedat")
    except BlinkGLError as error:
        assert "--size" not in str(error)
    else:
        assert len(found) == 200 and size == (128, 128)


@pytest.mark.parametrize(("size", "stated"), [("128x128", False)])
def test_04_a_size_makes_no_events_of_another_camera(size, stated):
    try:
        found, _, _ = events("04_dvs128.aedat", size=size)
    except BlinkGLError:
        return
    assert len(found) == 200


def levels(name: str) -> tuple[set[int], set[int]]:
    pictures, _, _ = frames(name, Declared(fps=100))
    ends = [(grey(p).min(), grey(p).max()) for p in pictures]
    return {round(float(a)) for a, _ in ends}, {round(float(b)) for _, b in ends}


def test_24_lab_is_refused_by_name():
    """TIFF says that a and b are signed; this file has them from 128 on, so no reading is right for both."""
    one_line(lambda: levels("24_lab"), "PhotometricInterpretation", "8")


def test_05_colours_of_print():
    low, high = levels("05_cmyk")
    assert all(abs(v - 40) <= 2 for v in low) and all(abs(v - 200) <= 2 for v in high), (low, high)


def test_06_associated_alpha_is_multiplied_once():
    low, _ = levels("06_premultiplied")
    assert all(abs(v - 20) <= 1 for v in low), low


def test_07_maximum_of_pgm():
    pictures, _, _ = frames("07_pgm_maximum", Declared(fps=100))
    source = open_frames(given("07_pgm_maximum"), Declared(fps=100))
    white = source.levels[1] if source.levels else 255
    low, high = (float(f([f(p.ravel()) for p in pictures])) / white * 255 for f in (np.min, np.max))
    assert 37.5 <= low <= 40 and 198.5 <= high <= 200.5, (low, high)


def test_08_unit_of_imagej():
    _, times, _ = frames("08_imagej_ms.tif")
    np.testing.assert_allclose(np.diff(times), 10e6, rtol=1e-6)


def test_09_alpha_of_webm():
    pictures, _, notes = frames("09_alpha.webm")
    brightness = [float(grey(p).mean()) for p in pictures]
    assert np.all(np.diff(brightness) > 3) or any("alpha" in note for note in notes), brightness


def test_10_pixel_aspect():
    pictures, _, notes = frames("10_anamorphic.mp4")
    assert pictures[0].shape[:2] == (32, 70) or any("aspect" in note for note in notes), pictures[0].shape


def test_11_another_array_first():
    try:
        found, _, _ = events("11_other_array_first.npz")
    except BlinkGLError:
        return
    assert len(found) == 200


def test_12_two_cameras():
    text = one_line(lambda: events("12_two_cameras.npz"), "--stream")
    assert "0" in text and "1" in text
    declared = {"columns": "t,x,y,p", "time_unit": "us"}
    a, b = (events("12_two_cameras.npz", stream=k, **declared)[0] for k in ("0", "right"))
    assert len(a) and len(b) and not np.array_equal(a.x, b.x)


def test_13_frames_of_the_camera_that_is_read():
    name = "13_stereo_frames.aedat4"
    one_line(lambda: events(name), "--stream")
    means = []
    for stream in ("0", "2"):
        with open_events(given(name), EventReading.of(stream=stream)) as file:
            means.append(np.mean([frame.image.mean() for frame in file.frames()]))
    assert abs(means[0] - 50) < 2 and abs(means[1] - 180) < 2, means


def test_13_two_frame_streams_are_listed():
    with open_events(given("13_two_frame_streams.aedat4")) as file:
        one_line(lambda: list(file.frames()), "frames", "--stream")


@pytest.fixture
def small(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("t,x,y,p\n0,1,2,1\n1000,3,4,0\n2000,5,6,1\n")
    return path


def test_14_an_ending_in_capitals(small, tmp_path, capsys):
    assert run(capsys, "convert", small, tmp_path / "OUT.NPZ", "--time-unit", "us", "--size", "16x16")[0] == 0
    assert (tmp_path / "OUT.NPZ").read_bytes()[:2] == b"PK"
    with np.load(tmp_path / "OUT.NPZ") as file:
        assert file["x"].tolist() == [1, 3, 5]


def test_14_aedat4_in_capitals(small, tmp_path, capsys):
    pytest.importorskip("dv_processing")
    status, text = run(capsys, "convert", small, tmp_path / "OUT.AEDAT4", "--time-unit", "us", "--size", "16x16")
    assert status in (0, 2) and (status == 0 or text.count("\n") == 1)


def test_14_negative_times(tmp_path, capsys):
    pytest.importorskip("dv_processing")
    path = tmp_path / "n.csv"
    path.write_text("t,x,y,p\n-5000,1,2,1\n1000,3,4,0\n")
    status, text = run(capsys, "convert", path, tmp_path / "n.aedat4", "--time-unit", "us", "--size", "16x16")
    assert status in (0, 2) and (status == 0 or text.count("\n") == 1)


def test_15_ycgco():
    try:
        pictures, _, _ = frames("15_ycgco.mp4")
    except BlinkGLError as error:
        assert "\n" not in str(error)
    else:
        assert pictures


def test_16_evimo():
    found, notes, _ = events("16_evimo.npz")
    assert len(found) == 200
    assert any("meta" in note for note in notes)


def test_17_nanoseconds_since_1970():
    found, _, _ = events("17_ns_since_1970.csv", time_unit="ns")
    lines = given("17_ns_since_1970.csv").read_text().splitlines()[1:]
    right = [(int(line.split(",")[0]) + 500) // 1000 for line in lines]
    assert found.t.tolist() == right


def test_18_padding_of_lucid():
    same(events("18_lucid_padding.raw")[0])


def test_19_evt21_of_old_cameras():
    same(events("19_evt21_by_system_id.raw")[0])


def test_20_format_by_system_id():
    with open_events(given("20_format_by_system_id.raw")) as file:
        assert (file.format, file.height, file.width) == ("evt2", 480, 640)
        assert len(file.read())


def test_20_size_by_system_id():
    _, _, size = events("20_size_by_system_id.raw")
    assert size == (480, 640)


@pytest.mark.parametrize(("name", "count"), [("21_open_gop_cut.mkv", 30), ("22_within_gop.ts", 14)])
def test_21_22_what_precedes_the_first_picture_is_left_out(name, count):
    pictures, _, notes = frames(name)
    assert len(pictures) == count
    assert any("left out" in note for note in notes), notes


def test_23_motion_photos():
    pictures, _, _ = frames("23_motion_photo", Declared(fps=30))
    assert len(pictures) == 3


def test_25_hidden_frames_of_vp8():
    assert len(frames("25_vp8_hidden.webm")[0]) == 28


def test_27_geometry_of_openeb():
    found, _, size = events("27_openeb_geometry.csv", columns="x,y,p,t", time_unit="us")
    assert size == (720, 1280)
    assert len(found) == 200


def test_28_size_in_attributes():
    _, _, size = events("28_size_in_attributes.h5")
    assert size == (480, 640)


def test_30_triggers_are_said_and_written(tmp_path, capsys):
    _, notes, _ = events("30_triggers.raw")
    assert any("2" in note and "trigger" in note for note in notes), notes
    status, _ = run(
        capsys, "convert", given("30_triggers.raw"), tmp_path / "o.h5", "--triggers", tmp_path / "triggers.csv"
    )
    assert status == 0
    assert len((tmp_path / "triggers.csv").read_text().splitlines()) == 3


def test_32_grey_and_colour():
    assert len(frames("32_grey_and_colour", Declared(fps=30))[0]) == 4


def test_34_no_invented_remedy():
    text = one_line(lambda: events("34_polarity_255.csv", time_unit="us"), "--polarity")
    assert "--damaged keep" not in text
    found, _, _ = events("34_polarity_255.csv", time_unit="us", polarity="0/255")
    assert len(found) == 200


def test_35_a_late_event():
    declared = {"columns": "x,y,t,p", "time_unit": "us"}
    text = one_line(lambda: events("35_late_event.txt", **declared), "--sort")
    assert "--columns" not in text
    found, _, _ = events("35_late_event.txt", **declared, sort=True)
    rows = np.loadtxt(given("35_late_event.txt")).astype(int)
    rows = rows[np.argsort(rows[:, 2], kind="stable")]
    np.testing.assert_array_equal(np.stack([found.x, found.y, found.t, found.p], 1), rows)
    bare = one_line(lambda: events("35_late_event.txt", sort=True), "--columns x,y,t,p")
    assert "--time-unit us" in bare


def test_copies_of_all_are_read_alike(tmp_path):
    """Names of files say nothing: a copy under another name gives the same."""
    path = tmp_path / "some recording.raw"
    shutil.copy(given("18_lucid_padding.raw"), path)
    with open_events(path) as file:
        same(file.read())
