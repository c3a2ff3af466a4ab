"""Whole scenes, one module per ``scene: {kind: …}``.

In:    a validated scene configuration, a seed.
Out:   :class:`~blinkgl.scene.types.Scene`.
Start: random_world.py, explicit.py or from_file.py; pool.py finds the meshes and images to draw from.
"""
