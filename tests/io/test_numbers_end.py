"""Numbers in text have an end: whatever a file says of a time, a pose, a camera or a size, it is finite or one line."""

from __future__ import annotations

import ast
import json
import math
import warnings
from pathlib import Path

import numpy as np
import pytest

import blinkgl
import eflow
from blinkgl.config.camchain import read_camchain, read_place_on_body
from blinkgl.config.reader import read_table
from blinkgl.errors import BlinkGLError
from blinkgl.io.formats import open_events
from blinkgl.io.frames import open_frames
from blinkgl.io.images import encode_png, read_pfm
from blinkgl.io.reading import Declared, EventReading
from blinkgl.io.sequence_tables import EXPOSURES, read_exposures
from blinkgl.io.stills import open_stills
from blinkgl.io.times import read_label_times, read_timestamps
from blinkgl.io.trajectories import read_trajectory
from blinkgl.types.numbers import exact, is_number
from eflow.data.sources import read_submission_times

ABSURD = (
    "1e999", "-1e999", "1e400", "1e308", "-1e308", "1e101", "1e99", "1e-400", "1e-99999", "9" * 400, "9" * 5000,
    "-" + "9" * 5000, "0." + "0" * 400 + "1", "1e99999999999999999999", "1e1000000", "nan", "inf", "-Infinity", "1/0",
    "0x10", "1_0", "", "٣", "²", "1e", "--1", "1e19", "18446744073709551616", "1e18", "1e25", "4611686018427387904",
)  # fmt: skip
"""Numbers that Python's own types read as infinite, refuse by exceptions of their own, or compute for minutes."""


def poses(number: str) -> str:
    return f"0.1 {number} 1 0 0 0 0 1\n0.2 1 1 0 0 0 0 1\n0.3 2 1 0 0 0 0 1\n"


EUROC = "#timestamp [ns],p_x [m],p_y [m],p_z [m],q_w [],q_x [],q_y [],q_z []\n"
KALIBR = """cam0:
  camera_model: pinhole
  distortion_model: {model}
  distortion_coeffs: [-0.1, {k2}, 0.0, 0.0]
  intrinsics: [{fx}, 500, {cx}, 240]
  resolution: [{width}, 480]
  T_cam_imu: [[1, 0, 0, {t}], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
"""
KALIBR_SOUND = {"model": "radtan", "k2": "0.01", "fx": "500", "cx": "320", "width": "640", "t": "0"}
OPENCV = """%YAML:1.0
---
image_width: {width}
image_height: 480
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {fx}, 0., 320., 0., 500., 240., 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ {k1}, 0., 0., 0., {k3} ]
"""
OPENCV_SOUND = {"width": "640", "fx": "500", "k1": "-0.1", "k3": "0"}


def nerf(number: str, time: str = "0") -> str:
    frame = '{"time": %s, "transform_matrix": [[1, 0, 0, %s], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}'
    return '{"frames": [' + ", ".join([frame % (time, number), frame % (0.2, 1), frame % (0.3, 2)]) + "]}"


def fields(template: str, sound: dict[str, str]) -> dict:
    return {key: (lambda number, key=key: template.format(**{**sound, key: number})) for key in sound if key != "model"}


TEXTS = {
    "tum x": ("p.txt", poses, read_trajectory),
    "tum q": ("p.txt", lambda n: f"0.1 0 0 0 0 0 0 {n}\n0.2 0 0 0 0 0 0 1\n", read_trajectory),
    "tum t": ("p.txt", lambda n: f"0.1 0 0 0 0 0 0 1\n{n} 0 0 0 0 0 0 1\n", read_trajectory),
    "euroc t": ("p.csv", lambda n: f"{EUROC}1000,0,0,0,1,0,0,0\n{n},0,0,0,1,0,0,0\n", read_trajectory),
    "euroc x": ("p.csv", lambda n: f"{EUROC}1000,0,{n},0,1,0,0,0\n2000,0,0,0,1,0,0,0\n", read_trajectory),
    "nerf x": ("p.json", nerf, read_trajectory),
    "nerf t": ("p.json", lambda n: nerf("0", n), read_trajectory),
    "stamps s": ("t.txt", lambda n: f"0\n{n}\n", lambda p: read_timestamps(p, "s").times_ns),
    "stamps unknown": ("t.txt", lambda n: f"0.000001 a\n{n} b\n", lambda p: read_timestamps(p).times_ns),
    "stamps names": ("t.txt", lambda n: f"0 a.png\n{n} b.png\n", lambda p: read_timestamps(p, "ms").times_ns),
    "stamps ends": ("t.txt", lambda n: f"start end\n0 1\n2 {n}\n", lambda p: read_timestamps(p, "us").times_ns),
    "stamps counts": ("t.txt", lambda n: f"0 0.1\n1 0.2\n2 {n}\n", lambda p: read_timestamps(p, "s").times_ns),
    "stamps frames": ("t.txt", lambda n: f"0\n{n}\n", lambda p: read_timestamps(p, "frames", 30.0).times_ns),
    "labels": ("t.txt", lambda n: f"0, 1\n{n}, 2\n", lambda p: read_label_times(p, 2)),
    "dsec test": ("t.csv", lambda n: f"0, 1, 2\n{n}, 2, 3\n", read_submission_times),
    "exposures": (EXPOSURES, lambda n: f"start_us,end_us,exposure_us,row_us,gain_db,instants\n0,1,1,{n},1,1\n",
                  lambda p: [vars(line) for line in read_exposures(p.parents[1])]),
    "instants": (EXPOSURES, lambda n: f"start_us,end_us,exposure_us,row_us,gain_db,instants\n0,1,1,1,1,{n}\n",
                 lambda p: [vars(line) for line in read_exposures(p.parents[1])]),
    "events t": ("e.txt", lambda n: f"t_s x y p\n0.1 1 1 1\n{n} 1 1 1\n", lambda p: open_events(p).read()),
    "events x": ("e.txt", lambda n: f"t_s x y p\n0.1 1 1 1\n0.2 {n} 1 1\n", lambda p: open_events(p).read()),
    "events bare": ("e.txt", lambda n: f"0.1 1 1 1\n{n} 1 1 1\n", lambda p: open_events(p).read()),
    "events size": ("e.txt", lambda n: f"{n} 480\n0.1 1 1 1\n",
                    lambda p: open_events(p, EventReading.of(columns="t,x,y,p", time_unit="s")).read()),
    "faery": ("e.csv", lambda n: f"t,x@{n},y@480,on\n1,1,1,1\n", lambda p: open_events(p).read()),
    "evt": ("e.raw", lambda n: f"% evt 3.0\n% geometry {n}x480\n% end\n", lambda p: open_events(p).read()),
    "evt system": ("e.raw", lambda n: f"% evt 3.0\n% system_ID {n}\n% end\n", lambda p: open_events(p).read()),
    "colmap": ("c.txt", lambda n: f"1 OPENCV 640 480 500 500 320 240 {n} 0 0 0\n", read_camchain),
    "colmap f": ("c.txt", lambda n: f"1 PINHOLE 640 480 {n} 500 320 240\n", read_camchain),
    "colmap size": ("c.txt", lambda n: f"1 PINHOLE {n} 480 500 500 320 240\n", read_camchain),
    **{f"kalibr {key}": ("c.yaml", text, read_camchain) for key, text in fields(KALIBR, KALIBR_SOUND).items()},
    **{f"fisheye {key}": ("c.yaml", text, read_camchain)
       for key, text in fields(KALIBR, KALIBR_SOUND | {"model": "equidistant"}).items()},
    "kalibr place": ("c.yaml", lambda n: KALIBR.format(**KALIBR_SOUND | {"t": n}), read_place_on_body),
    **{f"opencv {key}": ("c.yaml", text, read_camchain) for key, text in fields(OPENCV, OPENCV_SOUND).items()},
    "pfm": ("a.pfm", lambda n: f"PF\n{n} 1\n-1.0\n", read_pfm),
    "pfm scale": ("a.pfm", lambda n: f"Pf\n1 1\n{n}\n\0\0\0\0", read_pfm),
    "pgm": ("a.pgm", lambda n: f"P5\n{n} 1\n255\n\0", lambda p: open_stills(p).read()),
    "pgm most": ("a.pgm", lambda n: f"P5\n1 1\n{n}\n\0", lambda p: open_stills(p).read()),
    "hdr": ("a.hdr", lambda n: f"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1 +X {n}\n\0\0\0\0",
            lambda p: open_stills(p).read()),
    "yaml": ("c.yaml", lambda n: f"a: {n}\n", lambda p: bool(read_table(p))),
}  # fmt: skip
"""Doors: the file, its text with a number, what reads it."""


def finite(value: object) -> bool:
    """Whether all numbers of a result are, where it has any."""
    if isinstance(value, dict):
        return all(map(finite, value.values()))
    if isinstance(value, (list, tuple)):
        return all(map(finite, value))
    if isinstance(value, np.ndarray):
        return value.dtype.kind != "f" or bool(np.isfinite(value).all())
    return not isinstance(value, float) or math.isfinite(value)


@pytest.mark.parametrize("door", TEXTS)
def test_every_door_ends(tmp_path, door):
    name, text, read = TEXTS[door]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    for number in ABSURD:
        path.write_text(text(number), encoding="utf-8")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                value = read(path)
        except BlinkGLError as error:
            assert "\n" not in str(error) and len(str(error)) < 1500, number
            continue
        assert finite(value), (number, value)


@pytest.mark.parametrize(
    "names",
    [
        [f"{k}e99999999999999999999" for k in (1, 2, 3)],
        ["1e999999", "1e1000000", "2e1000000"],
        ["1e999", "2e999", "4e999"],
        ["1e99", "2e99", "4e99"],
        [f"{k}{'0' * 240}" for k in (1, 2, 4)],
        [f"{k}.{'3' * 240}" for k in (1, 2, 4)],
    ],
)
def test_names_of_frames_are_in_order(tmp_path, names):
    for k, name in enumerate(names):
        (tmp_path / f"{name}.png").write_bytes(encode_png(np.full((4, 4), k, np.uint8)))
    frames = list(open_frames(tmp_path, Declared(fps=10.0)))
    assert [frame[0, 0] for frame, _, _ in frames] == [0, 1, 2]
    assert all(abs(t_ns) < 2**62 for _, t_ns, _ in frames)


@pytest.mark.parametrize("number", ABSURD)
def test_options_of_the_command_line_end(tmp_path, number):
    for option in ("polarity", "size", "columns", "stream", "time_unit"):
        value = f"0/{number}" if option == "polarity" else f"{number}x480" if option == "size" else number
        try:
            reading = EventReading.of(**{option: value})
        except BlinkGLError as error:
            assert "\n" not in str(error)
            continue
        assert finite(reading.polarity or ()), option
    for k in range(3):
        (tmp_path / f"{k}.png").write_bytes(encode_png(np.zeros((4, 4), np.uint8)))
    (tmp_path / "stamps.txt").write_text(f"0\n0.1\n{number}\n")
    try:
        for _, t_ns, _ in open_frames(tmp_path, Declared(timestamps=tmp_path / "stamps.txt", time_unit="s")):
            assert abs(t_ns) < 2**62
    except BlinkGLError as error:
        assert "\n" not in str(error)


def test_a_header_of_latin_1_may_have_a_digit_that_is_no_number(tmp_path):
    (tmp_path / "e.raw").write_bytes("% system_ID ²\n% end\n".encode("latin-1"))
    with pytest.raises(BlinkGLError, match="no system_ID that says them"):
        open_events(tmp_path / "e.raw")


def test_what_a_number_is():
    assert all(map(is_number, ("0", "-1", "+.5", "1.", "1e-9", "1E+99", "9" * 99, "0.1" + "0" * 97)))
    assert not any(
        map(is_number, ("", ".", "1e", "1e1000", "1e100", "9" * 101, "nan", "inf", "1_0", "٣", "1/2", " 1", "1\n"))
    )
    assert exact("1403636579.763555584") * 10**9 == 1403636579763555584
    for number in ABSURD[:5]:
        with pytest.raises(ValueError, match="is no number below 1e100"):
            exact(number)


def test_exact_arithmetic_begins_in_one_place():
    """``Fraction`` and ``Decimal`` of a text whose length and exponent nobody limits compute for minutes."""
    allowed = {"Fraction": {"types/numbers.py", "io/times.py", "io/video.py", "timeline/sampling.py"},
               "Decimal": {"io/names.py"}}  # fmt: skip
    for root in (Path(package.__path__[0]) for package in (blinkgl, eflow)):
        for path in sorted(root.rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and ast.unparse(node.func) in allowed:
                    assert path.relative_to(root).as_posix() in allowed[ast.unparse(node.func)], ast.unparse(node)


def test_numbers_of_json_are_limited_where_poses_are_read(tmp_path):
    path = tmp_path / "transforms.json"
    for number in ("9" * 400, "1e999", "9" * 5000):
        path.write_text(nerf(number))
        with pytest.raises(BlinkGLError, match="no transforms.json: transform_matrix"):
            read_trajectory(path)
    json.loads(nerf("1"))
    path.write_text(nerf("1"))
    assert read_trajectory(path)[1][0, 0, 3] == 1.0
