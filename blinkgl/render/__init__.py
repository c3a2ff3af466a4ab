"""Rendering of a scene at one time; and a float64 reference without OpenGL.

In:    a :class:`~blinkgl.scene.types.Scene`, a context, a time.
Out:   luminance, colour and labels of that moment.
Start: renderer.py (``Renderer``); reference.py is its slow, simple reference (rays: casting.py; light:
appearance.py).
"""
