"""What a sequence says of a lens that distorts: ``rectify_map.h5`` and ``cam_to_cam.yaml`` as DSEC has them, and
``camchain.yaml`` as Kalibr has it."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING

from blinkgl.camera import CameraModel
from blinkgl.camera.rectified import rectify_map
from blinkgl.config.camchain import Calibrated, cam_to_cam_yaml, camchain_yaml
from blinkgl.io.dsec import write_rectify_map

if TYPE_CHECKING:
    from blinkgl.sequence_files.sequence_dir import SequenceWriter

RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN = "rectify_map.h5", "cam_to_cam.yaml", "camchain.yaml"
FILES = RECTIFY_MAP, CAM_TO_CAM, CAMCHAIN
_TOLERANCE = 1e-3


def write_lens(writer: SequenceWriter, camera: CameraModel) -> None:
    """All of them, into a sequence that is being written."""
    one = Calibrated(camera)
    writer.external(RECTIFY_MAP, partial(write_rectify_map, rectify_map=rectify_map(camera), codec=writer.codec))
    writer.text(CAM_TO_CAM, cam_to_cam_yaml([one]))
    writer.text(CAMCHAIN, camchain_yaml({"cam0": one}))
