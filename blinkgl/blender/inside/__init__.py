"""Blender's side: programs that a separate process runs, and that no module imports.

In:    a folder with a job, the scene's file.
Out:   a GLB in that folder, lines of JSON.
Start: convert.py, the import; exporting.py opens and exports, baking.py evaluates and bakes, glb.py writes keys.
"""
