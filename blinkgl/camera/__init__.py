"""Camera models: where a point is seen, along which ray a pixel looks, and what of the world can be in the picture.

In: points in camera axes (OpenCV: x right, y down, z forward), pixels. Out: pixels, rays, Jacobians, planes, matrices; float64, no OpenGL,
no poses, no YAML. Read :class:`CameraModel` first, then :class:`PinHole`. Nothing else in BlinkGL knows a camera's mathematics.
"""

from blinkgl.camera.model import CameraModel
from blinkgl.camera.pinhole import PinHole, focal_length

__all__ = ["CameraModel", "PinHole", "focal_length"]
