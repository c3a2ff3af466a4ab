"""Scenes as pure data in float64: shapes, surfaces, light, a camera, paths in time. No OpenGL here.

In:    a validated scene configuration, a seed, files of strangers.
Out:   :class:`~blinkgl.scene.types.Scene`.
Start: types.py says what a scene is, build.py makes one; rooms inside: geometry, surfaces, motion, importing, worlds.
"""
