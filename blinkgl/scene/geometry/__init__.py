"""Triangle meshes.

In:    arrays, parameters, triangles of files.
Out:   :class:`~blinkgl.scene.types.Mesh`, checked.
Start: meshes.py (``make_mesh``); primitives.py and living.py build, random_primitives.py draws proportions.
"""

from blinkgl.scene.geometry import living  # noqa: F401 - whose builders are registered
from blinkgl.scene.geometry.primitives import BUILDERS

__all__ = ["BUILDERS"]
