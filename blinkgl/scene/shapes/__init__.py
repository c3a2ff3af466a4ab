"""What changes the shape of a body: geometry at a time.

In:    parameters, skeletons and clips, morph targets; a mesh at rest and a time.
Out:   positions, velocities and normals in float64, and the numbers of which the vertex stage makes the same.
Start: deformer.py says what a :class:`~blinkgl.scene.shapes.deformer.Deformer` is; table.py lists them;
closed_forms.py has the simple ones.
"""
