"""The frame camera: images with exposure, shutter, lens, noise and a response, at their own times.

In:    a renderer, ``images:`` and the span of a sequence.
Out:   :class:`CameraImage`, in order, each when its last row has been exposed.
Start: frame_camera.py; it uses exposure.py (duration), lens.py and sensor.py (codes).
"""

from blinkgl.imaging.frame_camera import CameraImage, FrameCamera

__all__ = ["CameraImage", "FrameCamera"]
