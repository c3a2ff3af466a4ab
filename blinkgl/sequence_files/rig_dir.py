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
from typing import Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, FiniteFloat, TypeAdapter, ValidationError, model_validator

from blinkgl.camera import CameraModel
from blinkgl.camera.pinhole import rectify_map
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml, camchain_yaml
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.config.rig import RigSensorConfig, baseline_of
from blinkgl.errors import AssetError
from blinkgl.io.atomic import output_errors
from blinkgl.io.dsec import write_rectify_map
from blinkgl.io.records import PlainName, first_problem
from blinkgl.sequence_files.sequence_dir import MANIFEST, RIG, SequenceWriter, digest_of, read_manifest


class RigWriter(SequenceWriter):
    """Context manager around the folder of a rig's sequence, which appears completely or not at all, as a sequence's
    does.

    sensors : as configured.   The other parameters are those of :class:`SequenceWriter`.

        with RigWriter(final, sensors, config_yaml=…) as rig:
            with SequenceWriter(rig.folder("left"), …) as left: …
            rig.adopt("left")
    """

    kind = "blinkgl-rig"

    def __init__(
        self, final: str | os.PathLike, sensors: Sequence[RigSensorConfig], *, config_yaml: str, t_offset_us: int = 0
    ):
        super().__init__(final, 1, 1, config_yaml=config_yaml, t_offset_us=t_offset_us, events=False)
        self.sensors = tuple(sensors)
        self.count = 0
        """Events of all sensors."""

    def folder(self, name: str) -> Path:
        """Return the folder for the sequence of a sensor."""
        return self.path(name)

    def adopt(self, name: str) -> None:
        """List the files, with their checksums, of the complete sequence at :meth:`folder`."""
        folder = self.folder(name)
        manifest = read_manifest(folder)
        with output_errors(folder):
            self._files |= {f"{name}/{file}": known for file, known in manifest["files"].items()}
            self._files[f"{name}/{MANIFEST}"] = digest_of(folder / MANIFEST)
        self.count += manifest["events"]

    def _finish(self) -> None:
        self.text(RIG, rig_yaml(self.sensors))
        super()._finish()

    def _about(self) -> dict[str, Any]:
        return {
            "t_offset_us": self.t_offset_us,
            "events": self.count,
            "sensors": [one.name for one in self.sensors],
            "cameras": [one.name for one in self.sensors if one.sees],
        }


def rig_yaml(sensors: Sequence[RigSensorConfig]) -> str:
    """Return ``rig.yaml``: the rig's sensors, by name, unrounded."""
    tables: dict[str, Any] = {}
    for one in sensors:
        records = [key for key in ("events", "images", "imu") if getattr(one, key) is not None]
        about: dict[str, Any] = {"records": records, "T_rig_sensor": one.place.T.tolist()}
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


class _Rig(BaseModel):
    """``rig.yaml``."""

    sensors: dict[PlainName, _Sensor] = Field(min_length=1)

    @model_validator(mode="after")
    def _pairs(self) -> _Rig:
        for name, one in self.sensors.items():
            if one.pair is not None and (one.pair not in self.sensors or one.baseline is None):
                raise ValueError(f"'{name}' is paired with no sensor of the rig, or has no baseline")
        return self


_MODEL = TypeAdapter(_Rig)


def read_rig(folder: str | os.PathLike) -> dict[str, dict[str, Any]]:
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
    one = Calibrated(camera)
    writer.external(RECTIFY_MAP, partial(write_rectify_map, rectify_map=rectify_map(camera), codec=writer.codec))
    writer.text(CAM_TO_CAM, cam_to_cam_yaml([one]))
    writer.text(CAMCHAIN, camchain_yaml({"cam0": one}))
