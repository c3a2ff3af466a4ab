"""Triangles.

In:    arrays, parameters, triangles of files.
Out:   :class:`~blinkgl.scene.types.Mesh`, checked, at the level of detail that is asked for.
Start: meshes.py (``make_mesh``); primitives.py builds.
"""
