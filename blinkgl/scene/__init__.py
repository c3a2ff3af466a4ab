"""Scenes as plain float64 data: shapes, surfaces, light, a camera, paths in time. No OpenGL here.

In:    a validated scene configuration, a seed, files from untrusted users.
Out:   :class:`~blinkgl.scene.types.Scene`.
Start: types.py defines a scene, build.py makes one; rooms inside: geometry, surfaces, motion, importing, worlds.
"""
