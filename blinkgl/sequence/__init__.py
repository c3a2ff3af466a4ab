"""Simulation of one sequence, independent of how its items are written, stored, graded or counted.

In: the configuration of one sequence, and OpenGL where a scene is drawn.
Out: its events, ground truth, the frame camera's images and pictures, in the order of time.
Start: simulate.py; rendered.py and recorded.py are its two sources, rig.py merges several.
"""

from blinkgl.sequence.factory import simulate_sequence
from blinkgl.sequence.request import CameraImage, EventChunk, GroundTruth, Item, Picture, SequenceRequest
from blinkgl.sequence.simulate import Simulation

__all__ = [
    "CameraImage",
    "EventChunk",
    "GroundTruth",
    "Item",
    "Picture",
    "SequenceRequest",
    "Simulation",
    "simulate_sequence",
]
