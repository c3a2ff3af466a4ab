"""The ``camera:`` section: size, intrinsics and lens.

camera: {width: 346, height: 260, fov: 60}                       # a pinhole camera
camera: {width: 640, height: 480, focal: 560, lens: radtan, distortion: [-0.37, 0.19, 1.0e-4, -2.0e-4]} camera:
{calibration: camchain.yaml, calibration_name: cam1}     # Kalibr's, or DSEC's cam_to_cam.yaml

A calibration is replaced by the keys that it gives when the run is read, so that a sequence's configuration is complete
without the file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from blinkgl.camera import CAMERA_MODELS, CameraModel, focal_length
from blinkgl.camera.drawing import seen_through
from blinkgl.config.base import Config, Refused, placed, rule
from blinkgl.config.draw import is_distribution
from blinkgl.errors import ConfigError
from blinkgl.types.trees import Tree

_KEYS = ("width", "height", "lens", "distortion", "fov", "focal", "fx", "fy", "cx", "cy", "near")
_OF_A_CALIBRATION = ("lens", "distortion", "fov", "focal", "fx", "fy", "cx", "cy")
COUNTS = {"pinhole": (0,), "radtan": (4, 5), "equidistant": (4,)}
"""Numbers of coefficients that a lens model may have."""


class CameraConfig(Config):
    """One camera and its lens. Give the field of view, the focal length, or one focal length per axis."""

    width: int = Field(346, ge=1, le=16384, description="columns, px")
    height: int = Field(260, ge=1, le=16384, description="rows, px")
    fov: float | None = Field(
        None,
        gt=0.01,
        lt=179.9,
        description="horizontal field of view, degrees, without `distortion`; default 60",
    )
    focal: float | None = Field(None, ge=1e-3, le=1e9, description="focal length, px (fx = fy)")
    fx: float | None = Field(None, ge=1e-3, le=1e9, description="focal length along x, px; with fy")
    fy: float | None = Field(None, ge=1e-3, le=1e9, description="focal length along y, px; with fx")
    cx: float | None = Field(
        None, ge=-1e6, le=1e6, description="principal point x, px; default the image centre, (width - 1) / 2"
    )
    cy: float | None = Field(None, ge=-1e6, le=1e6, description="principal point y, px; default (height - 1) / 2")
    near: float = Field(0.05, ge=1e-9, le=1e9, description="near plane, world units: nothing nearer is drawn")
    lens: Literal["pinhole", "radtan", "equidistant"] = Field(
        "pinhole",
        description="radtan: plumb bob model of OpenCV and Kalibr; equidistant: their fisheye model (docs/cameras.md)",
    )
    distortion: tuple[Annotated[float, Field(ge=-1e6, le=1e6)], ...] = Field(
        (), max_length=8, description="radtan: k1, k2, p1, p2 and optionally k3; equidistant: k1 to k4"
    )
    calibration: str | None = Field(
        None,
        description="file of Kalibr, DSEC, EuRoC, OpenCV, ROS, COLMAP or Metavision, with size, lens, distortion, fx, "
        "fy, cx and cy",
    )
    calibration_name: str | None = Field(
        None, description="which camera of the calibration; default: its only one, or cam0"
    )

    @rule("fov", "focal", "fx", "fy")
    def _one_of(fov: float | None, focal: float | None, fx: float | None, fy: float | None):
        if (fx is None) != (fy is None):
            raise Refused("fx and fy come together; focal is both", where="fx" if fx is None else "fy", accepted="px")
        if sum(value is not None for value in (fov, focal, fx)) > 1:
            raise Refused("give fov or focal, not both" if fx is None else "give fov, focal, or fx and fy")

    @rule("calibration", "calibration_name")
    def _was_read(calibration: str | None, name: str | None):
        if calibration is not None:
            raise Refused(
                "a calibration is read with the run's file", where="calibration", value=calibration, accepted="load()"
            )
        if name is not None:
            raise Refused(
                "the name of a camera of a file", where="calibration_name", value=name, accepted="calibration"
            )

    @rule("lens", "distortion")
    def _coefficients(lens: str, distortion: tuple[float, ...]):
        if len(distortion) not in COUNTS[lens]:
            raise Refused(
                f"{lens} has other coefficients" if COUNTS[lens] != (0,) else "a pin-hole camera does not distort",
                where="distortion",
                value=list(distortion),
                accepted={
                    "radtan": "4 or 5 of them, k1 k2 p1 p2 [k3]",
                    "equidistant": "4 of them, k1 k2 k3 k4",
                    "pinhole": "none, or lens: radtan or equidistant",
                }[lens],
            )

    @rule(*_KEYS)
    def _can_be_drawn(width: int, height: int, lens: str, distortion: tuple[float, ...], *rest: object):
        if lens == "pinhole" or len(distortion) not in COUNTS[lens]:  # the rule of distortion reports this
            return
        with placed("distortion", Refused):
            seen_through(_model(width, height, lens, distortion, *rest))

    @property
    def model(self) -> CameraModel:
        """Return the camera that the keys describe."""
        return _model(*(getattr(self, key) for key in _KEYS))

    def scaled(self, factor: float) -> Tree:
        """Return the keys of a camera with the same view and ``factor`` times the pixels in x and y, rounded to whole
        pixels."""
        # Pixel centres are at whole numbers, so the picture begins at -0.5.
        keys = {key: (value + 0.5) * factor - 0.5 for key in ("cx", "cy") if (value := getattr(self, key)) is not None}
        keys |= {key: value * factor for key in ("focal", "fx", "fy") if (value := getattr(self, key)) is not None}
        keys |= {"fov": self.fov} if self.fov is not None else {}
        keys |= {"lens": self.lens, "distortion": list(self.distortion)} if self.lens != "pinhole" else {}
        return {
            "width": max(1, round(self.width * factor)),
            "height": max(1, round(self.height * factor)),
            "near": self.near,
            **keys,
        }


def _model(width, height, lens, distortion, fov, focal, fx, fy, cx, cy, near) -> CameraModel:
    kind = CAMERA_MODELS[lens]
    if fx is None:
        if focal is None:
            angle = math.radians(60.0 if fov is None else fov)
            # An equidistant lens has r = f * angle, a pinhole r = f tan(angle).
            focal = width / angle if lens == "equidistant" else focal_length(width, angle)
        fx = fy = focal
    cx, cy = (width - 1) / 2 if cx is None else cx, (height - 1) / 2 if cy is None else cy
    return kind(width, height, fx, fy, cx, cy, near, **dict(zip(kind.coefficients, distortion)))


def camera_radius(camera: CameraModel, clearance: float) -> float:
    """Return the distance that a random world's camera keeps from everything: its clearance, or a little more than the
    distance of the near plane's corners."""
    return max(clearance, 1.01 * camera.near_corner)


def room_for(camera: CameraModel, clearance: float, height: float) -> float:
    """Return :func:`camera_radius` in a random world's region of this height, m. Raises Refused for a lower one."""
    least = camera_radius(camera, clearance)
    if least > height:
        raise Refused(
            "the region is too low for the camera's clearance",
            where="scene.region.height",
            value=height,
            accepted=f"at least {least:.4g} m (scene.camera_clearance, or the distance of the near plane's corners: "
            "camera.near and camera.fov)",
        )
    return least


def calibrated(camera: object, base: Path) -> Any:
    """Return a ``camera:`` table with its calibration, read from ``base``, replaced by the calibration's keys. A table
    without a calibration is returned unchanged. Raises ConfigError."""
    if not isinstance(camera, dict) or camera.get("calibration") is None:
        return camera
    from blinkgl.config.camchain import read_camchain

    own = {key: value for key, value in camera.items() if key not in ("calibration", "calibration_name")}
    file, name = camera["calibration"], camera.get("calibration_name")
    for key, value in (("calibration", file), ("calibration_name", name)):
        if is_distribution(value) or not isinstance(value, (str, type(None))):
            raise ConfigError(
                "not text", where=f"camera.{key}", value=value, accepted="text, the same for the whole run"
            )
    if twice := [key for key in _OF_A_CALIBRATION if own.get(key) is not None]:
        raise ConfigError(
            "the calibration sets this key",
            where=f"camera.{twice[0]}",
            value=own[twice[0]],
            accepted="either camera.calibration or the key",
        )
    chain = read_camchain(base / file)
    if name is None:
        name = next(iter(chain)) if len(chain) == 1 else "cam0"
    if name not in chain:
        raise ConfigError(
            "no such camera in the calibration",
            where="camera.calibration_name",
            value=name,
            accepted=f"one of {', '.join(chain)}",
        )
    seen = chain[name].camera
    for key in ("width", "height"):
        if own.get(key) is not None and own[key] != getattr(seen, key):
            raise ConfigError(
                f"the calibration has another resolution, {seen.width}x{seen.height} px",
                where=f"camera.{key}",
                value=own[key],
                accepted=f"{getattr(seen, key)}, or nothing",
            )
    # Whole, so that nothing of a lens that it is laid over remains.
    return {**own, "lens": "pinhole", "distortion": [], **camera_keys(seen)}


def placed_by_calibration(table: Mapping[str, object], base: Path) -> dict[str, object]:
    """Return what the calibration of a sensor's ``camera:`` says of places and the table does not: ``place`` on the
    rig, whose origin is the file's first camera, or EuRoC's body, and ``imu`` with its position and rotation. Raises
    ConfigError."""
    from scipy.spatial.transform import Rotation

    from blinkgl.config.camchain import read_camchain

    camera, keys = table.get("camera"), {}
    if not isinstance(camera, dict) or not isinstance(camera.get("calibration"), str):
        return keys
    chain = list(read_camchain(base / camera["calibration"]).items())
    number = next((k for k, (name, _) in enumerate(chain) if name == camera.get("calibration_name")), 0)
    links = [one.T_cam_before for _, one in chain[1 : number + 1]]
    if "place" not in table and links and all(link is not None for link in links):
        T = np.eye(4)
        for link in links:  # from the axes of the camera before to its own
            T = np.asarray(link) @ T
        # T leads from the first camera to this one; the place on the rig is the way back.
        keys["place"] = {"matrix": np.linalg.inv(T).tolist()}
    elif "place" not in table and (T := chain[number][1].T_body_cam) is not None:
        keys["place"] = {"matrix": T.tolist()}
    imu, place = table.get("imu"), chain[number][1].T_cam_imu if chain else None
    if isinstance(imu, dict) and place is not None and not {"position", "rotation"} & set(imu):
        turned = Rotation.from_matrix(place[:3, :3]).as_euler("xyz", degrees=True)
        keys["imu"] = {**imu, "position": place[:3, 3].tolist(), "rotation": turned.tolist()}
    return keys


def camera_keys(camera: CameraModel) -> dict[str, object]:
    """Return the keys of ``camera:`` that describe a camera model, without ``near``."""
    keys: dict[str, object] = {"width": camera.width, "height": camera.height}
    keys |= zip(("fx", "fy", "cx", "cy"), camera.intrinsics)
    return keys | ({"lens": camera.kind, "distortion": list(camera.distortion)} if camera.coefficients else {})
