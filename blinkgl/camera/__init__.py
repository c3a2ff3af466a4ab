"""Camera models: the pixel of a point, the ray of a pixel, and bounds on what the picture can show.

Float64, without OpenGL, poses and YAML; all of BlinkGL's camera mathematics is here.

In:    points in camera axes (OpenCV: x right, y down, z forward), pixels
Out:   pixels, rays, Jacobians, planes, matrices
Start: model.py, then pinhole.py
"""

from blinkgl.camera.equidistant import Equidistant
from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole, focal_length
from blinkgl.camera.radtan import Radtan
from blinkgl.camera.table import CAMERA_MODELS, register

for _model in (PinHole, Radtan, Equidistant):
    register(_model)

__all__ = ["CAMERA_MODELS", "CameraModel", "Equidistant", "PinHole", "Radtan", "focal_length", "register"]
