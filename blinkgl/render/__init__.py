"""A scene at a moment becomes pixels; and, in float64 without OpenGL, what they should be.

In:    a :class:`~blinkgl.scene.types.Scene`, a context, a time.
Out:   luminance, colour and labels of that moment.
Start: renderer.py (``Renderer``); reference.py is its slow, obvious twin (rays: casting.py; light: appearance.py).
"""
