"""One sequence as it happens: a configuration comes in, events, ground truth and pictures go out in the order of time.

``simulate.py`` is the door (:func:`~blinkgl.sequence.simulate.simulate_sequence`) and what both sources share; ``rendered.py`` draws a
scene, ``recorded.py`` reads folders of frames. Files, arrays, measurements and training are consumers of it and live in other rooms.
"""

from blinkgl.sequence.items import EventChunk, GroundTruth, Item, Picture
from blinkgl.sequence.simulate import Simulation, simulate_sequence

__all__ = ["EventChunk", "GroundTruth", "Item", "Picture", "Simulation", "simulate_sequence"]
