"""Camera models: where a point is seen, along which ray a pixel looks, and what of the world can be in the picture.
Float64, no OpenGL, no poses, no YAML; nothing else in BlinkGL knows a camera's mathematics.

In:    points in camera axes (OpenCV: x right, y down, z forward), pixels
Out:   pixels, rays, Jacobians, planes, matrices
Start: model.py, then pinhole.py
"""

from blinkgl.camera.equidistant import Equidistant
from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole, focal_length
from blinkgl.camera.radtan import Radtan
from blinkgl.camera.table import CAMERA_MODELS, register, unregister

for _model in (PinHole, Radtan, Equidistant):
    register(_model)

__all__ = ["CAMERA_MODELS", "CameraModel", "Equidistant", "PinHole", "Radtan", "focal_length", "register", "unregister"]
