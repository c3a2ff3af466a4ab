"""Rendering of a scene at one time.

In:    a :class:`~blinkgl.scene.types.Scene`, a context, a time.
Out:   luminance, colour and labels of that moment.
Start: renderer.py (``Renderer``), painter.py, then passes/.

:mod:`blinkgl.tools.shader_debugger.reference` computes the same buffers in float64 without OpenGL, from the rays of
casting.py.
"""
