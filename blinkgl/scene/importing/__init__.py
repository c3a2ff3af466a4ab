"""Mesh files of strangers.

In: glTF, OBJ, PLY, STL, ... of unknown goodness. Out: :class:`~blinkgl.scene.importing.mesh_files.Asset` objects, or one line that names the file.
Start in mesh_files.py (``load_asset``); gltf.py reads what gltf_schema.py has checked.
"""
