"""Every refusal of files that names an option: the option, as the message gives it, is run on the file that was
refused, and reads what the file holds. A text with an option in `io/` or `recordings/` that is in no list fails."""

from __future__ import annotations

import ast
import re
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import blinkgl
from blinkgl.cli import run
from blinkgl.errors import AssetError
from blinkgl.io.formats import open_events, write_events
from blinkgl.io.trajectories import PoseFile, read_trajectory
from tests.io.aedat2_files import event_addresses, header, records
from tests.io.some_events import same, some_events
from tests.videos import put_video

ROOT = Path(blinkgl.__file__).parent
E = some_events(60, 70_000, 90_000, 180, 240)
ROWS = np.stack([E.t, E.x, E.y, E.p], axis=1)
XYP = {"x": E.x, "y": E.y, "p": E.p}
COLUMNS = {"t_us": E.t, **XYP}


def texts() -> dict[str, str]:
    """Each text of the two rooms that names an option, with its module."""
    found = {}
    for path in (*ROOT.glob("io/*.py"), *ROOT.glob("recordings/*.py")):
        tree = ast.parse(path.read_text())
        within = {id(part) for node in ast.walk(tree) if isinstance(node, (ast.JoinedStr, ast.Expr)) for part in
                  ast.walk(node if isinstance(node, ast.JoinedStr) else node.value) if part is not node and
                  (isinstance(node, ast.JoinedStr) or isinstance(node.value, ast.Constant))}  # fmt: skip
        for node in ast.walk(tree):
            if id(node) in within:
                continue
            if isinstance(node, ast.JoinedStr):
                text = "".join(part.value if isinstance(part, ast.Constant) else "{}" for part in node.values)
            else:
                text = node.value if isinstance(node, ast.Constant) and isinstance(node.value, str) else ""
            if re.search(r"--[a-z]|\b(columns|time_unit|form): |\brate:( in|$)", text) and not re.fullmatch(
                r"--[a-z-]+(, --[a-z-]+)*", text
            ):
                found[text] = path.name
    return found


LINES = {
    "y as in the file, which jAER shows from the bottom (--origin bottom turns it)",
    "{:,} triggers are no events: blinkgl convert --triggers FILE.csv writes them",
    "{} triggers are no events: blinkgl convert --triggers FILE.csv writes them",
    "transparent pixels are shown over {} (--background for another)",
    "the file says {}x{}; --size is used",
    "{} has its own columns, in µs; {} is not used",
    "the columns have names; --columns is not used (x=NAME,y=NAME … for others)",
    "left out: events more than {} ms late: {} (--sort keeps them)",
    "size taken as {}x{}, {} (--size if that is wrong)",
    "each frame is shown for {} ms, as the file says (--fps for another rate)",
    "{} beside the images is not used, because of --fps",
    "no list of times is read; --time-unit is not used",
    "there is one series of frames; --stream is not used",
    "'{}' in the file is not used, because of --fps or --timestamps",
    "{} frames state no delay: {} ms each, as browsers show them (--fps)",
    "left out: the interval between pages, {} '{}', of an unknown unit (--fps)",
    "left out: {}, whose meaning is not known (--size, --time-unit, --origin)",
    "the heading names the columns {}; --columns is used",
    "{}: the heading names the columns otherwise; columns: {} is used",
    "{}: the heading names the columns otherwise than form: {}, and is used",
    "{}: {}'s axes ({}) turned to OpenCV's (axes: opencv if they are already)",
    "range (limited; --range full for another)",
    "the video states the curve {} (--gamma for another)",
    "the first frame is at {} s of the file (--zero-time: at 0)",
    (
        "The frames' codes were taken as `--gamma {}`; the sensor file tells `simulate`, which takes grey images of "
        "the sensor's size for the camera's own."
    ),
    "floats taken as linear light (--gamma srgb for codes of pictures)",
    "images of the sensor's size taken for its own: --gamma {}",
    "integer codes taken as sRGB (--gamma linear for a camera's raw frames)",
    "floats up to {}, where {} is white: --white-level 255, if they are codes",
    "{}: --white-level {} for {} bits",
    (
        "blinkgl calibrate --still --emulator pixels, fitted to the first {} s of {}; in the other {} s {} of its "
        "events, events of a pixel KS {}, intervals KS {}"
    ),
    "cannot read --damaged",
    "--path {}",
}
"""Lines about what was read: they refuse nothing, or name the option that is wrong."""
ELSEWHERE = {
    "a new name, or --overwrite": "recordings/test_simulation.py",
    "another --out, or --resume after it has ended": "dataset/test_faults.py",
    "pictures, or --classes-from folders": "recordings/test_saccades.py",
    "--frames, or --still for a static scene": "recordings/test_calibration.py",
    "--frames, or nothing of frames": "recordings/test_frame_noise.py",
}
"""Texts whose remedy does not read a file -> the test that runs the option."""


# ---------------------------------------------------------------------------------------------------------------------
# Events: what `convert` writes after the remedy is what the file was made of.

Made = tuple[Path, list[str]]


def csv(rows=ROWS, heading="t_us,x,y,p", *options: str):
    def make(folder: Path) -> Made:
        lines = [",".join(f"{v:g}" if isinstance(v, float) else str(v) for v in row) for row in rows.tolist()]
        (folder / "e.csv").write_text("\n".join([heading, *lines][not heading :]) + "\n")
        return folder / "e.csv", list(options)

    return make


def npz(options=(), **columns):
    def make(folder: Path) -> Made:
        np.savez(folder / "e.npz", **columns)
        return folder / "e.npz", list(options)

    return make


def npy(rows, *options: str):
    def make(folder: Path) -> Made:
        np.save(folder / "e.npy", rows)
        return folder / "e.npy", list(options)

    return make


def raw(cut=0, *options: str):
    def make(folder: Path) -> Made:
        write_events(folder / "e.raw", E, 180, 240)
        data = (folder / "e.raw").read_bytes()
        (folder / "e.raw").write_bytes(data + b"\1" * cut)
        return folder / "e.raw", list(options)

    return make


def dat(folder: Path) -> Made:
    """Its third event is 3 ms late, which a fixed format's reader calls damage."""
    order = [0, 1, 3, 2, *range(4, len(E))]
    body = b"".join(struct.pack("<II", t, x | y << 14 | p << 28) for t, x, y, p in ROWS[order].tolist())
    (folder / "e.dat").write_bytes(b"% Version 2\n" + bytes([12, 8]) + body)
    return folder / "e.dat", []


def davis(folder: Path) -> Made:
    (folder / "e.aedat").write_bytes(header(None) + records(event_addresses(E), E.t))
    return folder / "e.aedat", []


def stereo(folder: Path) -> Made:
    with h5py.File(folder / "e.h5", "w") as file:
        for side, p in (("left", E.p), ("right", 1 - E.p)):
            for name, values in {**COLUMNS, "p": p}.items():
                file[f"{side}/{name}"] = values
    return folder / "e.h5", []


def ecd(folder: Path) -> Made:
    lines = [f"{t / 1e6:.6f} {x} {y} {p}" for t, x, y, p in ROWS.tolist()]
    # The last time has no point; a comment keeps it out of the sample that is looked at first.
    lines[-1:] = ["#" + " " * 40_000, lines[-1].replace(f"{ROWS[-1, 0] / 1e6:.6f}", "1", 1)]
    (folder / "e.txt").write_text("\n".join(lines) + "\n")
    return folder / "e.txt", []


WIDE = np.column_stack([ROWS, ROWS[:, 3]])
NAN = np.column_stack([np.full(len(E), np.nan), ROWS])
SHUFFLED = ROWS[[0, 1, 3, 2, *range(4, len(E))]]
EARLY = np.column_stack([ROWS[:, 0] - 100_000, ROWS[:, 1:]])
US = ["--time-unit", "us"]
EVENTS: dict[str, tuple[Callable[[Path], Made], list[str] | str, str]] = {
    "; or --polarity {}/{}": (npz(**{**COLUMNS, "p": E.p * 255}), r"--polarity 0/255", ".npy"),
    "; or --polarity, the numbers of OFF and ON":
        (npz(**{**COLUMNS, "p": np.full(len(E), 9)}), ["--polarity", "1/9"], None),
    "{} or {} (--polarity)": (npz(["--polarity", "0/1"], **{**COLUMNS, "p": E.p + 1}), ["--polarity", "1/2"], ".npy"),
    "1 to {} px a side and at most {} px: --size WIDTHxHEIGHT":
        (npz(**COLUMNS, height=0, width=0), ["--size", "240x180"], ".npy"),
    "EVT3 times count from the recording's start; --zero-time shifts them": (csv(EARLY), ["--zero-time"], ".raw"),
    "AEDAT4 has no negative times; --zero-time shifts them":
        (csv(EARLY, "t_us,x@240,y@180,p"), ["--zero-time"], ".aedat4"),
    "times that do not; or --sort": (csv(SHUFFLED), ["--sort"], ".npy"),
    ", or --damaged keep": (dat, ["--damaged", "keep"], ".npy"),
    "a larger --size": (npz(["--size", "100x100"], **COLUMNS), ["--size", "240x180"], ".npy"),
    "--damaged keep, or a larger --size": (npz(**COLUMNS, height=100, width=100), ["--size", "240x180"], ".npy"),
    "{}; or --damaged keep": (raw(1), ["--damaged", "keep"], ".npy"),
    "--write-unit with .txt and .csv only; --time-unit is the unit of what is read":
        (npz(["--write-unit", "us"], **COLUMNS), ["--write-unit", "us"], ".csv"),
    "--size WIDTHxHEIGHT": (npz(**COLUMNS), ["--size", "240x180"], ".aedat4"),
    "no --time-unit for them; --write-unit is the unit of text that is written":
        (raw(0, "--time-unit", "ns"), ["--write-unit", "us"], ".csv"),
    "; of a DAVIS or v2e --size WIDTHxHEIGHT says it, too": (davis, ["--size", "240x180"], ".npy"),
    "--stream {} ({})": (stereo, r"--stream 0", ".npy"),
    "--columns with x, y, t, p in the file's order, _ for others, and --time-unit":
        (npy(np.column_stack([ROWS, ROWS[:, :2]])), ["--columns", "t,x,y,p,_,_", *US], ".npy"),
    "--columns {}": (npy(ROWS), r"--columns t,x,y,p --time-unit us", ".npy"),
    "try {} if that is right (blinkgl convert --look shows the file)": (npz(t=E.t, **XYP), r"--time-unit us", ".npy"),
    "--time-unit {}": (npz(t=E.t * 1000 + 1.7e18, **XYP), r"--time-unit ns", None),
    "--columns names {} columns": (npy(WIDE, "--columns", "t,x,y,p", *US), ["--columns", "t,x,y,p,_", *US], ".npy"),
    "x, y, t, p in one place, an array (N, 4), or --columns x=NAME,y=NAME,t=NAME,p=NAME":
        (npz(when=E.t, u=E.x, v=E.y, sign=E.p), ["--columns", "x=u,y=v,t=when,p=sign", *US], ".npy"),
    "x, y, t, p (--columns)":
        (npy(NAN, "--columns", "t,x,y,p,_", *US, "--damaged", "keep"), ["--columns", "_,t,x,y,p", *US], ".npy"),
    "--columns {}={}": (npz(time_us=E.t, stamp_us=E.t, **XYP), r"--columns t=time_us", ".npy"),
    "{} (--columns)": (csv(WIDE, "", "--columns", "t,x,y,p", *US), ["--columns", "t,x,y,p,_", *US], ".npy"),
    " (--columns)":
        (csv(WIDE, "", "--columns", "t,x,y,p", *US, "--damaged", "keep"), ["--columns", "t,x,y,p,_", *US], ".npy"),
    "try --columns and --time-unit": (ecd, ["--columns", "t,x,y,p", "--time-unit", "s"], None),
    "a heading such as t x y p, or --columns":
        (csv(ROWS, "when,where_x,where_y,sign"), ["--columns", "t,x,y,p", *US], ".npy"),
}  # fmt: skip
"""Text -> what makes the file and the options with which it is refused; the options of the remedy, or a pattern that
finds them in the message; the ending to write (None: .npy, of other times)."""


@pytest.mark.parametrize("text", EVENTS)
def test_what_is_named_reads_the_events(tmp_path, capsys, text):
    make, remedy, ending = EVENTS[text]
    path, options = make(tmp_path)
    bad = tmp_path / f"bad{'.npy' if ending in (None, '.csv') and text != '' else ending}"
    assert run(["convert", str(path), str(bad), *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and re.search(re.escape(text).replace(r"\{\}", ".+"), said), said
    if isinstance(remedy, str):
        found = re.search(remedy, said)
        assert found, said
        remedy = found[0].split()
    out = tmp_path / f"out{ending or '.npy'}"
    assert run(["convert", str(path), str(out), *remedy]) == 0, capsys.readouterr().err
    with open_events(out) as file:
        events = file.read()
    shift = int(E.t[0]) if "--zero-time" in text else 0
    if ending is None:
        assert len(events) == len(E) and events.x.tolist() == E.x.tolist()
    else:
        assert events.t.tolist() == (E.t - shift).tolist() and events.x.tolist() == E.x.tolist()
        assert events.y.tolist() == E.y.tolist() and events.p.tolist() == E.p.tolist()


# ---------------------------------------------------------------------------------------------------------------------
# Frames: what `simulate` makes after the remedy is what it makes of the same film, stated.

FILM = np.random.default_rng(0).integers(0, 255, (4, 12, 16)).astype(np.uint8)
STAMPS = [0, 10_000, 20_000, 30_000]


def film_npz(options=(), film=FILM, name="frames", **more):
    def make(folder: Path) -> Made:
        np.savez(folder / "f.npz", **{name: film}, **more)
        return folder / "f.npz", list(options)

    return make


def film_npy(*options: str, stamps: str = "", film=FILM):
    def make(folder: Path) -> Made:
        np.save(folder / "f.npy", film)
        (folder / "t.txt").write_text(stamps)
        return folder / "f.npy", [option.replace("T.TXT", str(folder / "t.txt")) for option in options]

    return make


def cut_png(folder: Path) -> Made:
    (folder / "f").mkdir()
    for k, image in enumerate(np.repeat(FILM, 2, axis=0)[:5]):
        data = cv2.imencode(".png", image)[1].tobytes()
        (folder / f"f/{k}.png").write_bytes(data[:-30] if k == 1 else data)
    return folder / "f", ["--fps", "100"]


def film_of_a_log_curve(folder: Path) -> Made:
    return put_video(folder / "v.mp4", [FILM[0].repeat(2, 0).repeat(2, 1)] * 3, codec="libx264", curve=9), []


def cut_video(folder: Path) -> Made:
    path = put_video(folder / "v.avi", list(np.repeat(FILM, 8, axis=0)), codec="mjpeg", pix_fmt="yuvj444p")
    path.write_bytes(path.read_bytes()[:-2000])
    return path, []


TIMES, FAR = "0\n1\n2\n3\n", "5000000000\n5000010000\n5000020000\n5000030000\n"
FRAMES: dict[str, tuple[Callable[[Path], Made], list[str] | str, bool]] = {
    "as many, or --fps": (film_npz(timestamps_us=STAMPS[:3]), ["--fps", "100"], True),
    "--fps or --timestamps": (film_npy(), ["--fps", "100"], True),
    "one of them, or --time-unit frames":
        (film_npy("--fps", "100", "--timestamps", "T.TXT", stamps=TIMES), ["+", "--time-unit", "frames"], True),
    "more than {} s, or --fps instead of the stamps": (film_npz(timestamps_us=[0, 5, 5, 9]), ["--fps", "100"], True),
    "another --time-unit":
        (film_npy("--timestamps", "T.TXT", "--time-unit", "s", stamps=FAR),
         ["--timestamps", "T.TXT", "--time-unit", "us"], False),
    "a whole picture; or --damaged keep": (cut_png, ["+", "--damaged", "keep"], False),
    "--array NAME, or one 'frames'": (film_npz(name="film", timestamps_us=STAMPS), ["--array", "film"], True),
    "try --white-level {} of {} bits, or 65535 if dark (white_level in a recipe)":
        (film_npy("--fps", "100", film=FILM.astype(np.uint16) * 16), r"--white-level 4095", False),
    "try --time-unit {} if that is right (--frames-time-unit in compare and calibrate), or --fps":
        (film_npz(timestamps=STAMPS), r"--time-unit us", True),
    "--fps, too":
        (film_npy("--timestamps", "T.TXT", "--time-unit", "frames", stamps=TIMES), ["+", "--fps", "100"], True),
    "--stream {}": (film_npz(images=FILM, timestamps_us=STAMPS), r"--stream 0", True),
    "a whole file; or --damaged keep": (cut_video, ["--damaged", "keep"], False),
    "the file states a curve": (film_of_a_log_curve, ["--gamma", "2.2"], False),
}  # fmt: skip
"""As :data:`EVENTS`; "+" before options that come beside those of the refusal; whether the events are those of the film
at 100 Hz."""


@pytest.mark.parametrize("text", FRAMES)
def test_what_is_named_reads_the_frames(tmp_path, capsys, text):
    make, remedy, exact = FRAMES[text]
    path, options = make(tmp_path)
    command = ["simulate", str(path), "--out", str(tmp_path / "e.npy"), "--overwrite", "--set", "threshold_sigma=0"]
    assert run([*command, *options]) == 2
    said = capsys.readouterr().err
    assert said.count("\n") == 1 and re.search(re.escape(text).replace(r"\{\}", ".+"), said), said
    if isinstance(remedy, str):
        remedy = ["+", *re.search(remedy, said)[0].split()]
    remedy = [part.replace("T.TXT", str(tmp_path / "t.txt")) for part in remedy]
    assert run([*command, *(options + remedy[1:] if remedy[0] == "+" else remedy)]) == 0, capsys.readouterr().err
    if exact:
        np.savez(tmp_path / "whole.npz", frames=FILM, timestamps_us=STAMPS)
        whole = [str(tmp_path / "whole.npz"), "--out", str(tmp_path / "w.npy")]
        assert run(["simulate", *whole, "--set", "threshold_sigma=0"]) == 0
        with open_events(tmp_path / "e.npy") as one, open_events(tmp_path / "w.npy") as other:
            assert same(one.read(), other.read())


# ---------------------------------------------------------------------------------------------------------------------
# Trajectories, and two recordings.

T_S = np.arange(12) * 0.02
TURN = Rotation.from_rotvec(np.outer(T_S, (0, 1, 2)))
QUATERNIONS = TURN.as_quat()
POSES = "".join(f"{t:.4f} 1 2 {k} {a} {b} {c} {d}\n" for k, (t, (a, b, c, d)) in enumerate(zip(T_S, QUATERNIONS)))
HEADED = "# t x y z qx qy qz qw\n"
MATRICES = "".join(
    " ".join(map(str, np.column_stack([R, (1, 2, k)]).ravel())) + "\n" for k, R in enumerate(TURN.as_matrix())
)
TUM, S = "t x y z qx qy qz qw", {"time_unit": "s"}
TURNED = "".join(f"{d} {a} {b} {c} 1 2 {k} {t:.4f}\n" for k, (t, (a, b, c, d)) in enumerate(zip(T_S, QUATERNIONS)))
PATHS: dict[str, tuple[str, dict[str, object], dict[str, object]]] = {
    "try time_unit: {} if that is right": (HEADED + POSES, {}, S),
    "try form: tum or euroc, or columns: {} and time_unit: s, ms, us or ns": (POSES, {}, {"columns": TUM, **S}),
    "rate: in Hz, or times: a file of them": (MATRICES, {}, {"rate": 50.0}),
    "a file of times, or rate: in Hz": (MATRICES, {"times": "nosuch.txt"}, {"times": None, "rate": 50.0}),
    "as many, or rate:": (MATRICES, {"times": "t.txt"}, {"rate": 50.0}),
    "length 1, or columns: in the file's order":
        (TURNED, {"columns": TUM, **S}, {"columns": "qw qx qy qz x y z t", **S}),
}  # fmt: skip


@pytest.mark.parametrize("text", PATHS)
def test_what_is_named_reads_the_poses(tmp_path, text):
    body, wrong, remedy = PATHS[text]
    (tmp_path / "p.txt").write_text(body)
    (tmp_path / "t.txt").write_text("0.000000\n1.000000\n")
    wrong = {key: str(tmp_path / value) if key == "times" else value for key, value in wrong.items()}
    with pytest.raises(AssetError, match=re.escape(text).replace(r"\{\}", ".+")):
        read_trajectory(tmp_path / "p.txt", PoseFile(**wrong))
    t_ns, T = read_trajectory(tmp_path / "p.txt", PoseFile(**remedy))
    assert np.allclose(t_ns, T_S * 1e9, atol=2) and np.allclose(T[:, :3, :3], TURN.as_matrix(), atol=1e-9)


@pytest.mark.parametrize("wrong", ["s", "ms"])
def test_another_unit_of_poses(tmp_path, wrong):
    """Nanoseconds since 1970 taken for seconds are too large; µs taken for ms are too far apart."""
    scale, right = (1e9, "ns") if wrong == "s" else (1e6, "us")
    first = 1_400_000_000 if wrong == "s" else 0
    step = 0.02 if wrong == "s" else 5.0
    rows = [
        f"{round((first + step * k) * scale)} {line.split(' ', 1)[1]}" for k, line in enumerate(POSES.splitlines(True))
    ]
    (tmp_path / "p.txt").write_text(HEADED + "".join(rows))
    with pytest.raises(AssetError, match=re.escape("time_unit: s, ms, us or ns")):
        read_trajectory(tmp_path / "p.txt", PoseFile(time_unit=wrong))
    t_ns, _ = read_trajectory(tmp_path / "p.txt", PoseFile(time_unit=right))
    assert np.allclose(np.diff(t_ns), step * 1e9, atol=1000)


def test_recordings_that_do_not_overlap(tmp_path, capsys):
    np.savez(tmp_path / "a.npz", **COLUMNS)
    np.savez(tmp_path / "b.npz", **{**COLUMNS, "t_us": E.t + 10**9})
    command = ["compare", str(tmp_path / "a.npz"), str(tmp_path / "b.npz")]
    assert run(command) == 2
    assert "recordings that overlap (seconds shown), or --zero-time" in capsys.readouterr().err
    assert run([*command, "--zero-time"]) == 0


HERE = {"recordings that overlap (seconds shown), or --zero-time", "time_unit: s, ms, us or ns"}
"""Texts with a test of their own above."""


def test_every_text_with_an_option_is_in_a_list():
    listed = {*LINES, *ELSEWHERE, *EVENTS, *FRAMES, *PATHS, *HERE}
    missing = {text: module for text, module in texts().items() if text not in listed}
    assert not missing, "run its remedy here, or list it as a line that refuses nothing"
    assert not {text for text in listed - set(texts()) if "-" in text and text != "the file states a curve"}
    for text, name in ELSEWHERE.items():
        source = (Path(__file__).parents[1] / name).read_text()
        assert re.search(r"--[a-z-]+", text)[0] in source, f"{name} does not run the option"
