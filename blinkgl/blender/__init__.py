"""Blender, in a process of its own.

In:    .blend, FBX, USD, Collada and Alembic files of unknown goodness; programs of Blender's side.
Out:   a GLB that :mod:`blinkgl.scene.importing` reads, with what came and what could not; answers.
Start: importing.py (``import_scene``); process.py runs Blender and ends it; inside/convert.py is what Blender runs.

Blender's Python module ``bpy`` (extra [cycles]) is GPL and wants NumPy 1. Nothing imports it but the programs below
``inside/``, which another interpreter runs: they import nothing of BlinkGL, and exchange files and lines of JSON.
"""
