"""A sequence of several sensors on disk: a folder like any sequence's, with one sub-folder per sensor.

    <sequence>/
      rig.yaml                       sensors, what they record, their poses (T_rig_sensor), pairs
      left/  right/                  their own sequences, each with its manifest (sequence_dir.py)
      imu0/imu/                      a sensor that is only an inertial unit (blinkgl.io.imu)
      config.yaml  manifest.json  preview.mp4

The manifest has the format "blinkgl-rig" and lists every file below the folder.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError, model_validator

from blinkgl.camera import CameraModel
from blinkgl.camera.pinhole import rectify_map
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml, camchain_yaml
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.config.rig import RigSensorConfig, baseline_of
from blinkgl.errors import AssetError
from blinkgl.io.dsec import write_rectify_map
from blinkgl.io.records import first_problem
from blinkgl.sequence_files.manifest import PlainName
from blinkgl.sequence_files.sequence_dir import RIG, SequenceWriter
from blinkgl.types.trees import Tree


def sensors_yaml(sensors: Sequence[RigSensorConfig]) -> str:
    """Return ``rig.yaml``: the rig's sensors, by name, unrounded."""
    tables: dict[str, object] = {}
    for one in sensors:
        records = [key for key in ("events", "images", "imu") if getattr(one, key) is not None]
        about: dict[str, object] = {"records": records, "T_rig_sensor": one.place.T.tolist()}
        if one.sees:
            camera = one.camera.model
            about |= {
                "resolution": [camera.width, camera.height],
                "camera_model": camera.kind,
                "intrinsics": [float(v) for v in camera.intrinsics],
                "distortion": [float(v) for v in camera.distortion],
            }
        if one.pair is not None:
            other = next(other for other in sensors if other.name == one.pair)
            about |= {"pair": one.pair, "baseline": baseline_of(one, other)}
        tables[one.name] = about
    return (
        "# T_rig_sensor: from the sensor's axes to the rig's, both x right, y down, z forward; in world units.\n"
        "# intrinsics: fx, fy, cx, cy, px; distortion: coefficients of the model. baseline: along the camera's x axis\n"
        "# to the other eye.\n" + to_yaml({"sensors": tables})
    )


_Row = tuple[FiniteFloat, FiniteFloat, FiniteFloat, FiniteFloat]


class _Sensor(BaseModel):
    """What ``rig.yaml`` says of a sensor."""

    model_config = ConfigDict(extra="allow")
    records: list[Literal["events", "images", "imu"]]
    T_rig_sensor: tuple[_Row, _Row, _Row, _Row]
    pair: PlainName | None = None
    baseline: FiniteFloat | None = None


class _Sensors(BaseModel):
    """``rig.yaml``."""

    sensors: dict[PlainName, _Sensor] = Field(min_length=1)

    @model_validator(mode="after")
    def _pairs(self) -> _Sensors:
        for name, one in self.sensors.items():
            if one.pair is not None and (one.pair not in self.sensors or one.baseline is None):
                raise ValueError(f"'{name}' is paired with no sensor of the rig, or has no baseline")
        return self


_MODEL = TypeAdapter(_Sensors)


def read_sensors(folder: str | os.PathLike) -> dict[str, Tree]:
    """Return the sensors of a rig's folder, by name, as in ``rig.yaml``, with ``T_rig_sensor`` as (4, 4) float64.

    Raises AssetError, ConfigError: no such file, or damaged."""
    path = Path(folder) / RIG
    try:
        sensors = _MODEL.validate_python(read_table(path)).sensors
    except ValidationError as error:
        raise AssetError(f"damaged: {first_problem(error)}", where=str(path)) from None
    return {
        name: {**one.model_dump(), "T_rig_sensor": np.array(one.T_rig_sensor, np.float64)}
        for name, one in sensors.items()
    }


# ---------------------------------------------------------------------------------------------------------------------
# Files about a lens with distortion: ``rectify_map.h5`` and ``cam_to_cam.yaml`` in DSEC's form, ``camchain.yaml`` in
# Kalibr's.

RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN = "rectify_map.h5", "cam_to_cam.yaml", "camchain.yaml"
FILES = RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN
_TOLERANCE = 1e-3


def write_lens(writer: SequenceWriter, camera: CameraModel) -> None:
    """Write all of them into a sequence in progress."""
    # The same numbers in three forms: DSEC's map and YAML, and Kalibr's chain.
    one = Calibrated(camera)
    writer.external(RECTIFY_MAP, partial(write_rectify_map, rectify_map=rectify_map(camera), codec=writer.codec))
    writer.text(CAM_TO_CAM, cam_to_cam_yaml([one]))
    writer.text(CAMCHAIN, camchain_yaml({"cam0": one}))
