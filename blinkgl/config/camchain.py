"""Camera calibrations in YAML: Kalibr's camchain, DSEC's ``cam_to_cam.yaml`` and EuRoC's ``sensor.yaml``.

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
rectified images (``camRect0`` …). All count pixels as BlinkGL does: (0, 0) is the centre of the top-left pixel.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from blinkgl.camera import CAMERA_MODELS, CameraModel, PinHole
from blinkgl.camera.pinhole import rectified
from blinkgl.config.poses import rigid_matrix
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import ConfigError

_RIGID = 1e-4
_NONE = ("none", "None", "", None)
_COUNTS = {"radtan": (4, 5), "equidistant": (4,)}
_EUROC = {"radial-tangential": "radtan"}


@dataclass(frozen=True, eq=False)
class Calibrated:
    """A camera of a calibration file. camera : its model.   T_cam_before : (4, 4) float64 rigid, from the axes of the
    previous camera of the chain to its own (Kalibr's T_cn_cnm1); None where it is not given."""

    camera: CameraModel
    T_cam_before: np.ndarray | None = None


def read_camchain(path: str | Path) -> dict[str, Calibrated]:
    """Return the cameras of a calibration in any of these formats, by name, in the file's order: DSEC's raw cameras
    only, and EuRoC's as ``cam0``.

    Raises ConfigError naming file, camera and key for another kind of file, an unsupported model, a wrong number of
    coefficients, impossible values, a distortion that folds inside the image, or a transform that is not rigid."""
    where = str(path)
    tree = read_table(path, "a calibration: cam0, cam1, …")
    dsec = isinstance(tree.get("intrinsics"), dict)
    tables = tree["intrinsics"] if dsec else {"cam0": tree} if isinstance(tree.get("intrinsics"), list) else tree
    places = tree.get("extrinsics") if dsec else None
    found = {
        str(name): _camera(table, f"{where}: {name}", "camera_matrix" if dsec else "intrinsics")
        for name, table in tables.items()
        if isinstance(table, dict) and ("resolution" in table or "distortion_model" in table)
        if not (dsec and str(name).startswith("camRect"))
    }
    if not found:
        raise ConfigError(
            "the file has no camera", where=where, value=sorted(map(str, tree))[:5], accepted="cam0: {intrinsics: …, …}"
        )
    for k, (name, one) in enumerate(found.items()):
        given, key = tables[name].get("T_cn_cnm1"), "T_cn_cnm1"
        if dsec and isinstance(places, dict) and k:
            key = f"T_{k}{k - 1}"
            given = places.get(key)
        if given is not None:
            found[name] = Calibrated(one.camera, _rigid(given, f"{where}: {name}.{key}"))
    return found


def read_place_on_body(path: str | Path) -> np.ndarray:
    """Return T_body_sensor, (4, 4) float64: the ``T_BS`` of EuRoC's ``sensor.yaml`` with its rounded rotation made
    exact. Raises ConfigError."""
    given = read_table(path, "EuRoC's sensor.yaml").get("T_BS")
    data = given.get("data") if isinstance(given, dict) else given
    if isinstance(data, list) and len(data) == 16:
        data = [data[k : k + 4] for k in range(0, 16, 4)]
    return rigid_matrix(_rigid(data, f"{path}: T_BS"))


def camchain_yaml(cameras: Mapping[str, Calibrated]) -> str:
    """Return the text of a Kalibr camchain. Raises ValueError for a camera that Kalibr has no model of."""
    tree: dict[str, Any] = {}
    for name, one in cameras.items():
        table = {"camera_model": "pinhole", **_lens(one.camera, "intrinsics")}
        if one.T_cam_before is not None:
            table["T_cn_cnm1"] = one.T_cam_before.tolist()
        tree[name] = table
    return to_yaml(tree)


def cam_to_cam_yaml(
    cameras: Sequence[Calibrated],
    numbers: Sequence[int] | None = None,
    disparity_to_depth: Mapping[str, Any] | None = None,
) -> str:
    """Return the text of DSEC's ``cam_to_cam.yaml``: the raw cameras cam0 … and the rectified ones, which have the same
    axes (:func:`blinkgl.camera.pinhole.rectified`).

    numbers : the cameras' numbers where they are not 0, 1, …: DSEC's right event camera is cam3.   disparity_to_depth :
    the table of that name, ``cams_03`` -> 4 x 4."""
    numbers = range(len(cameras)) if numbers is None else numbers
    intrinsics: dict[str, Any] = {}
    extrinsics: dict[str, Any] = {}
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


def _lens(camera: CameraModel, key: str) -> dict[str, Any]:
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


def _camera(table: dict[str, Any], where: str, key: str) -> Calibrated:
    model = table.get("camera_model", "pinhole")
    if model != "pinhole":
        raise ConfigError("unsupported camera model", where=f"{where}.camera_model", value=model, accepted="pinhole")
    size = _numbers(table, "resolution", (2,), where)
    if any(v != round(v) for v in size):
        raise ConfigError("not a size", where=f"{where}.resolution", value=size, accepted="[width, height], whole px")
    intrinsics = _numbers(table, key, (4,), where)
    lens = table.get("distortion_model")
    kind = "pinhole" if lens in _NONE else _EUROC.get(str(lens), str(lens))
    numbers = "distortion_coefficients" if "distortion_coefficients" in table else "distortion_coeffs"
    if kind not in ("pinhole", *_COUNTS):
        raise ConfigError(
            "unknown distortion model",
            where=f"{where}.distortion_model",
            value=lens,
            accepted=f"one of {', '.join(_COUNTS)}, none",
        )
    given = [] if kind == "pinhole" else _numbers(table, numbers, _COUNTS[kind], where)
    try:
        made = CAMERA_MODELS[kind](
            int(size[0]), int(size[1]), *intrinsics, **dict(zip(CAMERA_MODELS[kind].coefficients, given))
        )
    except ConfigError as error:
        raise ConfigError(error.problem, where=where, value=error.value, accepted=error.accepted) from None
    return Calibrated(made)


def _numbers(table: dict[str, Any], key: str, counts: tuple[int, ...], where: str) -> list[float]:
    given = table.get(key)
    try:
        values = [float(v) for v in given if not isinstance(v, (bool, list, dict))]  # type: ignore[union-attr]
    except (TypeError, ValueError):
        values = []
    if not isinstance(given, list) or len(values) != len(given) or len(values) not in counts:
        said = " or ".join(map(str, counts))
        raise ConfigError("wrong numbers", where=f"{where}.{key}", value=given, accepted=f"a list of {said} numbers")
    if not all(map(math.isfinite, values)):
        raise ConfigError("not finite", where=f"{where}.{key}", value=given, accepted="finite numbers")
    return values


def _rigid(given: Any, where: str) -> np.ndarray:
    try:
        T = np.array(given, np.float64)
    except (TypeError, ValueError):
        T = np.zeros(0)
    right = T.shape == (4, 4) and np.isfinite(T).all() and np.allclose(T[3], [0, 0, 0, 1])
    if not right or not np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=_RIGID) or np.linalg.det(T[:3, :3]) < 0:
        raise ConfigError(
            "not a rigid transform",
            where=where,
            value=given,
            accepted="4 rows of 4 numbers: a rotation and a translation",
        )
    return T
