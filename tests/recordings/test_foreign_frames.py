"""Clips as other people's programs write them: their events are those of an independent ESIM that knows what was meant.

Each case writes the same film, a bright square that moves over a ramp while the light grows, in one container, rate,
depth, range, orientation or order of names, and says at which times and with which light it is to be seen."""

from __future__ import annotations

import math
import re
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from fractions import Fraction

import cv2
import numpy as np
import pytest
import tifffile
from PIL import Image
from pinned import only_with_pinned

from blinkgl.cli import run
from blinkgl.io.formats import open_events
from tests.io.test_video import turned
from tests.videos import put_exr, put_video

H, W, COUNT = 18, 26, 12
THRESHOLD, EPS = 0.2, 0.02


def film(count: int = COUNT) -> np.ndarray:
    """(count, H, W) uint8."""
    frames = np.empty((count, H, W), np.uint8)
    for k in range(count):
        frames[k] = np.linspace(40, 120, W)[None] * (1 + 0.03 * k)
        frames[k, 4:10, 2 + 2 * (k % 10) : 8 + 2 * (k % 10)] = 200 + k
    return frames


def srgb(code: np.ndarray) -> np.ndarray:
    return np.where(code <= 0.04045, code / 12.92, ((code + 0.055) / 1.055) ** 2.4)


def events_by_hand(light: np.ndarray, times_s: list[float]) -> dict[tuple[int, int], list[tuple[float, int]]]:
    """ESIM (Rebecq et al. 2018, section 3.2) pixel by pixel: crossings of a straight line between logarithms."""
    logs = np.log(light + EPS)
    found = {}
    for y, x in np.ndindex(light.shape[1:]):
        level, events = logs[0, y, x], []
        for k in range(1, len(times_s)):
            a, b = logs[k - 1, y, x], logs[k, y, x]
            sign = 1 if b > a else -1
            while sign * (b - level) >= THRESHOLD:
                level += sign * THRESHOLD
                share = (level - a) / (b - a)
                events.append((times_s[k - 1] + share * (times_s[k] - times_s[k - 1]), sign))
        found[x, y] = events
    return found


def check(capsys, path, light, times_s, options=(), said=(), tolerance_s=None):
    """Compare counts within 1 %, and the times of pixels that have as many within the frames' intervals."""
    out = path.parent / "events.npz"
    settings = [f"contrast_threshold={THRESHOLD}", "threshold_sigma=0", f"log_eps={EPS}", "refractory_us=0"]
    sets = [part for setting in settings for part in ("--set", setting)]
    assert run(["simulate", str(path), "--out", str(out), "--overwrite", *sets, *options]) == 0
    printed = capsys.readouterr().out
    for line in said:
        assert line in printed, printed
    expected = events_by_hand(light, times_s)
    events = open_events(out).read()
    ours: dict[tuple[int, int], list[tuple[float, int]]] = {at: [] for at in expected}
    for x, y, t, p in zip(events.x.tolist(), events.y.tolist(), events.t.tolist(), events.p.tolist()):
        ours[x, y].append((t * 1e-6, 1 if p else -1))
    total = sum(map(len, expected.values()))
    wrong = sum(abs(len(ours[at]) - len(expected[at])) for at in expected)
    assert total > 100 and wrong <= 0.01 * total, (total, wrong)
    off = [abs(a[0] - b[0]) for at in expected if len(ours[at]) == len(expected[at]) for a, b in
           zip(ours[at], expected[at], strict=True)]  # fmt: skip
    assert np.median(off) < 0.02 * np.median(np.diff(times_s)) + 2e-6
    assert max(off) <= (tolerance_s or max(np.diff(times_s)))
    same = [a[1] == b[1] for at in expected if len(ours[at]) == len(expected[at]) for a, b in
            zip(ours[at], expected[at], strict=True)]  # fmt: skip
    assert np.mean(same) > 0.99
    return printed


LOSSLESS = {"codec": "libx264", "options": {"qp": "0"}}
LUMA = np.rint(16 + film() / 255 * 219).astype(np.uint8)
SEEN = srgb(np.rint((LUMA - 16.0) * 255 / 219) / 255)  # in 8 bits, as every player shows it
YUV = [np.stack([luma, np.full_like(luma, 128), np.full_like(luma, 128)]) for luma in LUMA]
COLOUR = [np.repeat(frame[..., None], 3, axis=2) for frame in film()]
UNEVEN = [0, 1, 3, 7, 8, 10, 11, 15, 16, 20, 29, 30]


@pytest.mark.parametrize(
    ("name", "options", "times_s"),
    [
        ("plain.mkv", {}, [k / 100 for k in range(COUNT)]),
        ("full.mp4", {**LOSSLESS, "range_": 2, "matrix": 1}, [k / 100 for k in range(COUNT)]),
        ("limited.mp4", {**LOSSLESS, "range_": 1, "matrix": 5}, [k / 100 for k in range(COUNT)]),
        ("uneven.mp4", {**LOSSLESS, "ticks": UNEVEN}, [k / 100 for k in UNEVEN]),
        ("uneven.mkv", {"ticks": UNEVEN}, [k / 100 for k in UNEVEN]),
        ("sixty.mkv", {"tick": Fraction(1, 60), "rate": 60}, [k / 60 for k in range(COUNT)]),
        ("ntsc.mkv", {"tick": Fraction(1001, 24000), "rate": Fraction(24000, 1001)},
         [k * 1001 / 24000 for k in range(COUNT)]),
        ("fast.mkv", {"tick": Fraction(1, 2000), "rate": 2000}, [k / 2000 for k in range(COUNT)]),
        ("fastest.mp4", {**LOSSLESS, "tick": Fraction(1, 100_000), "rate": 100_000},
         [k / 100_000 for k in range(COUNT)]),
        ("slow.mp4", {**LOSSLESS, "tick": Fraction(10), "rate": Fraction(1, 10)}, [10.0 * k for k in range(COUNT)]),
        ("sound.mp4", {**LOSSLESS, "sound_s": (0, 2)}, [k / 100 for k in range(COUNT)]),
        ("late.mkv", {"ticks": [50 + k for k in range(COUNT)], "sound_s": (0, 1)},
         [0.5 + k / 100 for k in range(COUNT)]),
        ("stream.ts", {**LOSSLESS, "options": {"qp": "0", "bf": "2"}}, [k / 100 for k in range(COUNT)]),
        ("old.avi", {}, [k / 100 for k in range(COUNT)]),
        ("rgb.mkv", {"pix_fmt": "bgr0"}, [k / 100 for k in range(COUNT)]),
    ],
)  # fmt: skip
def test_videos_at_their_own_times(tmp_path, capsys, name, options, times_s):
    if "codec" not in options and "pix_fmt" not in options:
        path, light = put_video(tmp_path / name, list(film()), **options), srgb(film() / 255)
    elif options.get("range_") == 2 or "pix_fmt" in options:
        path, light = put_video(tmp_path / name, COLOUR, **options), srgb(film() / 255)
    else:
        path, light = put_video(tmp_path / name, YUV, source="yuv444p", size=(H, W), **options), SEEN
    check(capsys, path, light, times_s)


def test_more_than_eight_bits(tmp_path, capsys):
    deep = np.round(film().astype(np.float64) / 255 * 4095).astype(np.uint16)
    path = put_video(tmp_path / "grey12.mkv", list(deep), source="gray12le", pix_fmt="gray12le")
    check(capsys, path, srgb(deep / 4095), [k / 100 for k in range(COUNT)])


def pq(code: np.ndarray) -> np.ndarray:
    power = code ** (1 / 78.84375)
    return (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125) * 1e4 / 203


def hlg(code: np.ndarray) -> np.ndarray:
    high = (np.exp((code - 0.55991073) / 0.17883277) + 0.28466892) / 12
    return np.where(code <= 0.5, code**2 / 3, high) / 0.26496256


@pytest.mark.parametrize(("curve", "name", "light"), [(16, "pq", pq), (18, "hlg", hlg)])
def test_high_dynamic_range(tmp_path, capsys, curve, name, light):
    only_with_pinned("av")  # older ones cannot write such a video
    lossless = {"codec": "libx265", "pix_fmt": "yuv420p10le", "options": {"x265-params": "lossless=1:log-level=none"}}
    luma = np.rint(64 + np.tile(film() // 2 + 40, (1, 2, 2)) / 255 * 876).astype(np.uint16)  # x265 wants 32 px
    frames = [np.vstack([one, np.full_like(one[: len(one) // 2], 512)]) for one in luma]
    given = {"source": "yuv420p10le", "size": luma.shape[1:], "curve": curve, "matrix": 9, "range_": 1}
    path = put_video(tmp_path / "v.mp4", frames, **given, **lossless)
    said = [f"the video states the curve {name} (--gamma for another)"]
    check(capsys, path, light((luma - 64.0) / 876), [k / 100 for k in range(COUNT)], said=said)


@pytest.mark.parametrize(
    ("matrix", "seen"), [((0, 1, -1, 0), lambda f: np.rot90(f, -1, (1, 2))), ((-1, 0, 0, 1), lambda f: f[:, :, ::-1])]
)
def test_turned_and_mirrored(tmp_path, capsys, matrix, seen):
    path = put_video(tmp_path / "v.mp4", COLOUR, range_=2, matrix=1, **LOSSLESS)
    path.write_bytes(turned(path.read_bytes(), *matrix))
    check(capsys, path, seen(srgb(film() / 255)), [k / 100 for k in range(COUNT)])


def test_transparency_is_shown_over_a_colour(tmp_path, capsys):
    alpha = np.full((H, W), 255, np.uint8)
    alpha[:, :9] = 128
    rgba = [np.dstack([frame, frame, frame, alpha]) for frame in film()]
    video = put_video(tmp_path / "v.mkv", rgba, source="rgba", pix_fmt="bgra")
    (tmp_path / "f").mkdir()
    for k, image in enumerate(rgba):
        Image.fromarray(image).save(tmp_path / "f" / f"{k}.png")
    for below, options, said in ((0, (), "over black"), (255, ("--background", "white"), "over #ffffff")):
        seen = np.rint(film() * (alpha / 255) + below * (1 - alpha / 255))
        line = [f"transparent pixels are shown {said} (--background for another)"]
        times = [k / 100 for k in range(COUNT)]
        check(capsys, video, srgb(seen / 255), times, options, line)
        check(capsys, tmp_path / "f", srgb(seen / 255), times, ("--fps", "100", *options), line)


def test_a_leader_and_a_cut(tmp_path, capsys):
    frames = [np.zeros((H, W), np.uint8)] * 6 + list(film()) + list(film()[:6, ::-1])
    path = put_video(tmp_path / "v.mkv", frames)
    check(capsys, path, srgb(np.array(frames) / 255), [k / 100 for k in range(len(frames))])


def pictures(folder, name: Callable[[int], str], write=None, frames=None):
    folder.mkdir()
    for k, frame in enumerate(film() if frames is None else frames):
        (write or (lambda path, image: cv2.imwrite(str(path), image)))(folder / name(k), frame)
    return folder


@pytest.mark.parametrize(
    "name",
    [
        lambda k: f"{0.05 * k:.15g}.png",
        lambda k: f"t={k - 5}.png",
        lambda k: f"{(k + 1) * 1e-5:g}.png",
        lambda k: f"frame-{k + 8}.png",
        lambda k: f"clip.{k + 1}.png",
        lambda k: f"1.{k + 1}.png",
        lambda k: f"x_{-0.6 + 0.1 * k:.1f}.png",
    ],
    ids=["decimals", "signs", "exponents", "hyphens", "counter", "two counters", "signed decimals"],
)
def test_the_order_of_names(tmp_path, capsys, name):
    check(capsys, pictures(tmp_path / "f", name), srgb(film() / 255), [k / 100 for k in range(COUNT)], ("--fps", "100"))


def test_a_gap_and_what_does_not_belong(tmp_path, capsys):
    folder = pictures(tmp_path / "f", lambda k: f"{k + 9}.png")
    (folder / "14.png").unlink()
    (folder / "15.png").unlink()
    cv2.imwrite(str(folder / "12.jpg"), film()[0])
    cv2.imwrite(str(folder / "mask.png"), film()[0])
    (folder / "._9.png").write_bytes(b"Mac OS X")
    kept = [k for k in range(COUNT) if k not in (5, 6)]
    said = [
        "2 frames are missing (after 13.png): times follow the numbers, not the files",
        "12.jpg: left out, since there is a .png of the same name",
        "mask.png: left out, since the names of the 10 others are of the form #",
        "._9.png: hidden, so left out",
    ]
    check(capsys, folder, srgb(film()[kept] / 255), [k / 100 for k in kept], ("--fps", "100"), said)


def test_two_series_in_one_folder(tmp_path, capsys):
    folder = pictures(tmp_path / "f", lambda k: f"{'left' if k % 2 else 'right'}_{k // 2}.png")
    assert run(["simulate", str(folder), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 2
    assert "f: two series of pictures in one folder (got '6 named left_#, 6 named right_#')" in capsys.readouterr().err


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("ending", ["png", "webp", "tif"])
def test_pictures_come_upright(tmp_path, capsys, orientation, ending):
    stored = {1: lambda f: f, 2: lambda f: f[:, ::-1], 3: lambda f: f[::-1, ::-1], 4: lambda f: f[::-1],
              5: lambda f: f.T, 6: lambda f: np.rot90(f, 1), 7: lambda f: f[::-1, ::-1].T,
              8: lambda f: np.rot90(f, -1)}[orientation]  # fmt: skip

    def write(path, frame):
        image = Image.fromarray(np.ascontiguousarray(stored(frame))).convert("RGB")
        exif = image.getexif()
        exif[274] = orientation
        image.save(path, exif=exif, **({"lossless": True} if ending == "webp" else {}))

    folder = pictures(tmp_path / "f", lambda k: f"{k}.{ending}", write)
    check(capsys, folder, srgb(film() / 255), [k / 100 for k in range(COUNT)], ("--fps", "100"))


@pytest.mark.parametrize("kind", ["gif", "png", "webp"])
def test_animations_have_their_delays(tmp_path, capsys, kind):
    delays = [40, 20, 30, 100, 50, 20, 20, 70, 30, 30, 60, 40]
    images = [Image.fromarray(frame).convert("RGB" if kind == "webp" else "L") for frame in film()]
    path = tmp_path / f"a.{kind}"
    images[0].save(path, save_all=True, append_images=images[1:], duration=delays, loop=0, lossless=True)
    times = [sum(delays[:k]) / 1000 for k in range(COUNT)]
    said = ["each frame is shown for 20 to 100 ms, as the file says (--fps for another rate)"]
    check(capsys, path, srgb(film() / 255), times, said=said)
    check(capsys, path, srgb(film() / 255), [k / 100 for k in range(COUNT)], ("--fps", "100"))


@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
def test_pages_are_frames(tmp_path, capsys, compression):
    folder = tmp_path / "f"
    folder.mkdir()
    for name, part in (("a.tif", film()[:7]), ("b.tif", film()[7:])):
        if compression == "lzw":
            pages = [Image.fromarray(page) for page in part]
            pages[0].save(folder / name, save_all=True, append_images=pages[1:], compression="tiff_lzw")
        else:
            tifffile.imwrite(folder / name, part, photometric="minisblack", compression=compression)
    times = [k / 100 for k in range(COUNT)]
    check(capsys, folder, srgb(film() / 255), times, ("--fps", "100"))
    (tmp_path / "t.txt").write_text("".join(f"{t:.3f}\n" for t in times))
    check(capsys, folder, srgb(film() / 255), times, ("--timestamps", str(tmp_path / "t.txt"), "--time-unit", "s"))


def test_white_is_dark_in_some_tiffs(tmp_path, capsys):
    tifffile.imwrite(tmp_path / "a.tif", 255 - film(), photometric="miniswhite")
    check(capsys, tmp_path / "a.tif", srgb(film() / 255), [k / 100 for k in range(COUNT)], ("--fps", "100"))


DEEP = np.round(film().astype(np.float64) / 215 * 3900).astype(np.uint16)


def pgm(path, image):
    path.write_bytes(f"P5 {W} {H} 4095\n".encode() + image.astype(">u2").tobytes())


def tagged_tiff(path, image):
    tifffile.imwrite(path, image, photometric="minisblack", extratags=[(281, "H", 1, 4095, True)])


@pytest.mark.parametrize(
    ("ending", "write", "options"),
    [("png", None, ("--white-level", "4095")), ("pgm", pgm, ()), ("tif", tagged_tiff, ())],
    ids=["declared", "of the header", "of the tag"],
)
def test_twelve_bits_in_sixteen(tmp_path, capsys, ending, write, options):
    folder = pictures(tmp_path / "f", lambda k: f"{k}.{ending}", write, DEEP)
    times = [k / 100 for k in range(COUNT)]
    check(capsys, folder, srgb(DEEP / 4095), times, ("--fps", "100", *options), [])


@pytest.mark.parametrize("bits", [10, 12, 14, 15, 16])
@pytest.mark.parametrize("kind", ["png", "tif", "npy", "npz"])
def test_white_that_nothing_states_is_asked_for(tmp_path, capsys, bits, kind):
    """Codes that leave the upper two bits empty are a camera's, or a dark film: what is proposed reads them as the code
    over that white."""
    deep = (DEEP.astype(np.uint32) * (2**bits - 1) // DEEP.max()).astype(np.uint16)
    path = (
        tmp_path / f"f.{kind}"
        if kind.startswith("np")
        else pictures(tmp_path / "f", lambda k: f"{k}.{kind}", None, deep)
    )
    if kind == "npy":
        np.save(path, deep)
    elif kind == "npz":
        np.savez(path, frames=deep)
    times = [k / 100 for k in range(COUNT)]
    if bits > 14:
        check(capsys, path, srgb(deep / 65535), times, ("--fps", "100"), [])
        return
    assert run(["simulate", str(path), "--out", str(tmp_path / "e.h5"), "--fps", "100"]) == 2
    said = capsys.readouterr().err
    proposed = re.search(r"try (--white-level \d+) of \d+ bits, or 65535", said)
    assert proposed and said.count("\n") == 1
    check(capsys, path, srgb(deep / (2**bits - 1)), times, ("--fps", "100", *proposed[1].split()), [])


def png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


@pytest.mark.parametrize(
    ("chunk", "light"),
    [
        (png_chunk(b"gAMA", struct.pack(">I", 100_000)), lambda c: c),
        (png_chunk(b"gAMA", struct.pack(">I", 55_556)), lambda c: c**1.8),
        (png_chunk(b"gAMA", struct.pack(">I", 45_455)), srgb),
        (png_chunk(b"cICP", bytes([9, 16, 0, 1])), pq),
    ],
    ids=["linear", "1.8", "2.2", "pq"],
)
def test_curves_that_pictures_state(tmp_path, capsys, chunk, light):
    def write(path, frame):
        data = cv2.imencode(".png", frame)[1].tobytes()
        path.write_bytes(data[:33] + chunk + data[33:])

    folder = pictures(tmp_path / "f", lambda k: f"{k}.png", write, film() // 2 + 40)
    check(capsys, folder, light((film() // 2 + 40) / 255), [k / 100 for k in range(COUNT)], ("--fps", "100"))


def test_floats(tmp_path, capsys):
    light, times = srgb(film() / 255).astype(np.float32), [k / 100 for k in range(COUNT)]
    colour = np.repeat(light[..., None], 3, axis=3)
    folder = pictures(tmp_path / "f", lambda k: f"{k}.exr", put_exr, colour)
    check(capsys, folder, light, times, ("--fps", "100"))
    np.save(tmp_path / "light.npy", light)
    said = ["floats taken as linear light (--gamma srgb for codes of pictures)"]
    check(capsys, tmp_path / "light.npy", light, times, ("--fps", "100"), said)
    np.save(tmp_path / "codes.npy", film().astype(np.float32))
    sure = ("--fps", "100", "--white-level", "255", "--gamma", "srgb")
    check(capsys, tmp_path / "codes.npy", light, times, sure)
    assert run(["simulate", str(tmp_path / "codes.npy"), "--fps", "100", "--out", str(tmp_path / "e.h5")]) == 0
    assert "floats up to 211, where 1 is white: --white-level 255" in capsys.readouterr().out


def test_limited_range_of_pictures(tmp_path, capsys):
    limited = np.round(16 + film() / 255 * 219).astype(np.uint8)
    np.save(tmp_path / "v.npy", limited)
    light = srgb(np.maximum((limited - 16.0) / 219, 0))
    check(capsys, tmp_path / "v.npy", light, [k / 100 for k in range(COUNT)], ("--fps", "100", "--range", "limited"))


def test_lists_of_times(tmp_path, capsys):
    """EuRoC's data.csv in ns, TUM's rgb.txt in s, both beside the folder; --zero-time counts from the first."""
    start, times = 1403636579763555584, [k / 20 for k in range(COUNT)]
    stamps = [start + 50_000_000 * k for k in range(COUNT)]
    folder = pictures(tmp_path / "data", lambda k: f"{stamps[k]}.png")
    lines = "".join(f"{t},{t}.png\n" for t in stamps)
    (tmp_path / "data.csv").write_text("#timestamp [ns],filename\n" + lines)
    check(capsys, folder, srgb(film() / 255), times, ("--zero-time",))
    (tmp_path / "data.csv").unlink()
    (tmp_path / "data.txt").write_text("# color images\n# timestamp filename\n" + "".join(
        f"{t / 1e9:.6f} data/{t}.png\n" for t in stamps))  # fmt: skip
    check(
        capsys,
        folder,
        srgb(film() / 255),
        times,
        ("--zero-time",),
        ["data.txt: read as the Event Camera Dataset's and TUM's lists: seconds with a point"],
    )


@pytest.mark.parametrize(
    ("make", "options", "said"),
    [
        (lambda p: put_video(p / "v.mp4", COLOUR[:1], **LOSSLESS), (), "v.mp4: events need at least two frames"),
        (lambda p: put_video(p / "v.mp4", COLOUR, **LOSSLESS, container_options={
            "encryption_scheme": "cenc-aes-ctr", "encryption_key": "76a6c65c5ea762046bd749a2e632ccbb",
            "encryption_kid": "a7e61c373e219033c21091fa607bf3b8"}), (), "v.mp4: encrypted video; expected a file"),
        (lambda p: put_video(p / "v.mp4", COLOUR, **LOSSLESS), ("--fps", "9", "--timestamps", "x"),
         "--fps, --timestamps: a frame rate and a list of times contradict each other"),
        (lambda p: put_video(p / "v.mp4", COLOUR, **LOSSLESS), ("--range", "tv"), "--range: unknown range (got 'tv')"),
        (lambda p: put_video(p / "v.mp4", COLOUR, **LOSSLESS), ("--background", "sky"), "--background: unknown colour"),
        (lambda p: put_video(p / "v.mp4", COLOUR, **LOSSLESS), ("--time-unit", "min"), "--time-unit: unknown unit"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_one_line(tmp_path, capsys, make, options, said):
    assert run(["simulate", str(make(tmp_path)), "--out", str(tmp_path / "e.h5"), *options]) == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and said in error and error.count("\n") == 1
    assert not (tmp_path / "e.h5").exists()


def test_times_that_run_back_and_sizes_that_change(tmp_path, capsys):
    first = put_video(tmp_path / "a.ts", COLOUR, **LOSSLESS)
    later, larger = [12 + k for k in range(COUNT)], [np.pad(f, ((0, 46), (0, 38), (0, 0))) for f in COLOUR]
    other = put_video(tmp_path / "b.ts", larger, ticks=later, **LOSSLESS)
    for name, parts, said in (("back.ts", (first, first), "time stamps must increase"),
                              ("size.ts", (first, other), "frame size changed")):  # fmt: skip
        (tmp_path / name).write_bytes(b"".join(part.read_bytes() for part in parts))
        assert run(["simulate", str(tmp_path / name), "--out", str(tmp_path / "e.h5")]) == 2
        error = capsys.readouterr().err
        assert said in error and f"{name}: frame" in error and error.count("\n") == 1 and math.isfinite(len(error))


SIZES = """
import sys
import numpy as np
import blinkgl
first, last, step = map(int, sys.argv[1:])
rng = np.random.default_rng(0)
noise = rng.integers(-3, 4, (3, 60, 760))
big = np.add.outer(np.arange(60) * 2, np.arange(760) * 7 % 100) + 20
for height in range(first, last):
    for width in range(1, 701, step):
        frames = [np.uint8(big[k : k + height, k : k + width] + noise[k, :height, :width]) for k in range(3)]
        assert [len(e) >= 0 for e in blinkgl.simulate(frames, fps=100)] == [True] * 3
print("whole")
"""


@pytest.mark.parametrize(
    ("first", "last", "step"), [(1, 41, 97), pytest.param(1, 41, 1, marks=pytest.mark.slow)], ids=["some", "every"]
)
def test_clips_of_every_size(first, last, step):
    """In a process of their own: OpenCV's dense flow ended it for heights of 16 to 31 px."""
    command = [sys.executable, "-c", SIZES, str(first), str(last), str(step)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0 and done.stdout == "whole\n", done.stderr[-500:]
