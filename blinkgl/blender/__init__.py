"""Blender, in a separate process.

In:    .blend, FBX, USD, Collada and Alembic files that may be invalid; programs of Blender's side.
Out:   a GLB that :mod:`blinkgl.scene.importing` reads, with lists of what was imported and what was not; answers.
Start: importing.py (``import_scene``); comparing.py compares what is played with what Blender sees; process.py runs
       Blender and ends it; inside/convert.py is what Blender runs.

Blender's Python module ``bpy`` (extra [cycles]) is GPL and requires NumPy 1. Only the programs in ``inside/`` import
it. Another interpreter runs them: they import nothing of BlinkGL, and exchange files and lines of JSON.
"""
