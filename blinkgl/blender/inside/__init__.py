"""Blender's side: programs that its own process runs, and nothing imports.

In:    a folder with a job, the scene's file.
Out:   a GLB in that folder, lines of JSON.
Start: convert.py, the import.
"""
