"""Import of mesh files from untrusted users.

In:    glTF, OBJ, PLY and STL, not validated.
Out:   :class:`~blinkgl.scene.importing.mesh_files.Asset`, or a one-line error that names the file.
Start: mesh_files.py (``load_asset``); trimesh_files.py reads obj, ply and stl, gltf.py glTF checked by gltf_schema.py.
       Both return triangles, which parts.py converts to meshes.
"""
