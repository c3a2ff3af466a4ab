"""Deforming shapes: geometry as a function of time.

In:    parameters, skeletons and clips, morph targets; a mesh at rest and a time.
Out:   positions, velocities and normals in float64, and the numbers for the vertex stage.
Start: table.py lists all deformers (:class:`~blinkgl.scene.types.Deformer`); closed_forms.py has the simple ones.
"""
