"""Frame sources: videos, folders, arrays, time stamps; and what is wrong with them."""

from __future__ import annotations

import shutil

import cv2
import imageio
import numpy as np
import pytest
import tifffile

from blinkgl.errors import AssetError, BlinkGLError, ConfigError, EventDataError
from blinkgl.io.frames import open_frames, read_any_image
from blinkgl.io.reading import Declared
from blinkgl.io.times import read_timestamps, stamps_of_array
from blinkgl.io.video import VideoWriter
from tests.videos import put_exr


def images(folder, count=3, size=(12, 16), ending="png"):
    folder.mkdir(parents=True, exist_ok=True)
    for i in range(count):
        cv2.imwrite(str(folder / f"f{i}.{ending}"), np.full(size, 10 * i, np.uint8))
    return folder


def listed(source):
    return [(int(frame.flat[0]), t, name) for frame, t, name in source]


@pytest.mark.parametrize(
    "name, text, expected",
    [
        ("timestamps.txt", "# us\n0\n1000\n2500\n", [0, 10**6, 2_500_000]),
        ("timestamp.txt", "0.000000\n0.001000\n0.0025\n", [0, 10**6, 2_500_000]),
        ("data.csv", "#timestamp [ns],filename\n5,f0.png\n6,f1.png\n8,f2.png\n", [5, 6, 8]),
        ("timestamps.txt", "# seconds\n0.0\n1e-3\n0.0025\n", [0, 10**6, 2_500_000]),
        ("images.txt", "0.5 f0.png\n0.6 f1.png\n0.75 f2.png\n0.9 f3.png\n", [500_000_000, 600_000_000, 750_000_000]),
    ],
)
def test_time_stamp_files_are_found(tmp_path, name, text, expected):
    images(tmp_path)
    (tmp_path / name).write_text(text)
    assert [t for _, t, _ in open_frames(tmp_path)] == expected
    assert [t for _, t, _ in open_frames(tmp_path, Declared(fps=1))] == [0, 10**9, 2 * 10**9], "--fps wins"


def test_video(tmp_path):
    with VideoWriter(tmp_path / "v.mp4", 32, 48, 50) as video:
        for i in range(5):
            video.write(np.full((32, 48, 3), 40 * i, np.uint8))
    source = open_frames(tmp_path / "v.mp4")
    assert source.count == 5 and [t for _, t, _ in source] == [i * 20_000_000 for i in range(5)]
    assert [t for _, t, _ in open_frames(tmp_path / "v.mp4", Declared(fps=1000))] == [i * 10**6 for i in range(5)]
    for count in (3, 6):
        (tmp_path / "t.txt").write_text("".join(f"{k}\n" for k in range(count)))
        with pytest.raises(EventDataError, match=f"v.mp4: one time stamp per frame .got '{count} stamps, . frames'"):
            list(open_frames(tmp_path / "v.mp4", Declared(timestamps=tmp_path / "t.txt", time_unit="us")))


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8"])
@pytest.mark.parametrize("channels", [(), (1,), (3,)])
def test_arrays(tmp_path, dtype, channels):
    frames = np.random.default_rng(0).integers(0, 200, (4, 6, 8, *channels)).astype(dtype)
    np.save(tmp_path / "a.npy", frames)
    np.savez(tmp_path / "a.npz", frames=frames, timestamps_us=[0, 5, 10, 20])
    for source, times in (
        (open_frames(tmp_path / "a.npy", Declared(fps=10, white_level=65535)), [0, 10**8, 2 * 10**8, 3 * 10**8]),
        (open_frames(tmp_path / "a.npz", Declared(white_level=65535)), [0, 5000, 10000, 20000]),
    ):
        got = list(source)
        assert [t for _, t, _ in got] == times
        expected = frames[..., 0] if channels == (1,) else frames
        assert np.array_equal(np.stack([f for f, _, _ in got]), expected)
        assert got[0][0].dtype == (np.float32 if dtype in ("f4", "f8") else dtype)


def test_float_and_deep_images(tmp_path):
    rng = np.random.default_rng(0)
    colour = (rng.random((10, 14, 3)) * 4).astype(np.float32)
    put_exr(tmp_path / "a.exr", colour)
    assert np.array_equal(read_any_image(tmp_path / "a.exr"), colour)
    cv2.imwrite(str(tmp_path / "a.hdr"), colour[..., ::-1])
    assert np.allclose(read_any_image(tmp_path / "a.hdr"), colour, rtol=0.02, atol=0.02)
    cv2.imwrite(str(tmp_path / "a.pfm"), colour[..., ::-1])
    assert np.array_equal(read_any_image(tmp_path / "a.pfm"), colour)
    deep = rng.integers(0, 65536, (10, 14, 3)).astype(np.uint16)
    for ending in ("png", "tiff"):
        cv2.imwrite(str(tmp_path / f"a.{ending}"), deep[..., ::-1])
        assert np.array_equal(read_any_image(tmp_path / f"a.{ending}"), deep)
    (tmp_path / "b.exr").write_bytes((tmp_path / "a.exr").read_bytes()[:300])
    with pytest.raises(AssetError, match="cannot decode OpenEXR"):
        read_any_image(tmp_path / "b.exr")
    # A name that looks like a pattern of names is a name, and what is no OpenEXR is not read as something else.
    (tmp_path / "f%d.exr").write_bytes((tmp_path / "a.exr").read_bytes())
    (tmp_path / "f1.exr").write_bytes(b"no picture")
    assert np.array_equal(read_any_image(tmp_path / "f%d.exr"), colour)
    (tmp_path / "f1.exr").write_bytes((tmp_path / "a.png").read_bytes())
    with pytest.raises(AssetError, match="cannot decode OpenEXR"):
        read_any_image(tmp_path / "f1.exr")


def image_of(shape):
    return lambda folder: cv2.imwrite(str(folder / "f1.png"), np.zeros(shape, np.uint8))


@pytest.mark.parametrize(
    "spoil, fps, said",
    [
        (shutil.rmtree, 1, "no such file or folder"),
        (lambda f: [p.unlink() for p in f.iterdir()], 1, "no images in the folder"),
        (lambda f: None, None, "frames without times.*expected --fps"),
        (lambda f: None, 0, "--fps: frame rate .got 0"),
        (lambda f: [(f / f"f{k}.png").unlink() for k in (1, 2)], 1, "at least two frames"),
        (
            lambda f: (f / "timestamps.txt").write_text("# us\n0\n1\n"),
            None,
            "one time stamp per frame .got '2 stamps, 3 frames'",
        ),
        (
            lambda f: (f / "timestamps.txt").write_text("t_us name\n0 f0.png\n1 f1.png\n"),
            None,
            "no time stamp for image f2.png",
        ),
        (
            lambda f: (f / "timestamps.txt").write_text("# ms\n0\n20\n10\n"),
            None,
            r"frame 2 \(f2.png\): time stamps must increase \(got '0.01 s'\); expected more than 0.02 s, or --fps",
        ),
        (lambda f: (f / "f1.png").write_bytes(b"\x89PNG"), 1, "f1.png: cannot decode"),
        (image_of((12, 17)), 1, r"frame 1 \(f1.png\): frame size changed \(got \(12, 17\)\)"),
    ],
)
def test_bad_folders(tmp_path, spoil, fps, said):
    folder = images(tmp_path / "a")
    spoil(folder)
    with pytest.raises((AssetError, EventDataError), match=said):
        list(open_frames(folder, Declared(fps=fps)))


@pytest.mark.parametrize(
    "name, arrays, fps, said",
    [
        ("a.npy", np.zeros((3, 4)), 1, "not frames"),
        ("a.npy", np.zeros((3, 4, 5), np.int64), 1, "unsupported pixel type"),
        ("a.npy", np.zeros((3, 4, 5)), None, "frames without times"),
        ("a.npz", {"other": 1}, 1, "no array 'frames'"),
        ("a.xyz", None, 1, "unknown input"),
    ],
)
def test_bad_arrays_and_files(tmp_path, name, arrays, fps, said):
    with open(tmp_path / name, "wb") as file:
        if arrays is not None:
            np.savez(file, **arrays) if isinstance(arrays, dict) else np.save(file, arrays)
    with pytest.raises((AssetError, EventDataError), match=said):
        open_frames(tmp_path / name, Declared(fps=fps))


def test_an_array_that_is_cut(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((3, 4, 5)))
    (tmp_path / "a.npy").write_bytes((tmp_path / "a.npy").read_bytes()[:-10])
    with pytest.raises(AssetError, match="malformed array"):
        open_frames(tmp_path / "a.npy", Declared(fps=1))


def times(path, **given):
    return [t for _, t, _ in open_frames(path, Declared(**given))]


def test_times_that_are_named_come_before_those_that_lie_there(tmp_path, monkeypatch):
    """A folder's own timestamps.txt, its images.txt, its timestamps.csv, then the parent's images.txt."""
    folder = images(tmp_path / "a")
    written = {"images.txt": (4, tmp_path), "timestamps.csv": (3, folder), "timestamps.txt": (1, folder)}
    written_in_folder = (folder / "images.txt", 2)
    monkeypatch.chdir(folder)
    for name, (step, where) in written.items():
        (where / name).write_text("".join(f"{0.001 * step * k:.3f} f{k}.png\n" for k in range(3)))
        assert times(folder) == times(".") == [0, step * 10**6, 2 * step * 10**6]
        if name == "timestamps.csv":
            path, step = written_in_folder
            path.write_text(f"t_us,name\n0,f0.png\n{1000 * step},f1.png\n{2000 * step},f2.png\n")
            assert times(folder) == [0, step * 10**6, 2 * step * 10**6]
    (tmp_path / "mine.txt").write_text("5\n6\n8\n")
    mine = {"timestamps": tmp_path / "mine.txt"}
    assert times(folder, **mine, time_unit="us") == [5000, 6000, 8000]
    assert times(folder, **mine, time_unit="frames", fps=10) == [5 * 10**8, 6 * 10**8, 8 * 10**8]
    with pytest.raises(ConfigError, match="--fps, --timestamps: a frame rate and a list of times contradict"):
        times(folder, **mine, fps=10)
    with pytest.raises(ConfigError, match="--time-unit: times in frames need a frame rate"):
        times(folder, **mine, time_unit="frames")
    with pytest.raises(AssetError, match="none.txt: cannot read: No such file"):
        open_frames(folder, Declared(timestamps=tmp_path / "none.txt"))


@pytest.mark.parametrize(
    ("text", "unit", "times", "names"),
    [
        ("time_us name\n0 a\n33333,b\n66667 c\n", None, [0, 33_333_000, 66_667_000], ["a", "b", "c"]),
        ("-5 # before\n\n# nothing\n+7\n", "us", [-5000, 7000], None),
        ("1e-3\n.5\n2.\n", "s", [10**6, 5 * 10**8, 2 * 10**9], None),
        ("1.0\n1.010000\n1.02\n", None, [10**9, 1_010_000_000, 1_020_000_000], None),  # some with six places
        ("#timestamp [ns],filename\n1403636579763555584,a.png\n1403636579813555456,b.png\n", None,
         [1403636579763555584, 1403636579813555456], ["a.png", "b.png"]),
        ("# color images\n# timestamp filename\n1305031102.175304 rgb/1.png\n1305031102.211214 rgb/2.png\n", None,
         [1305031102175304000, 1305031102211214000], ["rgb/1.png", "rgb/2.png"]),
        ("# exposure_start_timestamp_us,exposure_end_timestamp_us\n10,30\n110,130\n", None, [20_000, 120_000], None),
        ("# timestamp format v2\n0\n16\n33\n", None, [0, 16_000_000, 33_000_000], None),
        ("index;t_ms;name\n0;5;a b\n1;15;c\n2;25;d\n", None, [5_000_000, 15_000_000, 25_000_000], None),
        ("0 0.500000\n1 0.533\n2 0.567\n", None, [500_000_000, 533_000_000, 567_000_000], None),
        ("a.png 0.5\nb.png 0.533\n", None, [500_000_000, 533_000_000], ["a.png", "b.png"]),
        ("\ufefft_ns\n1\n2\n", None, [1, 2], None),
    ],
)  # fmt: skip
def test_lines_of_times(tmp_path, text, unit, times, names):
    path = tmp_path / "t.txt"
    path.write_text(text, encoding="utf-8")
    stamps = read_timestamps(path, unit)
    assert stamps.times_ns == times and (names is None or stamps.names == names)
    stated = unit is not None or any(word in text for word in ("[ns]", "_us", "_ms", "_ns", "v2"))
    assert (stamps.note is None) == stated and (stated or "read as the Event Camera Dataset's" in stamps.note)


def test_lines_that_are_no_times(tmp_path):
    path = tmp_path / "t.txt"
    for text, said in (
        ("", "no time stamps"),
        ("header\n", "no time stamps"),
        ("1\ninf\n", "line 2 is not a time stamp .got 'inf'"),
        ("1\nnan\n", "line 2"),
        ("1\n1e999999999\n", "line 2"),
        ("time\n0\nx\n", "line 3 is not a time stamp"),
        ("1 a.png\n2\n", "times with a name and times without one"),
        ("0.01\n0.02\n0.03\n40000\n50000\n60000\n", "no unit of the times is stated; try --time-unit s if"),
        ("40000\n50000\n60000\n", "no unit of the times is stated; try --time-unit us if that is right"),
    ):
        path.write_text(text)
        with pytest.raises(EventDataError, match=said):
            read_timestamps(path)


def declared_of_frames(folder):
    """A clip of each kind: name -> (path, whether it has times of its own)."""
    film = np.random.default_rng(0).integers(0, 255, (6, 24, 32, 3), np.uint8)
    np.save(folder / "a.npy", film)
    np.savez(folder / "a.npz", frames=film)
    np.savez(folder / "b.npz", frames=film, t_us=np.arange(6) * 1000)
    tifffile.imwrite(folder / "a.tif", film)
    imageio.v3.imwrite(folder / "a.gif", film, duration=40)
    (folder / "f").mkdir()
    for k, frame in enumerate(film):
        imageio.v3.imwrite(folder / "f" / f"{k:04d}.png", frame)
    return {"a.npy": False, "a.npz": False, "b.npz": True, "a.tif": False, "a.gif": True, "f": False}


def test_whatever_is_declared_of_a_clip_is_used_or_said(tmp_path):
    """Of each kind: a stream that is not there, a unit without times, a unit that the file states otherwise, times
    beside the file's own."""
    clips = declared_of_frames(tmp_path)
    (tmp_path / "times.txt").write_text("\n".join(f"{k * 0.01:.3f}" for k in range(6)), encoding="utf-8")
    listed = {"timestamps": tmp_path / "times.txt", "time_unit": "s"}
    for name, timed in clips.items():
        for fields in ({"stream": "nosuch"}, {"time_unit": "ms"}, listed):
            more = {} if timed or "timestamps" in fields else {"fps": 50.0}
            plain = open_frames(tmp_path / name, Declared(**({} if timed else {"fps": 50.0})))
            before = [t for _, t, _ in plain]
            try:
                now = open_frames(tmp_path / name, Declared(**fields, **more))
                times = [t for _, t, _ in now]
            except BlinkGLError as error:
                assert "stream" in fields and "--stream" in str(error), (name, fields)
                continue
            new = [line for line in now.notes if line not in plain.notes]
            assert new or (times != before and not timed), (name, fields)
            assert not any("as the file says" in line for line in now.notes) or times == before, (name, fields)


def test_units_that_a_list_or_an_array_of_times_states_otherwise_are_said(tmp_path):
    (tmp_path / "times.csv").write_text("t_us,name\n0,a\n1000,b\n2000,c\n", encoding="utf-8")
    assert read_timestamps(tmp_path / "times.csv").note is None
    stamps = read_timestamps(tmp_path / "times.csv", "ms")
    assert stamps.times_ns == [0, 10**9, 2 * 10**9]
    assert stamps.note == "times.csv: the file says us; --time-unit ms is used"
    dated = np.array([0, 5], "timedelta64[ms]")
    assert stamps_of_array("t", dated, None, "a.npz").note is None
    assert stamps_of_array("t", dated, "us", "a.npz").note == "the file says ms; --time-unit us is used"


def test_one_list_of_two_cameras_gives_each_its_own_times(tmp_path):
    """Both have pictures of the same names; of a folder that the list does not name it is not known which is meant."""
    for camera in ("left", "right", "other"):
        (tmp_path / camera).mkdir()
        for k in range(3):
            cv2.imwrite(str(tmp_path / camera / f"{k:03d}.png"), np.full((4, 4), k, np.uint8))
    rows = [
        f"{k + first}.000000 {camera}/{k:03d}.png" for camera, first in (("left", 0), ("right", 10)) for k in range(3)
    ]
    (tmp_path / "images.txt").write_text("\n".join(rows) + "\n", encoding="utf-8")
    times = lambda camera: [t // 10**9 for _, t, _ in open_frames(tmp_path / camera)]
    assert times("left") == [0, 1, 2] and times("right") == [10, 11, 12]
    with pytest.raises(EventDataError, match="2 time stamps for image 000.png"):
        times("other")


def test_the_column_of_times_is_no_temperature_and_no_exposure(tmp_path):
    for heading, row in (
        ("temperature,timestamp_us,name", "{a},{t},{k}.png"),
        ("exposure_time_us,timestamp_us,name", "{a},{t},{k}.png"),
        ("type,topic,time_us", "{k},{a},{t}"),
        ("name,image_time_us", "{k}.png,{t}"),
    ):
        rows = [row.format(a=25 + k, t=1000 * k, k=k) for k in range(3)]
        (tmp_path / "l.csv").write_text("\n".join([heading, *rows]) + "\n", encoding="utf-8")
        assert read_timestamps(tmp_path / "l.csv", "us").times_ns == [0, 10**6, 2 * 10**6], heading
