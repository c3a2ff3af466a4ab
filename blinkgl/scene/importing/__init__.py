"""Import of mesh files from untrusted users.

In:    glTF, OBJ, PLY, STL, OFF and 3MF, not validated.
Out:   :class:`~blinkgl.scene.importing.mesh_files.Asset`, or a one-line error that names the file.
Start: mesh_files.py (``load_asset``); obj.py and ply.py read polygons (polygons.py), trimesh_files.py the other kinds,
       gltf.py glTF checked by gltf_schema.py. All return triangles, which parts.py converts to meshes.
"""
