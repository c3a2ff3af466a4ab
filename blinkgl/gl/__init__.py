"""OpenGL without a window. The only package that calls drivers.

In:    a backend and a device, GLSL text, names of formats.
Out:   a context, compiled programs, render targets.
Start: context.py (``create_context``); shader.py, framebuffer.py.
"""

from blinkgl.gl.context import GLContext, create_context, egl_devices
from blinkgl.gl.framebuffer import FORMATS, Target
from blinkgl.gl.shader import ShaderError, ShaderLoader, ShaderSource, expand

__all__ = [
    "FORMATS",
    "GLContext",
    "ShaderError",
    "ShaderLoader",
    "ShaderSource",
    "Target",
    "create_context",
    "egl_devices",
    "expand",
]
