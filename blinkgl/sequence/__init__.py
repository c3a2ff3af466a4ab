"""Simulation of one sequence, independent of how its items are written, stored, graded or counted.

In: the configuration of one sequence, and OpenGL where a scene is drawn.
Out: its events, ground truth, the frame camera's images and pictures, in the order of time.
Start: simulate.py, which merges the cameras of a rig, or has a single one; sensor.py is a camera, of a scene
(rendered.py) or of recorded frames (recorded.py).
"""

from blinkgl.sequence.request import CameraImage, EventChunk, GroundTruth, Item, Picture, SequenceRequest
from blinkgl.sequence.sensor import SensorSimulation
from blinkgl.sequence.simulate import Simulation, simulate_sequence

__all__ = [
    "CameraImage",
    "EventChunk",
    "GroundTruth",
    "Item",
    "Picture",
    "SensorSimulation",
    "SequenceRequest",
    "Simulation",
    "simulate_sequence",
]
