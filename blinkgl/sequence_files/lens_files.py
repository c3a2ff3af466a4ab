"""What a sequence says of a lens that distorts: ``rectify_map.h5`` and ``cam_to_cam.yaml`` as DSEC has them, and
``camchain.yaml`` as Kalibr has it."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from blinkgl.camera import CameraModel
from blinkgl.camera.rectified import rectify_map
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml, camchain_yaml, read_camchain
from blinkgl.io.dsec import read_rectify_map, write_rectify_map

if TYPE_CHECKING:
    from blinkgl.sequence_files.sequence_dir import SequenceWriter

RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN = "rectify_map.h5", "cam_to_cam.yaml", "camchain.yaml"
FILES = RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN
_TOLERANCE = 1e-3


def write_lens(writer: SequenceWriter, camera: CameraModel) -> None:
    """All of them, into a sequence that is being written."""
    one = Calibrated(camera)
    writer.external(RECTIFY_MAP, partial(write_rectify_map, rectify_map=rectify_map(camera)))
    writer.text(CAM_TO_CAM, cam_to_cam_yaml([one]))
    writer.text(CAMCHAIN, camchain_yaml({"cam0": one}))


def problems_of_lens(folder: Path, camera: CameraModel) -> list[str]:
    """In what the files are not those of this camera. Raises BlinkGLError for files that cannot be read."""
    problems = [
        f"{name}: not the camera of config.yaml"
        for name in (CAM_TO_CAM, CAMCHAIN)
        if camera not in [_near(one.camera, camera) for one in read_camchain(folder / name).values()]
    ]
    given, wanted = read_rectify_map(folder / RECTIFY_MAP), rectify_map(camera)
    if given.shape != wanted.shape or not np.abs(given - wanted).max() <= _TOLERANCE:
        problems.append(f"{RECTIFY_MAP}: not the map of config.yaml's camera")
    return problems


def _near(one: CameraModel, like: CameraModel) -> CameraModel:
    """``one`` with the near plane that no calibration knows."""
    return type(one)(one.width, one.height, *one.intrinsics, like.near, *one.distortion)
