"""Whole scenes, one module per ``scene: {kind: ...}``.

In: a validated scene configuration, a seed. Out: :class:`~blinkgl.scene.types.Scene`.
Start in random_world.py (``random_world``), explicit.py or from_file.py; pool.py finds the meshes and images to draw from.
"""
