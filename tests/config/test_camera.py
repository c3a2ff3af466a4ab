"""``camera:``: lenses, calibrations, and what is said of those that cannot be drawn."""

import json
import math

import cv2
import numpy as np
import pytest

import blinkgl
from blinkgl.camera import Equidistant, PinHole, Radtan
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml, camchain_yaml, read_camchain, read_place_on_body
from blinkgl.config.camera import CameraConfig, camera_keys
from blinkgl.config.problems import validate
from blinkgl.config.reader import to_yaml
from blinkgl.config.run import load_run
from blinkgl.errors import ConfigError
from tests.refusals import refusal

RADTAN = {"width": 120, "height": 90, "fx": 95.0, "fy": 99.0, "cx": 60.5, "cy": 43.0, "lens": "radtan"}
RADTAN["distortion"] = [-0.32, 0.11, 1e-3, -2e-3]


def camera(**keys):
    return validate(CameraConfig, keys, where="camera")


def test_the_keys_are_the_models():
    assert camera(**RADTAN).model == Radtan(120, 90, 95.0, 99.0, 60.5, 43.0, 0.05, -0.32, 0.11, 1e-3, -2e-3)
    assert camera(**RADTAN | {"distortion": [0, 0, 0, 0, 0.1]}).model.k3 == 0.1
    fish = camera(width=100, height=80, fov=90, lens="equidistant", distortion=(0.01, 0, 0, 0)).model
    assert fish == Equidistant(100, 80, 200 / math.pi, 200 / math.pi, 49.5, 39.5, 0.05, 0.01)
    assert camera(width=80, height=60, fx=70, fy=75).model == PinHole(80, 60, 70, 75, 39.5, 29.5)
    for one in (camera(**RADTAN), camera(width=80, height=60, fx=70, fy=75)):
        assert camera(**camera_keys(one.model)).model == one.model
    assert camera(**camera(**RADTAN).scaled(2)).model == camera(**RADTAN).model.resized(240, 180)


@pytest.mark.parametrize(
    "keys, said",
    [
        ({"lens": "fisheye62"}, "camera.lens: unknown choice"),
        ({"lens": "radtan", "distortion": [0.1]}, "camera.distortion: radtan has other coefficients"),
        ({"lens": "equidistant", "distortion": [1e308, 0, 0, 0]}, "camera.distortion.0: too large (got 1e+308)"),
        ({"lens": "equidistant", "distortion": [0.1] * 5}, "expected 4 of them, k1 k2 k3 k4"),
        ({"distortion": [0.1, 0, 0, 0]}, "camera.distortion: a pin-hole camera does not distort"),
        ({"lens": "radtan", "distortion": [math.nan, 0, 0, 0]}, "camera.distortion.0: not a finite number"),
        # r (1 - 0.8 r²) is largest at r = 0.645, where it is 0.4303 of a focal length of 173 px
        ({"lens": "radtan", "fov": 90, "distortion": [-0.8, 0, 0, 0]}, "folds inside the image (got '74.4 px"),
        ({"lens": "equidistant", "fov": 150, "distortion": [0] * 4}, "the lens sees up to 93.8 degrees off its axis"),
        ({"fx": 100}, "camera.fy: fx and fy come together"),
        ({"fx": 100, "fy": 100, "focal": 100}, "give fov, focal, or fx and fy"),
        ({"fx": -100, "fy": 100}, "camera.fx: too small"),
        ({"calibration": "a.yaml"}, "camera.calibration: a calibration is read with the run's file"),
        ({"calibration_name": "cam1"}, "camera.calibration_name: the name of a camera of a file"),
    ],
)
def test_what_cannot_be(keys, said):
    assert said in refusal(ConfigError, camera, **keys)


# ---- calibrations ---------------------------------------------------------------------------------------------------


def test_a_calibration_goes_out_and_comes_in_again(tmp_path):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.1, 0, 0.02]
    models = [camera(**RADTAN).model, PinHole(64, 48, 50.0, 51.0, 31.5, 23.0), Radtan(64, 48, 50, 51, 31, 23, k3=0.01)]
    models += [Equidistant(64, 48, 50.0, 51.0, 31.5, 23.0, 0.05, 0.1, 0.02, 0.003, 0.0004)]
    chain = {f"cam{k}": Calibrated(m, T if k else None) for k, m in enumerate(models)}
    for text in (camchain_yaml(chain), cam_to_cam_yaml([*chain.values()])):
        (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
        again = read_camchain(tmp_path / "c.yaml")
        flat = [name for name in again if name.startswith("camRect")]
        assert [name for name in again if name not in flat] == list(chain) and len(flat) in (0, 4)
        assert [again[name].camera for name in chain] == models
        assert all(again[name].camera.kind == "pinhole" for name in flat)
        assert again["cam0"].T_cam_before is None
        np.testing.assert_array_equal(again["cam2"].T_cam_before, T)


K, SIZE = [[95.0, 0, 60.5], [0, 99.0, 43.0], [0, 0, 1]], (120, 90)
RADIAL, EQUI = [-0.32, 0.11, 0.001, -0.002], [0.02, -0.004, 0.001, 0.0003]
FLAT = [v for row in K for v in row]
OPENCV = """%YAML:1.0
---
image_width: 120
image_height: 90
{name}: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: {K}
distortion_coefficients: !!opencv-matrix
   rows: {n}
   cols: 1
   dt: d
   data: {D}
{more}
"""
ROS = """image_width: 120
image_height: 90
camera_name: dvs
camera_matrix: {{rows: 3, cols: 3, data: {K}}}
distortion_model: {model}
distortion_coefficients: {{rows: 1, cols: {n}, data: {D}}}
rectification_matrix: {{rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}}
"""
TABLE = """cam0:
  camera_model: pinhole
  distortion_model: {model}
  distortion_coeffs: {D}
  intrinsics: [95.0, 99.0, 60.5, 43.0]
  resolution: [120, 90]
"""
COLMAP_HEAD = "# Camera list\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"


def opencv(D, name="camera_matrix", more=""):
    return OPENCV.format(name=name, K=FLAT, D=D, n=len(D), more=more)


@pytest.mark.parametrize(
    ("name", "text", "D", "fisheye"),
    [
        ("c.yaml", opencv(RADIAL), RADIAL, False),
        ("c.yaml", opencv([*RADIAL, 0.01], "K"), [*RADIAL, 0.01], False),
        ("c.yaml", opencv([*RADIAL, 0.01, 0, 0, 0]), [*RADIAL, 0.01], False),
        ("c.yml", "\ufeff" + opencv(EQUI, more="fisheye_model: 1"), EQUI, True),
        ("c.yaml", ROS.format(K=FLAT, D=RADIAL + [0.0], n=5, model="plumb_bob"), RADIAL, False),
        ("c.yaml", ROS.format(K=FLAT, D=EQUI, n=4, model="fisheye"), EQUI, True),
        ("c.yaml", ROS.format(K=FLAT, D=EQUI, n=4, model="equidistant"), EQUI, True),
        ("c.yaml", TABLE.format(D=RADIAL, model="plumb_bob"), RADIAL, False),
        ("c.yaml", TABLE.format(D=EQUI, model="kannala_brandt"), EQUI, True),
        ("c.yaml", TABLE.format(D=[0, 0, 0, 0], model="none"), [0.0] * 4, False),
        ("c.json", json.dumps({"type": "pinhole", "img_size": SIZE, "K": FLAT, "D": [*RADIAL, 0.0]}), RADIAL, False),
        ("c.json", json.dumps({"camera_model": {"img_size": SIZE, "K": FLAT, "D": RADIAL}}), RADIAL, False),
        ("cameras.txt", COLMAP_HEAD + "1 OPENCV 120 90 95 99 61 43.5 -0.32 0.11 0.001 -0.002\n", RADIAL, False),
        ("cameras.txt", COLMAP_HEAD + "1 OPENCV_FISHEYE 120 90 95 99 61 43.5 0.02 -0.004 0.001 0.0003\n", EQUI, True),
        ("cameras.txt", COLMAP_HEAD + "3 PINHOLE 120 90 95 99 61 43.5\n", [0.0] * 4, False),
        ("cameras.txt", COLMAP_HEAD + "1 FULL_OPENCV 120 90 95 99 61 43.5 -0.32 0.11 0.001 -0.002 0.01 0 0 0\n",
         [*RADIAL, 0.01], False),
    ],
)  # fmt: skip
def test_calibrations_of_others_project_as_opencv_does(tmp_path, name, text, D, fisheye):
    (tmp_path / name).write_text(text, encoding="utf-8")
    (made,) = read_camchain(tmp_path / name).values()
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.5, 0.5, (50, 2)), np.ones(50)])
    zero = np.zeros(3)
    if fisheye:
        seen = cv2.fisheye.projectPoints(points[:, None], zero, zero, np.array(K), np.array(D))[0][:, 0]
    else:
        seen = cv2.projectPoints(points, zero, zero, np.array(K), np.array(D))[0][:, 0]
    assert (made.camera.width, made.camera.height) == SIZE
    np.testing.assert_allclose(made.camera.project(points), seen, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TABLE.format(D=RADIAL, model="radtan").replace("  distortion_model: radtan\n", ""),
         "cam0.distortion_coeffs: distortion coefficients without a model"),
        (TABLE.format(D=RADIAL, model="none"), "cam0.distortion_coeffs: coefficients of a lens of model none"),
        (TABLE.format(D=RADIAL, model="fov"), "cam0.distortion_model: unknown distortion model (got 'fov')"),
        (TABLE.format(D=RADIAL, model="radtan").replace("pinhole", "omni"), "unsupported camera model (got 'omni')"),
        (TABLE.format(D=RADIAL, model="radtan").replace("pinhole", "ds"), "unsupported camera model (got 'ds')"),
        (TABLE.format(D=RADIAL[:2], model="radtan"), "wrong numbers"),
        (TABLE.format(D=RADIAL, model="radtan") + "  flip: True\n", "cam0.flip: of images turned upside down"),
        (opencv([*RADIAL, 0.01, 0.1, 0.2, 0.3]), "the rational model's further coefficients (k4, k5, k6 …) are not"),
        (opencv(RADIAL).replace("95.0, 0, 60.5", "95.0, 2.0, 60.5"), "the pixels are skewed"),
        (COLMAP_HEAD + "1 THIN_PRISM_FISHEYE 120 90 1 2 3 4\n", "camera 1: unsupported camera model"),
        (COLMAP_HEAD + "1 PINHOLE 120 90 95 99 61\n", "camera 1: wrong numbers"),
    ],
)  # fmt: skip
def test_what_a_calibration_says_is_never_dropped(tmp_path, text, said):
    (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
    line = refusal(ConfigError, read_camchain, tmp_path / "c.yaml")
    assert said in line and "c.yaml" in line


@pytest.mark.parametrize("key", ["T_BS", "T_body_sensor", "T_imu_cam", "T_cam_imu"])
def test_the_place_on_a_body_by_any_name(tmp_path, key):
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]], [0.1, 0, 0.02]
    given = np.linalg.inv(T) if key == "T_cam_imu" else T
    table = (
        {"cam0": {key: given.tolist()}}
        if "imu" in key
        else {key: {"rows": 4, "cols": 4, "data": given.ravel().tolist()}}
    )
    (tmp_path / "c.yaml").write_text(to_yaml(table))
    np.testing.assert_allclose(read_place_on_body(tmp_path / "c.yaml"), T, atol=1e-12)


KALIBR = """cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.32, 0.11, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [95.0, 99.0, 60.5, 43.0]
  resolution: [120, 90]
  rostopic: /dvs/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.1]
  - [0.0, 1.0, 0.0, 0.0]
  - [0.0, 0.0, 1.0, 0.0]
  - [0.0, 0.0, 0.0, 1.0]
  camera_model: pinhole
  distortion_coeffs: [0.01, 0.0, 0.0, 0.0]
  distortion_model: equidistant
  intrinsics: [50.0, 50.0, 31.5, 23.5]
  resolution: [64, 48]
"""


def test_a_run_takes_its_camera_from_kalibr(tmp_path, monkeypatch):
    (tmp_path / "k.yaml").write_text(KALIBR, encoding="utf-8")
    (tmp_path / "run.yaml").write_text("camera: {calibration: k.yaml, near: 0.1}", encoding="utf-8")
    run = load_run(tmp_path / "run.yaml")
    config = run.sequence(0).camera
    assert config.model == camera(**RADTAN, near=0.1).model and config.calibration is None
    other = load_run(tmp_path / "run.yaml", ["camera.calibration_name=cam1"]).sequence(0).camera.model
    assert other.kind == "equidistant" and other.width == 64
    monkeypatch.chdir(tmp_path)
    in_python = blinkgl.Camera(calibration="k.yaml", near=0.1)
    assert validate(CameraConfig, in_python.tree).model == config.model


@pytest.mark.parametrize(
    "change, keys, said",
    [
        (
            ("", ""),
            {"calibration_name": "cam7"},
            "camera.calibration_name: no such camera in the calibration (got 'cam7')",
        ),
        (("", ""), {"width": 121}, "camera.width: the calibration has another resolution, 120x90 px (got 121)"),
        (("", ""), {"fov": 60}, "camera.fov: the calibration sets this key"),
        (("[95.0, 99.0", "[-95.0, 99.0"), {}, "k.yaml: cam0: not a length (got -95.0)"),
        (("-0.32", ".nan"), {}, "k.yaml: cam0.distortion_coeffs: not finite"),
        (("-0.32, ", ""), {}, "expected a list of 4 or 5 numbers"),
        (("-0.32", "-3.2"), {}, "k.yaml: cam0: the distortion folds inside the image"),
        (("radtan", "fov"), {}, "k.yaml: cam0.distortion_model: unknown distortion model (got 'fov')"),
        (("pinhole", "omni"), {}, "k.yaml: cam0.camera_model: unsupported camera model (got 'omni')"),
        (("[1.0, 0.0, 0.0, -0.1]", "[1.0, 0.5, 0.0, -0.1]"), {}, "k.yaml: cam1.T_cn_cnm1: not a rigid transform"),
        (("[120, 90]", "120x90"), {}, "k.yaml: cam0.resolution: wrong numbers"),
        (("cam", "eye"), {}, "no such camera in the calibration (got 'cam0'); expected one of eye0, eye1"),
        ((KALIBR, "a: 1"), {}, "k.yaml: the file has no camera"),
        (("cam0:", "cam0: ]"), {}, "not valid YAML"),
    ],
)
def test_calibrations_that_cannot_be(tmp_path, change, keys, said):
    (tmp_path / "k.yaml").write_text(KALIBR.replace(*change), encoding="utf-8")
    tree = {"calibration": "k.yaml", **keys}
    (tmp_path / "run.yaml").write_text(f"camera: {tree}", encoding="utf-8")
    assert said in refusal(ConfigError, load_run, tmp_path / "run.yaml")


WHOLE = "binning_x: 0\nbinning_y: 1\nroi: {x_offset: 0, y_offset: 0, height: 90, width: 120, do_rectify: true}\n"


@pytest.mark.parametrize(
    "more, named",
    [
        ("binning_x: 2\n", "binning_x"),
        ("roi: {x_offset: 8, y_offset: 0, height: 0, width: 0, do_rectify: false}\n", "roi.x_offset"),
        ("roi: {x_offset: 0, y_offset: 0, height: 60, width: 120, do_rectify: false}\n", "roi.height"),
        ("xi: 1.2\n", "xi"),
        ("roi: [8, 0, 10, 10]\n", "roi"),
        ("roi: {x_offset: [1]}\n", "roi.x_offset"),
        ("binning_y: {a: 1}\n", "binning_y"),
    ],
)
def test_calibrations_of_other_pictures_are_refused(tmp_path, more, named):
    text = ROS.format(K=FLAT, D=RADIAL, n=4, model="plumb_bob")
    (tmp_path / "c.yaml").write_text(text + WHOLE)
    assert "cam0" in read_camchain(tmp_path / "c.yaml")
    (tmp_path / "c.yaml").write_text(text + more)
    with pytest.raises(ConfigError, match=rf"of other pictures or another lens.*{named}.*as they are stored"):
        read_camchain(tmp_path / "c.yaml")


def test_the_right_camera_of_dsec_keeps_its_place(tmp_path):
    """Its keys are made of the cameras' numbers, which need not follow each other: T_30 is of cam3 beside cam0."""
    T, model = np.eye(4), PinHole(64, 48, 50.0, 51.0, 31.5, 23.0)
    T[0, 3] = -0.6
    for numbers in ((0, 3), (0, 1), (2, 5)):
        text = cam_to_cam_yaml([Calibrated(model), Calibrated(model, T)], numbers)
        assert f"T_{numbers[1]}{numbers[0]}" in text
        (tmp_path / "c.yaml").write_text(text, encoding="utf-8")
        np.testing.assert_array_equal(read_camchain(tmp_path / "c.yaml")[f"cam{numbers[1]}"].T_cam_before, T)
