"""Recordings of cameras, without a renderer.

In:    any video, or event files.
Out:   its events (``simulate``), or how two recordings differ (``compare``).
Start: simulation.py; comparison.py.
"""
