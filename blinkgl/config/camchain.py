"""Camera calibrations: Kalibr's camchain, DSEC's ``cam_to_cam.yaml``, EuRoC's ``sensor.yaml``, OpenCV's FileStorage,
ROS' camera_info, COLMAP's ``cameras.txt`` and Metavision's JSON.

Kalibr has one table per camera, each with its pose relative to the camera before::

    cam0:
      camera_model: pinhole
      distortion_model: radtan            # or equidistant, or none
      distortion_coeffs: [-0.37, 0.19, 1.0e-4, -2.0e-4]
      intrinsics: [560.0, 558.0, 320.0, 240.0]      # fu, fv, pu, pv
      resolution: [640, 480]
    cam1: {…, T_cn_cnm1: 4 x 4, from the axes of cam0 to those of cam1}

EuRoC has one file per camera. Its distortion is called radial-tangential, and ``T_BS`` is the camera's pose on the body
that the trajectory describes.

DSEC has the tables under ``intrinsics``, with ``camera_matrix`` instead of ``intrinsics``, and beside them those of the
rectified images (``camRect0`` …).

OpenCV, ROS and Metavision have a matrix K and coefficients k1 k2 p1 p2 [k3 …], whose model, where none is named, is
OpenCV's own (``cv::calibrateCamera``). All count pixels as BlinkGL does, (0, 0) is the centre of the top-left pixel,
but COLMAP, where it is (0.5, 0.5).
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.camera import CAMERA_MODELS, CameraModel, PinHole
from blinkgl.camera.pinhole import rectified
from blinkgl.config.base import placed
from blinkgl.config.poses import rigid_matrix
from blinkgl.config.reader import parse_yaml, read_text, to_yaml
from blinkgl.errors import ConfigError
from blinkgl.types.numbers import is_number
from blinkgl.types.trees import Tree

_RIGID = 1e-4
_NONE = ("none", "None", "", "no", "pinhole", "no_distortion", None)
_COUNTS = {"radtan": (4, 5), "equidistant": (4,)}
_SYNONYMS = {
    "radial-tangential": "radtan", "plumb_bob": "radtan", "brown": "radtan", "opencv": "radtan", "radtan4": "radtan",
    "radtan5": "radtan", "rational_polynomial": "radtan", "fisheye": "equidistant", "equi": "equidistant",
    "kannala_brandt": "equidistant", "opencv_fisheye": "equidistant",
}  # fmt: skip
_MATRIX = ("camera_matrix", "K", "Camera_Matrix", "CameraMatrix", "cameraMatrix", "M1")
_COEFFICIENTS = ("distortion_coefficients", "distortion_coeffs", "Distortion_Coefficients", "dist_coeffs", "distCoeffs",
                 "D", "D1")  # fmt: skip
_COLMAP: dict[str, tuple[str | None, str]] = {
    # Model: ours, and what its numbers are; f is both focal lengths.
    "SIMPLE_PINHOLE": (None, "f cx cy"), "PINHOLE": (None, "fx fy cx cy"), "SIMPLE_RADIAL": ("radtan", "f cx cy k1"),
    "RADIAL": ("radtan", "f cx cy k1 k2"), "OPENCV": ("radtan", "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": ("equidistant", "fx fy cx cy k1 k2 k3 k4"),
    "FULL_OPENCV": ("radtan", "fx fy cx cy k1 k2 p1 p2 k3 k4 k5 k6"),
}  # fmt: skip


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A camera of a calibration file. camera : its model.   T_cam_before : (4, 4) float64 rigid, from the axes of the
    previous camera of the chain to its own (Kalibr's T_cn_cnm1).   T_cam_imu : (4, 4) rigid, from the inertial unit's
    axes to its own.   T_body_cam : (4, 4) rigid, from its own axes to the body's (EuRoC's T_BS). None: not
    given."""

    camera: CameraModel
    T_cam_before: np.ndarray | None = None
    T_cam_imu: np.ndarray | None = None
    T_body_cam: np.ndarray | None = None


def read_camchain(path: str | Path) -> dict[str, Calibrated]:
    """Return the cameras of a calibration in any of these formats, by name, in the file's order: of one camera as
    ``cam0``, COLMAP's as ``cam`` and their number, DSEC's rectified ones after the raw ones.

    Raises ConfigError naming file, camera and key for another kind of file, an unsupported model, coefficients without
    a model, a wrong number of them, impossible values, a distortion that folds inside the image, or a transform that is
    not rigid."""
    where, text = str(path), read_text(path)
    # A line of COLMAP's: CAMERA_ID MODEL WIDTH HEIGHT PARAMS.
    if re.search(r"^[ \t]*\d+[ \t]+[A-Z_]+[ \t]+\d+[ \t]+\d+[ \t]", text, re.M):
        return _colmap(text, where)
    tree = _tree(text, where)
    if (one := _of_matrix(tree, where)) is not None:
        return {"cam0": one}
    dsec = isinstance(tree.get("intrinsics"), dict)
    tables = tree["intrinsics"] if dsec else {"cam0": tree} if isinstance(tree.get("intrinsics"), list) else tree
    places = tree.get("extrinsics") if dsec else None
    names = [
        str(name)
        for name, table in tables.items()
        if isinstance(table, dict) and ("resolution" in table or "distortion_model" in table or "intrinsics" in table)
    ]
    if not names:
        accepted = "cam0: {intrinsics: …, …}, or a camera matrix"
        raise ConfigError("the file has no camera", where=where, value=sorted(map(str, tree))[:5], accepted=accepted)
    key = "camera_matrix" if dsec else "intrinsics"
    raw = [name for name in names if not (dsec and name.startswith("camRect"))]
    cameras = {name: _camera(tables[name], f"{where}: {name}", key) for name in raw}
    # DSEC's T_30 leads from cam0, the raw camera before it in the file, to cam3.
    numbers = [name.removeprefix("cam") for name in raw]
    for k, (name, one) in enumerate(cameras.items()):
        matrix, key = tables[name].get("T_cn_cnm1"), "T_cn_cnm1"
        if dsec and isinstance(places, dict) and k:
            key = f"T_{numbers[k]}{numbers[k - 1]}"
            matrix = places.get(key)
        before = None if matrix is None else _rigid(matrix, f"{where}: {name}.{key}")
        unit = next((k for k in ("T_cam_imu", "T_imu_cam") if tables[name].get(k) is not None), None)
        T = None if unit is None else _rigid(tables[name][unit], f"{where}: {name}.{unit}")
        T = np.linalg.inv(T) if T is not None and unit == "T_imu_cam" else T
        body = next((key for key in _ON_BODY if key in tables[name]), None)
        placed = None if body is None else _place(tables[name], body, f"{where}: {name}")
        cameras[name] = Calibrated(one.camera, before, T, placed)
    rectified_ = {name: _camera(tables[name], f"{where}: {name}", "camera_matrix") for name in names if name not in raw}
    return cameras | rectified_


def _tree(text: str, where: str) -> Tree:
    """Return the table of a YAML or JSON file, also of OpenCV's dialect: ``%YAML:1.0`` and the tags of its types."""
    # OpenCV writes a colon where YAML has a space, and tags that no other reader knows.
    text = re.sub(r"\A\s*%YAML[: ]1\.\d\s*\n(---\s*\n)?", "", text)
    tree = parse_yaml(re.sub(r"!!opencv-\w+", "", text), where)
    if not isinstance(tree, dict):
        raise ConfigError("not a table of keys", where=where, value=tree, accepted="a calibration: cam0, cam1, …")
    return tree


def _of_matrix(tree: Mapping[str, object], where: str) -> Calibrated | None:
    """Return the camera of a file of OpenCV, ROS or Metavision, or None for another kind of file."""
    inner = next((v for v in tree.values() if isinstance(v, dict) and any(key in v for key in _MATRIX)), {})
    table = tree if any(key in tree for key in _MATRIX) else inner if "K" in inner else {}
    key = next((key for key in _MATRIX if key in table), None)
    K = None if key is None else _flat(table[key])
    if K is None or len(K) != 9:
        return None
    # K row by row: fx, skew, cx; 0, fy, cy; 0, 0, 1.
    if abs(K[1]) > 1e-6 * abs(K[0]):
        raise ConfigError("the pixels are skewed", where=f"{where}: {key}", value=K[1], accepted="0 in the first row")
    if changed := _other_pictures(table):
        accepted = "the calibration of pictures as they are stored"
        raise ConfigError("of other pictures or another lens", where=where, value=changed, accepted=accepted)
    size = next((table[k] for k in ("img_size", "image_size", "resolution") if k in table), None)
    size = [table.get("image_width"), table.get("image_height")] if size is None else size
    numbers = next((name for name in _COEFFICIENTS if name in table), None)
    coefficients = [] if numbers is None else _flat(table[numbers])
    model = table.get("distortion_model", table.get("type", table.get("camera_model")))
    # Coefficients without a model are OpenCV's own; a flag of its files says which of the two.
    if model in _NONE and any(coefficients or ()):
        model = "equidistant" if table.get("fisheye_model") else "radtan"
    plain = {"resolution": size, "intrinsics": [K[0], K[4], K[2], K[5]], "distortion_model": model}
    return _camera(plain | {"distortion_coeffs": coefficients}, where, "intrinsics")


def _other_pictures(table: Mapping[str, Any]) -> dict[str, object]:
    """Return the keys by which a calibration is not of the pictures as they are: ROS's, whose binned and cut pictures
    keep the numbers of the whole ones, and the mirror xi of an omnidirectional lens."""
    roi = table.get("roi")
    if roi is not None and not isinstance(roi, dict):
        return {"roi": roi}
    sides = {"width": (0, None, table.get("image_width")), "height": (0, None, table.get("image_height"))}
    cut = {"x_offset": (0, None), "y_offset": (0, None), **sides}
    parts = roi or {}
    changed: dict[str, object] = {f"roi.{key}": parts[key] for key, whole in cut.items() if parts.get(key) not in whole}
    once = {"binning_x": (None, 0, 1), "binning_y": (None, 0, 1), "xi": (None, 0)}
    return changed | {key: table[key] for key, plain in once.items() if table.get(key) not in plain}


def _flat(matrix: object) -> list[float] | None:
    """Return the numbers of a matrix of OpenCV (rows, cols, data), of ROS, or a list of rows; None: none of these."""
    data = matrix.get("data") if isinstance(matrix, dict) else matrix
    if not isinstance(data, list):
        return None
    flat = [value for row in data for value in (row if isinstance(row, list) else [row])]
    return [float(v) for v in flat] if all(isinstance(v, (int, float)) for v in flat) else None


def _colmap(text: str, where: str) -> dict[str, Calibrated]:
    """Return the cameras of COLMAP's cameras.txt: CAMERA_ID MODEL WIDTH HEIGHT PARAMS."""
    cameras: dict[str, Calibrated] = {}
    for line in text.splitlines():
        fields = line.split()
        if not fields or fields[0].startswith("#"):
            continue
        place, model = f"{where}: camera {fields[0]}", fields[1] if len(fields) > 1 else ""
        if model not in _COLMAP:
            known = ", ".join(_COLMAP)
            raise ConfigError("unsupported camera model", where=place, value=model, accepted=f"one of {known}")
        kind, names = _COLMAP[model]
        numbers = [_number(field) for field in fields[4:]]
        if len(numbers) != len(names.split()) or None in numbers:
            raise ConfigError("wrong numbers", where=place, value=fields[4:], accepted=names)
        # COLMAP's parameters stand in another order for each of its models.
        by = dict(zip(names.split(), numbers))
        focal = [by.get("fx", by.get("f")), by.get("fy", by.get("f"))]
        # Its pixels begin at 0, ours are centred there.
        intrinsics = [*focal, by["cx"] - 0.5, by["cy"] - 0.5]
        order = ("k1", "k2", "k3", "k4") if kind == "equidistant" else ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
        coefficients = [by.get(name, 0.0) for name in order] if kind else []
        table = {"resolution": [_number(fields[2]), _number(fields[3])], "intrinsics": intrinsics}
        cameras[f"cam{fields[0]}"] = _camera(
            table | {"distortion_model": kind, "distortion_coeffs": coefficients}, place, "intrinsics"
        )
    return cameras


def _number(text: str) -> Any:
    return float(text) if is_number(text) else None


def read_place_on_body(path: str | Path) -> np.ndarray:
    """Return T_body_sensor, (4, 4) float64, with its rounded rotation made exact: ``T_BS`` or ``T_body_sensor`` of
    EuRoC's ``sensor.yaml``, or of Kalibr's first camera the inverse of ``T_cam_imu`` or ``T_imu_cam``. Raises
    ConfigError."""
    tree = _tree(read_text(path), str(path))
    tables = [tree, *(value for value in tree.values() if isinstance(value, dict))]
    names = (*_ON_BODY, "T_imu_cam", "T_cam_imu")
    place = next(((table, key) for table in tables for key in names if key in table), None)
    if place is None:
        accepted = "T_BS, T_body_sensor, T_cam_imu or T_imu_cam"
        raise ConfigError("no place on a body", where=str(path), value=sorted(map(str, tree))[:5], accepted=accepted)
    return _place(*place, str(path))


_ON_BODY = "T_BS", "T_body_sensor"


def _place(table: Mapping[str, Any], key: str, where: str) -> np.ndarray:
    matrix = table[key]
    data = matrix.get("data") if isinstance(matrix, dict) else matrix
    if isinstance(data, list) and len(data) == 16:
        data = [data[k : k + 4] for k in range(0, 16, 4)]
    T = rigid_matrix(_rigid(data, f"{where}: {key}"))
    return np.linalg.inv(T) if key == "T_cam_imu" else T


def camchain_yaml(cameras: Mapping[str, Calibrated]) -> str:
    """Return the text of a Kalibr camchain. Raises ValueError for a camera that Kalibr has no model of."""
    tree: dict[str, object] = {}
    for name, one in cameras.items():
        table = {"camera_model": "pinhole", **_lens(one.camera, "intrinsics")}
        if one.T_cam_before is not None:
            table["T_cn_cnm1"] = one.T_cam_before.tolist()
        tree[name] = table
    return to_yaml(tree)


def cam_to_cam_yaml(
    cameras: Sequence[Calibrated],
    numbers: Sequence[int] | None = None,
    disparity_to_depth: Mapping[str, object] | None = None,
) -> str:
    """Return the text of DSEC's ``cam_to_cam.yaml``: the raw cameras cam0 … and the rectified ones, which have the same
    axes (:func:`blinkgl.camera.pinhole.rectified`).

    numbers : the cameras' numbers where they are not 0, 1, …: DSEC's right event camera is cam3.   disparity_to_depth :
    the table of that name, ``cams_03`` -> 4 x 4."""
    numbers = range(len(cameras)) if numbers is None else numbers
    intrinsics: dict[str, object] = {}
    extrinsics: dict[str, object] = {}
    for place, (k, one) in enumerate(zip(numbers, cameras, strict=True)):
        intrinsics[f"cam{k}"] = _lens(one.camera, "camera_matrix")
        if one.T_cam_before is not None and place:
            extrinsics[f"T_{k}{numbers[place - 1]}"] = one.T_cam_before.tolist()
    for k, one in zip(numbers, cameras, strict=True):
        flat = _lens(rectified(one.camera), "camera_matrix")
        intrinsics[f"camRect{k}"] = {key: flat[key] for key in ("camera_matrix", "resolution")}
        extrinsics[f"R_rect{k}"] = np.eye(3).tolist()
    more = {} if disparity_to_depth is None else {"disparity_to_depth": dict(disparity_to_depth)}
    return to_yaml({"intrinsics": intrinsics, "extrinsics": extrinsics, **more})


def _lens(camera: CameraModel, key: str) -> dict[str, object]:
    drawn = camera.coefficients and camera.kind in _COUNTS
    if not drawn and not isinstance(camera, PinHole):
        raise ValueError(f"{camera.kind} cannot be written to a calibration file")
    numbers = [float(v) for v in camera.distortion]
    if camera.kind == "radtan" and numbers[4] == 0.0:  # Kalibr has four coefficients
        numbers = numbers[:4]
    return {
        "distortion_model": camera.kind if drawn else "none",
        "distortion_coeffs": numbers,
        key: [float(v) for v in camera.intrinsics],
        "resolution": [int(camera.width), int(camera.height)],
    }


def _camera(table: Tree, where: str, key: str) -> Calibrated:
    model = table.get("camera_model", "pinhole")
    if model != "pinhole":
        raise ConfigError("unsupported camera model", where=f"{where}.camera_model", value=model, accepted="pinhole")
    if table.get("flip") is True:
        accepted = "the calibration of images as they are stored"
        raise ConfigError("of images turned upside down first", where=f"{where}.flip", value=True, accepted=accepted)
    size = _numbers(table, "resolution", (2,), where)
    if any(v != round(v) for v in size):
        raise ConfigError("not a size", where=f"{where}.resolution", value=size, accepted="[width, height], whole px")
    intrinsics = _numbers(table, key, (4,), where)
    lens = table.get("distortion_model")
    kind = "pinhole" if lens in _NONE else _SYNONYMS.get(str(lens).lower(), str(lens))
    numbers = next((name for name in _COEFFICIENTS if name in table), "distortion_coeffs")
    known = f"one of {', '.join(_COUNTS)}, none"
    if kind not in ("pinhole", *_COUNTS):
        raise ConfigError("unknown distortion model", where=f"{where}.distortion_model", value=lens, accepted=known)
    values = _flat(table.get(numbers)) or []
    if kind == "pinhole" and any(values):
        # They are never dropped.
        stated = (
            "distortion coefficients without a model" if lens is None else f"coefficients of a lens of model {lens}"
        )
        accepted = f"distortion_model: {known}, and no coefficients with none"
        raise ConfigError(stated, where=f"{where}.{numbers}", value=values, accepted=accepted)
    if kind == "radtan" and len(values) > 5:
        if any(values[5:]):
            raise ConfigError(
                "the rational model's further coefficients (k4, k5, k6 …) are not supported",
                where=f"{where}.{numbers}",
                value=values[5:],
                accepted="k1 k2 p1 p2 k3: a calibration without CALIB_RATIONAL_MODEL",
            )
        table = {**table, numbers: values[:5]}
    elif isinstance(table.get(numbers), dict):
        table = {**table, numbers: values}
    values = [] if kind == "pinhole" else _numbers(table, numbers, _COUNTS[kind], where)
    with placed(where):
        coefficients = dict(zip(CAMERA_MODELS[kind].coefficients, values))
        return Calibrated(CAMERA_MODELS[kind](int(size[0]), int(size[1]), *intrinsics, **coefficients))


def _numbers(table: Mapping[str, object], key: str, counts: tuple[int, ...], where: str) -> list[float]:
    listed = table.get(key)
    try:
        values = [float(v) for v in listed if not isinstance(v, (bool, list, dict))]  # type: ignore[union-attr]
    except (TypeError, ValueError):
        values = []
    if not isinstance(listed, list) or len(values) != len(listed) or len(values) not in counts:
        accepted = f"a list of {' or '.join(map(str, counts))} numbers"
        raise ConfigError("wrong numbers", where=f"{where}.{key}", value=listed, accepted=accepted)
    if not all(map(math.isfinite, values)):
        raise ConfigError("not finite", where=f"{where}.{key}", value=listed, accepted="finite numbers")
    return values


def _rigid(matrix: object, where: str) -> np.ndarray:
    try:
        T = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    right = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    if not right or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=_RIGID) or np.linalg.det(T[:3, :3]) < 0:
        raise ConfigError(
            "not a rigid transform",
            where=where,
            value=matrix,
            accepted="4 rows of 4 numbers: a rotation and a translation",
        )
    return T
