"""GLSL: one file per program, what they share in include/.

In:    vertex streams and uniforms of ``blinkgl.render``.
Out:   pixels of one pass.
Start: luminance.glsl; include/guard.glsl is what every fragment program ends with.
"""
