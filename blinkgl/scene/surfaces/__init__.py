"""What surfaces look like.

In:    image files, names of procedural patterns.
Out:   :class:`~blinkgl.scene.types.Texture` images, and hashes of what they are made of.
Start: images.py (``load_image``); textures.py draws patterns.
"""
