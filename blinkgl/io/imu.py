"""Files of an inertial unit, in a folder of its own below the sequence:

imu/
  imu.csv     EuRoC's columns: time (ns), rates (rad/s), accelerations (m/s²), with noise and biases
  ideal.csv   the same without
  imu.h5      all of both, and the biases: t_ns, rate, acceleration, ideal_rate, ideal_acceleration, rate_bias,
              acceleration_bias, T_cam_imu
  imu.yaml    Kalibr's: noise densities, rate; and T_cam_imu as its camchain has it
"""

from __future__ import annotations

import io
import math
import os
from collections.abc import Mapping
from pathlib import Path

import h5py
import numpy as np

from blinkgl.config.over_time import ImuConfig
from blinkgl.config.reader import read_table, to_yaml
from blinkgl.errors import AssetError
from blinkgl.io.hdf5 import dataset, open_hdf5

FOLDER = "imu"
CSV, IDEAL, H5, KALIBR = (f"{FOLDER}/{name}" for name in ("imu.csv", "ideal.csv", "imu.h5", "imu.yaml"))
FILES = (CSV, IDEAL, H5, KALIBR)
HEADING = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
_NOISE = (
    "accelerometer_noise_density",
    "accelerometer_random_walk",
    "gyroscope_noise_density",
    "gyroscope_random_walk",
)
ROWS = ("rate", "acceleration", "ideal_rate", "ideal_acceleration", "rate_bias", "acceleration_bias")


def imu_csv(t_ns: np.ndarray, rate: np.ndarray, acceleration: np.ndarray) -> str:
    """Return EuRoC's text of N measurements: (N,) int64 ns, (N, 3) rad/s, (N, 3) m/s²; exact to 16 digits."""
    lines = [HEADING]
    for t, w, a in zip(t_ns.tolist(), rate.tolist(), acceleration.tolist()):
        lines.append(f"{t}," + ",".join(repr(v) for v in (*w, *a)))
    return "\n".join(lines) + "\n"


def imu_h5(arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the bytes of ``imu.h5``."""
    buffer = io.BytesIO()
    with h5py.File(buffer, "w") as file:
        for name in ("t_ns", *ROWS, "T_cam_imu"):
            file.create_dataset(name, data=arrays[name], track_times=False)
    return buffer.getvalue()


def kalibr_yaml(config: ImuConfig, T_cam_imu: np.ndarray) -> str:
    """Return the text of ``imu.yaml``."""
    table = {**{key: getattr(config, key) for key in _NOISE}, "update_rate": config.rate}
    return to_yaml({**table, "T_cam_imu": T_cam_imu.tolist()})


def made_again(sequence: str | os.PathLike) -> dict[str, bytes]:
    """Return the content of a sequence's :data:`FILES`, made of the numbers in ``imu.h5`` and ``imu.yaml``, and nothing
    else that these hold. Raises AssetError: missing, damaged."""
    arrays, path = read_imu(sequence), Path(sequence) / KALIBR
    table, pose = read_table(path), {"T_cam_imu": arrays["T_cam_imu"].tolist()}
    numbers = {key: value for key, value in table.items() if type(value) in (int, float) and 0 <= value < math.inf}
    if table != numbers | pose or set(numbers) != {*_NOISE, "update_rate"}:
        raise AssetError("not the inertial unit of imu.h5: densities of noise, update_rate, T_cam_imu", where=str(path))
    return {
        H5: imu_h5(arrays),
        CSV: imu_csv(arrays["t_ns"], arrays["rate"], arrays["acceleration"]).encode(),
        IDEAL: imu_csv(arrays["t_ns"], arrays["ideal_rate"], arrays["ideal_acceleration"]).encode(),
        KALIBR: to_yaml(numbers | pose).encode(),
    }


def read_imu(sequence: str | os.PathLike) -> dict[str, np.ndarray]:
    """Return the arrays in ``imu.h5`` of a sequence, by name. Raises AssetError: there is none, or it is damaged."""
    path = Path(sequence) / H5
    with open_hdf5(path) as file:
        arrays = {"t_ns": dataset(file, "t_ns", path, shape=(None,))[()]}
        for name in ROWS:
            arrays[name] = dataset(file, name, path, shape=(len(arrays["t_ns"]), 3), kinds="f")[()]
        arrays["T_cam_imu"] = dataset(file, "T_cam_imu", path, shape=(4, 4), kinds="f")[()]
        return arrays
