"""Recordings of cameras, without a renderer.

In:    any video, or event files.
Out:   its events (``simulate``), how two recordings differ (``compare``), or the emulator that is like a camera
       (``calibrate``).
Start: simulation.py; comparison.py; calibration.py, of the clips of clip.py and the numbers of statistics.py.
"""
