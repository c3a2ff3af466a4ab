"""Motion of bodies and cameras.

In:    waypoints, key frames, bounds of free space.
Out:   :class:`~blinkgl.scene.motion.pose_path.PosePath` objects without collisions.
Start: paths.py; trajectories.py draws random ones, collision.py prevents collisions.
"""
