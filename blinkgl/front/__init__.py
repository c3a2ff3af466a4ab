"""The front door: what ``import blinkgl`` gives a person in Python (``blinkgl/__init__.py`` has the table of names).

Comes in: plain Python values. Goes out: the same data classes and configurations that a YAML file becomes, and what the rooms make of them.
Every function here checks its arguments, names the one that is wrong, and calls a room; start with ``scenes.py``.
"""
