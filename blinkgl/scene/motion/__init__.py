"""What moves where.

In:    way-points, key frames, bounds of free space.
Out:   :class:`~blinkgl.scene.types.PosePath` objects that do not run into each other.
Start: paths.py; trajectories.py draws random ones, collision.py keeps them apart.
"""
