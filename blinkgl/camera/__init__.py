"""Camera models: where a point is seen, along which ray a pixel looks, and what of the world can be in the picture. Float64, no OpenGL, no
poses, no YAML; nothing else in BlinkGL knows a camera's mathematics.

In:    points in camera axes (OpenCV: x right, y down, z forward), pixels
Out:   pixels, rays, Jacobians, planes, matrices
Start: model.py, then pinhole.py
"""

from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole, focal_length

__all__ = ["CameraModel", "PinHole", "focal_length"]
