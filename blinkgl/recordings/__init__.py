"""Recordings of cameras, without a renderer.

In:    any video, or event files.
Out:   its events (``simulate``), the differences of two recordings (``compare``), or the emulator that resembles a
       camera (``calibrate``).
Start: simulation.py; comparison.py; calibration.py, with the clips of clip.py and the numbers of statistics.py.
"""
