"""Mesh files of strangers.

In:    glTF, OBJ, PLY and STL of unknown goodness.
Out:   :class:`~blinkgl.scene.importing.mesh_files.Asset`, or one line that names the file.
Start: mesh_files.py (``load_asset``); trimesh_files.py reads obj, ply and stl, gltf.py glTF that gltf_schema.py has
       checked. Both give triangles, of which parts.py makes meshes.
"""
