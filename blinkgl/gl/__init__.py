"""OpenGL without a window: context, programs, render targets. The only package that talks to drivers."""

from blinkgl.gl.context import GLContext, create_context, egl_devices
from blinkgl.gl.framebuffer import FORMATS, Target
from blinkgl.gl.shader import ShaderError, ShaderLoader, ShaderSource, expand

__all__ = ["FORMATS", "GLContext", "ShaderError", "ShaderLoader", "ShaderSource", "Target", "create_context", "egl_devices", "expand"]
