"""Appearance of surfaces.

In:    image files, names of procedural patterns.
Out:   :class:`~blinkgl.scene.types.Texture` images, and hashes of their sources.
Start: images.py (``load_image``); textures.py draws patterns.
"""
