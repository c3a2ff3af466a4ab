"""The frame camera: images with exposure, shutter, lens, noise and a response, at times of its own.

In:    a renderer, ``images:`` and the span of a sequence.
Out:   :class:`CameraImage`, one after the other, each when its last row has been exposed.
Start: frame_camera.py; exposure.py (how long), lens.py and sensor.py (codes) are what it is made of.
"""

from blinkgl.imaging.frame_camera import CameraImage, FrameCamera

__all__ = ["CameraImage", "FrameCamera"]
