"""Blender's side: programs that its own process runs, and nothing imports.

In:    a folder with a job, the scene's file.
Out:   a GLB in that folder, lines of JSON.
Start: __main__.py; pipeline.py is the import, step by step.

The files find each other by their bare names, because Blender's interpreter need not have BlinkGL.
"""
